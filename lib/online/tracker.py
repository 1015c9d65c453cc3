"""The rig in use: calibrated from the first frames, tested in each frame, and registered again after a motion."""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lib.calibration import Calibration, LandmarkOffsets, OnlineCalibration, with_offsets
from lib.calibration.offsets import OWN_BIAS, robots_part, rows_axes
from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.online.causes import CONVINCING, explain, misfit
from lib.online.result import FrameResult, Settings
from lib.recordings import Scene
from lib.registration import DriftMonitor, MovedCameras
from lib.trust import LEVELS, Reason, Verdict, judge
from lib.trust.optics import handedness

_CHI2_4_MEDIAN = 3.357
_STANDS_OUT = 8.0  # score above which a single frame is rejected
_FAR_MM = 200.0  # no tool reaches farther from the robot's median position
#: A scene that shifts by less stands still.  Then no motion of the cameras shifts landmarks by more than 1 px + 3 times that.
_STILL_PX, _NOISE_PX, _TIMES = 3.0, 1.0, 3.0
_PATIENT = 5  # factor on `Settings.give_up_frames` while the scene stands still
_PAST = 40  # frames kept to find a late report
_UNCALIBRATED = Reason(
    "no_covariance", LEVELS[1], "The cameras were given without a calibration; no standard deviation contains their errors.",
    "Give the Calibration that `lib.calibration.calibrate` returns.",
)  # fmt: skip
#: Cameras are doubted if matches of the scene lie farther from their epipolar lines than this, px, and than so many standard
#: deviations of the cameras; the median distance that the matches' own noise causes.
_OFF_LINES, _MATCHES_PX = (1.0, 3.0), 0.2
_OFF_LINES_REASON = Reason(
    "epipolar", LEVELS[1], "The scene's matches lie farther off the epipolar lines than the cameras' covariance explains.",
    "The detector may err on this tool or light; see `python3 -m lib check RECORDING`.",
)  # fmt: skip
_AGAIN = 30  # frames after a registration in which no microscope moves again; a new motion refutes the registration


@dataclass(frozen=True)
class Seen:
    """The landmarks of a frame, three rows; and a function that pairs them with the robot, given a rig for the shutter."""

    data: Correspondences
    pair: Callable[[StereoRig | None], Correspondences]


class RigTracker:
    """The rig in use, and whether images and robot still agree with it.

    `rig`, `calibration`, `state` and `cause` are as in `OnlinePipeline` and `FrameResult`, `rests_on_s` is the time of the
    newest frame used for the rig, and `doubted_since` the number of the first frame that disagreed with it, or None.
    `verdict` judges the newest calibration, even if it was refused and `rig` is an older one.
    """

    def __init__(
        self, rig: StereoRig | Calibration | None, *, noise_px: float, settings: Settings,
        calibrate: Callable[..., Calibration],
    ) -> None:  # fmt: skip
        self.settings, self._calibrate, self._noise_px = settings, calibrate, noise_px
        self._start_again([])
        self._given = rig is not None
        if rig is not None:
            self._use(rig)
            self.verdict = Verdict(() if self.calibration else (_UNCALIBRATED,))

    def _start_again(self, frames: Sequence[Seen], cause: str = "") -> None:
        """Drop the rig: at the start, and when the images show other optics or nothing explains them."""
        self.rig, self.calibration, self.state, self.cause = None, None, "calibrating", cause
        self._given = False  # True while a rig that the user gave is in use, which no calibration replaces
        self.verdict = Verdict()
        # By how much the scene shows the calibration's sd to be too small; the least since the calibration: a later rise may
        # be a change that the monitor must notice.
        self._misfit, self._least_misfit, self._off_lines = 1.0, 1.0, False
        self._frames, self._tried, self._fitted = list(frames), 0, 0  # for the calibration; number in the last try, and fit
        self._online: OnlineCalibration | None = None  # improved by each frame after the last calibration
        self._monitor: DriftMonitor | None = None
        self._recent: deque[Seen] = deque(maxlen=_PAST)  # not yet used for the rig: the cameras may just have moved
        self._doubtful: deque[int] = deque(maxlen=_PAST)  # numbers of single frames that were rejected
        self._past: deque[Correspondences] = deque(maxlen=_PAST)
        self._open: list[Correspondences] = []  # the newest frame with surely open jaws that has left `_past`
        self._since: list[Seen] = []  # frames since the disagreement, which show where the cameras are now
        self._before: StereoRig | None = None  # the rig before the disagreement, while its cause is sought
        self._motion: MovedCameras | None = None  # the motion that led to this rig; next, to the one before
        self._motion_before: MovedCameras | None = None
        self._scene: Scene | None = None  # of the newest frame that agreed with the rig
        self._attempts, self._explained, self.rests_on_s, self.doubted_since = 0, False, float("nan"), None
        # Numbers of frames: newest registration, newest motion soon after one, all frames from a motion to its registration.
        self._registered, self._again, self._astray = -_AGAIN, -_AGAIN, range(0)

    def _use(self, found: StereoRig | Calibration) -> None:
        rig, calibration = (found.rig, found) if isinstance(found, Calibration) else (found, None)
        self.rig, self.calibration, self.state, self.cause = rig, calibration, "tracking", ""
        if self._monitor is None:
            self._monitor = DriftMonitor(rig, covariance_px2=self._noise_px**2, sigma_x_mm=0.0)
        self._monitor.reset(rig)
        self._scale2, self._least_misfit = 1.0, self._misfit
        if calibration is not None:
            both = calibration.view_inliers[calibration.inliers].all(axis=1)
            _, _, weight, r = calibration.system
            chi2 = np.einsum("ni,nij,nj->n", r, np.broadcast_to(weight, (len(r), 4, 4)), r)[both]
            scatter, n = np.median(chi2) / _CHI2_4_MEDIAN, len(chi2)
            # Corrected for the 16 fitted parameters, and one standard deviation up, since few rows leave it uncertain.
            self._scale2 = scatter / (1.0 - 16.0 / max(4 * n, 17)) * (1.0 + 1.0 / np.sqrt(n)) ** 2

    def doubts(self, index: int) -> bool:
        """True if the rig in use in frame `index` was wrong, because the cameras had moved and were not registered yet."""
        since = self.doubted_since
        return self.rig is None or index in self._astray or (since is not None and index >= since)

    @property
    def doubt(self) -> str:
        """The level of `verdict` and of what the scene shows, and the names of the reasons, or "" if it is trustworthy."""
        verdict = Verdict.join([self.verdict, Verdict((_OFF_LINES_REASON,) * self._off_lines)])
        names = ", ".join(dict.fromkeys(reason.name for reason in verdict.reasons))
        return names and f"the calibration is {verdict.level}: {names}"

    def compare(self, epipolar_px: float, x_mm: np.ndarray | None) -> None:
        """Compare the rig with matches of the scene at x_mm (n, 3), of median distance `epipolar_px` from the epipolar lines.

        The scene knows nothing of detector and robot.  If it lies farther off than the rig's covariance says, the errors that
        the calibration was made with are biased or last longer than assumed, and the covariance is too small.  Infinite: the
        matcher refused the rig; NaN decides nothing.
        """
        if x_mm is None or not np.isfinite(epipolar_px):
            self._off_lines |= epipolar_px == np.inf
            return
        normal = self.rig.epipolar_normal
        left, right = self._motions
        if self.calibration is not None and left is right:  # a motion of both cameras moves no match off its line
            stale = x_mm if left is None else left.transform.inverse().apply(x_mm)
            covariance = self.calibration.projection_covariance(stale) * self._remains(stale)
        else:
            covariance = self._rig_covariance(x_mm)
        sd = float(np.sqrt(np.median(normal @ covariance @ normal)))
        self._off_lines = epipolar_px > max(_OFF_LINES[0], _OFF_LINES[1] * sd)
        self._misfit = max(1.0, np.sqrt(max(epipolar_px**2 - _MATCHES_PX**2, 0.0)) / sd) if sd > 0 else 1.0
        self._least_misfit = min(self._misfit, self._least_misfit)

    def is_unsettled(self, index: int) -> bool:
        """True if the newest registration is doubted, because the one before it held only for a short time."""
        return index - self._again < _AGAIN

    def take(self, result: FrameResult, frame: Seen, scene: Scene) -> None:
        """Process a frame with complete landmarks (both images and the robot's report), and its scene."""
        if len(self._past) == _PAST and int(self._past[0].frame[0]) not in self._doubtful and self._is_open(self._past[0]):
            self._open = [self._past[0]]
        self._past.append(frame.data)
        most = self.settings.calibration_frames[1]
        if self.verdict.is_red and self.rig is not None and (self._motion is not None or len(self._frames) > most):
            self._start_again([], self.doubt)
            self._tried = most  # a fit to few frames has passed by chance
        accepted = [frame] if self.rig is None else []
        if self.rig is not None:
            with result.stage("register"):
                accepted = self._watch(result, frame, scene)
        if self._collect(accepted):
            with result.stage("calibrate"):
                self._improve(accepted)
        if self.state == "tracking" and accepted:
            self.rests_on_s, self._scene = result.time_s, scene

    def _collect(self, accepted: list[Seen]) -> bool:
        """Collect frames; True if the rig should be calibrated now: as early as possible, and after growth by a quarter."""
        first, last = self.settings.calibration_frames
        if self._given or self._motion is not None or self._online is not None:  # no new calibration, at most online updates
            return self._online is not None and bool(accepted) and self._motion is None
        self._frames += accepted
        if self.rig is not None:
            return len(self._frames) > last or len(self._frames) >= 1.25 * self._fitted
        self._tried -= max(0, len(self._frames) - 2 * last)  # the oldest are dropped now
        self._frames = self._frames[-2 * last :]
        n = len(self._frames)
        return n >= first and bool(accepted) and n >= self._tried + (1 if n < 2 * first else 3)

    def _improve(self, accepted: list[Seen]) -> None:
        """Calibrate with all frames so far, or after the last calibration improve it with the new frames."""
        if self.rig is not None and len(self._frames) > self.settings.calibration_frames[1]:
            if self._online is None:
                self._online = OnlineCalibration(self.calibration)
                accepted = self._frames[self._fitted :]
            if any([self._online.add(self.corrected(frame.data)).any() for frame in accepted]):  # a list, to add every frame
                self.rig = self._online.solve()
                self._monitor.follow(self.rig)
            return
        self._tried = len(self._frames)
        found, kept, self.verdict = self._agreed(self._frames)
        if self.verdict.is_red or (self.cause and self.verdict.reasons):  # after a fault a doubtful one is refused, too
            raise ValueError(" ".join(f"{reason.text} {reason.cure}" for reason in self.verdict.reasons))
        self._frames, self._fitted = kept, len(kept)
        self._use(found)

    def _judge(self, found: Calibration, frames: Sequence[Seen]) -> Verdict:
        """The verdict on a calibration; red also for what leaves no residuals, such as mirrored images."""
        data, axes = Correspondences.join(frame.data for frame in frames), np.delete(np.arange(16), np.s_[3::4])
        cameras = found.pair.linear.reshape(2, 2, 3), found.covariance[np.ix_(axes, axes)], found.inverse_distance_per_mm
        faults = (h for h in handedness(*cameras, data.grid("x_mm"), data.frame / self.settings.fps) if h.is_named)
        mirrored = Verdict(tuple(Reason(h.name, LEVELS[2], h.text, h.cure) for h in faults))
        return Verdict.join([judge(None, found, robot_accuracy_mm=self.settings.robot_accuracy_mm), mirrored])

    def _agreed(self, frames: Sequence[Seen]) -> tuple[Calibration, list[Seen], Verdict]:
        """A calibration with all frames, or with the newer or the older half; the frames that agree with it; its verdict."""
        first = self.settings.calibration_frames[0]
        base = np.array([np.nanmean(frame.data.x_mm, axis=0) for frame in frames])
        near = np.linalg.norm(base - np.median(base, axis=0), axis=1) < _FAR_MM
        frames = [frame for frame, fine in zip(frames, near, strict=True) if fine]
        parts, refused = [frames] if frames else [], None
        if len(frames) >= first + 2:
            half = max(first, (len(frames) + 1) // 2)
            parts += [frames[-half:], frames[:half]]
        for part in parts:
            try:
                found = self._calibrate(Correspondences.join(frame.pair(self.rig) for frame in part))
            except Exception as error:  # if all fail, the first error is raised, that with all frames
                refused = refused or error
                continue
            used = found.inliers.reshape(len(part), -1).any(axis=1)
            kept = [frame for frame, fine in zip(part, used, strict=True) if fine]
            return found, kept, self._judge(found, kept)
        raise refused or ValueError("the robot's positions lie too far apart.")

    def _watch(self, result: FrameResult, frame: Seen, scene: Scene) -> list[Seen]:
        """Test whether images and robot still agree, and if not, find the cause.  Returns frames that may improve the rig."""
        if self.state != "tracking":
            self._since.append(frame)
            return self._resolve(result, scene)
        data, monitor = self.corrected(frame.data), self._monitor
        alarm = monitor.update(data, covariance_px2=self._noise(data), rig_px2=self._rig_covariance(data.x_mm))
        result.drift = monitor.statistic
        self._recent.append(frame)
        if alarm:
            self._since = [*self._since, frame] if self._before is not None else list(self._recent)[-monitor.since :]
            self.state, self.cause, self._attempts = "moved", f"images and robot disagree ({monitor.axis})", 0
            self.doubted_since = int(self._since[0].data.frame[0])
            if self._before is None:
                self._before, self._motion_before = self.rig, self._motion
                self._again = result.index if result.index - self._registered < _AGAIN else self._again
            monitor.forget()
            self._recent.clear()
            return self._resolve(result, scene)
        if monitor.score > _STANDS_OUT:
            self._doubtful.append(int(data.frame[0]))
            result.state, result.cause = "moved", f"this frame alone stands out ({monitor.score:.0f} sd)"
            gap = self.rig.triangulate(data.u_left, data.u_right).x_mm - data.x_mm
            off = f"{np.nanmedian(np.linalg.norm(gap, axis=1)):.2f} mm"
            result.failures["robot"] = f"images and robot disagree by {off} in this frame: rejected"
            return []
        if self._before is not None:  # registered, and still being refined
            self._since.append(frame)
            return self._resolve(result, scene)
        n = 0 if monitor.statistic < 0.25 else monitor.since
        passed = [self._recent.popleft() for _ in range(len(self._recent) - n)]
        return [frame for frame in passed if int(frame.data.frame[0]) not in self._doubtful]

    def _resolve(self, result: FrameResult, scene: Scene) -> list[Seen]:
        """Explain the frames since the disagreement by a motion or another cause, which must also explain the newest frames.

        A scene that stands still excludes a motion: then the rig was inaccurate, or the detector or the robot is wrong.
        Returns frames that may improve the rig.
        """
        first, last = self.settings.registration_frames
        self._since = self._since[-max(last, 30) :]
        if len(newest := [self.corrected(frame.data) for frame in self._since[-first:]]) < first:
            return []
        if self._explained and self._fits(self.rig, newest):
            self._settle()
            return []
        if self._explained and self._attempts % first:
            self._attempts += 1  # the cause persists: test again in a few frames
            return []
        frames = [self.corrected(frame.data) for frame in self._since]
        joined = Correspondences.join(frames).complete
        noise = self._noise(joined) + self._rig_covariance(joined.x_mm)
        moved_px = np.full(2, np.nan) if self._scene is None else self._scene.moved_px(scene)
        try:
            past = [self.corrected(part) for part in self._past]
            found = explain(self._before, frames, past, noise, undecided=len(frames) < last)
            shifted = found.kind in ("clock", "slipped", "exchanged", "eye")
            if found.kind in ("moved", "optics") and self._stands_still(found.rig, joined.x_mm, moved_px):
                agree, better = self._since[-first:], self._recalibrated()
                if better is None and not self._fits(self._before, newest):
                    raise ValueError("the scene stands still, so the cameras did not move: the detector or the robot errs.")
                self._revert(result.index)
                if better is not None:
                    self._use(better)
                self._settle()
                return agree if better is None else []
            if not (found.loss <= CONVINCING if shifted else found.kind == "open" or self._fits(found.rig, newest)):
                raise ValueError("no cause explains the newest frames.")
        except ValueError as error:
            self.state, self._explained = "moved", False
            # The oldest frames may be from before or during the motion.
            self._since = self._since[1 - 2 * first :]
            self._attempts += 1
            self.cause = str(error)
            patience = _PATIENT if (moved_px < _STILL_PX).all() else 1
            if self._attempts > patience * self.settings.give_up_frames:
                self._start_again(self._since, "no cause explains the images; calibrating again")
            raise
        if found.kind == "open":
            self.cause = self.cause if self._explained else found.text
        elif shifted:
            self._revert(result.index)
            self.state, self.cause = "robot" if found.kind in ("clock", "slipped") else "moved", found.text
            self._explained, self._attempts = True, 1
            self._since = self._since[1 - first :]
            result.failures["robot"] = found.text
        elif found.kind == "optics":
            self._start_again(self._since, found.text)
            result.failures["register"] = found.text
        elif found.kind == "none":
            self._revert(result.index)
            self._settle()
        else:
            self.rig, self.state, self.cause = found.rig, "tracking", ""
            result.motion, self._motion, self._registered = found.motion, found.motion, result.index
            self._monitor.reset(found.rig)
            if self.doubted_since is not None:
                self._astray = range(self.doubted_since, result.index)
            self.rests_on_s, self.doubted_since = result.time_s, None
            if len(self._since) >= last:
                self._settle()
        return []

    def _revert(self, index: int) -> None:
        """Return to the rig before the motion, and doubt the surfaces that were made with the other rig."""
        if self.rig is not self._before:
            self._astray = range(self._astray.start, index)
        self.rig, self._motion = self._before, self._motion_before

    def _settle(self) -> None:
        """Continue with the rig in use: the disagreement is over, or the motion is known well enough."""
        self.state, self.cause, self.doubted_since = "tracking", "", None
        self._before, self._since, self._attempts, self._explained = None, [], 0, False
        self._monitor.follow(self.rig)
        self._recent.clear()
        self._monitor.forget()

    def _recalibrated(self) -> Calibration | None:
        """A calibration with the frames since as well, if it explains the newest: then only the rig was inaccurate."""
        first = self.settings.registration_frames[0]
        if self._given or self._motion_before is not None or self._online is not None or self._attempts % first:
            return None
        with suppress(ValueError):
            found, kept, verdict = self._agreed([*self._frames, *self._since])
            newest = [with_offsets(frame.data, found.offsets) for frame in self._since[-first:]]
            if not verdict.reasons and self._fits(found.rig, newest):
                self._frames, self._fitted, self.verdict = kept, len(kept), verdict
                return found
        return None

    def _stands_still(self, rig: StereoRig, x_mm: np.ndarray, moved_px: np.ndarray) -> bool:
        """True if `rig`, compared with the one before, shifts the landmarks in an image whose scene hardly moved."""
        step = np.stack(rig.project(x_mm)) - np.stack(self._before.project(x_mm))
        farther = np.median(np.linalg.norm(step, axis=2), axis=1) > _NOISE_PX + _TIMES * moved_px
        return bool((farther & (moved_px < _STILL_PX)).any())

    def _fits(self, rig: StereoRig, frames: Sequence[Correspondences]) -> bool:
        data = Correspondences.join(frames).complete
        noise = self._noise(data) + self._rig_covariance(data.x_mm)
        return bool(len(data) and misfit(rig, data, noise) <= CONVINCING * len(data))

    def corrected(self, data: Correspondences) -> Correspondences:
        """The rows with calibrated offsets added; shut or crossed jaws take the tool's axes from the frames before."""
        offsets = None if self.calibration is None else self.calibration.offsets
        if offsets is None:
            return data
        if (alone := _corrected_alone(data, offsets)) is not None:
            return alone
        return with_offsets(self._with_past(data), offsets).of_frames(data.frame)

    def robots_error(self, data: Correspondences) -> tuple[np.ndarray, np.ndarray]:
        """The robot's error: (3, 3) mm from the reported landmarks of a frame to the true ones, and its covariance (3, 3, 3).

        It is a part of the calibrated offsets.  The rest is the detector's own error, which does not displace the tool.
        """
        offsets = None if self.calibration is None else self.calibration.offsets
        if offsets is None or offsets.offset.shape != (3, 3):
            return np.zeros((3, 3)), np.zeros((3, 3, 3))
        rows = data if _corrected_alone(data, offsets) is not None else self._with_past(data)
        axes, x = rows_axes(rows, offsets.offset if offsets.turns else None, carry=True)[-1], data.grid("x_mm")[0]
        if not np.isfinite(axes).all():
            return np.zeros((3, 3)), (offsets.offset**2).sum(axis=1)[:, None, None] * np.eye(3)
        part, covariance = robots_part(offsets, OWN_BIAS * np.linalg.norm(x[1:].mean(axis=0) - x[0]))
        return part @ axes.T, axes @ covariance @ axes.T

    def _with_past(self, data: Correspondences) -> Correspondences:
        """The rows of the trusted frames before a frame, then its own."""
        past = (part for part in (*self._open, *self._past) if int(part.frame[0]) not in self._doubtful)
        return Correspondences.join([*(part for part in past if part.frame[-1] < data.frame[0]), data])

    def _is_open(self, data: Correspondences) -> bool:
        """True if the axes are certain: the tips are so far apart that they are not crossed, whatever their offsets."""
        x, offsets = data.grid("x_mm")[0], None if self.calibration is None else self.calibration.offsets
        apart = 0.0 if offsets is None else np.linalg.norm(np.diff(offsets.offset[1:], axis=0))
        return bool(np.linalg.norm(x[2] - x[1]) > apart + 0.05 * np.linalg.norm((x[1] + x[2]) / 2 - x[0]))

    @property
    def persistence(self) -> float:
        """Variance of the mean of many frames, relative to independent errors; 1 before it is known."""
        return 1.0 if self._monitor is None else max(1.0, self._monitor.inflation)

    def detection_covariance(self, data: Correspondences) -> np.ndarray:
        """(n, 4, 4) px^2: covariance of the detections alone."""
        if self.calibration is None:
            return np.tile(self._noise_px**2 * np.eye(4), (len(data), 1, 1))
        return self._scale2 * self.calibration.detection_covariance(data)

    def point_covariance(self, x_mm: np.ndarray) -> np.ndarray:
        """(n, 3, 3) mm^2: covariance of points in the robot's frame by the errors of the rig."""
        own = np.zeros((len(x_mm), 3, 3))
        if self.calibration is not None:
            share = self._remains(x_mm) * self._misfit**2
            own += self.calibration.point_covariance(x_mm, detection=False) * share
        left, right = self._motions
        if left is right:
            return own if left is None else own + left.covariance_at(left.transform.inverse().apply(x_mm))
        # If one camera moved alone, its shift along its own view is unknown, but not visible.  So errors are taken in pixels.
        J, pixels = self.rig.jacobian(x_mm), np.zeros((len(x_mm), 4, 4))
        for motion, rows in zip(self._motions, (slice(0, 2), slice(2, 4)), strict=True):
            if motion is not None:
                stale = motion.covariance_at(motion.transform.inverse().apply(x_mm))
                pixels[:, rows, rows] = J[:, rows] @ stale @ J[:, rows].mT
        gain = np.linalg.solve(J.mT @ J, J.mT)
        return own + gain @ pixels @ gain.mT

    def _remains(self, x_mm: np.ndarray) -> np.ndarray:
        return np.ones((1, 1, 1)) if self._online is None else self._online.remains(x_mm)[:, None, None]

    @property
    def _motions(self) -> tuple:
        return (None, None) if self._motion is None else (self._motion.left, self._motion.right)

    def _noise(self, data: Correspondences) -> np.ndarray:
        """(n, 4, 4) px^2: covariance of the landmarks' residuals by detections and robot's report."""
        sigma_x = self.settings.robot_accuracy_mm if self.calibration is None else self.calibration.sigma_x_mm
        A = (self._before or self.rig).linear
        return self.detection_covariance(data) + self._scale2 * sigma_x**2 * A @ A.T

    def _rig_covariance(self, x_mm: np.ndarray) -> np.ndarray:
        """(n, 4, 4) px^2: covariance of the rig's projections of x_mm (n, 3)."""
        covariance, known = np.zeros((len(x_mm), 4, 4)), self.calibration
        for motion, rows in zip(self._motions, (slice(0, 2), slice(2, 4)), strict=True):
            stale = x_mm if motion is None else motion.transform.inverse().apply(x_mm)
            if known is not None:
                own = known.projection_covariance(stale) * self._remains(stale) * self._least_misfit**2
                covariance[:, rows, rows] += own[:, rows, rows]
            if motion is not None:
                covariance[:, rows, rows] += self.rig.linear[rows] @ motion.covariance_at(stale) @ self.rig.linear[rows].T
        return covariance


@lru_cache(maxsize=64)  # the search for a cause corrects the same frames many times
def _corrected_alone(data: Correspondences, offsets: LandmarkOffsets) -> Correspondences | None:
    """The corrected rows if the axes follow from open jaws in this frame and no offset turns them; otherwise None."""
    return with_offsets(data, offsets) if not offsets.turns and np.isfinite(rows_axes(data)).all() else None
