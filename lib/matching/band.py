"""Matching along the epipolar lines of a calibrated rig: rectify, find the depth range, match, refine.

A coarse pass on small images, free to leave the epipolar line, tells two things: whether the rig fits the images,
and the range of depth.  The fine pass searches only the band that is left.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from lib.cameras import StereoRig
from lib.matching.confidence import peak_ratio, require_fit
from lib.matching.descriptors import CHANNELS, pixel_descriptors
from lib.matching.free import MIN_SEEN, patch_quality
from lib.matching.rectification import Rectification, rectify, warp
from lib.matching.refine import refine
from lib.matching.result import Matches
from lib.matching.volume import (
    PATCH,
    VolumeMatches,
    correlation_volume,
    match_volume,
    predicted_bytes,
)
from lib.parallel import single_threaded_torch

__all__ = ["SETTINGS", "CoarseView", "Setting", "coarse_view", "match_band"]


@dataclass(frozen=True)
class Setting:
    """How finely the band is searched.

    Attributes
    ----------
    max_pixels:
        The canvas is shrunk to so many, if it has more.
    downscale:
        Binary logarithm of the pooling of the descriptors.
    off_line:
        Cells searched on either side of the epipolar line.
    refine_margin:
        Cells around a patch that take part in its sub-pixel step.
    """

    max_pixels: int
    downscale: int
    off_line: int
    refine_margin: int = 0

    def scale(self, size_px: tuple[int, int]) -> float:
        """Canvas pixels per left pixel for a canvas that has this (width, height) at scale 1."""
        return min(1.0, float(np.sqrt(self.max_pixels / (size_px[0] * size_px[1]))))


SETTINGS = {
    "fast": Setting(max_pixels=400_000, downscale=1, off_line=1),
    "quality": Setting(max_pixels=3_000_000, downscale=1, off_line=1, refine_margin=1),
}

COARSE_WIDTH_PX = 256
COARSE_OFF_LINE = 5
#: Half width of the coarse search, as a fraction of the canvas.
COARSE_REACH = 0.2
MIN_SUPPORTED = 12

#: Standard deviation along and off the line, in cells: gain times what `refine` says, and a floor.  Measured on
#: synthetic affine pairs with known surface (noise 2 grey values, unequal gain and blur): the normalised errors then
#: have a robust standard deviation of 1 (tests hold it between 0.7 and 1.4).
SIGMA_GAIN = 3.5
SIGMA_FLOOR = 0.015
#: The left point is chosen, not measured; a patch has no sharper centre than this.
SIGMA_LEFT_PX = 0.05
#: `refine`'s sigma, in cells, at which the score is one half: there every third match of the Middlebury pairs and
#: every twentieth of simulated eyes is wrong by more than 3/4 cell; below a third of it hardly any is.
SIGMA_HALF = 0.06


@dataclass(frozen=True, eq=False)
class CoarseView:
    """What the coarse pass saw.

    Attributes
    ----------
    displacement_px:
        (n, 2) along and off the epipolar line, in pixels of a canvas of scale 1, of the supported matches.
    off_line_px, epipolar_px:
        Median displacement off the line, and median of its size; NaN with fewer than 12 supported matches.
    range_px:
        (low, high) displacement to search, with margin.
    n_found:
        Matches before those without support were left out.
    """

    displacement_px: np.ndarray
    off_line_px: float
    epipolar_px: float
    range_px: tuple[float, float]
    n_found: int


def _descriptors(
    images: tuple[np.ndarray, np.ndarray],
    masks: tuple[np.ndarray | None, np.ndarray | None],
    rectification: Rectification,
    setting: Setting,
    low: int,
    n: int,
    off_line_px: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Left grid (4 gy, 4 gx, 9) and the right grid with the margins that the band needs."""
    cell = 1 << setting.downscale
    step = PATCH * cell
    width, height = (side // step * step for side in rectification.size_px)
    margin_y = setting.off_line * cell

    def one(side: int) -> np.ndarray:
        if side == 0:
            target, size, shift = rectification.left_from_canvas, (width, height), (0, 0)
        else:
            target = rectification.right_from_canvas
            size, shift = (width + (n - 1) * cell, height + 2 * margin_y), (low * cell, off_line_px - margin_y)
        gray, valid = warp(images[side], target, size, shift_px=shift, mask=masks[side])
        return pixel_descriptors(gray, setting.downscale, valid=valid)

    with ThreadPoolExecutor(2) as pool:
        return tuple(pool.map(one, (0, 1)))


def _match(
    left: np.ndarray, right: np.ndarray, low: int, n: int, off_line: int, *, reciprocal: bool = True
) -> tuple[VolumeMatches, np.ndarray]:
    """Matches of two grids, without those on flat or mostly ignored patches and those at the end of the range.

    And their peak ratios (n,).
    """
    with single_threaded_torch():
        volume = correlation_volume(torch.from_numpy(left), torch.from_numpy(right), low, n, off_line)
        matches = match_volume(volume, low, reciprocal=reciprocal)
    x, y = matches.patch.T
    start = matches.cell - (low, -off_line) + matches.patch * PATCH
    seen_right = np.mean(
        [right[start[:, 1] + r, start[:, 0] + c, CHANNELS - 1] > 0 for r in range(PATCH) for c in range(PATCH)], axis=0
    )
    kept = patch_quality(left)[y, x] & (seen_right >= MIN_SEEN) & (matches.curvature[:, 0] > 0)
    matches = matches.keep(kept)
    return matches, peak_ratio(volume.numpy(), matches.patch, matches.cell[:, 0] - low)


def _supported(matches: VolumeMatches, tolerance: float = 1.5) -> np.ndarray:
    """Mask (n,) of the matches with at least three neighbours on the lattice that moved alike (cells)."""
    gx, gy = matches.patch.max(axis=0, initial=0) + 1
    field = np.full((gy + 2, gx + 2, 2), np.nan)
    x, y = matches.patch.T + 1
    field[y, x] = matches.displacement
    support = np.zeros(len(x), int)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if dy or dx:
                apart = np.abs(field[y + dy, x + dx] - matches.displacement).max(axis=1, initial=0)
                support += apart <= tolerance
    return support >= 3


def coarse_view(
    images: tuple[np.ndarray, np.ndarray], masks: tuple[np.ndarray | None, np.ndarray | None], rig: StereoRig
) -> CoarseView:
    """Match small images in a wide window around the epipolar lines.

    Parameters
    ----------
    images:
        Left and right, (h, w) uint8 grey.
    masks:
        Left and right, (h, w) bool, True = ignore, or None.
    """
    shapes = images[0].shape, images[1].shape
    whole = rectify(rig, *shapes)
    scale = min(1.0, COARSE_WIDTH_PX / max(whole.size_px))
    rectification = rectify(rig, *shapes, scale=scale)
    setting = Setting(0, downscale=1, off_line=COARSE_OFF_LINE)
    reach = int(np.ceil(COARSE_REACH * rectification.size_px[0] / 2))
    low, n = -reach, 2 * reach + 1
    left, right = _descriptors(images, masks, rectification, setting, low, n)
    matches, _ = _match(left, right, low, n, COARSE_OFF_LINE)
    chosen = matches.keep(_supported(matches))
    start = chosen.patch * PATCH
    step, _ = refine(left, right, start, start + chosen.cell - (low, -COARSE_OFF_LINE))
    displacement = (chosen.cell + step) * 2 / scale
    # Both canvases refer to the same depth only up to whole coarse pixels.
    displacement[:, 0] += (rectification.reference_depth_mm - whole.reference_depth_mm) * whole.displacement_px_per_mm
    if len(displacement) < MIN_SUPPORTED:
        widest = COARSE_REACH * whole.size_px[0]
        return CoarseView(displacement, float("nan"), float("nan"), (-widest, widest), len(matches.patch))
    low_px, high_px = np.percentile(displacement[:, 0], (0.5, 99.5))
    margin = 4 / scale
    return CoarseView(
        displacement,
        float(np.median(displacement[:, 1])),
        float(np.median(np.abs(displacement[:, 1]))),
        (float(low_px - margin), float(high_px + margin)),
        len(matches.patch),
    )


def match_band(
    images: tuple[np.ndarray, np.ndarray],
    masks: tuple[np.ndarray | None, np.ndarray | None],
    rig: StereoRig,
    *,
    depth_range_mm: tuple[float, float] | None = None,
    setting: Setting = SETTINGS["quality"],
    max_epipolar_px: float = 6.0,
    budget_bytes: int = 2 << 30,
    reciprocal: bool = True,
) -> Matches:
    """Matches of a calibrated pair; arguments as in `coarse_view` and `lib.matching.match`.

    Raises
    ------
    ValueError
        If the rig does not fit the images, nothing in the depth range is seen by both cameras, or the search would
        need more memory than the budget.
    """
    shapes = images[0].shape, images[1].shape
    whole = rectify(rig, *shapes)
    scale = setting.scale(whole.size_px)
    rectification = rectify(rig, *shapes, scale=scale)
    cell = 1 << setting.downscale

    coarse = coarse_view(images, masks, rig)
    require_fit(len(coarse.displacement_px), coarse.epipolar_px, max_epipolar_px)
    if not coarse.n_found and depth_range_mm is None:
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 4, 4)), method="band")
    # The band follows a small misfit, so that it may be narrow; below half a pixel nothing is resampled for it.
    off_line_px = coarse.off_line_px * scale if abs(coarse.off_line_px) >= 0.5 else 0.0
    if depth_range_mm is None:
        depth_range_mm = whole.depth_range_mm(coarse.range_px)
    low, high = rectification.search_range_px(depth_range_mm, shapes[1])
    low, high = int(np.floor(low / cell)) - 1, int(np.ceil(high / cell)) + 1
    n = high - low + 1
    gx, gy = (side // (PATCH * cell) for side in rectification.size_px)
    need = predicted_bytes(gy, gx, n, setting.off_line)
    if need > budget_bytes:
        raise ValueError(
            f"budget_bytes: {n} displacements of {gx} x {gy} patches need {need / 2**30:.2f} GiB, the budget is "
            f"{budget_bytes / 2**30:.2f} GiB. Narrow depth_range_mm, or take setting='fast'."
        )
    left, right = _descriptors(images, masks, rectification, setting, low, n, off_line_px)
    found, ratio = _match(left, right, low, n, setting.off_line, reciprocal=reciprocal)

    # Where the rig says the match lies: on the line, at the best whole cell, and one step from there.
    start = found.patch * PATCH
    on_line = start + np.column_stack([found.cell[:, 0] - low, np.full(len(start), setting.off_line)])
    step, sigma = refine(left, right, start, on_line, margin=setting.refine_margin)
    displacement = step + np.column_stack([found.cell[:, 0], np.zeros(len(step))])
    canvas = (start + PATCH / 2) * float(cell) - 0.5
    u_left = rectification.u_left(canvas)
    u_right = rectification.u_right(canvas + displacement * cell + (0.0, off_line_px))

    deviation = np.hypot(SIGMA_GAIN * sigma, SIGMA_FLOOR) * cell
    right_from_canvas = rectification.right_from_canvas[:, :2]
    covariance = np.zeros((len(sigma), 4, 4))
    covariance[:, :2, :2] = SIGMA_LEFT_PX**2 * np.eye(2)
    covariance[:, 2:, 2:] = np.einsum("ij,nj,kj->nik", right_from_canvas, deviation**2, right_from_canvas)
    return Matches(
        u_left,
        u_right,
        1 / (1 + (sigma[:, 0] / SIGMA_HALF) ** 4),
        covariance,
        peak_ratio=ratio,
        reciprocal=found.reciprocal,
        method="band",
    )
