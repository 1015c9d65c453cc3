"""Windows around landmarks: upright crops in which the tool points right, at full resolution.

The second stage of the detector looks at one small window per landmark.  Each is turned so that the direction from
base to tips points right and tip_1, the left one for somebody who looks along the tool, lies above: whatever
the tool's direction in the image, the network sees one pose.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

__all__ = ["cut", "direction_rad", "map_points", "tool_centre", "window_from_image"]


def direction_rad(u: ArrayLike) -> np.ndarray:
    """Angle (n,) of base to the mean of the known tips, from x towards y; NaN without a base or without a tip."""
    u = np.asarray(u, dtype=np.float64)
    known = np.isfinite(u[:, 1:]).all(axis=2)
    tips = np.where(known[..., None], u[:, 1:], 0).sum(1) / np.maximum(known.sum(1), 1)[:, None]
    d = tips - u[:, 0]
    return np.where(known.any(1), np.arctan2(d[:, 1], d[:, 0]), np.nan)


def tool_centre(u: ArrayLike) -> np.ndarray:
    """Halfway (n, 2) between the base and the mean of the known tips; NaN without a base or without a tip."""
    u = np.asarray(u, dtype=np.float64)
    known = np.isfinite(u[:, 1:]).all(axis=2)
    tips = np.where(known[..., None], u[:, 1:], 0).sum(1) / np.maximum(known.sum(1), 1)[:, None]
    return np.where(known.any(1)[:, None], (u[:, 0] + tips) / 2, np.nan)


def window_from_image(centre: ArrayLike, angle_rad: ArrayLike, size: int, zoom: ArrayLike = 1.0) -> np.ndarray:
    """Matrices (..., 2, 3) that turn by -angle about `centre` (..., 2) and bring it to the middle of the window."""
    centre, angle = np.asarray(centre, dtype=np.float64), np.asarray(angle_rad, dtype=np.float64)
    c, s = np.cos(angle) * zoom, np.sin(angle) * zoom
    linear = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    shift = (size - 1) / 2 - (linear @ centre[..., None])
    return np.concatenate([linear, shift], -1)


def map_points(matrix: np.ndarray, u: ArrayLike) -> np.ndarray:
    """Points (n, 2) through a (2, 3) matrix, or point i (..., 2) through matrix i (..., 2, 3)."""
    return (matrix[..., :2] @ np.asarray(u, dtype=np.float64)[..., None])[..., 0] + matrix[..., 2]


def cut(image: np.ndarray, matrix: np.ndarray, size: int) -> np.ndarray:
    """The window (size, size, 3) uint8 of an image; black where it leaves the image."""
    return cv2.warpAffine(image, matrix, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
