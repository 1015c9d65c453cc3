"""Other matchers with the same interface: OpenCV's SGBM and DIS, and any callable, on rectified images."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import torch

from lib.cameras import StereoRig
from lib.matching.band import CELL_PX, MAX_PIXELS, Images, Masks, Where, coarse_reach_px, descriptors, plan_search
from lib.matching.deepmatching import correlation_volume, peak_ratio
from lib.matching.descriptors import PATCH, patch_quality
from lib.matching.rectification import on_image, warp
from lib.matching.result import SIGMA_LEFT_PX, Matches
from lib.parallel import single_threaded_torch

#: Disparities are sampled on a lattice of this step, which is DeepMatching's at full resolution.
LATTICE_PX = PATCH * CELL_PX
#: Standard deviation of a disparity in canvas px, also for callables: these matchers state none, so it is constant.  It is
#: 1.48 times the median error, a value between those on simulated eyes and on Middlebury pairs.
SIGMA_PX = 0.2


def _sgbm(left: np.ndarray, right: np.ndarray, range_px: tuple, *, checked: bool) -> tuple[np.ndarray, ...]:
    """Semi-global block matching (Hirschmueller, PAMI 2008), HH mode; it has no confidence.

    `checked` drops disparities that fail the left-right check; else a second run only marks them.
    """
    low, block = int(np.floor(range_px[0])), 5

    def disparity(tolerance_px: int) -> np.ndarray:
        sgbm = cv2.StereoSGBM_create(
            minDisparity=low, numDisparities=max(16, int(np.ceil((range_px[1] - low) / 16)) * 16), blockSize=block,
            P1=8 * block**2, P2=32 * block**2, disp12MaxDiff=tolerance_px, preFilterCap=31, uniquenessRatio=5,
            speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH,
        )  # fmt: skip
        found = sgbm.compute(left, right).astype(np.float32) / 16
        return np.where(found < low, np.nan, found)

    # OpenCV treats -1 (no check) like 1, so a tolerance of the image's width turns the check off.
    found = disparity(1 if checked else left.shape[1])
    return found, np.isfinite(found).astype(float), np.isfinite(found if checked else disparity(1))


def _dis(left: np.ndarray, right: np.ndarray, range_px: tuple) -> tuple[np.ndarray, ...]:
    """Dense inverse search (Kroeger et al., ECCV 2016), forward and backward; the confidence is 1 - their difference."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    # DIS only finds small displacements well: start it at the middle of the range.
    start = np.zeros((*left.shape, 2), np.float32)
    start[..., 0] = -sum(range_px) / 2
    forward, backward = dis.calc(left, right, start.copy()), dis.calc(right, left, -start)
    y, x = np.mgrid[: left.shape[0], : left.shape[1]].astype(np.float32)
    back = cv2.remap(backward, x + forward[..., 0], y + forward[..., 1], cv2.INTER_LINEAR, borderValue=(np.inf, np.inf))
    apart = np.linalg.norm(forward + back, axis=2)
    return -forward[..., 0], np.clip(1 - apart, 0, 1), apart < 1


def match_with(
    function: Callable | str, images: Images, masks: Masks, rig: StereoRig, where: Where, *, reciprocal: bool
) -> Matches:
    """Rectify the images by the rig, call a disparity function, and sample its result on a lattice.

    Arguments as in `lib.matching.match`, images (h, w) uint8 grey.
    """
    named = isinstance(function, str)
    call = {"sgbm": partial(_sgbm, checked=reciprocal), "dis": _dis}[function] if named else function
    name = function if named else getattr(function, "__name__", "callable")
    plan = plan_search(images, masks, rig, where, MAX_PIXELS[where[0]][0])
    if plan is None:
        return Matches.none(name)
    rectification, scale, (low, high), _ = plan

    # Matchers only find points inside both canvases, so widen the canvas by the largest displacement, rounded up.
    width, height = rectification.size_px
    reach = min(int(np.ceil(max(abs(low), abs(high)))), int(2 * coarse_reach_px(rectification, images[1].shape)))
    reach = -(-reach // LATTICE_PX) * LATTICE_PX
    size, shift = (width + 2 * reach, height), (-reach, 0)
    left, valid_left = warp(images[0], rectification.left_from_canvas, size, shift_px=shift, mask=masks[0])
    right, valid_right = warp(images[1], rectification.right_from_canvas, size, shift_px=shift, mask=masks[1])
    left, right = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (left, right))
    maps = call(left, right, (-high, -low))
    shapes = [np.shape(part) for part in maps] if isinstance(maps, tuple | list) else [np.shape(maps)]
    if len(shapes) not in (2, 3) or any(shape != left.shape for shape in shapes):
        what = f"(disparity, confidence) or (disparity, confidence, passed), arrays of the shape {left.shape}"
        got = f"{len(shapes)} of the shapes {', '.join(map(str, shapes[:3]))}"
        raise ValueError(f"method: the matcher {name} must return {what}; got {got}.")
    disparity, confidence, *rest = map(np.asarray, maps)
    passed = rest[0].astype(bool) if rest else np.ones(left.shape, dtype=bool)

    columns, rows = (np.arange(LATTICE_PX // 2, side // LATTICE_PX * LATTICE_PX, LATTICE_PX) for side in (width, height))
    x, y = np.meshgrid(reach + columns, rows)
    kept = valid_left[y, x] & np.isfinite(disparity[y, x]) & (passed[y, x] | (not reciprocal))
    x, y = x[kept], y[kept]
    d = disparity[y, x].astype(np.float64)
    target = np.rint(x - d).astype(np.intp)
    kept = (target >= 0) & (target < size[0]) & valid_right[y, np.clip(target, 0, size[0] - 1)]
    x, y, d = x[kept], y[kept], d[kept]
    canvas = np.column_stack([x - reach, y]).astype(np.float64)
    cells = int(np.floor(max(low, -reach) / CELL_PX)) - 1, int(np.ceil(min(high, reach) / CELL_PX)) + 1
    grids = descriptors(images, masks, rectification, cells, 0)
    ratio, textured = _judge(*grids, cells[0], canvas.astype(int), -d)
    matches = Matches(
        on_image(rectification.left_from_canvas, canvas),
        on_image(rectification.right_from_canvas, canvas - np.column_stack([d, np.zeros(len(d))])),
        np.clip(confidence[y, x], 0.0, 1.0).astype(np.float64),
        np.tile(np.diag([SIGMA_LEFT_PX**2] * 2 + [(SIGMA_PX / scale) ** 2] * 2), (len(d), 1, 1)),
        peak_ratio=ratio, reciprocal=passed[y, x], method=name,
    )  # fmt: skip
    return matches.keep(textured)


def _judge(
    left: np.ndarray, right: np.ndarray, low: int, points: np.ndarray, displacement: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Peak ratios (n,) of lattice points (n, 2) at displacements (n,), from DeepMatching's descriptors, since these matchers
    give none; and (n,) bool, True for points with texture: on flat patches a disparity is interpolated from neighbours.

    `left` and `right` are grids of `descriptors`, searched from `low` cells on.
    """
    with single_threaded_torch():
        volume = correlation_volume(torch.from_numpy(left), torch.from_numpy(right), 0)
    x, y = points.T // LATTICE_PX
    index = np.rint(displacement / CELL_PX).astype(np.intp) - low
    searched = (index >= 0) & (index < volume.shape[3])
    ratio, along = np.full(len(points), np.nan), torch.from_numpy(index[searched])
    ratio[searched] = peak_ratio(volume[y[searched], x[searched]], torch.zeros_like(along), along)
    return ratio, patch_quality(left)[y, x]
