"""The forceps: a shaft and two curved tapered jaws, as chains of round cones, and their landmarks.

Tool frame: the origin is the base, x runs along the shaft towards the tips, y points towards jaw 1, z = x cross y.
The base is the point on the shaft's axis where the shaft ends and the jaws begin.  tip_1 and tip_2 are the ends of the
jaws.  Jaw 1 is the left jaw for an observer at the microscope who looks along the shaft towards the tips.  So in an
image that is not mirrored, tip_1 lies left of the direction from base to tips.  `Pose` limits the roll about the shaft
to 60 degrees, so that this holds in every image.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lib.simulator.limits import check, not_negative, positive

__all__ = ["MAX_PITCH_RAD", "MAX_ROLL_RAD", "MAX_TIP_RADIUS_MM", "Forceps", "Pose"]

MAX_ROLL_RAD = np.deg2rad(60.0)
MAX_PITCH_RAD = np.deg2rad(60.0)
MAX_TIP_RADIUS_MM = 0.02


@dataclass(frozen=True)
class Pose:
    """Where the tool is, in the microscope frame.

    Attributes:
        base_mm: The base (3,).
        azimuth_rad: Direction from base to tips in the image plane, measured from x (right) towards y (down).
        pitch_rad: Angle by which the tips dip below the base, into the eye; 0 is parallel to the image.
        roll_rad: Rotation about the shaft; at 0 both jaws are equally deep.
        opening_mm: Distance between the tips.
    """

    base_mm: tuple[float, float, float] = (0.0, 0.0, -1.0)
    azimuth_rad: float = 0.0
    pitch_rad: float = 0.35
    roll_rad: float = 0.0
    opening_mm: float = 0.8

    def __post_init__(self) -> None:
        if np.shape(self.base_mm) != (3,) or not np.isfinite(self.base_mm).all():
            raise ValueError(f"base_mm: expected three finite coordinates, got {self.base_mm}.")
        check(self, "pitch_rad", lambda v: 0 <= v <= MAX_PITCH_RAD, f"must lie between 0 and {MAX_PITCH_RAD:.2f}")
        rule = f"beyond {MAX_ROLL_RAD:.2f} an image no longer tells tip_1 from tip_2"
        check(self, "roll_rad", lambda v: abs(v) <= MAX_ROLL_RAD, rule)
        not_negative(self, "opening_mm")

    @property
    def microscope_from_tool(self) -> np.ndarray:
        """Rotation (3, 3): columns are the tool's x, y and z in the microscope frame."""
        # At azimuth 0 jaw 1 (tool y) points up in the image, -y; the tool's z then points out of the eye.
        upright = np.diag([1.0, -1.0, -1.0])
        turn = Rotation.from_euler("ZY", [self.azimuth_rad, -self.pitch_rad]).as_matrix()
        return turn @ upright @ Rotation.from_euler("x", self.roll_rad).as_matrix()


@dataclass(frozen=True)
class Forceps:
    """The design of a forceps; lengths in mm.

    Attributes:
        shaft_radius_mm: Radius of the shaft; 0.3 is the usual 23 gauge, 0.6 mm thick.
        jaw_length_mm: Distance along the shaft's axis from the base to the tips of the closed tool.
        jaw_radius_mm, tip_radius_mm: Radius of a jaw at the base and at its end; a power law connects the two.
        taper: Exponent of the power law.  1 is a cone; below 1 the jaw stays thick until close to the tip.
        bow_mm: Distance by which each jaw arches outwards in the middle when the tips touch.
        bend_mm: Distance by which both tips bend out of the plane of the jaws, towards the retina.
        hook_mm: Distance by which the last fifth of each jaw turns inwards.
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
    shaft_length_mm: float = 40.0
    brightness: float = 0.55
    brushed: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        positive(self, "shaft_radius_mm jaw_length_mm jaw_radius_mm tip_radius_mm taper shaft_length_mm")
        radii = self.tip_radius_mm, self.jaw_radius_mm, self.shaft_radius_mm
        if not radii[0] <= radii[1] <= radii[2]:
            raise ValueError(f"tip_radius_mm, jaw_radius_mm, shaft_radius_mm: must not decrease in this order, got {radii}.")
        rule = f"beyond {MAX_TIP_RADIUS_MM} a tip is no point to measure"
        check(self, "tip_radius_mm", lambda v: v <= MAX_TIP_RADIUS_MM, rule)
        check(self, "brightness", lambda v: 0 < v <= 1, "must lie between 0 and 1")

    def _jaw(self, side: int, opening_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Centreline (n, 3) in the tool frame and radii (n,), from the base to the tip; `side` +1 is jaw 1.

        The last centre lies one tip radius before the landmark, so that the landmark is the jaw's end.
        """
        s = 1 - (1 - np.linspace(0, 1, 15)) ** 1.4  # denser towards the tip
        half = max(opening_mm / 2, self.tip_radius_mm)
        root = 0.45 * self.jaw_radius_mm
        y = root * (1 - s) ** 2 + self.bow_mm * np.sin(np.pi * s) ** 1.2
        y += self.hook_mm * np.clip((s - 0.6) / 0.2, 0, 1) * np.clip((1 - s) / 0.2, 0, 1)
        y += half * s**1.5
        # Opening the jaws turns them, it does not stretch them.
        x = s * np.sqrt(max(self.jaw_length_mm**2 - max(half - self.tip_radius_mm, 0) ** 2, 1e-6))
        line = np.column_stack([x, side * y, -self.bend_mm * s**2])
        radii = self.tip_radius_mm + (self.jaw_radius_mm - self.tip_radius_mm) * (1 - s) ** self.taper
        end = line[-1] - line[-2]
        line[-1] -= self.tip_radius_mm * end / np.linalg.norm(end)
        return line, radii

    def landmarks(self, pose: Pose) -> np.ndarray:
        """base, tip_1, tip_2 (3, 3) mm in the microscope frame."""
        points = [np.zeros(3)]
        for side in (+1, -1):
            line, radii = self._jaw(side, pose.opening_mm)
            direction = line[-1] - line[-2]
            points.append(line[-1] + radii[-1] * direction / np.linalg.norm(direction))
        return np.array(points) @ pose.microscope_from_tool.T + np.asarray(pose.base_mm)

    def nodes(self, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The tool as chains of round cones, in the microscope frame.

        Returns: (n, 3) centres, (n,) radii in mm, (n,) chain of each node: 0 shaft (far end first), 1 and 2 the jaws.
        """
        k = max(2, round(self.shaft_length_mm) + 1)
        shaft = np.column_stack([np.linspace(-self.shaft_length_mm, 0, k), np.zeros(k), np.zeros(k)])
        parts = [(shaft, np.full(k, self.shaft_radius_mm)), *(self._jaw(side, pose.opening_mm) for side in (+1, -1))]
        lines, radii = zip(*parts, strict=True)
        centres = np.vstack(lines) @ pose.microscope_from_tool.T + np.asarray(pose.base_mm)
        return centres, np.concatenate(radii), np.repeat(np.arange(3), [len(line) for line in lines])
