"""Images as the detector takes them: checked, and as tensors for the networks."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

__all__ = ["as_tensor", "as_uint8"]


def as_uint8(images: ArrayLike) -> np.ndarray:
    """Images (n, h, w, 3), uint8 or float in [0, 1], as uint8; `ValueError` for another shape, type or range.

    >>> as_uint8(np.full((1, 2, 4, 3), 0.5)).max()
    np.uint8(128)
    """
    array = np.asarray(images)
    if array.ndim != 4 or array.shape[-1] != 3:
        raise ValueError(
            f"images: expected (n, h, w, 3) RGB, got {array.shape}. "
            "Add a first axis for one image; repeat a grey channel three times; drop an alpha channel."
        )
    if not array.size:
        raise ValueError(f"images: empty, {array.shape}; give at least one image.")
    if array.dtype == np.uint8:
        return array
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"images: expected uint8 or float, got {array.dtype}; convert with astype(np.uint8).")
    low, high = float(array.min()), float(array.max())
    if not (low >= 0.0 and high <= 1.0):
        raise ValueError(f"images: float images must lie in [0, 1], got {low:g} to {high:g}; divide by 255?")
    return np.round(array * 255).astype(np.uint8)


def as_tensor(images: ArrayLike) -> Tensor:
    """The same images as the networks take them: (n, 3, h, w) float in [0, 1], channels last."""
    return torch.from_numpy(np.ascontiguousarray(as_uint8(images))).permute(0, 3, 1, 2).float().div_(255.0)
