"""Pixel descriptors of DeepMatching: soft histograms of gradient orientation, computed with OpenCV on the CPU.

Source: Weinzaepfel, Revaud, Harchaoui, Schmid, DeepFlow (ICCV 2013); Revaud et al., DeepMatching (IJCV 2016), Sec. 3.1.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike

#: Number of cells along a side of DeepMatching's atomic patches.
PATCH = 4
#: Eight orientations, and a constant that keeps flat patches from matching noise.
CHANNELS = 9

SIGMA_PX = 1.0
SLOPE = 0.2
CONSTANT = 0.3
#: Distance at which pixels influence a descriptor: three blurs of 3 px and a gradient of 1 px.
REACH_PX = 10
STRIP_PIXELS = 1 << 17
#: Longer side of the small copies that show the contrast of images, and the largest gain that equalises it.
SMALL_PX, MOST_GAIN = 256, 5.0
#: Mean squared length of the orientation channels below which a patch is flat: gradients well below 1 grey value.
MIN_TEXTURE = 1e-4


def as_gray(image: ArrayLike, name: str) -> np.ndarray:
    """A grey uint8 image (h, w) from an RGB (h, w, 3) or grey (h, w) uint8 image of at least 16 x 16 px.

    A ValueError refuses anything else and names the argument `name`.
    """
    image = np.asarray(image)
    if image.dtype != np.uint8:
        raise ValueError(f"{name}: expected a uint8 image (0..255), got {image.dtype}. Convert it first.")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"{name}: expected (h, w, 3) RGB or (h, w) grey, got shape {image.shape}.")
    if min(image.shape[:2]) < 16:
        raise ValueError(f"{name}: {image.shape[1]} x {image.shape[0]} px is too small; give at least 16 x 16 px.")
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image


def of_equal_contrast(images: tuple[np.ndarray, ...], masks: tuple[np.ndarray | None, ...]) -> tuple[np.ndarray, ...]:
    """Two grey images (h, w) as float32, brought to the same mean level and contrast: the higher ones of the two.

    The eyes of a microscope may differ in gain and stray light.  Descriptors saturate, so they depend on the contrast.  The
    upper quartile of the gradient in small copies measures it; there noise and blur count little.  `masks` as in `match`.
    """
    levels, contrasts = [], []
    for image, mask in zip(images, masks, strict=True):
        factor = max(1, max(image.shape) // SMALL_PX)
        size = image.shape[1] // factor, image.shape[0] // factor
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        hidden = np.zeros_like(small) if mask is None else cv2.resize(mask.view(np.uint8), size, interpolation=cv2.INTER_AREA)
        seen = cv2.dilate(hidden, np.ones((3, 3))) == 0
        slope = np.hypot(cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1))
        levels.append(small[seen].mean() if seen.any() else 0.0)
        contrasts.append(np.percentile(slope[seen], 75) if seen.any() else 0.0)
    level, contrast = max(levels), max(contrasts)
    gains = [min(contrast / max(own, 1e-6), MOST_GAIN) for own in contrasts]
    return tuple(
        (image - np.float32(own)) * np.float32(gain) + np.float32(level)
        for image, own, gain in zip(images, levels, gains, strict=True)
    )


def _blur(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (7, 7), SIGMA_PX, borderType=cv2.BORDER_REPLICATE)


def pixel_descriptors(gray: np.ndarray, downscale: int = 1, *, valid: np.ndarray | None = None) -> np.ndarray:
    """Descriptors (h >> downscale, w >> downscale, 9) float32 of a grey image (h, w), float32 or uint8, 0..255.

    The image is smoothed.  Its gradient is projected on eight directions, its negative part set to zero, smoothed,
    compressed by 2 / (1 + exp(-0.2 x)) - 1 (so that contrast matters little) and smoothed again.  The ninth channel is
    constant.  Cells of 2^downscale px are averaged.  Cells with a pixel that is not `valid` (h, w) are zero, thus ignored.
    """
    stride = 1 << downscale
    rows, columns = gray.shape[0] // stride, gray.shape[1] // stride
    descriptors = np.empty((rows, columns, CHANNELS), np.float32)
    # Work on strips that stay in the cache, with a margin of rows for the three blurs and the gradient.
    strip = max(1, STRIP_PIXELS // (gray.shape[1] * stride))
    for first in range(0, rows, strip):
        last = min(first + strip, rows)
        top = max(0, first * stride - REACH_PX)
        inner = slice(first * stride - top, last * stride - top)
        _describe(gray[top : last * stride + REACH_PX], inner, stride, descriptors[first:last])
    if valid is not None:
        seen = valid[: rows * stride, : columns * stride].view(np.uint8) * np.uint8(255)
        descriptors[cv2.resize(seen, (columns, rows), interpolation=cv2.INTER_AREA) < 255] = 0.0
    return descriptors


def _describe(gray: np.ndarray, rows: slice, stride: int, out: np.ndarray) -> None:
    """Fill `out` (rows / stride, w / stride, 9) with the descriptors of the given rows of a strip."""
    smooth = _blur(gray.astype(np.float32, copy=False))
    dx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1, borderType=cv2.BORDER_REPLICATE)
    dy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1, borderType=cv2.BORDER_REPLICATE)
    half = np.float32(np.sqrt(0.5))
    height, width = out.shape[:2]
    for k, projection in enumerate((dx, (dx + dy) * half, dy, (dy - dx) * half)):
        for opposite in (False, True):
            squashed = _blur(np.maximum(-projection if opposite else projection, 0.0))
            squashed *= np.float32(SLOPE / 2)
            np.tanh(squashed, out=squashed)  # 2 / (1 + exp(-SLOPE x)) - 1
            channel = _blur(squashed)[rows, : width * stride]
            out[:, :, k + 4 * opposite] = cv2.resize(channel, (width, height), interpolation=cv2.INTER_AREA)
    out[:, :, CHANNELS - 1] = CONSTANT


def patch_quality(grid: np.ndarray) -> np.ndarray:
    """(gy, gx) bool: True for the patches of descriptors (h, w, 9) that have texture and no masked cell.

    Masked cells are zero in both images, so patches with equal masks or image borders would match whatever they show.
    """
    gy, gx = grid.shape[0] // PATCH, grid.shape[1] // PATCH
    cells = grid[: gy * PATCH, : gx * PATCH].reshape(gy, PATCH, gx, PATCH, CHANNELS)
    constant = np.ascontiguousarray(cells[..., CHANNELS - 1])
    rows = cells.reshape(gy, PATCH, gx, PATCH * CHANNELS)
    texture = np.einsum("yrxk,yrxk->yx", rows, rows) - np.einsum("yrxc,yrxc->yx", constant, constant)
    return (constant > 0).all(axis=(1, 3)) & (texture / PATCH**2 > MIN_TEXTURE)
