"""A sphere as the prior of the retina, the baseline that the paper argues against (Sec. IV-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from lib.cameras import AffineCamera
from lib.geometry import finite_points, points


@dataclass(frozen=True, eq=False)
class Sphere:
    """Points at `radius_mm` from `centre_mm` (3,); `inliers` (n,) are the points that the fit used."""

    centre_mm: np.ndarray
    radius_mm: float
    inliers: np.ndarray

    def along_view(self, u: ArrayLike, camera: AffineCamera, *, bowl: bool = True) -> np.ndarray:
        """The points (n, 3) mm in which the camera's rays through u (n, 2) meet the sphere; NaN if they miss it.

        `bowl` selects the far side, which is visible in an eye seen from within; otherwise it is the near side.
        """
        d = camera.viewing_direction
        ray = (points(u, 2, "u") - camera.offset_px) @ np.linalg.pinv(camera.linear).T
        to_centre = self.centre_mm - ray
        along = to_centre @ d
        half_chord = np.sqrt(
            np.where((squared := self.radius_mm**2 - (to_centre**2).sum(axis=1) + along**2) >= 0, squared, np.nan)
        )
        return ray + (along + (half_chord if bowl else -half_chord))[:, None] * d


def fit_sphere(x_mm: ArrayLike, *, reject_medians: float = 5.0) -> Sphere:
    """Robust fit of a sphere to points (n, 3): soft L1 loss, then rejection of outliers and a second fit.

    Raises
    ------
    ValueError
        If there are fewer than four points, a NaN, or all points lie in a plane.
    """
    x = finite_points(x_mm, 3, "x_mm")
    if len(x) < 4:
        raise ValueError(f"x_mm: a sphere needs 4 points or more, got {len(x)}.")
    mean = x.mean(axis=0)
    size = np.linalg.svd(x - mean, compute_uv=False)
    if size[2] < 1e-9 * size[0]:
        raise ValueError("x_mm: the points lie in a plane, which no single sphere fits best.")
    unit = size[0] / np.sqrt(len(x))

    def solve(chosen: np.ndarray) -> np.ndarray:
        points_ = (x[chosen] - mean) / unit
        # Algebraic start: |x|^2 = 2 c.x + (r^2 - |c|^2) is linear.
        design = np.column_stack([2 * points_, np.ones(len(points_))])
        linear = np.linalg.lstsq(design, (points_**2).sum(axis=1), rcond=None)[0]
        start = np.append(linear[:3], np.sqrt(max(linear[3] + linear[:3] @ linear[:3], 1e-12)))
        scale = max(np.median(np.abs(distance(points_, start))), 1e-9)
        return least_squares(lambda s: distance(points_, s), start, loss="soft_l1", f_scale=scale, x_scale="jac").x

    def distance(p: np.ndarray, s: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p - s[:3], axis=1) - s[3]

    all_points = np.ones(len(x), dtype=bool)
    residual = np.abs(distance((x - mean) / unit, solve(all_points)))
    inliers = residual <= max(reject_medians * np.median(residual), 1e-12)
    found = solve(inliers)
    return Sphere(mean + unit * found[:3], float(unit * abs(found[3])), inliers)
