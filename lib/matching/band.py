"""Matching along the epipolar lines of a calibrated rig: rectify, find the depth range, match, refine.

A coarse pass on small images searches beside the epipolar lines, too.  It checks the rig and finds the range of depth.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from lib.cameras import StereoRig
from lib.matching.deepmatching import VolumeMatches, correlation_volume, match_volume, peak_ratio
from lib.matching.descriptors import CHANNELS, PATCH, patch_quality, pixel_descriptors
from lib.matching.rectification import Rectification, on_image, rectify, warp
from lib.matching.result import SIGMA_LEFT_PX, Matches
from lib.parallel import single_threaded_torch

Images = tuple[np.ndarray, np.ndarray]
Masks = tuple[np.ndarray | None, np.ndarray | None]
#: Setting, depth_range_mm (None = to be found) and max_epipolar_px of a search, as in `lib.matching.match`.
Where = tuple[str, tuple[float, float] | None, float]
#: The rectification, its canvas pixels per left pixel, the range (low, high) of displacements along the line and the median
#: one off it, in canvas pixels.
Plan = tuple[Rectification, float, tuple[float, float], float]

#: Largest numbers of pixels of the canvas (the common rectified image), for each setting.  The next one is tried if a smaller
#: share than ENOUGH of the textured patches matches: in noisy or smooth images the few matches are poor, and many are wrong.
#: Chosen on a simulated eye with noise of 8 to 48 grey values and blur of 2 to 8 px, and on two validation recordings.
MAX_PIXELS = {"fast": (400_000,), "quality": (3_000_000, 1_100_000, 400_000)}
ENOUGH = 0.15
#: Matches with a lower score are dropped unless the caller gives another limit: half of the wrong ones are below.
LEAST_SCORE = 0.5
#: The score is 0 if DeepMatching's is less than this many times that of another place on the line: a printed grid repeats.
LEAST_UNIQUE = 1.1
#: Number of cells around a patch that its sub-pixel step uses, too.
REFINE_MARGIN = {"fast": 0, "quality": 1}

#: The descriptors are pooled by 2^DOWNSCALE; width of a cell in canvas pixels.
DOWNSCALE = 1
CELL_PX = 1 << DOWNSCALE
#: Number of cells searched on either side of the epipolar line.  Lines of near-affine cameras are not straight rows: down to
#: a distance of 60 mm they deviate by up to 9 px.
OFF_LINE = 1
NEAR_OFF_LINE = {"fast": 2, "quality": 4}
COARSE_OFF_LINE = 5
COARSE_WIDTH_PX = 256
#: Half width of the coarse search of images of equal width, as a fraction of the canvas.
COARSE_REACH = 0.2
#: Least number of coarse matches that agree, for checking the rig and finding the depth range; with fewer there is no match.
MIN_SUPPORTED = 12

#: Standard deviation along and off the line, in cells: gain times the one from `refine`, and a floor.  Measured on
#: synthetic affine pairs with known surface (noise 2 grey values, unequal gain and blur): the normalised errors then
#: have a robust standard deviation of 1 (tests require 0.7 to 1.4).
SIGMA_GAIN = 3.5
SIGMA_FLOOR = 0.015
#: `refine`'s sigma, in cells, at which the score is one half.  At this sigma every third match of the Middlebury pairs and
#: every twentieth of simulated eyes is wrong by more than 3/4 cell; below a third of this sigma hardly any is.
SIGMA_HALF = 0.06

CHUNK = 2048
#: Reach of the derivative filter (8 (g1 - g-1) - (g2 - g-2)) / 12.
REACH = 2
#: Ridge parameter of the step off the line: on an edge parallel to the line, where that step is undetermined, it becomes 0.
RIDGE = 0.05


class RigMisfitError(ValueError):
    """Most matches are far from the epipolar lines of the rig."""


def plan_search(images: Images, masks: Masks, rig: StereoRig, where: Where, max_pixels: int) -> Plan | None:
    """Choose a canvas of at most `max_pixels`, check the rig by coarse matches, and find the depth range if it is not given.

    The displacement off the line is 0 below half a left pixel, where resampling gains nothing.  The plan is None if the range
    is not given and too few coarse matches agree, such as in images of noise, which match somewhere.
    A ValueError refuses a rig that does not fit the images, and a depth range that the cameras do not share.
    """
    _, depth_range_mm, max_epipolar_px = where
    shapes = images[0].shape, images[1].shape
    whole = rectify(rig, *shapes)
    width, height = whole.size_px
    scale = min(1.0, float(np.sqrt(max_pixels / (width * height))))
    rectification = rectify(rig, *shapes, scale=scale)
    if depth_range_mm is not None and np.isinf(max_epipolar_px):
        return rectification, scale, rectification.search_range_px(depth_range_mm, shapes[1]), 0.0
    displacement, off_line_px = _coarse_displacement(images, masks, rig, whole), 0.0
    if len(displacement) >= MIN_SUPPORTED:
        misfit = float(np.median(np.abs(displacement[:, 1])))
        if misfit > max_epipolar_px:
            what = f"the median distance of {len(displacement)} free matches from their epipolar lines is {misfit:.1f} px"
            cure = "Calibrate again, or check that left and right are not exchanged"
            allowed = f"{max_epipolar_px:.1f} px are allowed (max_epipolar_px)"
            raise RigMisfitError(f"rig: it does not fit the images: {what}, {allowed}. {cure}.")
        off_line_px = float(np.median(displacement[:, 1]))
        low, high = np.percentile(displacement[:, 0], (0.5, 99.5))
        margin = 4 / min(1.0, COARSE_WIDTH_PX / max(whole.size_px))
        depth_range_mm = whole.depth_range_mm((low - margin, high + margin)) if depth_range_mm is None else depth_range_mm
    if depth_range_mm is None:
        return None
    off_line_px = off_line_px * scale if abs(off_line_px) >= 0.5 else 0.0
    return rectification, scale, rectification.search_range_px(depth_range_mm, shapes[1]), off_line_px


def coarse_reach_px(rectification: Rectification, shape_right: tuple[int, int]) -> float:
    """Half width of the coarse search in canvas px: more if one image is wider, since the other may show any part of it."""
    width, (low, high) = rectification.size_px[0], rectification.shared_range_px(shape_right)
    return COARSE_REACH * width + abs(high - low - 2 * width) / 2


def _coarse_displacement(images: Images, masks: Masks, rig: StereoRig, whole: Rectification) -> np.ndarray:
    """Displacements (n, 2) along and off the line, in pixels of the canvas `whole`, from small images matched in a wide
    window, of the matches that agree with their neighbours.
    """
    scale = min(1.0, COARSE_WIDTH_PX / max(whole.size_px))
    rectification = rectify(rig, images[0].shape, images[1].shape, scale=scale)
    reach = int(np.ceil(coarse_reach_px(rectification, images[1].shape) / CELL_PX))
    left, right = descriptors(images, masks, rectification, (-reach, reach), COARSE_OFF_LINE)
    matches = _match(left, right, -reach, COARSE_OFF_LINE)[0]  # the volume is large
    # Keep matches with at least three neighbours on the lattice whose displacement is the same within 1.5 cells.
    gx, gy = matches.patch.max(axis=0, initial=0) + 1
    field, (x, y) = np.full((gy + 2, gx + 2, 2), np.nan), matches.patch.T + 1
    field[y, x] = matches.displacement
    apart = np.array([field[y + dy - 1, x + dx - 1] - matches.displacement for dy, dx in np.ndindex(3, 3)])
    chosen = matches.keep((np.abs(apart).max(axis=2, initial=0) <= 1.5).sum(axis=0) > 3)  # each match counts itself
    start = chosen.patch * PATCH
    step, _ = refine(left, right, start, start + chosen.cell - (-reach, -COARSE_OFF_LINE))
    return (chosen.cell + step) * CELL_PX / scale


def descriptors(
    images: Images, masks: Masks, rectification: Rectification, range_cells: tuple[int, int], off_line: int,
    off_line_px: float = 0.0,
) -> list[np.ndarray]:  # fmt: skip
    """Left grid (4 gy, 4 gx, 9), and the right grid with the margins that the search needs."""
    step, low, high = PATCH * CELL_PX, *range_cells
    width, height = (side // step * step for side in rectification.size_px)
    margin_y = off_line * CELL_PX
    wide = width + (high - low) * CELL_PX, height + 2 * margin_y

    def one(image: np.ndarray, mask: np.ndarray | None, target: np.ndarray, size: tuple, shift: tuple) -> np.ndarray:
        gray, valid = warp(image, target, size, shift_px=shift, mask=mask)
        return pixel_descriptors(gray, DOWNSCALE, valid=valid)

    targets = rectification.left_from_canvas, rectification.right_from_canvas
    shifts = (0, 0), (low * CELL_PX, off_line_px - margin_y)
    with ThreadPoolExecutor(2) as executor:
        return list(executor.map(one, images, masks, targets, ((width, height), wide), shifts))


def _match(
    left: np.ndarray, right: np.ndarray, low: int, off_line: int, *, reciprocal: bool = True
) -> tuple[VolumeMatches, torch.Tensor, int]:
    """Matches of two grids, except those on flat or partly masked patches or without a peak; the correlation volume; and the
    number of left patches that are neither flat nor partly masked.
    """
    with single_threaded_torch():
        volume = correlation_volume(torch.from_numpy(left), torch.from_numpy(right), off_line)
        matches = match_volume(volume, low, reciprocal=reciprocal)
    (x, y), textured = matches.patch.T, patch_quality(left)
    start = matches.cell - (low, -off_line) + matches.patch * PATCH
    cells = np.ndindex(PATCH, PATCH)
    seen_right = np.all([right[start[:, 1] + r, start[:, 0] + c, CHANNELS - 1] > 0 for r, c in cells], axis=0)
    return matches.keep(textured[y, x] & seen_right & matches.peaked), volume, int(textured.sum())


def match_band(images: Images, masks: Masks, rig: StereoRig, where: Where, *, budget_bytes: int, reciprocal: bool) -> Matches:
    """Matches of a calibrated pair; arguments as in `lib.matching.match`, images (h, w) uint8 grey."""
    best, most, scale = Matches.none("band"), -1, None
    for max_pixels in MAX_PIXELS[where[0]]:
        plan = plan_search(images, masks, rig, where, max_pixels)
        if plan is None:  # so is that of any other canvas
            break
        if plan[1] == scale:  # small images have one canvas
            continue
        scale = plan[1]
        found, textured = _match_on(plan, images, masks, rig, where[0], budget_bytes=budget_bytes, reciprocal=reciprocal)
        accepted = int((found.score >= LEAST_SCORE).sum())
        best, most = (found, accepted) if accepted > most else (best, most)
        if accepted >= ENOUGH * textured:
            break
    return best


def _match_on(
    plan: Plan, images: Images, masks: Masks, rig: StereoRig, setting: str, *, budget_bytes: int, reciprocal: bool
) -> tuple[Matches, int]:
    """Matches on one canvas, and the number of textured patches."""
    rectification, _, range_px, off_line_px = plan
    low, high = int(np.floor(range_px[0] / CELL_PX)) - 1, int(np.ceil(range_px[1] / CELL_PX)) + 1
    gx, gy = (side // (PATCH * CELL_PX) for side in rectification.size_px)
    off_line = OFF_LINE if rig.is_affine else NEAR_OFF_LINE[setting]
    need = 4 * gy * gx * (2 * off_line + 1) * (high - low + 1) * 2.7  # bytes of the float32 volume and its pooled copies
    if need > budget_bytes:
        what = f"{high - low + 1} displacements of {gx} x {gy} patches need {need / 2**30:.2f} GiB"
        budget = f"the budget is {budget_bytes / 2**30:.2f} GiB"
        raise ValueError(f"budget_bytes: {what}, {budget}. Narrow depth_range_mm, or take setting='fast'.")
    left, right = descriptors(images, masks, rectification, (low, high), off_line, off_line_px)
    found, volume, textured = _match(left, right, low, off_line, reciprocal=reciprocal)
    unique = found.uniqueness >= LEAST_UNIQUE
    x, y = torch.from_numpy(found.patch.T)
    along = torch.from_numpy(found.cell[:, 0] - low)
    ratio = peak_ratio(volume[y, x].amax(dim=1, keepdim=True), torch.zeros_like(along), along)
    del volume  # large

    # Start at the best whole cell, on the line if the rig is affine, and add one step of `refine`.
    start = found.patch * PATCH
    cell = found.cell * (1, 0 if rig.is_affine else 1)
    step, sigma = refine(left, right, start, start + cell - (low, -off_line), margin=REFINE_MARGIN[setting])
    displacement = step + cell
    canvas = (start + PATCH / 2) * float(CELL_PX) - 0.5
    deviation = np.hypot(SIGMA_GAIN * sigma, SIGMA_FLOOR) * CELL_PX
    linear = rectification.right_from_canvas[:, :2]
    score = 1 / (1 + (sigma[:, 0] / SIGMA_HALF) ** 4)
    clear = score >= LEAST_SCORE  # noise is ambiguous, too, such as in what the lamp does not reach
    covariance = np.zeros((len(sigma), 4, 4))
    covariance[:, :2, :2] = SIGMA_LEFT_PX**2 * np.eye(2)
    covariance[:, 2:, 2:] = np.einsum("ij,nj,kj->nik", linear, deviation**2, linear)
    return Matches(
        on_image(rectification.left_from_canvas, canvas),
        on_image(rectification.right_from_canvas, canvas + displacement * CELL_PX + (0.0, off_line_px)),
        unique * score,
        covariance, peak_ratio=ratio, reciprocal=found.reciprocal, method="band",
        ambiguous=float((~unique[clear]).mean()) if clear.any() else 0.0,
    ), textured  # fmt: skip


def _cut(grid: np.ndarray, x: np.ndarray, y: np.ndarray, margin: int) -> np.ndarray:
    """(n, s + 2, s + 4, C) windows of a grid (h, w, C): the patches that start at (x, y), with margins; s = 4 + 2 margin."""
    side = PATCH + 2 * margin
    height, width, channels = grid.shape
    window = side + 2, (side + 2 * REACH) * channels
    view = np.lib.stride_tricks.sliding_window_view(grid.reshape(height, width * channels), window)
    return view[y - margin - 1, (x - margin - REACH) * channels].reshape(len(x), side + 2, side + 2 * REACH, channels)


def _derivatives(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives along x, of fourth order, and along y, (n, s, s, C)."""
    middle = windows[:, 1:-1]
    near, far = middle[:, :, 3:-1] - middle[:, :, 1:-3], middle[:, :, 4:] - middle[:, :, :-4]
    across = windows[:, 2:, REACH:-REACH] - windows[:, :-2, REACH:-REACH]
    return near * np.float32(8 / 12) - far * np.float32(1 / 12), across * np.float32(1 / 2)


def refine(
    left: np.ndarray, right: np.ndarray, start_left: np.ndarray, start_right: np.ndarray, *, margin: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Refine matches of whole cells by one symmetric Gauss-Newton step on the descriptors.

    With f the left and g the right patch, scaled to the same norm, and w the mean of their gradients along x, the step is
    w.(f - g) / w.w (efficient second-order minimisation: Malis, ICRA 2004), which is unbiased at zero.

    Args:
        left, right: (h, w, C) float32 descriptor grids.
        start_left, start_right: (n, 2) int, (x, y) cells where the matching 4 x 4 patches start.
        margin: Number of cells added to the patch on every side: less noise on smooth surfaces, worse at depth edges.

    Returns the steps (n, 2) to add to the right cells, within -1 and 1: x is the step along the line alone, y belongs to a
    step in both directions.  Also their standard deviations (n, 2), up to a scale, for independent descriptor residuals.
    """
    pad = margin + REACH
    left, right = (np.pad(grid, ((margin + 1, margin + 1), (pad, pad), (0, 0))) for grid in (left, right))
    step, sigma = np.empty((2, len(start_left), 2))

    def one(first: int) -> None:
        part = slice(first, first + CHUNK)
        sides = (left, start_left[part] + (pad, margin + 1)), (right, start_right[part] + (pad, margin + 1))
        f, g = (_cut(grid, *start.T, margin) for grid, start in sides)
        slopes = [[a.reshape(len(f), -1) for a in _derivatives(windows)] for windows in (f, g)]
        f, g = (np.ascontiguousarray(a[:, 1:-1, REACH:-REACH]).reshape(len(a), -1) for a in (f, g))
        scale = np.sqrt(np.einsum("ij,ij->i", f, f) / np.maximum(np.einsum("ij,ij->i", g, g), 1e-12))[:, None]
        w, across = ((f_slope + g_slope * scale) * np.float32(0.5) for f_slope, g_slope in zip(*slopes, strict=True))
        f -= g * scale
        information = np.maximum(np.einsum("ij,ij->i", w, w), 1e-12)
        projection = np.einsum("ij,ij->i", w, f)
        variance = np.maximum(np.einsum("ij,ij->i", f, f) - projection**2 / information, 0) / (f.shape[1] - 1)

        cross = np.einsum("ij,ij->i", w, across)
        free = np.einsum("ij,ij->i", across, across) * (1 + RIDGE) - cross**2 / information
        rest = np.einsum("ij,ij->i", across, f) - cross / information * projection
        step[part] = np.clip(np.column_stack([projection / information, rest / np.maximum(free, 1e-12)]), -1, 1)
        sigma[part] = np.sqrt(np.column_stack([variance / information, variance / np.maximum(free, 1e-12)]))

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, range(0, len(step), CHUNK)))
    return step, sigma
