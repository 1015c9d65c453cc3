"""Where the shaft ends, in images that the robot aligns.

The base has no edge of its own, so a detector that does not know a tool marks it too far along the shaft, in all frames by
the same distance.  But the base is where the jaws leave the shaft, on its axis, and that can be measured.  The robot's
landmarks align the frames; in their mean the tool stays and the ground fades.  The shaft is a cylinder that ends flat.  Its
end appears as an ellipse around the base, of half axes r across the shaft and r sin(e) along it, where e is the angle between
shaft and image.  So the outline is two lines, parallel or tapered, and the half of the ellipse on the side of the tips.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from lib.cameras import AffineCamera, NearAffineCamera
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.windows import cut, tool_pose, window_from_image
from lib.recordings import Recording
from lib.recordings.annotations import inside

#: The aligned pictures (width, height), and the tool's length in them; half of the width is the search's reach and the shaft.
_SIZE_PX, _LENGTH_PX = (161, 141), 200
#: Searched positions of the shaft's end along the tool and across, and its radii, in pixels of the aligned pictures.
_ALONG_PX, _ACROSS_PX = np.arange(-36, 37), np.array([-3.0, 0.0, 3.0])
_RADII_PX = np.concatenate([np.arange(2.0, 20.0), np.arange(20.0, 47.0, 2.0)])
#: Slopes of the shaft's sides in its last pixels; a tapered shaft is only searched on the axis.
_SLOPES, _TAPER_PX = (0.0, 0.2, 0.45), 12.0
#: Directions from the base to the points of the half ellipse, and number of points of each straight line.
_DIRECTIONS_RAD, _STRAIGHT = np.radians(np.linspace(-70, 70, 15)), 10
#: Groups of consecutive frames with a mean picture each, for each image; and fewest pictures of a group.
_GROUPS, _FEWEST = 4, 3
#: Weight of gradients along the outline, which belong to other edges, relative to those across it.
_OTHER_EDGES = 0.6
#: A longer outline explains more edges, so the mean score counts times this power of the radius.  A highlight is shorter.
_LARGE = 0.75
#: Of maxima with this share of the largest, the one nearest to the tips is the end: steps and highlights lie behind it.  It
#: must exceed the median of all positions by this factor, and its mean score must be this large.
_AS_CLEAR, _CLEAR, _LEAST = 0.75, 1.45, 0.2
#: Standard deviation of the measured end: a share of the tool's length, and pixels of the image.  Chosen, as all above, on
#: four recordings by other renderers and on validation recordings.
_SD, _SD_PX = 0.011, 1.0


class ShaftEnd(NamedTuple):
    """The base as measured in the aligned pictures.

    Attributes:
        frame: Numbers (m,) of the frames.
        u: The base (m, 2, 2) px in both images; NaN where it is unknown.
        moved, sd: Median shift from the given base towards the tips, and its standard deviation: shares of the tool's length.
        pictures: Mean of the aligned pictures (2, 141, 161, 3) uint8 of left and right.
        outline: Points (2, n, 2) px of the fitted outline in them.
    """

    frame: np.ndarray
    u: np.ndarray
    moved: float
    sd: float
    pictures: np.ndarray
    outline: np.ndarray


def tilt(x_mm: np.ndarray, cameras: Sequence[AffineCamera | NearAffineCamera]) -> np.ndarray:
    """Sine (m, k) of the angle between the tool with landmarks x_mm (m, 3, 3) and the images of k cameras.

    It is positive if the tool points away from the camera, and NaN where a landmark is unknown.

    >>> tool = [[[0.0, 0.0, 0.0], [3.0, 1.0, 4.0], [3.0, -1.0, 4.0]]]
    >>> tilt(np.array(tool), [AffineCamera([[100, 0, 0, 0], [0, 100, 0, 0]])]).tolist()
    [[0.8]]
    """
    along = x_mm[:, 1:].mean(axis=1) - x_mm[:, 0]
    views = np.stack([camera.viewing_direction for camera in cameras], axis=1)
    return along @ views / np.linalg.norm(along, axis=1, keepdims=True)


def shaft_end(recording: Recording, frames: np.ndarray, u: np.ndarray, sine: np.ndarray) -> ShaftEnd | None:
    """Measure where the shaft ends, or return None if the pictures do not show it clearly.

    Args:
        frames: Numbers (m,) of the frames.
        u: Base and tips (m, 2, 3, 2) px in them, of which the base may be off along the tool.
        sine: Of the angle between tool and image (m, 2), by `tilt`.
    """
    aligned = _aligned(recording, frames, u)
    if min(len(pictures) for pictures, _ in aligned) < _GROUPS * _FEWEST:
        return None
    means, scores, sines = [], [], []
    for side, (pictures, kept) in enumerate(aligned):
        groups = np.array_split(np.arange(len(pictures)), _GROUPS)
        even = pictures - pictures.mean(axis=(1, 2), keepdims=True)
        even /= np.maximum(even.std(axis=(1, 2, 3), keepdims=True), 1.0)
        sines.append(np.abs([sine[kept[group], side].mean() for group in groups]).clip(0, 0.9))
        scores.append(_scores(np.stack([even[group].mean(axis=0) for group in groups]), sines[-1]))
        means.append(pictures.mean(axis=0))
    every = np.mean([score.max(axis=2) for score in scores], axis=0) * _RADII_PX[:, None] ** _LARGE
    total = every.max(axis=0)
    clear = total.max(axis=0)
    peaks = np.flatnonzero((clear[1:-1] >= clear[:-2]) & (clear[1:-1] > clear[2:])) + 1
    peaks = peaks[clear[peaks] > _AS_CLEAR * clear.max()]
    if not len(peaks) or clear[peaks[-1]] < _CLEAR * np.median(clear):
        return None
    i, k = peaks[-1], total[:, peaks[-1]].argmax()
    slope = every[:, k, i].argmax()
    scores = [score[slope] for score in scores]
    best = [score[k, :, i].argmax() for score in scores]  # the positions across
    if k == len(_RADII_PX) - 1 or np.mean([score[k, j, i] for score, j in zip(scores, best, strict=True)]) < _LEAST:
        return None
    radius = _RADII_PX[k]
    before, at, after = clear[i - 1 : i + 2]
    along = _ALONG_PX[i] + 0.5 * (before - after) / (before - 2 * at + after)
    axis = u[:, :, 1:].mean(axis=2) - u[:, :, 0]
    outlines = []
    for across, own in zip(_ACROSS_PX[best], sines, strict=True):
        ellipse, _, straight = _outline(radius, own.mean()[None])
        half = radius / np.sqrt(1 - own.mean() ** 2) + _SLOPES[slope] * np.minimum(straight, _TAPER_PX)
        low, high = (np.stack([-straight, side * half], axis=1) for side in (-1, 1))
        outlines.append(np.concatenate([low[::-1], ellipse[0], high]) + [along, across] + (np.array(_SIZE_PX) - 1) / 2)
    found = u[:, :, 0] + along / _LENGTH_PX * axis
    sd = float(np.hypot(_SD, _SD_PX / np.nanmedian(np.linalg.norm(axis, axis=-1))))
    return ShaftEnd(frames, found, along / _LENGTH_PX, sd, np.stack(means).round().astype(np.uint8), np.stack(outlines))


def _aligned(recording: Recording, frames: np.ndarray, u: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each image, pictures (k, h, w, 3) around the base, in which the tool points right, and which frames they show."""
    shown = np.isfinite(u).all(axis=(2, 3)) & inside(u, recording.image_size_px)[:, :, 0]
    found: tuple[list[np.ndarray], ...] = ([], [])
    for k in np.flatnonzero(shown.any(axis=1)):
        frame, angle, zoom = recording.frames[int(frames[k])], tool_pose(u[k])[1], _LENGTH_PX / tool_length_px(u[k])
        for side in np.flatnonzero(shown[k]):
            matrix = window_from_image(u[k, side, 0], angle[side], _SIZE_PX, zoom[side])
            found[side].append(cut((frame.left, frame.right)[side], matrix, _SIZE_PX, border=cv2.BORDER_REPLICATE))
    return [
        (np.array(pictures, np.float32).reshape(-1, *_SIZE_PX[::-1], 3), np.flatnonzero(shown[:, side]))
        for side, pictures in enumerate(found)
    ]


def _outline(radius: float, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a shaft's end in g pictures: points and normals (g, 15, 2) of its half ellipse, and x (10,) back along its lines."""
    across = (radius / np.sqrt(1 - sine**2))[:, None]  # relative to the tool's length, which the angle shortens
    along = np.maximum(across * sine[:, None], 0.5)
    x, y = np.cos(_DIRECTIONS_RAD), np.sin(_DIRECTIONS_RAD)
    normal = np.stack([x / along, y / across], axis=-1)
    points = np.stack(np.broadcast_arrays(along * x, across * y), axis=-1)
    return points, normal / np.linalg.norm(normal, axis=-1, keepdims=True), np.linspace(2, max(1.2 * radius, 16), _STRAIGHT)


def _scores(pictures: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """How clearly pictures (g, h, w, 3) show the outline of a shaft's end: (slopes, radii, positions across and along)."""
    smooth = [cv2.GaussianBlur(picture, (0, 0), 1.2) for picture in pictures]
    gx, gy = (np.stack([cv2.Sobel(one, cv2.CV_32F, *order) for one in smooth]) for order in ((1, 0), (0, 1)))
    level = np.quantile(np.hypot(gx, gy).max(axis=-1).reshape(len(pictures), -1), 0.9, axis=1)[:, None]
    g, (w, h), middle = np.arange(len(pictures))[:, None], _SIZE_PX, (np.array(_SIZE_PX) - 1) / 2
    found = np.full((len(_SLOPES), len(_RADII_PX), len(_ACROSS_PX), len(_ALONG_PX)), -1.0)  # less than any score
    if not level.all():  # pictures without any edge
        return found

    gradient = np.stack([gx, gy]).reshape(2, -1, gx.shape[-1])

    def clear(x: np.ndarray, y: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Gradients across the outline less those along it, in terms of all: their mean over points and pictures."""
        column, row = np.rint(x).astype(int).clip(0, w - 1), np.rint(y).astype(int).clip(0, h - 1)
        dx, dy = gradient[:, (g * h + row) * w + column]
        nx, ny = np.moveaxis(normal.astype(np.float32)[..., None], -2, 0)
        across, along = (np.sqrt(np.einsum("...i,...i", part, part)) for part in (dx * nx + dy * ny, dx * ny - dy * nx))
        return ((across - _OTHER_EDGES * along) / (across + along + level)).mean(axis=(-2, -1))

    for i, radius in enumerate(_RADII_PX):
        ellipse, normal, straight = _outline(radius, sine)
        side = (radius / np.sqrt(1 - sine**2))[:, None]
        for j, across in enumerate(_ACROSS_PX):
            x0, y0 = middle[0] + _ALONG_PX[:, None, None], middle[1] + across
            end = clear(x0 + ellipse[..., 0], y0 + ellipse[..., 1], normal)
            for k, slope in enumerate(_SLOPES if across == 0 else _SLOPES[:1]):
                back = np.minimum(straight, _TAPER_PX) if slope else straight
                lines = [
                    clear(x0 - back, y0 + sign * (side + slope * back), np.array([slope, sign]) / np.hypot(slope, 1))
                    for sign in (-1, 1)
                ]
                found[k, i, j] = 0.6 * end + 0.2 * sum(lines)
    return found


def outlined(end: ShaftEnd, zoom: int = 3) -> np.ndarray:
    """The aligned pictures of left and right side by side, with the fitted outline of the shaft's end; RGB."""
    pictures = []
    for picture, outline in zip(end.pictures, end.outline, strict=True):
        large = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        points = np.rint(zoom * (outline + 0.5) - 0.5).astype(np.int32)
        pictures.append(cv2.polylines(large, [points], False, (0, 255, 0), 1, cv2.LINE_AA))
    return np.hstack(pictures)
