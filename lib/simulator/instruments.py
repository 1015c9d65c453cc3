"""Tools of any shape: a shaft and two jaws made of round cones, each with a surface of its own, and other objects.

An `Instrument` offers what the renderer and `Motion` need of a `Forceps`, in the same tool frame (see `forceps.py`).  The
landmarks are defined once, for every tool.  base: the point on the shaft's axis where the jaws leave the shaft or its
neck.  tip_1, tip_2: the farthest point of each jaw on its own centre line; of a ring or a spoon, its far end.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from lib.simulator.forceps import Pose

__all__ = ["Finish", "Instrument", "Jaw", "finished"]

_SHAFT_MM = 40.0


@dataclass(frozen=True)
class Finish:
    """How a surface looks.

    Attributes:
        colour: Linear reflectance (3,): 0.02 is black, 0.9 a mirror.
        matt, mirror: Shares of it that scatter evenly, and that reflect the field and the sky.
        shine, sharpness: Strength of the lamp's highlight and its exponent.
        brushed: Contrast of marks along the part.
    """

    colour: tuple[float, float, float] = (0.5, 0.5, 0.49)
    matt: float = 0.5
    mirror: float = 0.4
    shine: float = 0.6
    sharpness: float = 30.0
    brushed: float = 0.1


@dataclass(frozen=True, eq=False)
class Jaw:
    """A closed jaw in the tool frame; y is the distance from the plane between the jaws, whichever jaw it is.

    Attributes:
        line, radii: Centres (n, 3) and radii (n,) mm of its round cones, from the base.
        tip: The farthest point (3,) on its centre line.
        flex: 0 = it turns about the base as one piece; 1 = it bends more and more towards the tip.
        share: Part of the opening that it takes; the other jaw takes the rest.
    """

    line: np.ndarray
    radii: np.ndarray
    tip: np.ndarray
    flex: float = 0.0
    share: float = 0.5

    def opened(self, side: int, opening_mm: float) -> np.ndarray:
        """Centres and tip (n + 1, 3) when the tips are about `opening_mm` apart; `side` is +1 for jaw 1."""
        points = np.vstack([self.line, self.tip])
        angle = 2 * self.share * np.arcsin(np.clip(opening_mm / 2 / np.hypot(*self.tip[:2]), 0.0, 0.71))
        angle = angle * np.clip(points[:, 0] / max(self.tip[0], 1e-3), 0, 1) ** self.flex
        x, y = points[:, 0], points[:, 1]
        cosine, sine = np.cos(angle), np.sin(angle)
        return np.column_stack([cosine * x - sine * y, side * (sine * x + cosine * y), points[:, 2]])


@dataclass(frozen=True, eq=False)
class Instrument:
    """A tool of two jaws, or an object without landmarks.

    Attributes:
        jaws: Two jaws; of an object without landmarks, up to two parts that move with its shaft.
        profile: (k, 2) distance behind the base and radius, mm, from the base outwards: steps, necks and collars.
        finishes: Of the shaft, and of the jaws.
        bend_per_mm: Curvature of the shaft.
        others: Objects that stand still beside it, each with its pose.
        has_landmarks: False for an object that only resembles the tool.
        seed: Of the brush marks.
    """

    jaws: tuple[Jaw, ...]
    profile: tuple[tuple[float, float], ...] = ((0.0, 0.3),)
    finishes: tuple[Finish, Finish] = (Finish(), Finish())
    bend_per_mm: float = 0.0
    others: tuple[tuple["Instrument", Pose], ...] = ()
    has_landmarks: bool = True
    seed: int = 0

    @property
    def jaw_length_mm(self) -> float:
        """Mean distance from the base to the tips of the closed tool."""
        return float(np.mean([np.hypot(*jaw.tip[:2]) for jaw in self.jaws] or [10 * self.shaft_radius_mm]))

    @property
    def shaft_radius_mm(self) -> float:
        """At the base."""
        return self.profile[0][1]

    @property
    def tip_radius_mm(self) -> float:
        """Radius of the ball in which the blunter jaw ends."""
        return max((float(jaw.radii[-1]) for jaw in self.jaws), default=0.0)

    def landmarks(self, pose: Pose) -> np.ndarray:
        """base, tip_1, tip_2 (3, 3) mm in the microscope frame; NaN for an object without landmarks."""
        if not self.has_landmarks:
            return np.full((3, 3), np.nan)
        tips = [jaw.opened(side, pose.opening_mm)[-1] for jaw, side in zip(self.jaws, (1, -1), strict=True)]
        return np.array([np.zeros(3), *tips]) @ pose.microscope_from_tool.T + np.asarray(pose.base_mm)

    def nodes(self, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres (n, 3) in the microscope frame, radii (n,) mm and chains (n,) of the round cones, as `Forceps.nodes`.

        Chain 0 is the shaft, 1 and 2 the jaws; each other object has the next three numbers.
        """
        parts = [(3 * k + chain, *part) for k, one in enumerate([(self, pose), *self.others])
                 for chain, part in enumerate(one[0].parts(one[1]))]  # fmt: skip
        chains = np.concatenate([np.full(len(radii), chain) for chain, _, radii in parts])
        return np.vstack([line for _, line, _ in parts]), np.concatenate([radii for _, _, radii in parts]), chains

    def parts(self, pose: Pose) -> list[tuple[np.ndarray, np.ndarray]]:
        """(centres in the microscope frame, radii) of the shaft and the jaws."""
        behind, radius = np.array(self.profile).T
        x = np.unique(np.concatenate([np.linspace(behind[-1], _SHAFT_MM, 20), behind]))[::-1]
        shaft = np.column_stack([-x, 0.5 * self.bend_per_mm * x * x, np.zeros(len(x))]), np.interp(x, behind, radius)
        jaws = [(jaw.opened(side, pose.opening_mm)[:-1], jaw.radii) for jaw, side in zip(self.jaws, (1, -1), strict=False)]
        turn, base = pose.microscope_from_tool.T, np.asarray(pose.base_mm)
        return [(line @ turn + base, r) for line, r in [shaft, *jaws]]


def finished(
    raster: object, tool: Instrument, lamp: np.ndarray, scene: np.ndarray, zoom: float, clearance_mm: float
) -> np.ndarray:
    """Linear colour (n, 3) of the raster's tool samples under the lamp (3,), with `scene` (h, w, 3) mirrored in them.

    Args:
        zoom: px per mm of the scene's image.
        clearance_mm: Mean height of the tool above the scene.
    """
    normal, tangent = raster.normal, raster.tangent
    chain = raster.part[raster.hit].astype(int) - 1
    finishes = [f for one in (tool, *(other for other, _ in tool.others)) for f in (one.finishes[0], *[one.finishes[1]] * 2)]
    matt, mirror, shine, sharpness, brushed, colour = (
        np.array([getattr(finish, name) for finish in finishes], np.float32)[chain]
        for name in ("matt", "mirror", "shine", "sharpness", "brushed", "colour")
    )
    lamp = lamp.astype(np.float32)
    half = (lamp - [0, 0, 1]).astype(np.float32)
    half /= np.linalg.norm(half)
    to_half, along = np.clip(normal @ half, 0, 1), tangent @ half
    streak = np.maximum(1 - along * along, 0) ** sharpness * to_half**4
    # The view ray (0, 0, 1), mirrored: where it goes down it meets the scene, where it goes up the room and the lamp.
    up = 2 * normal[:, 2] ** 2 - 1
    shift = -2 * normal[:, 2:] * normal[:, :2] * (zoom * clearance_mm / np.maximum(-up, 0.15))[:, None]
    sky = 0.08 + 0.75 / (1 + np.exp(-(up - 0.6) / 0.12))
    small = cv2.GaussianBlur(cv2.resize(scene, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), (0, 0), 1.5)
    at = [(sample + 0.5) / raster.factor + first for sample, first in zip(raster.hit[::-1], raster.origin_px, strict=True)]
    column, row = (np.clip((at[i] + shift[:, i]) / 4, 0, small.shape[1 - i] - 1).astype(int) for i in (0, 1))
    below, down = small[row, column], np.clip(0.5 - 2.5 * up, 0, 1)[:, None]
    marks = np.random.default_rng([tool.seed, 3]).standard_normal((64, 128)).astype(np.float32)
    marks = cv2.GaussianBlur(marks, (0, 0), sigmaX=4, sigmaY=0.8)
    around = (normal[:, 0] * tangent[:, 1] - normal[:, 1] * tangent[:, 0]) * 31 + 32
    marks = marks[around.astype(int) % 64, (raster.along_mm * 6).astype(int) % 128] / marks.std()
    brush = np.clip(1 + brushed * marks, 0.2, 2)
    even = (matt * brush)[:, None] * ((0.12 + 0.9 * np.clip(normal @ lamp, 0, 1))[:, None]
                                      + 0.3 * np.clip(0.4 - up, 0, 1.4)[:, None] * below)  # fmt: skip
    mirrored = (mirror * brush)[:, None] * (down * below + (1 - down) * sky[:, None])
    return colour * (even + mirrored) + (shine * (0.4 * to_half**sharpness + 0.8 * streak))[:, None]
