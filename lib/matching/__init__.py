"""Semi-dense stereo matching: DeepMatching, a fast version along epipolar lines, and alternatives (paper Sec. IV-B)."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.matching.band import LEAST_SCORE, MAX_PIXELS, RigMisfitError, match_band
from lib.matching.deepmatching import match_free
from lib.matching.descriptors import as_gray, of_equal_contrast
from lib.matching.masks import checked_mask, dark_mask, glint_mask, tool_mask
from lib.matching.opencv import match_with
from lib.matching.rectification import RECTIFIED
from lib.matching.result import Matches

__all__ = ["RECTIFIED", "Matches", "RigMisfitError", "checked_mask", "dark_mask", "glint_mask", "match", "tool_mask"]


def match(
    left: ArrayLike, right: ArrayLike, *, method: str | Callable | None = None, rig: StereoRig | None = None,
    mask_left: ArrayLike | None = None, mask_right: ArrayLike | None = None,
    depth_range_mm: tuple[float, float] | None = None, setting: str = "quality", min_score: float | None = None,
    downscale: int | None = None, budget_bytes: int = 2 << 30, max_epipolar_px: float = 6.0, reciprocal: bool = True,
    device: str = "cpu",
) -> Matches:  # fmt: skip
    """Match the two images of a stereo pair.

    Args:
        left, right: (h, w, 3) uint8 RGB or (h, w) uint8 grey; sizes, gain and stray light may differ.
        method: "deepmatching": free DeepMatching, integer positions, as published; a rig is only used for `epipolar_px`.
            "band": DeepMatching along the epipolar lines, sub-pixel; needs a rig.  "sgbm", "dis": OpenCV's, on rectified
            images; without a rig the pair is taken as rectified.  A callable `f(left, right, (low, high)) -> (disparity,
            confidence)` of rectified grey uint8 images (h, w): x_right = x_left - disparity, not finite = none; confidence in
            [0, 1]; optionally its own left-right check, (h, w) bool.  None is "band" with a rig, else "deepmatching".
        rig: Calibrated rig, or `RECTIFIED` for a pair whose rows correspond (depth is then disparity in px).
        mask_left, mask_right: (h, w) bool, True = ignore (see `glint_mask`, `dark_mask`, `tool_mask`).
        depth_range_mm: (near, far): the depths d.x to search, where d is the left camera's `viewing_direction` and x a point
            in the rig's frame, so depth 0 is at that frame's origin.  None = found by a coarse pass.  Only used with a rig.
        setting: "quality" searches at full resolution (up to 3 Mpx), and "band" in noisy or smooth images at a lower one;
            "fast" searches at up to 0.4 Mpx.  Not for "deepmatching".
        min_score: Matches with a lower score are dropped.  None is 0.5 for "band", else 0.
        downscale: DeepMatching only: pools descriptors by 2^downscale; None is the smallest from 1 that fits the budget.
        budget_bytes: Memory that "band" and "deepmatching" may use; a search that needs more, by prediction, is refused.
        max_epipolar_px: A rig is refused if the median distance of coarse free matches to its epipolar lines is larger.  With
            ``numpy.inf`` and a `depth_range_mm` there is no coarse pass: faster, for a rig that was checked before.
        reciprocal: Drop matches that fail the left-right check (mainly occlusions).
        device: torch device of free DeepMatching, such as "cuda".

    The result may have no matches.  Of score, peak ratio and reciprocity, the score is usually the best confidence; SGBM has
    no score (always 1).  A ValueError refuses unfit images, masks and options, and a rig that does not fit the images.

    >>> noise = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    >>> matches = match(noise, np.roll(noise, 4, axis=1))
    >>> np.median(matches.u_right - matches.u_left, axis=0).tolist()
    [4.0, 0.0]
    """
    images = as_gray(left, "left"), as_gray(right, "right")
    given = zip((mask_left, mask_right), images, ("mask_left", "mask_right"), strict=True)
    masks = tuple(None if mask is None else checked_mask(mask, image.shape, name) for mask, image, name in given)
    if setting not in MAX_PIXELS:
        raise ValueError(f"setting: expected one of {sorted(MAX_PIXELS)}, got {setting!r}.")
    if depth_range_mm is not None:
        depth_range_mm = tuple(float(z) for z in depth_range_mm)
        if len(depth_range_mm) != 2 or not np.isfinite(depth_range_mm).all() or depth_range_mm[0] >= depth_range_mm[1]:
            raise ValueError(f"depth_range_mm: expected (near, far) with near < far, got {depth_range_mm}.")
    for name, value in (("min_score", min_score), ("max_epipolar_px", max_epipolar_px)):
        if value is not None and np.isnan(value):
            raise ValueError(f"{name}: expected a number, got NaN.")
    method = ("deepmatching" if rig is None else "band") if method is None else method
    where = (setting, depth_range_mm, max_epipolar_px)
    alike = images if method == "deepmatching" else of_equal_contrast(images, masks)
    if method == "deepmatching":
        matches = match_free(images, masks, downscale, budget_bytes=budget_bytes, reciprocal=reciprocal, device=device)
    elif method == "band":
        if rig is None:
            raise ValueError("rig: method 'band' needs a calibrated rig, or RECTIFIED for a rectified pair.")
        matches = match_band(alike, masks, rig, where, budget_bytes=budget_bytes, reciprocal=reciprocal)
    elif callable(method) or method in ("sgbm", "dis"):
        matches = match_with(method, alike, masks, rig or RECTIFIED, where, reciprocal=reciprocal)
    else:
        raise ValueError(f"method: expected 'deepmatching', 'band', 'sgbm', 'dis' or a callable, got {method!r}.")
    u = np.hstack([matches.u_left, matches.u_right])
    inside = ((u >= 0) & (u <= np.subtract((*images[0].shape[::-1], *images[1].shape[::-1]), 1))).all(axis=1)
    least = (LEAST_SCORE if method == "band" else 0.0) if min_score is None else min_score
    matches = matches.keep(inside & (matches.score >= least))
    if rig is None or not len(matches):
        return matches
    distance = rig.epipolar_distance(matches.u_left, matches.u_right)  # NaN where distorted optics image nothing
    return replace(matches, epipolar_px=float(np.nanmedian(np.abs(distance))))
