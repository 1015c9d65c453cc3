"""Tools and their landmarks, as chains of round cones: the reference forceps, and instruments of any shape.

Tool frame: the origin is the base, where the jaws leave the shaft's axis; x runs along the shaft towards the tips, y points
towards jaw 1, z = x cross y.  A tip is the farthest point of a jaw on its own centre line; of a ring or a spoon, its far end.
Jaw 1 is the left jaw for an observer at the microscope who looks along the shaft towards the tips.  It is also the left jaw
in every image that is not mirrored, because `Pose` limits the roll about the shaft to 60 degrees.
"""

import math
from dataclasses import dataclass

import numpy as np

from lib.geometry import check

MAX_ROLL_RAD = np.deg2rad(60.0)
MAX_PITCH_RAD = np.deg2rad(60.0)
MAX_TIP_RADIUS_MM = 0.02
_SHAFT_MM = 40.0
_ALONG = 1 - (1 - np.linspace(0, 1, 15)) ** 1.4  # positions along a jaw of `Forceps`, denser towards the tip
_BOW, _HOOK = np.sin(np.pi * _ALONG) ** 1.2, np.clip((_ALONG - 0.6) / 0.2, 0, 1) * np.clip((1 - _ALONG) / 0.2, 0, 1)

#: Round cones: centres (n, 3) in the microscope frame, radii (n,) mm, and the chain (n,) that each belongs to.
Nodes = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Pose:
    """The tool's pose in the microscope frame: its base (3,), its direction, and the distance between its tips.

    `azimuth_rad` is the direction from base to tips in the image plane, from x (right) towards y (down).  `pitch_rad` is the
    angle by which the tips point into the eye.  `roll_rad` turns the tool about its shaft; at 0 both jaws are equally deep.
    """

    base_mm: tuple[float, float, float] = (0.0, 0.0, -1.0)
    azimuth_rad: float = 0.0
    pitch_rad: float = 0.35
    roll_rad: float = 0.0
    opening_mm: float = 0.8

    def __post_init__(self) -> None:
        check(self, "base_mm", lambda v: np.shape(v) == (3,) and np.isfinite(v).all(), "expected three finite coordinates")
        check(self, "azimuth_rad", math.isfinite, "must be finite")
        check(self, "pitch_rad", lambda v: 0 <= v <= MAX_PITCH_RAD, f"must lie between 0 and {MAX_PITCH_RAD:.2f}")
        rule = f"beyond {MAX_ROLL_RAD:.2f} an image no longer tells tip_1 from tip_2"
        check(self, "roll_rad", lambda v: abs(v) <= MAX_ROLL_RAD, rule)
        check(self, "opening_mm", lambda v: v >= 0, "must not be negative")

    @property
    def microscope_from_tool(self) -> np.ndarray:
        """Rotation (3, 3): columns are the tool's x, y and z in the microscope frame."""
        (a, b), (c, d), (e, f) = ((math.cos(v), math.sin(v)) for v in (self.azimuth_rad, self.pitch_rad, self.roll_rad))
        turn = np.array([[a * c, -b, -a * d], [b * c, a, -b * d], [d, 0.0, c]])  # about z, then about y by -pitch
        # At azimuth 0 jaw 1 (tool y) points up in the image, -y; the tool's z then points out of the eye.
        return turn @ np.diag([1.0, -1.0, -1.0]) @ np.array([[1.0, 0.0, 0.0], [0.0, e, -f], [0.0, f, e]])

    def place(self, points: np.ndarray) -> np.ndarray:
        """Transform points (n, 3) mm from the tool frame to the microscope frame."""
        return points @ self.microscope_from_tool.T + np.asarray(self.base_mm)


@dataclass(frozen=True)
class Forceps:
    """The design of a forceps; lengths in mm.

    Attributes:
        shaft_radius_mm: 0.3 is the usual 23 gauge, 0.6 mm thick.
        jaw_length_mm: From the base to the tips of the closed tool, along the shaft's axis.
        jaw_radius_mm, tip_radius_mm, taper: Radii of a jaw at its ends, and the exponent between; 1 is a cone.
        bow_mm, bend_mm, hook_mm: Distances by which each closed jaw arches outwards in its middle, by which both tips bend
            out of the jaws' plane towards the retina, and by which the last fifth of a jaw turns inwards.
        brightness, brushed: Reflectance of the metal, and contrast of its brush marks.
    """

    shaft_radius_mm: float = 0.30
    jaw_length_mm: float = 3.0
    jaw_radius_mm: float = 0.13
    tip_radius_mm: float = 0.005
    taper: float = 0.6
    bow_mm: float = 0.18
    bend_mm: float = 0.20
    hook_mm: float = 0.05
    brightness: float = 0.55
    brushed: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        check(self, "shaft_radius_mm jaw_length_mm jaw_radius_mm tip_radius_mm taper", lambda v: v > 0, "must be positive")
        radii = self.tip_radius_mm, self.jaw_radius_mm, self.shaft_radius_mm
        if not radii[0] <= radii[1] <= radii[2]:
            raise ValueError(f"tip_radius_mm, jaw_radius_mm, shaft_radius_mm: must not decrease in this order, got {radii}.")
        rule = f"beyond {MAX_TIP_RADIUS_MM} a tip is not a point"
        check(self, "tip_radius_mm", lambda v: v <= MAX_TIP_RADIUS_MM, rule)
        check(self, "brightness", lambda v: 0 < v <= 1, "must lie between 0 and 1")

    def _jaw(self, side: int, opening_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centre line (n, 3) in the tool frame, radii (n,), and the landmark one tip radius beyond the line; +1 is jaw 1."""
        s, half, root = _ALONG, max(opening_mm / 2, self.tip_radius_mm), 0.45 * self.jaw_radius_mm
        y = root * (1 - s) ** 2 + self.bow_mm * _BOW + self.hook_mm * _HOOK + half * s**1.5
        # Opening the jaws rotates them and does not stretch them.
        x = s * np.sqrt(max(self.jaw_length_mm**2 - max(half - self.tip_radius_mm, 0) ** 2, 1e-6))
        line = np.column_stack([x, side * y, -self.bend_mm * s**2])
        radii = self.tip_radius_mm + (self.jaw_radius_mm - self.tip_radius_mm) * (1 - s) ** self.taper
        tip, end = line[-1].copy(), line[-1] - line[-2]
        line[-1] -= self.tip_radius_mm * end / np.linalg.norm(end)
        return line, radii, tip

    def landmarks(self, pose: Pose) -> np.ndarray:
        """Positions (3, 3) mm of base, tip_1 and tip_2 in the microscope frame."""
        return pose.place(self._jaw(+1, pose.opening_mm)[2] * [[0, 0, 0], [1, 1, 1], [1, -1, 1]])  # mirror images

    def nodes(self, pose: Pose) -> Nodes:
        """The tool as chains of round cones: 0 is the shaft (far end first), 1 and 2 the jaws."""
        k = round(_SHAFT_MM) + 1
        shaft = np.column_stack([np.linspace(-_SHAFT_MM, 0, k), np.zeros(k), np.zeros(k)])
        parts = [(shaft, np.full(k, self.shaft_radius_mm)), *(self._jaw(side, pose.opening_mm)[:2] for side in (+1, -1))]
        lines, radii = zip(*parts, strict=True)
        return pose.place(np.vstack(lines)), np.concatenate(radii), np.repeat(np.arange(3), [len(line) for line in lines])


@dataclass(frozen=True)
class Finish:
    """The look of a surface: `colour` is its linear reflectance (3,); 0.02 is black, 0.9 a mirror.

    `matt` and `mirror` are the shares of diffuse reflection, and of mirror reflection of the scene and the sky.  `shine` and
    `sharpness` are the strength of the lamp's highlight and its exponent, `brushed` the contrast of marks along the part.
    """

    colour: tuple[float, float, float] = (0.5, 0.5, 0.49)
    matt: float = 0.5
    mirror: float = 0.4
    shine: float = 0.6
    sharpness: float = 30.0
    brushed: float = 0.1


@dataclass(frozen=True, eq=False)
class Jaw:
    """A closed jaw in the tool frame; y is the distance from the plane between the jaws, for either jaw.

    `line` (n, 3) and `radii` (n,) mm are its round cones, from the base; `tip` is the farthest point (3,) on its centre
    line.  With `flex` 0 it opens as a rigid piece, with 1 it bends towards the tip.  `share` is its share of the opening.
    """

    line: np.ndarray
    radii: np.ndarray
    tip: np.ndarray
    flex: float = 0.0
    share: float = 0.5

    def opened(self, side: int, opening_mm: float) -> np.ndarray:
        """Centres and tip (n + 1, 3) of the opened jaw, with the tips about `opening_mm` apart; `side` is +1 for jaw 1."""
        x, y, z = np.vstack([self.line, self.tip]).T
        angle = 2 * self.share * np.arcsin(np.clip(opening_mm / 2 / np.hypot(*self.tip[:2]), 0.0, 0.71))
        angle = angle * np.clip(x / max(self.tip[0], 1e-3), 0, 1) ** self.flex
        cosine, sine = np.cos(angle), np.sin(angle)
        return np.column_stack([cosine * x - sine * y, side * (sine * x + cosine * y), z])


@dataclass(frozen=True, eq=False)
class Instrument:
    """A tool of two jaws, or an object without landmarks.

    Attributes:
        jaws: Two jaws; for an object without landmarks, up to two parts that move with its shaft.
        profile: (k, 2) distance behind the base and radius of the shaft, mm, from the base outwards.
        finishes: Finish of the shaft, and of the jaws.
        bend_per_mm: Curvature of the shaft.
        others: Objects that stand still beside the tool, each with its pose.
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
        """Radius of the shaft at the base."""
        return self.profile[0][1]

    @property
    def tip_radius_mm(self) -> float:
        """Radius of the ball at the end of the blunter jaw."""
        return max((float(jaw.radii[-1]) for jaw in self.jaws), default=0.0)

    def landmarks(self, pose: Pose) -> np.ndarray:
        """Positions (3, 3) mm of base, tip_1 and tip_2 in the microscope frame; NaN for an object without landmarks."""
        if not self.has_landmarks:
            return np.full((3, 3), np.nan)
        tips = [jaw.opened(side, pose.opening_mm)[-1] for jaw, side in zip(self.jaws, (1, -1), strict=True)]
        return pose.place(np.array([np.zeros(3), *tips]))

    def nodes(self, pose: Pose) -> Nodes:
        """As `Forceps.nodes`; the chains of each further object have the next three numbers."""
        parts = []
        for k, (tool, at) in enumerate([(self, pose), *self.others]):
            behind, radius = np.array(tool.profile).T
            x = np.unique(np.concatenate([np.linspace(behind[-1], _SHAFT_MM, 20), behind]))[::-1]
            shaft = np.column_stack([-x, 0.5 * tool.bend_per_mm * x * x, np.zeros(len(x))]), np.interp(x, behind, radius)
            jaws = [(jaw.opened(side, at.opening_mm)[:-1], jaw.radii) for jaw, side in zip(tool.jaws, (1, -1), strict=False)]
            parts += [(3 * k + chain, at.place(line), r) for chain, (line, r) in enumerate([shaft, *jaws])]
        chains = np.concatenate([np.full(len(radii), chain) for chain, _, radii in parts])
        return np.vstack([line for _, line, _ in parts]), np.concatenate([radii for _, _, radii in parts]), chains
