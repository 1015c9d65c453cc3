"""A bowl under the reference rig, with matches on it: what every surface test sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from lib.cameras import Points, StereoRig
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.surface_evaluation import surface_on_rays

DOMAIN = (300.0, 150.0, 1620.0, 930.0)


@dataclass(frozen=True)
class Bowl:
    """Matches on a bowl of 12 mm radius with an undulation; `outlier` marks gross errors along the view."""

    rig: StereoRig
    u_left: np.ndarray
    points: Points
    outlier: np.ndarray
    domain: tuple[float, float, float, float] = DOMAIN

    def truth(self, u: np.ndarray) -> np.ndarray:
        """The surface point (n, 3) in the robot frame on the left camera's ray through each u (n, 2)."""
        return surface_on_rays(self.rig.left, depth_mm, u)

    def depth_error_mm(self, surface) -> np.ndarray:
        """Error along the view on a lattice of the domain."""
        x0, y0, x1, y1 = self.domain
        u = np.stack(np.meshgrid(np.linspace(x0, x1, 50), np.linspace(y0, y1, 35)), axis=-1).reshape(-1, 2)
        return (surface(u) - self.truth(u)) @ self.rig.left.viewing_direction


def depth_mm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Depth below the focal plane in the microscope frame: a bowl seen from above."""
    return np.sqrt(144 - x**2 - y**2) - 12 + 0.05 * np.sin(x) * np.cos(1.3 * y)


def make_bowl(n: int = 2000, *, noise_px: float = 0.3, outliers: float = 0.05, seed: int = 0) -> Bowl:
    rng, rig = np.random.default_rng(seed), reference_rig()
    x, y = rng.uniform((-7.5, -4.8), (7.5, 4.8), (n, 2)).T
    u_left, u_right = rig.project(ROBOT_FROM_MICROSCOPE.apply(np.column_stack([x, y, depth_mm(x, y)])))
    u_right = u_right + rng.normal(0, noise_px, u_right.shape)
    outlier = rng.random(n) < outliers
    u_right[outlier, 0] += rng.uniform(-30, 30, outlier.sum())
    return Bowl(rig, u_left, rig.triangulate(u_left, u_right, noise_px**2 / 2), outlier)


@pytest.fixture(scope="session")
def bowl() -> Bowl:
    return make_bowl()


@pytest.fixture(scope="session")
def bowl_factory():
    return make_bowl
