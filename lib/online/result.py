"""The settings of the online system, and its result for each frame."""

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lib.cameras import StereoRig
from lib.correspondences import LANDMARKS, Correspondences
from lib.geometry import check
from lib.registration import MovedCameras
from lib.surface import Reconstruction

#: The stages whose seconds and failures a `FrameResult` names, in their order.
STAGES = ("detect", "calibrate", "register", "match", "triangulate", "surface", "distance")

#: The meaning of each state, and the source of the distances in it.
STATES = {
    "calibrating": "there is no rig yet, the optics changed, or a calibration with more frames was refused; no distances",
    "tracking": "images, robot and rig agree; distances from all three",
    "unseen": "the eye is in view, but the landmarks are not; distances from the robot's report, with a growing sd, until a "
    "new surface shows that eye or cameras moved",
    "blind": "an image is black, corrupt, or repeats the one before, or neither images nor robot show the tool; no distances",
    "robot": "the robot's report is missing, frozen or late, or the tool slipped; distances from the images",
    "moved": "images and robot disagree and nothing lasting explains it, or a camera's images are late; no distances",
}


def told(error: Exception) -> str:
    """What a failure says: a ValueError in its own words, another error with its type."""
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


@dataclass(frozen=True)
class Settings:
    """The settings of the online system.

    Attributes:
        calibration_frames: Number of frames with landmarks for the first calibration, and number after which it is not
            repeated.  In between it is repeated when the number has grown by a quarter; afterwards each frame improves it.
        registration_frames: Number of frames with the tool, after the cameras moved, for the first registration (3 in the
            paper), and number after which it is not refined.
        give_up_frames: Number of frames that no motion explains, after which the rig is calibrated again.
        surface_every: Reconstruct the surface in every n-th frame.
        setting: "fast" or "quality", an argument of `lib.surface.reconstruct`.
        control: Control points of the surface (n_x, n_y).
        fps: Frames per second, for frames without a time stamp.
        stale_s: Largest age of the surface, and of the last detection of landmarks, for which distances are given.
        eye_mm_s: Speed at which eye and cameras may move unseen, by which the distance's standard deviation grows.  The
            faster, the less the distance trusts the robot's earlier reports.
        slip_mm: Standard deviation of the landmarks' offset from the robot's report, in addition to its own accuracy.
        robot_accuracy_mm: Standard deviation of the robot's report, per coordinate.
        alarm_mm, miss_rate: A tip is `too_close` if its distance may be below alarm_mm.  A tip that truly is below is missed
            with probability miss_rate.  False alarms are as rare for tips farther than alarm_mm + 2 `FrameResult.margin_mm`.
    """

    calibration_frames: tuple[int, int] = (8, 60)
    registration_frames: tuple[int, int] = (3, 12)
    give_up_frames: int = 8
    surface_every: int = 1
    setting: str = "fast"
    control: tuple[int, int] = (16, 12)
    fps: float = 25.0
    stale_s: float = 5.0
    eye_mm_s: float = 0.02
    slip_mm: float = 0.010
    robot_accuracy_mm: float = 0.010
    alarm_mm: float = 0.2
    miss_rate: float = 0.01

    def __post_init__(self) -> None:
        check(self, "calibration_frames registration_frames", lambda n: 2 <= n[0] <= n[1], "expected 2 <= first <= last")
        check(self, "surface_every give_up_frames", lambda value: value >= 1, "must be at least 1")
        check(self, "fps stale_s", lambda value: value > 0, "must be positive")
        check(self, "eye_mm_s slip_mm robot_accuracy_mm", lambda value: value >= 0, "must not be negative")
        check(self, "miss_rate", lambda value: 0 < value < 0.5, "expected a probability below one half")


_unknown = partial(np.full, len(LANDMARKS), np.nan)


@dataclass
class FrameResult:
    """The result of one frame.  Arrays are NaN, objects None, if a stage did not run or failed.

    Attributes:
        index, time_s: Number of the frame since the start; its time in s, video clock.
        state, cause: One of `STATES`, and why it is not "tracking" or the calibration is doubtful, in a few words.
        landmarks, x_tool_mm: The detected landmarks with the robot's report; (3, 3) the triangulated landmarks.
        rig: The rig in use after this frame.
        reconstruction, reconstructed_at: The newest surface and its points, and the number of their frame.
        distance_mm, distance_sd_mm: (3,) from each landmark to the surface along the view, positive = above it, and its
            standard deviation from detector, robot, calibration, surface and the surface's age.
        normal_mm, normal_sd_mm: The same along the surface's normal.
        approach_mm_s: (3,) speed at which the robot moves each landmark towards the surface, along the view; NaN if the robot
            has been silent for half a second.
        too_close, margin_mm: (3,) the alarm, raised below `Settings.alarm_mm` + margin_mm, and this margin.
        rests_on: Time in s of the newest frame used for "landmarks", "rig" and "surface", and of the frame in which the
            report of the "robot" last changed; NaN = none.
        drift: Statistic of the drift monitor, in units of its alarm threshold.
        motion: The registration that was made in this frame, or None.
        dropped: Number of surfaces so far that were requested and dropped, because a newer frame came first.
        seconds, failures: Stage -> wall-clock seconds, and stage -> reason of a failure (also "images", "robot", "worker").
    """

    index: int
    time_s: float = float("nan")
    state: str = "calibrating"
    cause: str = ""
    landmarks: Correspondences = field(default_factory=lambda: Correspondences.of_points(
        *(np.full((3, size), np.nan) for size in (3, 2, 2)), landmark=range(len(LANDMARKS))))  # fmt: skip
    x_tool_mm: np.ndarray = field(default_factory=lambda: np.full((3, 3), np.nan))
    rig: StereoRig | None = None
    reconstruction: Reconstruction | None = None
    reconstructed_at: int | None = None
    distance_mm: np.ndarray = field(default_factory=_unknown)
    distance_sd_mm: np.ndarray = field(default_factory=_unknown)
    normal_mm: np.ndarray = field(default_factory=_unknown)
    normal_sd_mm: np.ndarray = field(default_factory=_unknown)
    approach_mm_s: np.ndarray = field(default_factory=_unknown)
    too_close: np.ndarray = field(default_factory=lambda: np.zeros(3, dtype=bool))
    margin_mm: np.ndarray = field(default_factory=_unknown)
    rests_on: dict[str, float] = field(default_factory=dict)
    drift: float = 0.0
    motion: MovedCameras | None = None
    dropped: int = 0
    seconds: Counter[str] = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)

    @property
    def working_distance_mm(self) -> float:
        """The working distance of the cameras in use; infinite if they are affine or there is no rig."""
        near = 0.0 if self.rig is None else getattr(self.rig.left, "inverse_distance_per_mm", 0.0)
        return 1.0 / near if near else float("inf")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; an exception is noted in `failures` instead of raised."""
        start = time.perf_counter()
        try:
            yield
        except Exception as error:  # any error at all: the next frame comes in 40 ms
            self.failures[name] = told(error)
        finally:
            self.seconds[name] += time.perf_counter() - start
