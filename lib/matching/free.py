"""Free DeepMatching of two images: grids, memory, masks; and the maps that show how it works."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike

from lib.matching import deepmatching
from lib.matching.deepmatching import PATCH
from lib.matching.descriptors import CHANNELS, as_gray, pixel_descriptors
from lib.matching.result import Matches

__all__ = ["MIN_TEXTURE", "ResponseMap", "match_free", "patch_quality", "predicted_bytes", "response_maps"]

#: Mean squared length of the orientation channels below which a patch is flat: gradients well below 1 grey value.
MIN_TEXTURE = 1e-4
#: Least part of a patch that must not be masked.
MIN_SEEN = 0.5


def predicted_bytes(shape_left: tuple[int, int], shape_right: tuple[int, int], *, downscale: int = 1) -> int:
    """Peak memory in bytes of free DeepMatching of two images (h, w), in one piece."""
    return deepmatching.predicted_bytes(
        tuple(n >> downscale for n in shape_left[:2]), tuple(n >> downscale for n in shape_right[:2])
    )


def patch_quality(grid: np.ndarray) -> np.ndarray:
    """Mask (gy, gx) of the atomic patches that have texture and are mostly not masked, of descriptors (h, w, 9)."""
    gy, gx = grid.shape[0] // PATCH, grid.shape[1] // PATCH
    cells = grid[: gy * PATCH, : gx * PATCH].reshape(gy, PATCH, gx, PATCH, CHANNELS)
    constant = np.ascontiguousarray(cells[..., CHANNELS - 1])
    seen = (constant > 0).mean(axis=(1, 3))
    rows = cells.reshape(gy, PATCH, gx, PATCH * CHANNELS)
    texture = np.einsum("yrxk,yrxk->yx", rows, rows) - np.einsum("yrxc,yrxc->yx", constant, constant)
    texture /= PATCH**2
    return (seen >= MIN_SEEN) & (texture > MIN_TEXTURE)


def match_free(
    images: tuple[np.ndarray, np.ndarray],
    masks: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
    *,
    downscale: int | None = None,
    budget_bytes: int = 2 << 30,
    reciprocal: bool = True,
    device: str = "cpu",
) -> Matches:
    """DeepMatching without any calibration; arguments as in `lib.matching.match`, images (h, w) uint8 grey."""
    shapes = images[0].shape, images[1].shape
    largest = int(np.log2(min(shapes[0] + shapes[1]) / (2 * PATCH)))
    if downscale is None:
        downscale = 1
        while downscale < largest and predicted_bytes(*shapes, downscale=downscale) > budget_bytes:
            downscale += 1
    elif not 0 <= downscale <= largest:
        raise ValueError(f"downscale: expected 0 to {largest} for images of these sizes, got {downscale}.")
    stride = 1 << downscale
    grids = tuple(tuple(n >> downscale for n in shape) for shape in shapes)
    tiles = deepmatching.plan_tiles(*grids, budget_bytes)
    left, right = (
        pixel_descriptors(image, downscale, valid=None if mask is None else ~mask)
        for image, mask in zip(images, masks, strict=True)
    )
    grids = (torch.from_numpy(grid).to(device) for grid in (left, right))
    found = deepmatching.match_grids(*grids, tiles, reciprocal=reciprocal)
    patch = (found.left // PATCH).astype(np.intp)
    target = np.clip(np.rint(found.right).astype(np.intp), 0, np.array(right.shape[1::-1]) - 1)
    kept = patch_quality(left)[patch[:, 1], patch[:, 0]] & (right[target[:, 1], target[:, 0], CHANNELS - 1] > 0)
    # A grid corner c lies at c * stride - 1/2 px where pixel centres are integers.
    u_left, u_right = (corner[kept] * stride - 0.5 for corner in (found.left, found.right))
    # Positions are multiples of the stride: a uniform error, beside what the descriptor itself cannot tell.
    variance = stride**2 / 12 + 0.25 * stride**2 / 4
    covariance = np.tile(np.diag([0.05**2, 0.05**2, variance, variance]), (len(u_left), 1, 1))
    return Matches(
        u_left,
        u_right,
        np.clip(found.score[kept], 0, 1),
        covariance,
        peak_ratio=found.peak_ratio[kept],
        reciprocal=found.reciprocal[kept],
        method="deepmatching",
    )


@dataclass(frozen=True, eq=False)
class ResponseMap:
    """How well one patch of the left image fits everywhere in the right one, at one level of the pyramid.

    Attributes
    ----------
    level:
        0 is the atomic patch.
    centre_px, size_px:
        Centre (2,) and width of the left patch.
    response:
        (h, w) in [0, 1].
    stride_px:
        Response [y, x] stands for the right pixel (x, y) * stride_px - 1/2.
    """

    level: int
    centre_px: np.ndarray
    size_px: int
    response: np.ndarray
    stride_px: int

    @property
    def peak_px(self) -> np.ndarray:
        """Right pixel (2,) of the largest response."""
        y, x = np.unravel_index(np.argmax(self.response), self.response.shape)
        return np.array([x, y]) * self.stride_px - 0.5

    @property
    def extent_px(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) for matplotlib's imshow over the right image."""
        height, width = self.response.shape
        half = self.stride_px / 2
        return (-0.5 - half, width * self.stride_px - 0.5 - half, height * self.stride_px - 0.5 - half, -0.5 - half)


def response_maps(
    left: ArrayLike,
    right: ArrayLike,
    u_left: ArrayLike,
    *,
    downscale: int = 1,
    budget_bytes: int = 2 << 30,
) -> list[ResponseMap]:
    """The pyramid of response maps of the patches around one left pixel: how DeepMatching grows sure.

    Parameters
    ----------
    left, right:
        uint8 images as in `match`; 256 x 192 px take 0.2 s.
    u_left:
        (2,) px; the patch of each level whose centre is nearest is shown.
    downscale, budget_bytes:
        As in `match`.

    Returns
    -------
    list of ResponseMap
        Level 0 (atomic patch) first.
    """
    images = as_gray(left, "left"), as_gray(right, "right")
    u_left = np.asarray(u_left, dtype=np.float64)
    height, width = images[0].shape
    if u_left.shape != (2,) or not (-0.5 <= u_left[0] <= width - 0.5 and -0.5 <= u_left[1] <= height - 0.5):
        raise ValueError(f"u_left: expected one pixel (x, y) inside the {width} x {height} left image, got {u_left}.")
    need = predicted_bytes(images[0].shape, images[1].shape, downscale=downscale)
    if need > budget_bytes:
        raise ValueError(
            f"budget_bytes: the maps need {need / 2**30:.1f} GiB, the budget is {budget_bytes / 2**30:.1f} GiB. "
            "Raise downscale or shrink the images."
        )
    grids = [torch.from_numpy(pixel_descriptors(image, downscale)) for image in images]
    pyramid = deepmatching.bottom_up(*grids)
    stride = 1 << downscale
    patch_px = PATCH * stride
    corner = u_left + 0.5
    gy, gx = pyramid.pooled[0].shape[:2]
    x, y = np.clip((corner // patch_px).astype(int), 0, (gx - 1, gy - 1))
    atomic = deepmatching.atomic_response(*grids, int(y), int(x)).numpy()
    maps = [ResponseMap(0, (np.array([x, y]) + 0.5) * patch_px - 0.5, patch_px, atomic, stride)]
    x, y = np.clip(np.rint(corner / patch_px).astype(int), 0, (gx, gy))
    for level, response in enumerate(pyramid.responses, start=1):
        maps.append(
            ResponseMap(
                level,
                np.array([x, y]) * float(patch_px) - 0.5,
                patch_px << level,
                response[y, x].numpy().copy(),
                stride << level,
            )
        )
    return maps
