"""Windows around landmarks: upright crops in which the tool points right.

The later stages of the detector see small windows.  Each is rotated so that the direction from base to tips points right and
tip_1, the left tip for a view along the tool, lies above.  So the network sees one pose, whatever the tool's direction in the
image.  The tool's window is scaled so that every tool fills the same share of it.  Closeups are scaled down a little, and
mirrored for tip_2, so that both tips look alike.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib.landmarks.metrics import tool_length_px

#: Side of the tool's window, and length of the tool in it.
TOOL_PX, _TOOL_LENGTH_PX = 128, 56.0
#: Closeups of tools of these lengths, in image pixels, have scale 1.  Other tools are scaled to the nearer of these lengths.
_SAME_SCALE_PX = (165.0, 450.0)

#: Closeup pixels per image pixel, for base, tip_1 and tip_2.  At the base the closeup must show both edges of the shaft.
CLOSEUP_ZOOM = (0.65, 0.85, 0.85)
#: Image pixels from a landmark back along the tool to the centre of its closeup: the taper of a jaw shows where it ends.
CLOSEUP_BEHIND_PX = (0.0, 18.0, 18.0)
#: A closeup counts only if it finds its landmark within this distance of the expected position, image pixels.
CLOSEUP_REACH_PX = 20.0
#: A landmark gets a second closeup if the first moved it by more than this, in image pixels times `closeup_scale`.  After
#: shorter moves a second one is no more accurate, on validation images of other eyes and tools.
_SECOND_LOOK_PX = 4.0


def tool_pose(u: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Midpoint (n, 2) between the base and the mean of the known tips, and direction (n,) from base to tips in rad.

    The angle runs from x towards y.  Both are NaN without a base or without a tip.

    >>> tool_pose([[[0, 0], [10, 0], [0, 10]]])[1].round(3)
    array([0.785])
    """
    u = np.asarray(u, dtype=np.float64)
    known = np.isfinite(u[:, 1:]).all(axis=2)
    tip = np.where(known[..., None], u[:, 1:], 0).sum(1) / np.maximum(known.sum(1), 1)[:, None]
    base, tip = u[:, 0], np.where(known.any(1)[:, None], tip, np.nan)
    return (base + tip) / 2, np.arctan2(*(tip - base).T[::-1])


def tool_zoom(length_px: ArrayLike) -> np.ndarray:
    """Pixels of the tool's window per image pixel, for tools of length `length_px` in the image.

    >>> float(tool_zoom(28.0))
    2.0
    """
    return _TOOL_LENGTH_PX / np.asarray(length_px, dtype=np.float64)


def closeup_scale(length_px: ArrayLike) -> np.ndarray:
    """Magnification of closeups relative to `CLOSEUP_ZOOM`, for tools of length `length_px`.  It is limited so that a closeup
    pixel is at least half an image pixel wide, since a closeup cannot show more than the image.

    >>> closeup_scale([900, 300, 110, 20]).round(2).tolist()
    [0.5, 1.0, 1.5, 2.35]
    """
    length = np.asarray(length_px, dtype=np.float64)
    return np.minimum(np.clip(length, *_SAME_SCALE_PX) / length, 2 / max(CLOSEUP_ZOOM))


def window_from_image(centre: ArrayLike, angle_rad: ArrayLike, size: ArrayLike, zoom: ArrayLike = 1.0) -> np.ndarray:
    """Matrices (..., 2, 3) that turn by -angle, scale, and move `centre` (..., 2) to the middle of `size`, side or (w, h)."""
    centre, angle = np.asarray(centre, dtype=np.float64), np.asarray(angle_rad, dtype=np.float64)
    c, s = np.cos(angle) * zoom, np.sin(angle) * zoom
    linear = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    shift = ((np.array(np.broadcast_to(size, 2)) - 1) / 2)[:, None] - (linear @ centre[..., None])
    return np.concatenate([linear, shift], -1)


def closeup_from_image(
    centre: ArrayLike, angle_rad: ArrayLike, size: int, landmark: ArrayLike, length_px: ArrayLike = 300.0
) -> np.ndarray:
    """Matrices (..., 2, 3) from image to closeup, like `window_from_image`: zoomed by `CLOSEUP_ZOOM` times `closeup_scale`,
    mirrored for tip_2, and centred `CLOSEUP_BEHIND_PX` behind `centre` (..., 2), the expected position of the landmark.
    """
    landmark, angle, scale = np.asarray(landmark), np.asarray(angle_rad, dtype=np.float64), closeup_scale(length_px)
    behind = (np.array(CLOSEUP_BEHIND_PX)[landmark] / scale)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    matrix = window_from_image(np.asarray(centre) - behind, angle, size, np.array(CLOSEUP_ZOOM)[landmark] * scale)
    mirrored = np.asarray(landmark == 2)[..., None]
    matrix[..., 1, :] = np.where(mirrored, [0.0, 0.0, size - 1.0] - matrix[..., 1, :], matrix[..., 1, :])
    return matrix


def moved_far(before: ArrayLike, after: ArrayLike) -> np.ndarray:
    """(n, 3) bool: landmarks that a closeup moved so far, from `before` to `after` (n, 3, 2), that a second one is worth it.

    >>> tool = np.array([[[0, 0], [300, -9], [300, 9]]])
    >>> moved_far(tool, tool + [[5, 0], [3, 0], [np.nan, 0]]).tolist()
    [[True, False, False]]
    """
    scale = closeup_scale(np.maximum(tool_length_px(np.asarray(before)), 1.0))[:, None]
    return np.linalg.norm(np.subtract(after, before), axis=2) * scale > _SECOND_LOOK_PX


def expected_in_closeup(size: int, landmark: ArrayLike) -> np.ndarray:
    """Position (..., 2) px of a closeup's landmark (...) in the closeup, if the expected position in the image is right."""
    landmark = np.asarray(landmark)
    ahead = np.array(CLOSEUP_BEHIND_PX)[landmark] * np.array(CLOSEUP_ZOOM)[landmark]
    return (size - 1) / 2 + np.stack([ahead, np.zeros_like(ahead)], -1)


def map_points(matrix: np.ndarray, u: ArrayLike) -> np.ndarray:
    """Transform points (n, 2) by a matrix (2, 3), or point i (..., 2) by matrix i (..., 2, 3)."""
    return (matrix[..., :2] @ np.asarray(u, dtype=np.float64)[..., None])[..., 0] + matrix[..., 2]


def unmapped(matrices: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Transform points u (n, 2) of windows to the image; the matrices (n, 2, 3) are window_from_image."""
    return np.linalg.solve(matrices[:, :, :2], (u - matrices[:, :, 2])[..., None])[..., 0]


def cut(image: np.ndarray, matrix: np.ndarray, size: int | ArrayLike, *, border: int = cv2.BORDER_CONSTANT) -> np.ndarray:
    """Cut a window (h, w, 3) uint8 of `size`, its side or (w, h), from an image; `border` (OpenCV's) fills what lies outside.

    To avoid aliasing, a window at half the image's scale or less is the block mean of a finer one.  At a quarter or less, the
    part of the image that it shows is halved first, which is faster.
    """
    finer = int(np.clip(1 / np.sqrt(abs(np.linalg.det(matrix[:, :2]))), 1, 8))
    side = np.broadcast_to(size, 2)
    if finer >= 4:
        corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * side - 0.5 - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
        (x, y), (right, bottom) = corners.min(axis=0).astype(int) // 2 * 2 - 4, corners.max(axis=0).astype(int) // 2 * 2 + 6
        x, y, (right, bottom) = max(x, 0), max(y, 0), np.minimum((right, bottom), np.array(image.shape[1::-1]) // 2 * 2)
        if x < right and y < bottom:
            half = cv2.resize(image[y:bottom, x:right], ((right - x) // 2, (bottom - y) // 2), interpolation=cv2.INTER_AREA)
            shift = matrix[:, :2] @ [x + 0.5, y + 0.5] + matrix[:, 2]
            return cut(half, np.column_stack([2 * matrix[:, :2], shift]), size, border=border)
    matrix = finer * matrix + [0, 0, (finer - 1) / 2]
    whole = cv2.warpAffine(image, matrix, (side * finer).tolist(), flags=cv2.INTER_LINEAR, borderMode=border)
    return whole if finer == 1 else cv2.resize(whole, side.tolist(), interpolation=cv2.INTER_AREA)
