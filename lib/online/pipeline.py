"""The online system (paper Sec. V): every stage, frame by frame, with the seconds of each and what failed.

    pipeline = OnlinePipeline(Detector.load())
    for frame, x_mm in zip(recording.frames, recording.landmarks_mm()):
        result = pipeline.step(frame.left, frame.right, x_mm)

It starts without any calibration: landmarks and kinematics accumulate until the stereo rig can be calibrated; from then
on each frame is matched, triangulated and fitted, and the landmarks watch whether the cameras still stand where they
stood.  When they do not, a few frames of the tool tell which camera moved and how (Sec. IV-C).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import AffineCamera, Points, StereoRig
from lib.matching.masks import glint_mask, tool_mask
from lib.registration import DriftMonitor, MovedCameras, identify_motion

__all__ = ["STAGES", "FrameResult", "OnlinePipeline", "Settings", "errors_against_truth"]

#: The stages whose seconds and failures a `FrameResult` names, in their order.
STAGES = ("detect", "calibrate", "register", "match", "triangulate", "surface", "distance")

_CHI2_4_MEDIAN = 3.357
# A registration convinces if the newest frames scatter less than this many times the calibration's noise.
_CONVINCING = 2.0


class Detector(Protocol):
    """`lib.landmarks.Detector`, or anything that looks like it from here."""

    def __call__(self, images: np.ndarray) -> Any: ...


@dataclass(frozen=True)
class Settings:
    """What a user may turn.

    Attributes
    ----------
    min_confidence:
        Detections below count as missing.
    calibration_frames:
        Complete frames before the first calibration, and frames after which it is left alone.  In between it is
        repeated whenever a quarter more frames are at hand.
    ransac_px:
        Bound of the calibration's outlier rejection; None judges by the noise that it measures.
    robot_accuracy_mm:
        Standard deviation of the robot's report, per coordinate.
    registration_frames:
        Frames of the tool after the cameras moved before the first registration (the paper's 3), and frames after which
        it is no longer refined.
    give_up_frames:
        Frames without a convincing registration after which the rig is calibrated afresh (someone turned the zoom).
    surface_every:
        Match and fit the surface in every n-th frame.
    matching:
        "fast" or "quality", as `lib.matching.match` has it.
    epipolar_px:
        Matches further from the epipolar constraint are dropped before triangulation.
    control:
        Control points of the surface (n_x, n_y).
    """

    min_confidence: float = 0.2
    calibration_frames: tuple[int, int] = (8, 60)
    ransac_px: float | None = None
    robot_accuracy_mm: float = 0.010
    registration_frames: tuple[int, int] = (3, 12)
    give_up_frames: int = 8
    surface_every: int = 1
    matching: str = "fast"
    epipolar_px: float = 2.0
    control: tuple[int, int] = (16, 12)

    def __post_init__(self) -> None:
        for name in ("calibration_frames", "registration_frames"):
            first, last = getattr(self, name)
            if not 2 <= first <= last:
                raise ValueError(f"{name}: expected 2 <= first <= last, got {(first, last)}.")
        if self.surface_every < 1 or self.give_up_frames < 1:
            raise ValueError("surface_every, give_up_frames: must be at least 1.")


@dataclass
class FrameResult:
    """What one frame told.  Arrays are NaN, objects None, where a stage did not run or failed.

    Attributes
    ----------
    index:
        Number of the frame since the start.
    state:
        "calibrating" (no rig yet), "tracking", or "moved" (the cameras moved and are not registered yet).
    u_left, u_right, confidence:
        Detected landmarks (3, 2) px, and (2, 3) confidence of left and right.
    x_robot_mm, x_tool_mm:
        (3, 3) landmarks as the robot reports and as the cameras triangulate them.
    rig, surface, surface_camera:
        In force after this frame; the surface may be of an earlier frame, and is parametrised by the left image of
        `surface_camera`.
    points, u_points:
        Triangulated matches of this frame, and their left pixels (n, 2).
    distance_mm:
        (3,) from each landmark to the surface along the view; positive = above it.
    drift:
        Statistic of the drift monitor, in units of its alarm threshold.
    motion:
        The registration made in this frame, if one was.
    seconds, failures:
        By stage: wall-clock seconds of what ran, reason of what failed.
    """

    index: int
    state: str = "calibrating"
    u_left: np.ndarray = field(default_factory=lambda: np.full((3, 2), np.nan))
    u_right: np.ndarray = field(default_factory=lambda: np.full((3, 2), np.nan))
    confidence: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))
    x_robot_mm: np.ndarray = field(default_factory=lambda: np.full((3, 3), np.nan))
    x_tool_mm: np.ndarray = field(default_factory=lambda: np.full((3, 3), np.nan))
    rig: StereoRig | None = None
    points: Points | None = None
    u_points: np.ndarray | None = None
    surface: Callable | None = None
    surface_camera: AffineCamera | None = None
    distance_mm: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    drift: float = 0.0
    motion: MovedCameras | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Seen:
    """One frame's correspondences: x (3, 3) mm, u_left and u_right (3, 2) px, NaN rows where incomplete."""

    x_mm: np.ndarray
    u_left: np.ndarray
    u_right: np.ndarray

    @property
    def complete(self) -> np.ndarray:
        return np.isfinite(np.hstack([self.x_mm, self.u_left, self.u_right])).all(axis=1)


def _stack(frames: list[_Seen]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Complete correspondences of several frames: x (n, 3), u_left (n, 2), u_right (n, 2)."""
    parts = [(f.x_mm[f.complete], f.u_left[f.complete], f.u_right[f.complete]) for f in frames]
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


class OnlinePipeline:
    """Landmarks, calibration, drift and registration, matching, surface and distance, one `step` a frame.

    A frame never ends the run: a stage that fails leaves its reason in the result, and the others go on as far as they
    can.

    Parameters
    ----------
    detector:
        Images (2, h, w, 3) uint8 RGB to landmarks with `.u` (2, 3, 2) and `.confidence` (2, 3).
    rig:
        A calibration to start from; None calibrates from the first frames.
    calibrate, match, fit_surface:
        Replace `lib.calibration.calibrate`, `lib.matching.match` and `lib.surface.fit_surface`.

    Attributes
    ----------
    rig:
        In force now, None before the first calibration.
    state:
        As in `FrameResult`.
    noise_px:
        Standard deviation of a landmark's residual per coordinate, as the calibration left it.
    """

    def __init__(
        self,
        detector: Detector,
        *,
        rig: StereoRig | None = None,
        noise_px: float = 1.5,
        settings: Settings | None = None,
        calibrate: Callable | None = None,
        match: Callable | None = None,
        fit_surface: Callable | None = None,
    ) -> None:
        if calibrate is None:
            from lib.calibration import calibrate
        if match is None:
            from lib.matching import match
        if fit_surface is None:
            from lib.surface import fit_surface
        self.settings = settings or Settings()
        self._detector, self._calibrate, self._match, self._fit_surface = detector, calibrate, match, fit_surface
        self.rig, self.noise_px = rig, float(noise_px)
        self.state = "calibrating" if rig is None else "tracking"
        self._index = -1
        self._calibration = None if rig is None else _Support.exact()
        self._frames: list[_Seen] = []  # that the rig is calibrated with; no more are added once the cameras moved
        self._monitor = None if rig is None else DriftMonitor(rig, covariance_px2=self.noise_px**2, sigma_x_mm=0.0)
        self._since: list[_Seen] = []  # since the monitor last saw nothing unusual
        self._before: StereoRig | None = None  # the rig before the cameras moved, while they are being registered
        self._motion: MovedCameras | None = None
        self._waiting = 0
        self._surface, self._surface_camera, self._smoothness = None, None, None

    def step(self, left: np.ndarray, right: np.ndarray, kinematics: ArrayLike | Callable | None = None) -> FrameResult:
        """Take in one stereo frame.

        Parameters
        ----------
        left, right:
            (h, w, 3) uint8 RGB.
        kinematics:
            (3, 3) mm, base, tip_1, tip_2 in the robot frame at the time of the frame; NaN or None where the robot said
            nothing.  Or a function of the detected left pixels (3, 2) that returns it, such as
            ``functools.partial(recording.landmarks_at, index)``: with a rolling shutter each row has its own time.
        """
        self._index += 1
        result = FrameResult(self._index)
        with self._stage(result, "detect"):
            self._detect(result, left, right, kinematics)
        seen = _Seen(result.x_robot_mm, result.u_left, result.u_right)
        if self.rig is not None and seen.complete.any():
            with self._stage(result, "register"):
                self._watch(result, seen)
        elif seen.complete.any():
            self._frames.append(seen)
        if self._calibration_due():
            with self._stage(result, "calibrate"):
                self._calibrate_rig()
        result.state, result.rig = self.state, self.rig
        if self.rig is not None:
            with self._stage(result, "triangulate"):
                result.x_tool_mm = self.rig.triangulate(result.u_left, result.u_right).x_mm
        if (
            self.state == "tracking"
            and "detect" not in result.failures
            and self._index % self.settings.surface_every == 0
        ):
            self._reconstruct(result, left, right)
        result.surface, result.surface_camera = self._surface, self._surface_camera
        if self._surface is not None:
            with self._stage(result, "distance"):
                x = np.where(np.isfinite(result.x_robot_mm), result.x_robot_mm, result.x_tool_mm)
                result.distance_mm = self._surface.distance(x, self._surface_camera).along_view_mm
        return result

    @contextmanager
    def _stage(self, result: FrameResult, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        except Exception as error:  # whatever a stage dies of: the next frame comes in 40 ms
            result.failures[name] = f"{type(error).__name__}: {error}"
        finally:
            result.seconds[name] = result.seconds.get(name, 0.0) + time.perf_counter() - start

    def _detect(self, result: FrameResult, left: np.ndarray, right: np.ndarray, kinematics) -> None:
        left, right = np.asarray(left), np.asarray(right)
        if left.ndim != 3 or left.shape[2] != 3 or left.dtype != np.uint8 or right.shape != left.shape:
            raise ValueError(f"left, right: expected two (h, w, 3) uint8 images, got {left.shape} and {right.shape}.")
        landmarks = self._detector(np.stack([left, right]))
        confidence = np.asarray(landmarks.confidence, dtype=np.float64)
        u = np.where(confidence[..., None] >= self.settings.min_confidence, landmarks.u, np.nan)
        if kinematics is not None:
            x = np.asarray(kinematics(u[0]) if callable(kinematics) else kinematics, dtype=np.float64)
            if x.shape != (3, 3):
                raise ValueError(f"kinematics: expected (3, 3) mm, one landmark a row, got {x.shape}.")
            result.x_robot_mm = np.where(np.isfinite(x).all(axis=1, keepdims=True), x, np.nan)
        result.u_left, result.u_right, result.confidence = u[0], u[1], confidence

    # --- the rig -----------------------------------------------------------------------------------------------------

    def _calibration_due(self) -> bool:
        """As soon as possible, then whenever a quarter more frames are at hand; never again once the cameras moved."""
        first, last = self.settings.calibration_frames
        n = len(self._frames)
        if self._calibration is None:
            return n >= first
        return self._motion is None and n <= last and n >= 1.25 * self._calibration.n_frames

    def _calibrate_rig(self) -> None:
        x, u_left, u_right = _stack(self._frames)
        self.rig = self._calibrate(x, [u_left, u_right], ransac_px=self.settings.ransac_px).rig
        residual = np.hstack([u_left, u_right]) - np.hstack(self.rig.project(x))
        # Robust, and corrected for the 16 parameters that the residuals have paid for.
        unpaid = 1.0 - 16.0 / max(residual.size, 17)
        self.noise_px = float(np.sqrt(np.median((residual**2).sum(axis=1)) / _CHI2_4_MEDIAN / unpaid))
        # So few residuals may flatter: the monitor works with the upper end of what they allow.
        self.noise_px *= 1.0 + 1.0 / np.sqrt(len(x))
        self._calibration = _Support.of(x, len(self._frames))
        self._monitor = DriftMonitor(self.rig, covariance_px2=self.noise_px**2, sigma_x_mm=0.0)
        if self.state == "calibrating":
            self.state = "tracking"

    def _watch(self, result: FrameResult, seen: _Seen) -> None:
        """Do the cameras still stand where they stood?  If not, where now?"""
        self._since.append(seen)
        if self.state == "tracking":
            alarm = self._monitor.update(*_stack([seen]), self._residual_covariance(_stack([seen])[0]))
            result.drift = self._monitor.statistic / self._monitor.threshold
            if alarm:
                self.state, self._before, self._waiting = "moved", self._before or self.rig, 0
            elif self._before is None and self._monitor.statistic == 0.0:
                if self._motion is None:
                    self._frames += self._since  # all is well: these frames make the calibration better
                self._since = []
        first, last = self.settings.registration_frames
        if self._before is not None and len(self._since) >= first:
            self._register(result)
            if self.state == "tracking" and len(self._since) >= last:
                self._before, self._since = None, []

    def _register(self, result: FrameResult) -> None:
        """Which camera moved, and how, from the frames since; convinced only if the newest frames agree."""
        newest = self._since[-self.settings.registration_frames[0] :]
        try:
            found = identify_motion(self._before, *_stack(self._since), covariance_px2=self.noise_px**2)
            x, u_left, u_right = _stack(newest)
            residual = np.hstack([u_left, u_right]) - np.hstack(found.rig.project(x))
            misfit = np.sqrt(np.median((residual**2).sum(axis=1)) / _CHI2_4_MEDIAN) / self.noise_px
            if not misfit <= _CONVINCING:
                raise ValueError(f"no motion explains the newest frames ({misfit:.1f} times the calibration's noise).")
        except ValueError:
            self.state = "moved"
            self._since = newest[1:]  # the oldest may be from before, or from during the motion
            self._waiting += 1
            if self._waiting > self.settings.give_up_frames:
                self._start_again()
            raise
        self.rig, self.state, result.motion = found.rig, "tracking", found
        self._monitor.reset(found.rig)
        if found.moved == "none":
            self._before, self._since = None, []
        else:
            self._motion = found

    def _start_again(self) -> None:
        """The optics changed, not only the pose: calibrate afresh."""
        self.rig = self._calibration = self._monitor = self._before = self._motion = None
        self._frames, self._since, self.state = self._since, [], "calibrating"
        self._surface = self._surface_camera = None

    def _residual_covariance(self, x: np.ndarray) -> np.ndarray:
        """(n, 4, 4) px^2 of landmarks' residuals: their own noise, and what the rig is uncertain by there."""
        moved = self._motion
        left, right = (None, None) if moved is None else (moved.left, moved.right)
        covariance = np.tile(self.noise_px**2 * np.eye(4), (len(x), 1, 1))
        stale = []
        for motion, rows in ((left, slice(0, 2)), (right, slice(2, 4))):
            stale.append(x if motion is None else motion.transform.inverse().apply(x))
            if motion is not None:
                A = self.rig.linear[rows]
                covariance[:, rows, rows] += A @ motion.covariance_at(stale[-1]) @ A.T
        leverage = np.maximum(*(self._calibration.leverage(points) for points in stale))
        return covariance * (1.0 + leverage)[:, None, None]

    # --- the surface --------------------------------------------------------------------------------------------------

    def _reconstruct(self, result: FrameResult, left: np.ndarray, right: np.ndarray) -> None:
        with self._stage(result, "match"):
            masks = [
                glint_mask(image) | tool_mask(image.shape[:2], u)
                for image, u in ((left, result.u_left), (right, result.u_right))
            ]
            options = {"mask_left": masks[0], "mask_right": masks[1], "setting": self.settings.matching}
            matches = self._match(left, right, rig=self.rig, **options)
            # The mask that a matcher is given is about patches; this one is about points.
            column, row = np.rint(matches.u_left).astype(int).T
            good = ~masks[0][np.clip(row, 0, left.shape[0] - 1), np.clip(column, 0, left.shape[1] - 1)]
            good &= np.abs(self.rig.epipolar_distance(matches.u_left, matches.u_right)) <= self.settings.epipolar_px
        if "match" in result.failures:
            return
        with self._stage(result, "triangulate"):
            u, covariance = matches.u_left[good], matches.covariance_px2[good]
            result.points, result.u_points = self.rig.triangulate(u, matches.u_right[good], covariance), u
        if "triangulate" in result.failures:
            return
        with self._stage(result, "surface"):
            low, high = np.percentile(u, [1, 99], axis=0)
            surface = self._fit_surface(
                u,
                result.points.x_mm,
                domain=(*low, *high),
                control=self.settings.control,
                smoothness=self._smoothness,
                camera=self.rig.left,
            )
            self._surface, self._surface_camera = surface, self.rig.left
            # Chosen by held-out error once: the eye is the same in the next frame.
            self._smoothness = getattr(getattr(surface, "fit", None), "smoothness", None)


@dataclass(frozen=True)
class _Support:
    """Where a rig was calibrated: its predictions are less certain away from there."""

    centre_mm: np.ndarray
    information: np.ndarray
    n: int
    n_frames: float

    @classmethod
    def of(cls, x: np.ndarray, n_frames: int) -> _Support:
        centre = x.mean(axis=0)
        return cls(centre, np.linalg.pinv((x - centre).T @ (x - centre), hermitian=True), len(x), n_frames)

    @classmethod
    def exact(cls) -> _Support:
        """Of a rig that was given: certain everywhere, and not to be calibrated again."""
        return cls(np.zeros(3), np.zeros((3, 3)), 0, np.inf)

    def leverage(self, x: np.ndarray) -> np.ndarray:
        """(n,) variance of the prediction in units of one observation's (Cook and Weisberg 1982)."""
        offset = x - self.centre_mm
        return (1.0 / self.n if self.n else 0.0) + np.einsum("ni,ij,nj->n", offset, self.information, offset)


def errors_against_truth(
    results: list[FrameResult], truth: Any, rigs: list[StereoRig] | None = None
) -> dict[str, np.ndarray]:
    """How wrong each frame was, in mm, (n,) each, NaN where there was nothing yet.  For evaluation only.

    Parameters
    ----------
    results:
        Of frames 0, 1, ... of a simulated recording.
    truth:
        Its `lib.recordings.Truth`.
    rigs:
        The true rig in each frame where the cameras moved; None = the recording's throughout.

    Returns
    -------
    dict
        "rig": RMS error of triangulating, with the frame's rig, exact pixels of the tool's positions in the recording.
        "surface": RMS distance along the view of the surface fitted in this frame to the true one, on a lattice of
        pixels.  "distance": largest error of a landmark's distance to the surface.
    """
    workspace = truth.landmarks_mm.reshape(-1, 3)
    errors = {name: np.full(len(results), np.nan) for name in ("rig", "surface", "distance")}
    for i, result in enumerate(results):
        rig = truth.rig if rigs is None else rigs[i]
        view = truth.rig.left.viewing_direction
        if result.rig is not None:
            off = result.rig.triangulate(*rig.project(workspace)).x_mm - workspace
            errors["rig"][i] = np.sqrt(np.mean((off**2).sum(axis=1)))
        if result.surface is None:
            continue
        if result.points is not None:
            x0, y0, x1, y1 = result.surface.grid.domain
            lattice = np.stack(np.meshgrid(np.linspace(x0, x1, 40), np.linspace(y0, y1, 30)), axis=-1).reshape(-1, 2)
            # The truth is known by the pixels of the cameras that did not move.
            x = result.surface(lattice)
            off = (x - truth.surface(truth.rig.left.project(x))) @ view
            errors["surface"][i] = np.sqrt(np.nanmean(off**2))
        # As imaged: a rolling shutter sees each landmark at its own time.
        x = truth.rig.triangulate(truth.u_left[i], truth.u_right[i]).x_mm
        true_distance = (truth.surface(truth.rig.left.project(x)) - x) @ view
        off = np.abs(result.distance_mm - true_distance)
        errors["distance"][i] = np.nanmax(off) if np.isfinite(off).any() else np.nan
    return errors
