"""The online system (paper Sec. V): every stage, frame by frame, with the seconds of each and what failed.

    pipeline = OnlinePipeline(Detector.load())
    for i, frame in enumerate(recording.frames):
        result = pipeline.step(frame.left, frame.right, partial(of_recording, recording, frames=[i]))

It starts without a calibration.  Landmarks and kinematics accumulate until the stereo rig can be calibrated.  From then
on each frame is reconstructed, and the landmarks show whether the cameras stand where they stood.  If they do not, a few
frames of the tool tell which camera moved and how (Sec. IV-C).
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration import Calibration, OnlineCalibration, calibrate, with_offsets
from lib.cameras import StereoRig
from lib.correspondences import LANDMARKS, MIN_CONFIDENCE, Correspondences
from lib.registration import DriftMonitor, MovedCameras, identify_motion
from lib.surface import Reconstruction, reconstruct

__all__ = ["STAGES", "Detector", "FrameResult", "OnlinePipeline", "Settings"]

#: The stages whose seconds and failures a `FrameResult` names, in their order.
STAGES = ("detect", "calibrate", "register", "match", "triangulate", "surface", "distance")

_PARTS_OF_MATCHING = {"mask": "match", "refine": "match"}
_CHI2_4_MEDIAN = 3.357
# A registration convinces if the newest frames scatter less than this many times the calibration's noise.
_CONVINCING = 2.0


class Detector(Protocol):
    """`lib.landmarks.Detector`, or anything alike: `.u` (n, 3, 2), `.covariance`, `.confidence` of n images.

    If it has a method `track(images, previous)`, frames after the first are given to that.
    """

    def __call__(self, images: np.ndarray) -> Any: ...


@dataclass(frozen=True)
class Settings:
    """What a user may change.

    Attributes:
        calibration_frames: Complete frames before the first calibration, and frames after which it is not repeated.  In
            between it is repeated whenever a quarter more frames are at hand; after that each frame updates its
            moments.
        registration_frames: Frames of the tool after the cameras moved before the first registration (the paper's 3),
            and frames after which it is not refined.
        give_up_frames: Frames without a convincing registration after which the rig is calibrated afresh (someone
            turned the zoom).
        surface_every: Reconstruct the surface in every n-th frame.
        setting: "fast" or "quality", as `lib.surface.reconstruct` has it.
        control: Control points of the surface (n_x, n_y).
    """

    calibration_frames: tuple[int, int] = (8, 60)
    registration_frames: tuple[int, int] = (3, 12)
    give_up_frames: int = 8
    surface_every: int = 1
    setting: str = "fast"
    control: tuple[int, int] = (16, 12)

    def __post_init__(self) -> None:
        for name in ("calibration_frames", "registration_frames"):
            first, last = getattr(self, name)
            if not 2 <= first <= last:
                raise ValueError(f"{name}: expected 2 <= first <= last, got {(first, last)}.")
        if self.surface_every < 1 or self.give_up_frames < 1:
            raise ValueError("surface_every, give_up_frames: must be at least 1.")


def _nothing() -> Correspondences:
    """The three landmarks, none of them seen or reported."""
    missing = np.full((len(LANDMARKS), 2), np.nan)
    return Correspondences.of_points(
        np.full((len(LANDMARKS), 3), np.nan), missing, missing, landmark=range(len(LANDMARKS))
    )


@dataclass
class FrameResult:
    """What one frame told.  Arrays are NaN, objects None, where a stage did not run or failed.

    Attributes:
        index: Number of the frame since the start.
        state: "calibrating" (no rig yet), "tracking", or "moved" (the cameras moved and are not registered yet).
        landmarks: Base, tip_1 and tip_2: where the detector saw them and where the robot reports them.
        x_tool_mm: (3, 3) landmarks as the cameras triangulate them.
        rig: In force after this frame.
        reconstruction, reconstructed_at: The newest surface and its points, and the number of the frame that they are
            from.
        distance_mm: (3,) from each landmark to the surface along the view; positive = above it.
        drift: Statistic of the drift monitor, in units of its alarm threshold.
        motion: The registration made in this frame, if one was.
        seconds, failures: By stage: wall-clock seconds of what ran, reason of what failed.
    """

    index: int
    state: str = "calibrating"
    landmarks: Correspondences = field(default_factory=_nothing)
    x_tool_mm: np.ndarray = field(default_factory=lambda: np.full((3, 3), np.nan))
    rig: StereoRig | None = None
    reconstruction: Reconstruction | None = None
    reconstructed_at: int | None = None
    distance_mm: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    drift: float = 0.0
    motion: MovedCameras | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)

    @property
    def reconstructed(self) -> bool:
        """True where the surface is this frame's own."""
        return self.reconstructed_at == self.index

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage, and note its failure in place of raising it."""
        start = time.perf_counter()
        try:
            yield
        except Exception as error:  # whatever a stage dies of: the next frame comes in 40 ms
            self.failures[name] = f"{type(error).__name__}: {error}"
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


@dataclass(frozen=True)
class _Frame:
    """Landmarks of a frame, and how to pair them with the robot by another rig, which moves pixels to one instant."""

    data: Correspondences
    pair: Callable[[StereoRig | None], Correspondences]


class OnlinePipeline:
    """Landmarks, calibration, drift and registration, reconstruction and distance, one `step` a frame.

    A frame never ends the run: a stage that fails leaves its reason in the result, and the others go on as far as they
    can.

    Args:
        detector: Images (2, h, w, 3) uint8 RGB to landmarks.
        rig: A rig or a calibration to start from, which is kept until the cameras move; None calibrates from the first
            frames.
        noise_px: Standard deviation of a landmark's residual per coordinate, for a `rig` that is no calibration.
        calibrate, reconstruct: Replace `lib.calibration.calibrate` and `lib.surface.reconstruct`.

    Attributes:
        rig: In force now, None before the first calibration.
        calibration: That `rig` comes from, None for a rig that was given.
        state: As in `FrameResult`.
    """

    def __init__(
        self,
        detector: Detector,
        *,
        rig: StereoRig | Calibration | None = None,
        noise_px: float = 1.5,
        settings: Settings | None = None,
        calibrate: Callable[..., Calibration] = calibrate,
        reconstruct: Callable[..., Reconstruction] = reconstruct,
    ) -> None:
        self.settings = settings or Settings()
        self._detector, self._calibrate, self._reconstruct = detector, calibrate, reconstruct
        self._given, self._noise_px = rig is not None, float(noise_px)
        self._index, self._seen = -1, None
        self._start_again([])
        if isinstance(rig, StereoRig):
            self._use(rig, None)
        elif rig is not None:
            self._use(rig.rig, rig)

    def step(self, left: np.ndarray, right: np.ndarray, kinematics: ArrayLike | Callable | None = None) -> FrameResult:
        """Take in one stereo frame.

        Args:
            left, right: (h, w, 3) uint8 RGB.
            kinematics: (3, 3) mm, base, tip_1, tip_2 in the robot frame at the time of the frame; NaN or None where the
                robot said nothing.  Or a function that pairs the detections with the robot's positions at the instants
                at which their rows were read, given as to `lib.correspondences.pair_with_robot`, and returns the
                frame's Correspondences: ``partial(of_recording, recording, frames=[index])``.
        """
        self._index += 1
        result, accepted = FrameResult(self._index), []
        with result.stage("detect"):
            frame = self._detect(left, right, kinematics)
            result.landmarks = frame.data
        data = result.landmarks
        if data.is_complete.any():
            if self.rig is None:
                accepted = [frame]
            else:
                with result.stage("register"):
                    accepted = self._watch(result, frame)
        if self._takes_in(accepted):
            with result.stage("calibrate"):
                self._improve_rig(accepted)
        result.state, result.rig = self.state, self.rig
        if self.rig is not None:
            with result.stage("triangulate"):
                result.x_tool_mm = self.rig.triangulate(data.u_left, data.u_right).x_mm
        due = self._index % self.settings.surface_every == 0
        if due and self.state == "tracking" and "detect" not in result.failures:
            self._fit_surface(result, left, right)
        result.reconstruction, result.reconstructed_at = self._surface, self._surface_at
        if self._surface is not None:
            with result.stage("distance"):
                x = np.where(np.isfinite(data.x_mm), data.x_mm, result.x_tool_mm)
                result.distance_mm = self._surface.surface.distance(x, self._surface.rig.left).along_view_mm
        return result

    def _detect(self, left: np.ndarray, right: np.ndarray, kinematics: ArrayLike | Callable | None) -> _Frame:
        left, right = np.asarray(left), np.asarray(right)
        if left.ndim != 3 or left.shape[2] != 3 or left.dtype != np.uint8 or right.shape != left.shape:
            raise ValueError(f"left, right: expected two (h, w, 3) uint8 images, got {left.shape} and {right.shape}.")
        images, previous = np.stack([left, right]), self._seen
        self._seen = None  # whatever fails now, the next frame is searched as a whole
        follow = previous is not None and hasattr(self._detector, "track")
        found = self._detector.track(images, previous) if follow else self._detector(images)
        self._seen = found
        u = np.where(found.confidence[..., None] >= MIN_CONFIDENCE, found.u, np.nan)
        stated = {"covariance_px2": np.swapaxes(found.covariance, 0, 1), "confidence": np.transpose(found.confidence)}
        index = np.full(len(LANDMARKS), self._index)
        if callable(kinematics):

            def pair(rig: StereoRig | None) -> Correspondences:
                linear = None if rig is None else rig.linear
                rows = kinematics(
                    u[:1], u[1:], linear=linear, **{name: values[None] for name, values in stated.items()}
                )
                if not isinstance(rows, Correspondences) or rows.landmark.tolist() != list(range(len(LANDMARKS))):
                    raise ValueError("kinematics: expected a function that returns the Correspondences of one frame.")
                return replace(rows, frame=index)

            return _Frame(pair(self.rig), pair)
        x = np.full((3, 3), np.nan) if kinematics is None else np.array(kinematics, dtype=np.float64)
        if x.shape != (3, 3):
            raise ValueError(f"kinematics: expected (3, 3) mm, one landmark a row, got {x.shape}.")
        data = Correspondences.of_points(x, *u, frame=index, landmark=range(len(LANDMARKS)), **stated)
        return _Frame(data, lambda rig: data)

    # --- the rig -----------------------------------------------------------------------------------------------------

    def _start_again(self, frames: list[_Frame]) -> None:
        """Without a rig: at first, and where the optics changed, not only the pose."""
        self.rig, self.calibration, self.state = None, None, "calibrating"
        self._frames = frames  # that the rig is calibrated with; no more are added once the cameras moved
        self._calibrated = 0  # how many of them it was calibrated with
        self._moments: OnlineCalibration | None = None  # take the frames after the last calibration
        self._monitor: DriftMonitor | None = None
        self._since: list[_Frame] = []  # frames since the monitor last saw nothing unusual
        self._before: StereoRig | None = None  # the rig before the cameras moved, while they are being registered
        self._motion: MovedCameras | None = None
        self._waiting = 0
        self._surface, self._surface_at, self._smoothness = None, None, None

    def _use(self, rig: StereoRig, calibration: Calibration | None) -> None:
        self.rig, self.calibration, self.state = rig, calibration, "tracking"
        self._monitor = DriftMonitor(rig, covariance_px2=self._noise_px**2, sigma_x_mm=0.0)
        self._scale2 = 1.0
        if calibration is not None:
            both = calibration.view_inliers[calibration.inliers].all(axis=1)
            _, _, weight, r = calibration.system
            weight, r = weight if len(weight) == 1 else weight[both], r[both]
            scatter = (
                np.median(np.einsum("ni,nij,nj->n", r, np.broadcast_to(weight, (len(r), 4, 4)), r)) / _CHI2_4_MEDIAN
            )
            # Corrected for the 16 parameters that the residuals have paid for, and the upper end of what so few allow.
            self._scale2 = scatter / (1.0 - 16.0 / max(r.size, 17)) * (1.0 + 1.0 / np.sqrt(len(r))) ** 2

    def _takes_in(self, accepted: list[_Frame]) -> bool:
        """As soon as possible, then whenever a quarter more frames are at hand; never again once the cameras moved."""
        first, last = self.settings.calibration_frames
        if self._given or self._motion is not None or self._moments is not None:
            return self._moments is not None and bool(accepted) and self._motion is None
        self._frames += accepted
        n = len(self._frames)
        return n >= first if self.rig is None else n > last or n >= 1.25 * self._calibrated

    def _improve_rig(self, accepted: list[_Frame]) -> None:
        """Calibrate with all frames so far; after the last calibration let each frame update its moments."""
        if self.rig is not None and len(self._frames) > self.settings.calibration_frames[1]:
            if self._moments is None:
                known, rows = self.calibration, self.calibration.view_inliers.all(axis=1)
                self._moments = OnlineCalibration(sigma_u_px=known.sigma_u_px, sigma_x_mm=known.sigma_x_mm)
                self._moments.add(known.x_mm[rows], known.y_px[rows, :2], known.y_px[rows, 2:])
                accepted = self._frames[self._calibrated :]
            for frame in accepted:
                data = self._corrected(frame.data)
                self._moments.add(data.x_mm, data.u_left, data.u_right)
            self.rig = self._moments.solve()
            self._monitor.reset(self.rig)
            return
        try:
            found = self._calibrate(Correspondences.join(frame.pair(self.rig) for frame in self._frames))
        except Exception:
            # One bad frame must not stand in the way for good: forget the newest, or the older half of the first ones.
            n = len(self._frames)
            if self.rig is not None:
                self._frames = self._frames[: self._calibrated]
            elif n >= 2 * self.settings.calibration_frames[0]:
                self._frames = self._frames[n // 2 :]
            raise
        self._calibrated = len(self._frames)
        self._use(found.rig, found)

    def _watch(self, result: FrameResult, frame: _Frame) -> list[_Frame]:
        """Do the cameras still stand where they stood?  If not, where now?  Returns frames that may improve the rig."""
        accepted: list[_Frame] = []
        self._since.append(frame)
        if self.state == "tracking":
            data = self._corrected(frame.data)
            alarm = self._monitor.update(data, covariance_px2=self._residual_covariance(data))
            result.drift = self._monitor.statistic / self._monitor.threshold
            if alarm:
                self.state, self._before, self._waiting = "moved", self._before or self.rig, 0
            elif self._before is None and self._monitor.statistic == 0.0:
                accepted, self._since = self._since, []  # all is well
        first, last = self.settings.registration_frames
        if self._before is not None and len(self._since) >= first:
            self._register(result)
            if self.state == "tracking" and len(self._since) >= last:
                self._before, self._since = None, []
        return accepted

    def _register(self, result: FrameResult) -> None:
        """Which camera moved, and how, from the frames since; convinced only if the newest frames agree."""
        newest = self._since[-self.settings.registration_frames[0] :]
        data, last = (
            self._corrected(Correspondences.join(frame.data for frame in frames)) for frames in (self._since, newest)
        )
        try:
            found = identify_motion(self._before, data, covariance_px2=self._noise(data))
            last = last.complete
            residual = np.hstack([last.u_left, last.u_right]) - np.hstack(found.rig.project(last.x_mm))
            chi2 = np.einsum("ni,ni->n", residual, np.linalg.solve(self._noise(last), residual[:, :, None])[:, :, 0])
            misfit = np.sqrt(np.median(chi2) / _CHI2_4_MEDIAN)
            if not misfit <= _CONVINCING:
                raise ValueError(f"no motion explains the newest frames ({misfit:.1f} times the calibration's noise).")
        except ValueError:
            self.state = "moved"
            self._since = newest[1:]  # the oldest may be from before, or from during the motion
            self._waiting += 1
            if self._waiting > self.settings.give_up_frames:
                self._given = False
                self._start_again(self._since)
            raise
        self.rig, self.state, result.motion = found.rig, "tracking", found
        self._monitor.reset(found.rig)
        if found.moved == "none":
            self._before, self._since = None, []
        else:
            self._motion = found

    def _corrected(self, data: Correspondences) -> Correspondences:
        """With the landmarks where the detector sees them on the tool."""
        return with_offsets(data, None if self.calibration is None else self.calibration.offsets)

    def _noise(self, data: Correspondences) -> np.ndarray:
        """(n, 4, 4) px^2 of landmarks' residuals: of the detections, and of the robot's report."""
        known = self.calibration
        if known is None:
            return np.tile(self._noise_px**2 * np.eye(4), (len(data), 1, 1))
        own = data.pair_covariance_px2
        if known.covariance_px2 is None or not np.isfinite(own[data.is_complete]).all():
            own = np.broadcast_to(known.noise_px2, own.shape)
        A = self.rig.linear
        return self._scale2 * (np.where(np.isfinite(own), own, known.noise_px2) + known.sigma_x_mm**2 * A @ A.T)

    def _residual_covariance(self, data: Correspondences) -> np.ndarray:
        """(n, 4, 4) px^2: the noise, and by how much the rig is uncertain where these landmarks are."""
        covariance = self._noise(data)
        moved = self._motion
        left, right = (None, None) if moved is None else (moved.left, moved.right)
        for motion, rows in ((left, slice(0, 2)), (right, slice(2, 4))):
            stale = data.x_mm if motion is None else motion.transform.inverse().apply(data.x_mm)
            if self.calibration is not None:
                covariance[:, rows, rows] += self.calibration.projection_covariance(stale)[:, rows, rows]
            if motion is not None:
                A = self.rig.linear[rows]
                covariance[:, rows, rows] += A @ motion.covariance_at(stale) @ A.T
        return covariance

    # --- the surface --------------------------------------------------------------------------------------------------

    def _fit_surface(self, result: FrameResult, left: np.ndarray, right: np.ndarray) -> None:
        seconds: dict[str, float] = {}
        try:
            self._surface = self._reconstruct(
                left,
                right,
                self.rig,
                setting=self.settings.setting,
                u_landmarks=(result.landmarks.u_left, result.landmarks.u_right),
                percentiles=(1, 99),
                control=self.settings.control,
                smoothness=self._smoothness,
                seconds=seconds,
            )
            self._surface_at = self._index
            # Chosen by held-out error once: the eye is the same in the next frame.
            self._smoothness = self._surface.surface.fit.smoothness
        except Exception as error:  # as in `FrameResult.stage`
            stage = next(reversed(seconds), "match")
            result.failures[_PARTS_OF_MATCHING.get(stage, stage)] = f"{type(error).__name__}: {error}"
        for part, spent in seconds.items():
            stage = _PARTS_OF_MATCHING.get(part, part)
            result.seconds[stage] = result.seconds.get(stage, 0.0) + spent
