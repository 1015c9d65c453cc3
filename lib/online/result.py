"""What a user may change about the online system, and what it says about each frame."""

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

#: What each state means, and what follows for the distances.
STATES = {
    "calibrating": "there is no rig yet, or the optics changed; no distances",
    "tracking": "images, robot and rig agree; distances from all three",
    "unseen": "the eye is in view and the landmarks are not; distances from the robot's report, with a growing sd, until the "
    "surface is not where it was",
    "blind": "an image is black, corrupt, or repeats the one before; no distances",
    "robot": "the robot's report is missing, frozen or late, or the tool slipped; distances from the images",
    "moved": "images and robot disagree and nothing lasting explains it, or a camera's images are late; no distances",
}


@dataclass(frozen=True)
class Settings:
    """What a user may change.

    Attributes:
        calibration_frames: Frames with landmarks before the first calibration, and frames after which it is not repeated.
            In between it is repeated whenever a quarter more frames are at hand; after that each frame improves it.
        registration_frames: Frames of the tool after the cameras moved before the first registration (the paper's 3),
            and frames after which it is not refined.
        give_up_frames: Frames that no motion explains after which the rig is calibrated afresh.
        surface_every: Reconstruct the surface in every n-th frame.
        setting: "fast" or "quality", as `lib.surface.reconstruct` has it.
        control: Control points of the surface (n_x, n_y).
        fps: Frames a second, for frames that come without a time.
        stale_s: Distances end where the surface, or the last sight of the landmarks, is older.
        eye_mm_s: Speed at which eye and cameras may move unseen, by which the distance's standard deviation grows.
        slip_mm: Standard deviation of how far the landmarks may lie off the robot's report, beside its own accuracy.
        robot_accuracy_mm: Standard deviation of the robot's report, per coordinate.
        alarm_mm, miss_rate: A tip is `too_close` where its distance may be below alarm_mm: a true one below it is missed with
            this probability.  False alarms are as rare for tips farther away than alarm_mm and twice `FrameResult.margin_mm`.
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
    """What one frame told.  Arrays are NaN, objects None, where a stage did not run or failed.

    Attributes:
        index, time_s: Number of the frame since the start; its time, video clock.
        state, cause: One of `STATES`, and why it is not "tracking", in a few words.
        landmarks, x_tool_mm: Where the detector saw and the robot reports them; (3, 3) as the cameras triangulate them.
        rig: In force after this frame.
        reconstruction, reconstructed_at: The newest surface and its points, and the number of their frame.
        distance_mm, distance_sd_mm: (3,) from each landmark to the surface along the view, positive = above it, and its
            standard deviation: detector, robot, calibration, surface and the surface's age.
        normal_mm, normal_sd_mm: The same along the surface's normal.
        approach_mm_s: (3,) speed at which the robot takes each landmark towards the surface, along the view; NaN where it has
            been silent for half a second.
        too_close, margin_mm: (3,) alarm of `Settings.alarm_mm`, and how far above it the alarm already sounds.
        rests_on: Time in s of the newest frame behind each of "landmarks", "robot", "rig" and "surface"; NaN = none.
        drift: Statistic of the drift monitor, in units of its alarm threshold.
        motion: The registration made in this frame, if one was.
        dropped: Surfaces asked for and dropped so far, because a newer frame came first.
        seconds, failures: By stage: wall-clock seconds of what ran, reason of what failed; also "images", "robot", "worker".
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
        """Of the cameras in force: finite where the detections show one, infinite of affine ones and without a rig."""
        near = 0.0 if self.rig is None else getattr(self.rig.left, "inverse_distance_per_mm", 0.0)
        return 1.0 / near if near else float("inf")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage, and note its failure in place of raising it."""
        start = time.perf_counter()
        try:
            yield
        except Exception as error:  # whatever a stage dies of: the next frame comes in 40 ms
            self.failures[name] = f"{type(error).__name__}: {error}"
        finally:
            self.seconds[name] += time.perf_counter() - start
