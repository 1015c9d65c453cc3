"""Motion of the tool: calibration sweeps that fill a volume, and a surgeon's approach, grasp and peel."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import PchipInterpolator

from lib.geometry import check
from lib.simulator.eye import Scene
from lib.simulator.forceps import MAX_ROLL_RAD, Forceps, Pose

#: Kinds of motion, and the default duration of each.
DURATIONS_S = {"sweep": 30.0, "surgeon": 18.0, "both": 45.0}
_CLEARANCE_MM = 0.12  # between a tip and the retina
_DEPTHS_MM = (-1.5, -0.7, 0.1, 0.9)  # z of the tips during a sweep, in the microscope frame
_HALF_FIELD_MM = np.array([6.8, 3.4])  # half width and half height of the area that the jaws' centre covers


@dataclass(frozen=True)
class Motion:
    """A smooth trajectory through random waypoints, which depend on the seed.

    Attributes:
        kind: "sweep": the jaws scan the field at several depths while they turn and open.  "surgeon": descend, grasp,
            peel, pause, release, then the same elsewhere.  "both": a sweep for two thirds of the time, then a surgeon.
        tremor_mm: Peak-to-peak amplitude of the physiological tremor (8 to 12 Hz) in the surgeon's part.
    """

    forceps: Forceps
    scene: Scene
    kind: str = "sweep"
    seed: int = 0
    duration_s: float = 30.0
    tremor_mm: float = 0.15

    def __post_init__(self) -> None:
        if self.kind not in DURATIONS_S:
            raise ValueError(f"motion: unknown kind {self.kind!r}; one of {', '.join(DURATIONS_S)}.")
        check(self, "duration_s", lambda v: v > 0, "must be positive")
        check(self, "tremor_mm", lambda v: v >= 0, "must not be negative")

    @cached_property
    def _parts(self) -> tuple[tuple[float, PchipInterpolator], ...]:
        """(start, interpolator of (jaw centre x, y, tip z, azimuth, pitch, roll, opening)) of each part, in order of time."""
        rng = np.random.default_rng([self.seed, 23])
        side = rng.uniform(-np.pi, np.pi)  # mean azimuth of the tool, given by where the robot stands
        sweep_end, end = {"sweep": 1.0, "surgeon": 0.0, "both": 0.66}[self.kind] * self.duration_s, self.duration_s
        parts = [(0.0, sweep_end, *self._sweep(rng, side))] if sweep_end > 0 else []
        parts += [(sweep_end, end, *self._surgeon(rng, side))] if sweep_end < end else []
        shares = [np.cumsum([0, *pace]) / np.sum(pace) for *_, pace in parts]
        return tuple((start, PchipInterpolator(start + share * (stop - start), points))
                     for share, (start, stop, points, _) in zip(shares, parts, strict=True))  # fmt: skip

    def _sweep(self, rng: np.random.Generator, side: float) -> tuple[list[list[float]], np.ndarray]:
        """Waypoints, and the relative durations between consecutive ones."""
        half_x, half_y = _HALF_FIELD_MM
        points = []
        for layer, z in enumerate(rng.permutation(_DEPTHS_MM)):
            for k, row in enumerate(np.array([-0.85, 0.0, 0.85]) * (1 if layer % 2 else -1)):
                for column in np.array([-0.9, -0.3, 0.3, 0.9]) * (1 if k % 2 else -1):
                    x, y = column * half_x + rng.normal(0, 0.5), row * half_y + rng.normal(0, 0.35)
                    turn = [side + rng.normal(0, 0.45), rng.uniform(0.12, 0.6), np.clip(rng.normal(0, 0.3), -0.9, 0.9)]
                    opening = rng.uniform(0.1, 0.5) * self.forceps.jaw_length_mm
                    points.append([x, y, z + rng.normal(0, 0.12), *turn, opening])
        return points, np.linalg.norm(np.diff(points, axis=0)[:, :3], axis=1) + 0.8  # mm, plus time to turn

    def _surgeon(self, rng: np.random.Generator, side: float) -> tuple[list[list[float]], list[float]]:
        half_x, half_y = 0.7 * _HALF_FIELD_MM
        points, shares = [], []
        for _ in range(max(1, round(self.duration_s * (0.34 if self.kind == "both" else 1.0) / 9))):
            x, y = rng.uniform(-half_x, half_x), rng.uniform(-half_y, half_y)
            ground = float(self.scene.height(x, y))
            turn = np.array([side + rng.normal(0, 0.3), rng.uniform(0.25, 0.6), np.clip(rng.normal(0, 0.25), -0.8, 0.8)])
            wide, shut = 0.35 * self.forceps.jaw_length_mm, 0.03
            peel = rng.uniform(0.8, 2.2) * np.array([np.cos(side + np.pi), np.sin(side + np.pi)]) + rng.normal(0, 0.4, 2)
            path = [
                ((0, 0), 2.2, wide * 0.6, 1.6),  # come near
                ((0, 0), 0.5, wide, 1.0),  # open and descend
                ((0, 0), 0.15, wide, 0.4),  # wait
                ((0, 0), 0.15, shut, 0.6),  # grasp
                (0.5 * peel, 0.3, shut, 1.2),  # peel
                (peel, 0.8, shut, 1.2),
                (peel, 0.85, shut, 0.7),  # pause
                (peel, 1.1, wide, 0.5),  # release
                (peel, 2.2, wide * 0.6, 1.2),  # retreat
            ]
            for (dx, dy), above, opening, share in path:
                points.append([x + dx, y + dy, ground - above, *(turn + rng.normal(0, 0.03, 3)), opening])
                shares.append(share)
        return points, shares[1:]

    def pose(self, time_s: float) -> Pose:
        """The pose at `time_s` from the start; times outside the motion get the pose at its start or end."""
        time = float(np.clip(time_s, 0, self.duration_s))
        start, path = [part for part in self._parts if part[0] <= time][-1]
        x, y, z, azimuth, pitch, roll, opening = path(time)
        pose = Pose((0.0, 0.0, 0.0), azimuth, max(pitch, 0.0), np.clip(roll, -MAX_ROLL_RAD, MAX_ROLL_RAD), max(opening, 0))
        base, tips = np.split(self.forceps.landmarks(pose), [1])
        moved = np.array([x, y, z]) - [*((base[0] + tips.mean(axis=0)) / 2)[:2], tips[:, 2].max()]
        moved[2] = min(moved[2], *(self.scene.height(*(tips + moved)[:, :2].T) - _CLEARANCE_MM - tips[:, 2]))
        if self.kind == "surgeon" or start > 0:
            rng = np.random.default_rng([self.seed, 29])
            frequency, phase = rng.uniform(8, 12, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
            size = self.tremor_mm / 2 * np.array([0.75, 0.75, 0.4])[:, None] * np.array([0.6, 0.3, 0.2])
            moved += (size * np.sin(2 * np.pi * frequency * time + phase)).sum(axis=1)
        return replace(pose, base_mm=tuple(moved.tolist()))
