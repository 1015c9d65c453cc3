"""A lab without pictures: blank frames that carry their own number, and a stand-in for the detector that knows the rest."""

from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from lib.cameras import NearAffineCamera, StereoRig
from lib.landmarks import Landmarks
from lib.recordings import Recording, RecordingWriter, StereoFrame, encoded, recording
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps
from lib.simulator.motion import Motion
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig

SIZE = (480, 270)
FPS, HZ = 2.0, 50.0
TOOL = Forceps()


@cache
def true_landmarks_mm(n: int, seed: int, times: bytes) -> np.ndarray:
    """(m, 3, 3) mm in the robot frame; worked out once, since every recording of a world asks for the same times."""
    motion = Motion(TOOL, Eye(texture_px=64), kind="both", seed=seed, duration_s=n / FPS)
    poses = [motion.pose(t) for t in np.clip(np.frombuffer(times), 0, None)]
    return ROBOT_FROM_MICROSCOPE.apply(np.array([TOOL.landmarks(pose) for pose in poses]))


@dataclass(eq=False)
class World:
    """What truly is: landmarks in the robot frame at any time, the rig, and where each frame shows them."""

    n: int = 40
    seed: int = 0
    moved_from: int | None = None
    distance_mm: float = np.inf
    rig: StereoRig = field(init=False)

    def __post_init__(self):
        self.rig = reference_rig(image_size_px=SIZE, pixels_per_mm=(25.0, 25.0))
        if np.isfinite(self.distance_mm):
            seen_from = 1 / self.distance_mm, (np.array(SIZE) - 1) / 2, ROBOT_FROM_MICROSCOPE.t
            self.rig = StereoRig(*(NearAffineCamera(c.matrix, *seen_from) for c in (self.rig.left, self.rig.right)))
        self.time_s = np.arange(self.n) / FPS
        self.u = np.stack([self.project(i, x) for i, x in enumerate(self.at(self.time_s))])  # (n, 2, 3, 2)

    def at(self, time_s):
        """(m, 3, 3) mm."""
        return true_landmarks_mm(self.n, self.seed, np.asarray(time_s, dtype=float).tobytes())

    def project(self, i, x_mm):
        u = np.stack(self.rig.project(x_mm))
        if self.moved_from is not None and i >= self.moved_from:
            u = 1.05 * u + [[[20.0, -12.0]], [[24.0, -12.0]]]
        return u

    def record(self, folder: Path, *, robot=lambda time_s, x: x, clock_s=0.0, rate=1.0, noise_mm=0.005) -> Recording:
        """Write it; `robot` makes of the truth (m, 3, 3) what the log says."""
        rng = np.random.default_rng([self.seed, 1])
        sample_s = np.arange(-0.4, self.time_s[-1] + 0.4, 1 / HZ)
        x = robot(sample_s, self.at(sample_s) + rng.normal(0, noise_mm, (len(sample_s), 3, 3)))
        header = {"name": folder.name, "fps": FPS, "image_size_px": SIZE, "suffix": ".png"}
        with pytest.MonkeyPatch.context() as patch, RecordingWriter(folder, **header) as writer:
            patch.setattr(recording, "encoded", encoded_once)
            for t, pair in zip(self.time_s, blank_pairs(self.n), strict=True):
                writer.add(*pair, t)
            writer.kinematics(rate * sample_s + clock_s, x)
        made = Recording.open(folder)
        return replace(made, frames=Kept(made.frames.time_s))


@cache
def blank_pairs(n: int) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The left and the right image of n frames, (h, w, 3); a frame's number and its side are its colour."""
    rows = (np.tile(np.uint8([i + 1, 60 * side + 20, 90]), (SIZE[0], 1)) for i in range(n) for side in (0, 1))
    images = [np.tile(row, (SIZE[1], 1, 1)) for row in rows]
    for image in images:
        image.setflags(write=False)  # as those of a recording
    return tuple(zip(images[::2], images[1::2], strict=True))


_ENCODED: dict[int, bytes] = {}


def encoded_once(image: np.ndarray, *how: object) -> bytes:
    """`encoded` of an image of `blank_pairs`, which lives as long as the process: every recording has the same ones."""
    if id(image) not in _ENCODED:
        _ENCODED[id(image)] = encoded(image, *how)
    return _ENCODED[id(image)]


class Kept:
    """Frames as the files hold them, without reading these: every stage looks at them anew."""

    def __init__(self, time_s):
        self.time_s, self._pairs = time_s, blank_pairs(len(time_s))

    def __len__(self):
        return len(self.time_s)

    def __getitem__(self, index):
        return StereoFrame(*self._pairs[index], self.time_s[index])


@dataclass(eq=False)
class StandIn:
    """Finds what `u` (n, 2, 3, 2) says, with noise; a share of the landmarks, in some frames or all, is lost in the image.

    `taught` counts how often something was asked of it.
    """

    u: np.ndarray
    noise_px: float = 1.0
    wrong: float = 0.0
    elsewhere: dict[int, np.ndarray] = field(default_factory=dict)
    seed: int = 0
    asked: int = 0

    def __call__(self, images):
        found = Landmarks.none(len(images))
        for j, image in enumerate(images):
            i, side = int(image[0, 0, 0]) - 1, int(image[0, 0, 1] > 50)
            rng = np.random.default_rng([self.seed, i, side])
            u = self.elsewhere[i][side] if i in self.elsewhere else self.u[i, side]
            lost = rng.random(3) < self.wrong
            u = np.where(lost[:, None], rng.uniform((0, 0), SIZE, (3, 2)), u + rng.normal(0, self.noise_px, (3, 2)))
            found.u[j], found.covariance[j] = u, self.noise_px**2 * np.eye(2)
            found.confidence[j] = np.where(lost, 0.4, 0.9)
        self.asked += 1
        return found


def pupil(world: World):
    """A `tune` whose pupil finds the truth plus the mean error of the labels it was given, to 0.2 px: a lie is learnt."""
    calls = []

    def tune(detector, images, held_out, folder, *, progress, **how):
        number = {"left": 0, "right": 1}
        where = [(int(one.name.split()[1]), number[one.name.split()[0]]) for one in images]
        off = np.stack([one.u - world.u[i, side] for one, (i, side) in zip(images, where, strict=True)])
        calls.append({"images": images, "off": off, "held_out": held_out, **how})
        return StandIn(world.u + np.nanmean(off, axis=0), noise_px=0.2)

    tune.calls = calls
    return tune
