"""Other matchers under the same interface: OpenCV's SGBM and DIS, and any callable, on rectified canvases."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch

from lib.cameras import StereoRig
from lib.matching.band import COARSE_REACH, SETTINGS, Setting, coarse_view
from lib.matching.confidence import peak_ratio, require_fit
from lib.matching.descriptors import pixel_descriptors
from lib.matching.free import patch_quality
from lib.matching.rectification import RECTIFIED, rectify, warp
from lib.matching.result import Matches
from lib.matching.volume import PATCH, correlation_volume
from lib.parallel import single_threaded_torch

__all__ = ["DisparityFunction", "match_with"]

#: Two rectified grey uint8 images (h, w) and the (low, high) disparity range, px, to disparity and confidence (h, w):
#: x_right = x_left - disparity, not finite = none; confidence in [0, 1].  It may add a third array, bool: whether the way
#: back from the right image ends where it started.
DisparityFunction = Callable[..., tuple[np.ndarray, ...]]

#: Matches are taken on this lattice, as DeepMatching's are at full resolution.
LATTICE_PX = 8


def _sgbm(left: np.ndarray, right: np.ndarray, range_px: tuple[float, float]) -> tuple[np.ndarray, ...]:
    """Semi-global block matching (Hirschmueller, PAMI 2008), HH mode, with left-right check; tells no confidence."""
    disparity = _sgbm_disparity(left, right, range_px, tolerance_px=1)
    found = np.isfinite(disparity)
    return disparity, np.where(found, 1.0, 0.0), found


def _sgbm_unchecked(left: np.ndarray, right: np.ndarray, range_px: tuple[float, float]) -> tuple[np.ndarray, ...]:
    """`_sgbm` twice, so that what fails the left-right check is told rather than left out."""
    disparity = _sgbm_disparity(left, right, range_px, tolerance_px=left.shape[1])
    checked = np.isfinite(_sgbm_disparity(left, right, range_px, tolerance_px=1))
    return disparity, np.where(np.isfinite(disparity), 1.0, 0.0), checked


def _sgbm_disparity(
    left: np.ndarray, right: np.ndarray, range_px: tuple[float, float], *, tolerance_px: int
) -> np.ndarray:
    """Disparity (h, w), NaN = none; `tolerance_px` of the left-right check (OpenCV takes -1, no check, for 1)."""
    low = int(np.floor(range_px[0]))
    n = max(16, int(np.ceil((range_px[1] - low) / 16)) * 16)
    block = 5
    sgbm = cv2.StereoSGBM_create(
        minDisparity=low,
        numDisparities=n,
        blockSize=block,
        P1=8 * block**2,
        P2=32 * block**2,
        disp12MaxDiff=tolerance_px,
        preFilterCap=31,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    disparity = sgbm.compute(left, right).astype(np.float32) / 16
    disparity[disparity < low] = np.nan
    return disparity


def _dis(left: np.ndarray, right: np.ndarray, range_px: tuple[float, float]) -> tuple[np.ndarray, ...]:
    """Dense inverse search (Kroeger et al., ECCV 2016), forward and backward; confidence from their difference."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    # DIS sees only small motion well: start it at the middle of the range.
    middle = (range_px[0] + range_px[1]) / 2
    start = np.zeros((*left.shape, 2), np.float32)
    start[..., 0] = -middle
    forward = dis.calc(left, right, start.copy())
    backward = dis.calc(right, left, -start)
    height, width = left.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    back = cv2.remap(backward, x + forward[..., 0], y + forward[..., 1], cv2.INTER_LINEAR, borderValue=(np.inf, np.inf))
    apart = np.linalg.norm(forward + back, axis=2)
    return -forward[..., 0], np.clip(1 - apart, 0, 1), apart < 1


#: Standard deviation of a disparity in canvas px (1.48 times the median error, between that on simulated eyes and on
#: Middlebury pairs); for callables too.  It is the same everywhere: these matchers tell no uncertainty.
SIGMA_PX = 0.2


def match_with(
    function: DisparityFunction | str,
    images: tuple[np.ndarray, np.ndarray],
    masks: tuple[np.ndarray | None, np.ndarray | None],
    rig: StereoRig | None,
    *,
    depth_range_mm: tuple[float, float] | None = None,
    setting: Setting = SETTINGS["quality"],
    reciprocal: bool = True,
    max_epipolar_px: float = 6.0,
) -> Matches:
    """Rectify by the rig, call a disparity function, and sample its result on a lattice.

    Without a rig the pair is taken as rectified already.  The peak ratio is that of DeepMatching's descriptors, since
    these matchers tell none: do they, too, fit best where the match lies?
    """
    rig = RECTIFIED if rig is None else rig
    shapes = images[0].shape, images[1].shape
    whole = rectify(rig, *shapes)
    scale = setting.scale(whole.size_px)
    rectification = rectify(rig, *shapes, scale=scale)
    coarse = coarse_view(images, masks, rig)
    require_fit(len(coarse.displacement_px), coarse.epipolar_px, max_epipolar_px)
    if depth_range_mm is None:
        depth_range_mm = whole.depth_range_mm(coarse.range_px)
    low, high = rectification.search_range_px(depth_range_mm, shapes[1])
    name = function if isinstance(function, str) else getattr(function, "__name__", "callable")
    known = {"sgbm": _sgbm if reciprocal else _sgbm_unchecked, "dis": _dis}
    call = known[function] if isinstance(function, str) else function

    # Both matchers only find what lies in both images, so the canvas is widened by the reach of the search.
    width, height = rectification.size_px
    reach = int(np.ceil(max(abs(low), abs(high))))
    reach = -(-min(reach, int(COARSE_REACH * 2 * width)) // LATTICE_PX) * LATTICE_PX
    size, shift = (width + 2 * reach, height), (-reach, 0)
    left, valid_left = warp(images[0], rectification.left_from_canvas, size, shift_px=shift, mask=masks[0])
    right, valid_right = warp(images[1], rectification.right_from_canvas, size, shift_px=shift, mask=masks[1])
    left, right = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (left, right))
    disparity, confidence, *checked = (np.asarray(part) for part in call(left, right, (-high, -low)))
    if disparity.shape != left.shape or confidence.shape != left.shape or any(c.shape != left.shape for c in checked):
        raise ValueError(
            f"method: the matcher {name} must return disparity and confidence of shape {left.shape}, "
            f"got {', '.join(str(part.shape) for part in (disparity, confidence, *checked))}."
        )
    passed = checked[0].astype(bool) if checked else np.ones(left.shape, dtype=bool)
    x, y = np.meshgrid(
        np.arange(reach + LATTICE_PX // 2, reach + width // LATTICE_PX * LATTICE_PX, LATTICE_PX),
        np.arange(LATTICE_PX // 2, height // LATTICE_PX * LATTICE_PX, LATTICE_PX),
    )
    x, y = x.ravel(), y.ravel()
    d = disparity[y, x].astype(np.float64)
    kept = valid_left[y, x] & np.isfinite(d)
    if reciprocal:
        kept &= passed[y, x]
    target = np.zeros_like(x)
    target[kept] = np.rint(x[kept] - d[kept])
    kept &= (target >= 0) & (target < size[0])
    kept[kept] = valid_right[y[kept], target[kept]]
    canvas = np.column_stack([x[kept] - reach, y[kept]]).astype(np.float64)
    u_left = rectification.u_left(canvas)
    u_right = rectification.u_right(canvas - np.column_stack([d[kept], np.zeros(kept.sum())]))
    sigma = SIGMA_PX / scale
    covariance = np.tile(np.diag([0.05**2, 0.05**2, sigma**2, sigma**2]), (len(u_left), 1, 1))
    score = np.clip(confidence[y, x][kept], 0.0, 1.0).astype(np.float64)
    points = np.column_stack([x, y])[kept]
    ratio, textured = _judge((left, right), (valid_left, valid_right), reach, (low, high), points, -d[kept])
    matches = Matches(
        u_left, u_right, score, covariance, peak_ratio=ratio, reciprocal=passed[y[kept], x[kept]], method=name
    )
    return matches.keep(textured)


def _judge(
    images: tuple[np.ndarray, np.ndarray],
    valid: tuple[np.ndarray, np.ndarray],
    reach: int,
    range_px: tuple[float, float],
    points: np.ndarray,
    displacement: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Peak ratio (n,) of the descriptors' correlation, as in the band, at displacements (n,) of lattice points (n, 2).

    And which of them (n,) have texture: on a flat patch a smooth disparity is made up from its neighbours.

    `reach`, a multiple of the lattice, is how far the canvases go on beyond the lattice on either side.
    """
    cell = LATTICE_PX // PATCH
    left, right = (
        pixel_descriptors(image.astype(np.float32), cell.bit_length() - 1, valid=seen)
        for image, seen in zip(images, valid, strict=True)
    )
    margin = reach // cell
    gy, gx = len(left) // PATCH, (left.shape[1] - 2 * margin) // PATCH
    low = max(int(np.floor(range_px[0] / cell)) - 1, -margin)
    n = min(int(np.ceil(range_px[1] / cell)) + 1, margin) - low + 1
    left = np.ascontiguousarray(left[: gy * PATCH, margin : margin + gx * PATCH])
    right = np.ascontiguousarray(right[: gy * PATCH, margin + low : margin + low + gx * PATCH + n - 1])
    with single_threaded_torch():
        volume = correlation_volume(torch.from_numpy(left), torch.from_numpy(right), low, n, 0).numpy()
    index = np.rint(displacement / cell).astype(np.intp) - low
    searched = (index >= 0) & (index < n)
    ratio = np.full(len(points), np.nan)
    patch = points // LATTICE_PX - (reach // LATTICE_PX, 0)
    ratio[searched] = peak_ratio(volume, patch[searched], index[searched])
    return ratio, patch_quality(left)[patch[:, 1], patch[:, 0]]
