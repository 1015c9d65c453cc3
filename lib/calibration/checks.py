"""Plausibility checks before any fit: each raises a `DataError` with the reason and the cure."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chndtrix

from lib.correspondences import DataError
from lib.geometry import finite_points

#: Plausible zooms (px per mm), from a room camera to the resolution of light; beyond them positions have the wrong unit.
PLAUSIBLE_PX_PER_MM = (0.2, 5000.0)
#: The robot accuracy (the paper's) assumed where none is given, for judging whether points are coplanar.
ROBOT_ACCURACY_MM = 0.010
_NAMES = {1: ["u"], 2: ["u_left", "u_right"]}  # number of cameras -> names of their pixels in messages


def stacked_rows(x_mm: ArrayLike, u: Sequence[ArrayLike]) -> tuple[np.ndarray, np.ndarray]:
    """x (n, 3) and the stacked pixels y (n, 2 or 4) of one or two cameras; checks that all are finite and n >= 4."""
    x = finite_points(x_mm, 3, "x_mm")
    u = [u] if isinstance(u, np.ndarray) and u.ndim == 2 else list(u)
    if len(u) not in _NAMES:
        raise ValueError(f"u: expected [u_left, u_right] or [u], got {len(u)} arrays.")
    y = [finite_points(pixels, 2, name) for pixels, name in zip(u, _NAMES[len(u)], strict=True)]
    for pixels, name in zip(y, _NAMES[len(u)], strict=True):
        if len(pixels) != len(x):
            raise ValueError(f"{name}: {len(pixels)} points, x_mm has {len(x)}; correspondences go row by row.")
    if len(x) < 4:
        raise DataError(f"x_mm: {len(x)} points; an affine camera needs at least 4, better 50, not in one plane.")
    return x, np.hstack(y)


def check_spread(x: np.ndarray, sigma_x_mm: float = 0.0) -> None:
    """Refuse coplanar points: thinner than points of a true thickness of 2 sigma_x would look with a probability of 1e-9.

    A few points may look thin by chance, so they pass; their covariance is large, and `lib.trust` doubts thin sets.
    """
    n, extent = len(x), extents(x)
    chance = np.sqrt(chndtrix(1e-9, max(n - 3, 1), 4.0 * n) / n)  # the thickness has a non-central chi-square distribution
    least = max(1e-6 * extent[0], chance * sigma_x_mm)
    if extent[0] <= least:
        raise DataError(f"x_mm: the points hardly move (RMS {extent[0]:.3g} mm); move the tool through the volume.")
    cures = {"collinear": "move the tool in all three directions", "coplanar": "cover a few depths as well"}
    for size, (shape, cure) in zip(extent[1:], cures.items(), strict=True):
        if size <= least:
            raise DataError(f"x_mm: the points are {shape} (RMS {size:.3g} mm, robot errors {sigma_x_mm:.3g} mm); {cure}.")


def extents(x: np.ndarray) -> np.ndarray:
    """(3,) RMS extents of points (n, 3) along their principal axes, the largest first; the last is their thickness."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh((c := x - x.mean(axis=0)).T @ c / len(x))[::-1], 0.0))


def check_units(x: np.ndarray, y: np.ndarray) -> None:
    """Refuse points that imply an impossible zoom: metres or micrometres given as millimetres."""

    def extent(parts: Sequence[np.ndarray]) -> float:  # robust: a few gross outliers must not look like another unit
        known = [part[np.isfinite(part).all(axis=1)] for part in parts]  # np.nanmedian is slow
        sizes = [np.median(np.abs(part - np.median(part, axis=0)), axis=0).max() for part in known]
        return float(max(sizes) or max(part.std(axis=0).max() for part in known))

    size = extent([x])
    if size <= 1e-9 * np.abs(x).max():
        return  # no motion at all: `check_spread` refuses that
    zoom, (low, high) = extent(np.split(y, y.shape[1] // 2, axis=1)) / size, PLAUSIBLE_PX_PER_MM
    if zoom > high:
        raise DataError(f"x_mm: {zoom:.3g} px per mm is finer than light resolves; multiply metres by 1000.")
    if zoom < low:
        raise DataError(f"x_mm: {zoom:.3g} px per mm is too coarse; divide micrometres by 1000, or move the tool.")


def check_duplicates(x: np.ndarray, y: np.ndarray) -> None:
    """Refuse rows that repeat another row in every digit: they add no information but would lower the covariance."""
    repeated = len(x) - len({row.tobytes() for row in np.hstack([x, y])})  # np.unique of rows sorts them
    if repeated:
        raise DataError(f"x_mm, u: {repeated} of {len(x)} rows repeat another row; drop frames frozen or read twice.")


def check_images(y: np.ndarray, image_size_px: tuple[int, int] | None = None) -> None:
    """Refuse pixels (n, m) that do not move or lie on a line in a camera, are the same in both, or leave the image."""
    names = _NAMES[y.shape[1] // 2]
    for name, u in zip(names, np.split(y, len(names), axis=1), strict=True):
        u = u[np.isfinite(u).all(axis=1)]
        if len(u) < 4:
            raise DataError(f"{name}: {len(u)} detections; an affine camera needs at least 4, better 50, not in one plane.")
        if np.linalg.svd(u - u.mean(axis=0), compute_uv=False)[1] <= 1e-9 * np.abs(u).max() * np.sqrt(len(u)):
            raise DataError(f"{name}: the detections stand still or lie on one line; is this the moving tool?")
        if image_size_px is not None:
            limit = np.asarray(image_size_px, dtype=float)
            outside, swapped = (((v < -0.1 * limit) | (v > 1.1 * limit)).any(axis=1).mean() for v in (u, u[:, ::-1]))
            if outside > 0.1 and swapped < 0.5 * outside:
                raise DataError(f"{name}: {100 * outside:.0f} % lie outside the image; give (x, y), not (row, column).")
    both = y[np.isfinite(y).all(axis=1)]
    if len(names) == 2 and len(both) and (both[:, :2] == both[:, 2:]).all(axis=1).mean() > 0.5:
        raise DataError("u_right: the same pixels as u_left; give the right camera's own detections.")


def sides(A: np.ndarray) -> tuple[float, float]:
    """Baseline from the left to the right camera of A (4, 3), along and across the image rows, as an angle in rad."""
    a, b, c, d = A / np.linalg.norm(A, axis=1, keepdims=True)
    left, right = np.cross(a, b), np.cross(c, d)
    apart = left / np.linalg.norm(left) - right / np.linalg.norm(right)  # positions are opposite to viewing directions
    return apart @ (a + c) / 2, apart @ (b + d) / 2


def eyes_exchanged(A: np.ndarray, sd_rad: float) -> bool:
    """True if the left camera of a stereo head A (4, 3) is certainly on the right.

    This needs images rotated by at most 30 degrees to each other, axes that converge by 1 to 30 degrees, a baseline within
    34 degrees of the image rows, and one of the wrong sign by at least five standard deviations `sd_rad` of the convergence.
    """
    rows = A / np.linalg.norm(A, axis=1, keepdims=True)
    if (rows[:2] * rows[2:]).sum(axis=1).min() < np.cos(np.deg2rad(30)):
        return False
    along, across = sides(A)
    return bool(np.deg2rad(1) < np.hypot(along, across) < np.deg2rad(30) and along < -max(1.5 * abs(across), 5.0 * sd_rad))
