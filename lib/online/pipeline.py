"""The online system (paper Sec. V): every stage, frame by frame, with the duration of each stage and its failures.

It starts without a calibration, and calibrates as soon as there are enough landmarks and kinematics.  From then on each
frame is reconstructed, and its landmarks show whether the cameras moved or something else is wrong.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration import Calibration, calibrate_as_shown
from lib.cameras import StereoRig
from lib.correspondences import LANDMARKS, MIN_CONFIDENCE, Correspondences
from lib.landmarks import Landmarks, with_ground
from lib.landmarks.contrast import levelled
from lib.online.checks import FrameChecks
from lib.online.distance import Surface, TipDistance
from lib.online.result import FrameResult, Settings
from lib.online.surface_worker import Beside, SurfaceJob, make
from lib.online.tracker import RigTracker, Seen
from lib.recordings import GrowingGround
from lib.surface import Reconstruction, reconstruct

_JUMP_MM = 0.15  # surfaces that differ by more show that the eye or the cameras moved between them
_DEPTH_MARGIN_MM = 0.5  # largest motion of the eye along the view from one surface to the next


class OnlinePipeline:
    """Landmarks, calibration, drift monitor, registration, surface and distance, in one `step` per frame.

        pipeline = OnlinePipeline(Detector.load())
        for i, frame in enumerate(recording.frames):
            result = pipeline.step(frame.left, frame.right, partial(of_recording, recording, frames=[i]))

    A frame never ends the run: if a stage fails, the reason is in the result, and the other stages go on as far as they
    can.  `lib.online.STATES` has the meaning of each state.

    Args:
        detector: `lib.landmarks.Detector`, or any function of images (2, h, w, 3) uint8 RGB to `.u` (2, 3, 2), `.covariance`
            and `.confidence`.  Methods `track` and `near`, if any, follow the tool and search near the robot's report.
            The memory of the images is used again for the next frame: a detector that keeps them must copy them.
        rig: A calibration to start from, kept until the cameras move; None calibrates from the first frames.  A `StereoRig`
            has no covariance and no landmark offsets: the distances' standard deviations lack its errors, which each frame
            states as a doubt.
        noise_px: Standard deviation of a landmark's residual per coordinate, for a `rig` without a calibration.
        beside: Reconstruct surfaces in a separate process, the newest frame first; otherwise within `step`, which gives
            the same output for the same input.  Use the pipeline in a ``with`` block, which ends the process.
        calibrate, reconstruct: Replace `lib.calibration.calibrate_as_shown` and (unless `beside`) `lib.surface.reconstruct`.
    """

    def __init__(
        self, detector: Callable[[np.ndarray], Any], *, rig: StereoRig | Calibration | None = None, noise_px: float = 1.5,
        settings: Settings | None = None, beside: bool = False, calibrate: Callable[..., Calibration] = calibrate_as_shown,
        reconstruct: Callable[..., Reconstruction] = reconstruct,
    ) -> None:  # fmt: skip
        self.settings = settings or Settings()
        self._detector, self._seen, self._index = detector, None, -1
        self._tracker = RigTracker(rig, noise_px=float(noise_px), settings=self.settings, calibrate=calibrate)
        self._checks, self._tips = FrameChecks(), TipDistance(self.settings)
        self._surface: Surface | None = None
        self._surface_seen: Surface | None = None  # the newest surface when the landmarks were last in view
        self._pair: np.ndarray | None = None
        self._ground = GrowingGround()
        self._smoothness: float | None = None
        self._asked = self._most_points = self._rig_since = 0  # surfaces; most points since a full search; first frame
        self._rests_on = dict.fromkeys(("landmarks", "robot"), float("nan"))
        self._worker, self._reconstruct = Beside() if beside else None, reconstruct

    def __enter__(self) -> Self:
        if self._worker:
            self._worker.wait_ready()
        return self

    def __exit__(self, *error: object) -> None:
        if self._worker:
            self._worker.close()

    @property
    def rig(self) -> StereoRig | None:
        """The rig in use, None before the first calibration."""
        return self._tracker.rig

    @property
    def calibration(self) -> Calibration | None:
        """The calibration that `rig` comes from, None for a rig that was given."""
        return self._tracker.calibration

    def step(
        self, left: np.ndarray, right: np.ndarray, kinematics: ArrayLike | Callable | None = None, *,
        time_s: float | None = None,
    ) -> FrameResult:  # fmt: skip
        """Process one stereo frame.

        Args:
            left, right: (h, w, 3) uint8 RGB.
            kinematics: (3, 3) mm, base, tip_1, tip_2 in the robot frame at the time of the frame; NaN or None where the
                robot is silent.  Or a function that takes detections as `lib.correspondences.pair_with_robot` does, pairs
                them with the robot's positions at the instants at which their image rows were read, and returns the
                frame's Correspondences: ``partial(of_recording, recording, frames=[index])``.  Before detection it is called
                with NaN, to find out where the robot reports the tool.
            time_s: Time of the frame, video clock; None = uniform at `Settings.fps`.
        """
        self._index += 1
        time_s = self._index / self.settings.fps if time_s is None else float(time_s)
        result, tracker = FrameResult(self._index, time_s), self._tracker
        bad_images, bad_report, x_mm = "the images cannot be read", "", np.full((3, 3), np.nan)
        with result.stage("detect"):
            bad_images = self._checks.images(left, right, time_s)
            frame = None if bad_images else self._detect(left, right, kinematics)
            bad_images = bad_images or self._checks.landmarks(np.stack([frame.data.u_left, frame.data.u_right]))
            if frame is not None:
                result.landmarks = frame.data
                bad_report = self._checks.robot(frame.data)
                x_mm = x_mm if bad_report else frame.data.x_mm
                self._ground.take(self._pair, x_mm)
        if bad_images and "detect" not in result.failures:
            result.failures["images"] = bad_images
        if bad_report and kinematics is not None:
            result.failures["robot"] = bad_report
        data, seen = result.landmarks, not bad_images and bool(result.landmarks.seen.all(axis=1).any())
        self._rests_on |= {"landmarks": time_s} if seen else {}
        self._rests_on |= {"robot": self._checks.changed_s} if not bad_images and np.isfinite(x_mm).any() else {}
        before, calibration = tracker.rig, tracker.calibration
        if seen and not bad_report and data.is_complete.any():
            tracker.take(result, frame, self._checks.scene)
        self._name_state(result, bad_images, bad_report, seen)
        result.rig = tracker.rig
        if tracker.calibration is not calibration or result.motion is not None:
            self._rig_since = self._index
        if result.motion is not None:
            self._ground = GrowingGround()  # the cameras now see another part of the scene
        if tracker.rig is not before and (result.motion is not None or tracker.rig is None):
            self._tips.reset()
        if tracker.rig is not None and seen:
            with result.stage("triangulate"):
                self._tips.triangulate(result, tracker)
        self._follow_surface(result, left, right)
        recent = 0.0 <= time_s - self._rests_on["landmarks"] <= self.settings.stale_s
        if seen:
            self._surface_seen = self._surface
        elif result.state == "unseen" and self._surface_jumped():
            recent, result.cause = False, "no landmarks, and eye or cameras moved since they were seen"
        if tracker.rig is not None and (result.state in ("tracking", "robot") or (result.state == "unseen" and recent)):
            with result.stage("distance"):
                # State "robot" means that the report is late or the tool slipped, even if the frame passed its own checks.
                trusted_mm = np.full((3, 3), np.nan) if result.state == "robot" else x_mm
                self._tips.measure(result, tracker, trusted_mm, self._surface)
        surface_s = self._surface.time_s if self._surface else float("nan")
        result.rests_on = self._rests_on | {"rig": tracker.rests_on_s, "surface": surface_s}
        return result

    def _name_state(self, result: FrameResult, bad_images: str, bad_report: str, seen: bool) -> None:
        """Set state and cause of a result, from the images, the robot's report, and the agreement of the two."""
        if doubt := self._tracker.doubt:
            result.failures.setdefault("calibrate", doubt)
        if result.state == "moved":  # only this frame stands out
            return
        state, cause = self._tracker.state, self._tracker.cause
        if state in ("tracking", "robot") and self._tracker.verdict.is_red:  # more frames refute the calibration in use
            state = "calibrating"
        if state == "tracking" and self._tracker.is_unsettled(result.index):
            state, cause = "moved", "the cameras seem to move again and again: something else has changed"
        measures = state in ("tracking", "robot")
        if bad_images:
            state, cause = "blind", bad_images
        elif measures and not seen and (bad_report or state == "robot"):
            state, cause = "blind", f"no landmarks; {bad_report or cause}"
        elif measures and not seen:
            state, cause = "unseen", "no landmarks"
        elif measures and bad_report:
            state, cause = "robot", bad_report
        elif not seen:
            cause = f"no landmarks; {cause}" if cause else "no landmarks"
        result.state, result.cause = state, cause or doubt

    def _detect(self, left: np.ndarray, right: np.ndarray, kinematics: ArrayLike | Callable | None) -> Seen:
        if self._pair is None or self._pair.shape[1:] != left.shape:
            self._pair = np.empty((2, *left.shape), np.uint8)  # reused: fresh memory costs more than the copy
            self._ground = GrowingGround()
        images, previous = np.stack([left, right], out=self._pair), self._seen
        self._seen = None  # if anything fails now, the whole next frame is searched
        paired, known = self._pairing(kinematics), with_ground(self._detector, self._ground)
        follow = previous is not None and hasattr(self._detector, "track")
        guides = hasattr(self._detector, "near") and getattr(self._detector, "tool_network", True) is not None
        robot_px = self._robot_px(paired) if guides else None
        previous = self._guided(images, previous, robot_px, known) if follow else previous
        found = self._detector.track(images, previous, **known) if follow else self._detector(images, **known)
        self._seen = found = self._guided(images, found, robot_px, known)
        u = np.where(found.confidence[..., None] >= MIN_CONFIDENCE, found.u, np.nan)
        stated = {"covariance_px2": np.swapaxes(found.covariance, 0, 1), "confidence": np.transpose(found.confidence)}
        return Seen(paired(self.rig, u, **stated), partial(paired, u=u, **stated))

    def _pairing(self, kinematics: ArrayLike | Callable | None) -> Callable[..., Correspondences]:
        """A function (rig, u (2, 3, 2) px) that pairs this frame's landmarks with `kinematics`, an argument of `step`."""
        index, landmarks = np.full(len(LANDMARKS), self._index), list(range(len(LANDMARKS)))
        if not callable(kinematics):
            x_mm = np.full((3, 3), np.nan) if kinematics is None else np.array(kinematics, dtype=np.float64)
            if x_mm.shape != (3, 3):
                raise ValueError(f"kinematics: expected (3, 3) mm, one landmark a row, got {x_mm.shape}.")
            return lambda rig, u, **stated: Correspondences.of_points(x_mm, *u, frame=index, landmark=landmarks, **stated)

        def paired(rig: StereoRig | None, u: np.ndarray, **stated: np.ndarray) -> Correspondences:
            of_one = {name: values[None] for name, values in stated.items()}
            rows = kinematics(u[:1], u[1:], linear=None if rig is None else rig.linear, **of_one)
            if not isinstance(rows, Correspondences) or rows.landmark.tolist() != landmarks:
                raise ValueError("kinematics: expected a function that returns the Correspondences of one frame.")
            return replace(rows, frame=index)

        return paired

    def _guided(self, images: np.ndarray, found: Landmarks, robot_px: np.ndarray | None, known: dict) -> Landmarks:
        """`found`; images in which it is in doubt or far from `robot_px` are searched again near `robot_px`."""
        found, ground = Landmarks.join([found]), known.get("ground")  # a copy
        for differs in (False, True)[: 1 + bool(ground)]:  # the difference from the ground takes longer
            lost = [] if robot_px is None else np.flatnonzero(found.doubtful | found.away(robot_px).any(axis=1))
            if len(lost):
                shown = [levelled(images[i], ground()[i]) if differs else images[i] for i in lost]
                near = self._detector.near(np.stack(shown), robot_px[lost])
                found.put(lost[~near.doubtful], near[~near.doubtful])
        return found

    def _robot_px(self, paired: Callable[..., Correspondences]) -> np.ndarray | None:
        """(2, 3, 2) px: the robot's landmarks, projected by the rig in use; None if there is no rig or one is unknown."""
        if self.rig is None:
            return None
        n = len(LANDMARKS)
        nothing = {"covariance_px2": np.full((n, 2, 2, 2), np.nan), "confidence": np.zeros((n, 2))}
        with suppress(ValueError, TypeError):  # no positions, which the frame's failure will state, or behind a camera
            x_mm = self._tracker.corrected(paired(self.rig, np.full((2, n, 2), np.nan), **nothing)).x_mm
            return np.stack(self.rig.project(x_mm)) if np.isfinite(x_mm).all() else None
        return None

    def _surface_jumped(self) -> bool:
        """True if the newest surface lies elsewhere than the newest one when the landmarks were last in view."""
        now, before = self._surface, self._surface_seen
        if now is None or before is None or now is before:
            return False
        u, view = now.reconstruction.u, now.reconstruction.rig.left.viewing_direction
        u = u[:: len(u) // 100 + 1]
        apart = (now.reconstruction.surface(u) - before.reconstruction.surface(u)) @ view
        apart = np.abs(apart[np.isfinite(apart)])
        return not len(apart) or bool(np.median(apart) > _JUMP_MM)

    def _where_to_search(self) -> dict[str, Any]:
        """Options that limit matching to the last surface; {} in every tenth frame, for a new rig, or after few points."""
        last, self._asked = self._surface, self._asked + 1
        known = last is not None and last.index >= self._rig_since
        if not known or self._asked % 10 == 0 or len(last.reconstruction.u) < 0.6 * self._most_points:
            self._most_points = 0
            return {}
        return {"depth_range_mm": last.reconstruction.depth_range_mm(_DEPTH_MARGIN_MM), "max_epipolar_px": np.inf}

    def _follow_surface(self, result: FrameResult, left: np.ndarray, right: np.ndarray) -> None:
        """Request a surface of this frame, and take the newest that is ready."""
        tracker = self._tracker
        if self._worker and (tracker.doubted_since is not None or tracker.rig is None):
            self._worker.forget()
        if self._surface is not None and tracker.doubts(self._surface.index):
            self._surface = None  # its cameras had moved
        done, due = [], self._index % self.settings.surface_every == 0 or result.motion is not None
        if due and result.state in ("tracking", "unseen", "robot") and tracker.doubted_since is None:
            tool = tracker.corrected(result.landmarks).tool_px(tracker.rig)
            options = {"setting": self.settings.setting, "control": self.settings.control, "smoothness": self._smoothness}
            options |= {"u_landmarks": tool, "percentiles": (1, 99)} | self._where_to_search()
            job = SurfaceJob(left, right, tracker.rig, self._index, result.time_s, options)
            if self._worker:
                self._worker.submit(job)
            else:
                done = [make(job, self._reconstruct)]
        if self._worker:
            done, event = self._worker.collect()
            result.dropped = self._worker.dropped
            if event:
                result.failures["worker"] = event
        for surface in done:
            result.seconds.update(surface.seconds)  # a counter adds
            result.failures |= surface.failures
            if tracker.doubts(surface.index):
                continue
            found = surface.reconstruction
            tracker.compare(surface.epipolar_px, None if found is None else found.points.x_mm[::20])
            if found is not None:
                # The smoothness is chosen once, by held-out error, since the eye is the same in the next frame.
                self._surface, self._smoothness = surface, found.surface.fit.smoothness
                self._most_points = max(self._most_points, len(found.u))
        if self._surface is not None:
            result.reconstruction, result.reconstructed_at = self._surface.reconstruction, self._surface.index
