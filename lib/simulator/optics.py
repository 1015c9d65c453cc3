"""Blur of linear light by depth and by motion."""

from __future__ import annotations

import cv2
import numpy as np

from lib.simulator.window import Grid

__all__ = ["blur", "blur_by_depth", "motion_kernel"]


def blur(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian blur; a width too small to see leaves the image as it is."""
    return cv2.GaussianBlur(image, (0, 0), sigma_px) if sigma_px > 0.15 else image


def blur_by_depth(image: np.ndarray, sigma_px: np.ndarray, grid: Grid | None = None) -> np.ndarray:
    """Gaussian blur whose width varies slowly over the image: a blend, linear in variance, of up to three blurs.

    `sigma_px` is given on the coarse grid, or for every pixel where `grid` is None.
    """
    low, high = float(sigma_px.min()), float(sigma_px.max())
    if high - low < 0.15:
        return blur(image, (low + high) / 2)
    levels = np.linspace(low, high, 3 if high - low > 0.8 else 2)
    stack = [blur(image, level) for level in levels]
    result = stack[0]
    for k in range(1, len(levels)):
        share = (sigma_px**2 - levels[k - 1] ** 2) / (levels[k] ** 2 - levels[k - 1] ** 2)
        share = np.clip(grid.full(share) if grid else share, 0, 1).astype(np.float32)[..., None]
        result = result + share * (stack[k] - result)
    return result


def motion_kernel(shift_px: np.ndarray) -> np.ndarray | None:
    """A centred box along the movement (2,) px during the exposure, or None if it is too short to see."""
    length = float(np.hypot(*shift_px))
    if length < 0.3:
        return None
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1,) * 2, np.float32)
    for t in np.linspace(-0.5, 0.5, 4 * half + 1):
        x, y = t * shift_px + half
        i, j = int(np.floor(y)), int(np.floor(x))
        fy, fx = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
    return kernel / kernel.sum()
