"""Masks of pixels that a matcher should ignore: (h, w) bool, True = ignore."""

import cv2
import numpy as np
from numpy.typing import ArrayLike

#: Square root of the area in px to which `dark_mask` reduces images, which averages noise.
DARK_SIZE_PX = 360
#: Limits of `dark_mask`.  Relative to the level of the bright areas, a surround is darker than DARK, its rim than DIM, and
#: its standard deviation in 7 x 7 px is below FLAT.  It has one level: the 5th and 75th percentiles differ by less than
#: CONSTANT times its median, and ALIKE times the bright level.  Noise allows no less than 0.5 and 1 grey values for these.
DARK, DIM, FLAT, CONSTANT, ALIKE = 0.25, 0.5, 0.01, 0.2, 0.025


def glint_mask(image: ArrayLike, *, grow_px: int = 5) -> np.ndarray:
    """Specular reflections: pixels with all channels nearly saturated (245 or more), dilated by a margin for the halo.

    A glint moves with the viewpoint, so a match on it has a mirror image's depth.  `image` is uint8, (h, w, 3) or (h, w).
    """
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise ValueError(f"image: expected a uint8 image (h, w, 3) or (h, w), got {image.dtype} {image.shape}.")
    core = cv2.inRange(np.ascontiguousarray(image), (245,) * 4, (255,) * 4)  # OpenCV uses one for each channel
    return cv2.dilate(core, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * grow_px + 1,) * 2)).astype(bool)


def dark_mask(image: np.ndarray) -> np.ndarray:
    """The surround of a round field: dark areas of one level at the border of the image, their blurred rim, and a margin.

    Such a rim is at the same place in both images, so it would match itself.  Levels are relative to those of the bright
    areas, so that a dim picture is not masked.  What a lamp hardly reaches is dark and flat, too, but not of one level.
    `image` as for `glint_mask`.
    """
    height, width = image.shape[:2]
    factor = max(1, round(np.sqrt(height * width) / DARK_SIZE_PX))
    small = cv2.resize(np.ascontiguousarray(image), (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    level = small.reshape(*small.shape[:2], -1).max(axis=2).astype(np.float32)
    bright = level[level < 245]  # without glints; a mean weighted by squares hardly depends on the size of a dark area
    bright = (bright**3).sum() / max((bright**2).sum(), 1.0)
    level = cv2.blur(level, (3, 3))
    variance = cv2.blur(level**2, (7, 7)) - cv2.blur(level, (7, 7)) ** 2
    flat = variance < max(FLAT * bright, 0.5) ** 2
    core = cv2.morphologyEx((flat & (level < DARK * bright)).view(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5)))  # no specks
    areas = cv2.connectedComponents(cv2.morphologyEx(core, cv2.MORPH_CLOSE, np.ones((15, 15))))[1]  # with what lies between
    for area in range(1, areas.max() + 1):
        low, usual, high = np.percentile(level[inside := areas == area], (5, 50, 75))
        at_border = inside[[0, -1]].any() or inside[:, [0, -1]].any()
        core[inside] &= at_border and high - low < max(min(CONSTANT * usual, ALIKE * bright), 1.0)
    soft = cv2.dilate(core, np.ones((31, 31))) & (level < DIM * bright).view(np.uint8)  # the blurred rim of the core, too
    grown = cv2.dilate(soft, np.ones((5, 5)))
    return cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)


def tool_mask(shape: tuple[int, int], u_landmarks: ArrayLike, *, width_px: float | None = None) -> np.ndarray:
    """The forceps, from its three landmarks: both jaws, and the shaft continued beyond the base.

    Args:
        shape: (h, w) of the image.
        u_landmarks: (3, 2) px of base, tip_1, tip_2.  A jaw with a NaN tip is left out; without base or tips, all is.
        width_px: Full width of jaws and shaft, with a margin; None is 0.45 of the mean jaw length.
    """
    u = np.asarray(u_landmarks, dtype=np.float64)
    if u.shape != (3, 2):
        raise ValueError(f"u_landmarks: expected (3, 2) px, base, tip_1, tip_2, got {u.shape}.")
    mask = np.zeros(shape[:2], np.uint8)
    base, tips = u[0], u[1:][np.isfinite(u[1:]).all(axis=1)]
    if not np.isfinite(base).all() or not len(tips):
        return mask.astype(bool)
    thickness = max(1, round(0.45 * np.linalg.norm(tips - base, axis=1).mean() if width_px is None else width_px))
    backwards = base - tips.mean(axis=0)
    back = base + backwards / max(np.linalg.norm(backwards), 1e-300) * (np.hypot(*shape[:2]) + np.abs(base).max())
    shift = 4  # fractional bits of OpenCV's line drawing
    limit = 2 ** (30 - shift) / 8
    for end in (*tips, back):
        a, b = (tuple(int(v) for v in np.clip(np.rint(p * 2**shift), -limit, limit)) for p in (base, end))
        cv2.line(mask, a, b, 1, thickness, cv2.LINE_8, shift)
    return mask.astype(bool)


def checked_mask(mask: ArrayLike, shape: tuple[int, int], name: str) -> np.ndarray:
    """The mask as an array.  A ValueError names the argument `name` if it is not bool of this shape, or masks everything."""
    mask = np.asarray(mask)
    if mask.shape != shape or mask.dtype != bool:
        raise ValueError(f"{name}: expected a bool array {shape}, True = ignore, got {mask.dtype} {mask.shape}.")
    if mask.all():
        raise ValueError(f"{name}: everything is masked, so nothing can be matched; True means ignore.")
    return mask
