"""Where the shaft ends, in images that the robot aligns.

The base has no edge of its own, so a detector that does not know a tool marks it elsewhere on the shaft, in all frames by the
same distance.  But the base is where the jaws leave the shaft, on its axis, and that can be measured.  The robot's
landmarks align the frames; in their mean the tool stays and the ground fades.  The shaft is a cylinder that ends flat.  Its
end appears as an ellipse around the base, of half axes r across the shaft and r sin(e) along it, where e is the angle between
shaft and image.  So the outline is two lines, parallel or tapered, and the half of the ellipse on the side of the tips.

The sides of the shaft also show where its axis lies: midway between them.

The jaws may be angled.  Then the shaft does not point to the tips, but its direction in the tool's axes is the same in all
frames: the one along which the mean of the aligned frames shows the sharpest sides.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from lib.landmarks.windows import cut, window_from_image
from lib.recordings import Recording
from lib.recordings.annotations import inside

#: Size of the aligned pictures (width, height), and distance from the base to the middle of the tips in them.
_SIZE_PX, _LENGTH_PX = (161, 141), 200
_MIDDLE_PX = (np.array(_SIZE_PX) - 1) / 2
#: Searched positions of the shaft's end along the tool and across, and its radii, in pixels of the aligned pictures.
_ALONG_PX, _ACROSS_PX = np.arange(-31, 32), np.array([-6.0, -3.0, 0.0, 3.0, 6.0])
_RADII_PX = np.concatenate([np.arange(2.0, 20.0), np.arange(20.0, 47.0, 2.0)])
#: Slopes of the shaft's sides in its last pixels; a tapered shaft is only searched on the axis.
_SLOPES, _TAPER_PX = (0.0, 0.2, 0.45), 12.0
#: Directions from the base to the points of the half ellipse, and number of points of each straight line.
_DIRECTIONS_RAD, _STRAIGHT = np.radians(np.linspace(-70, 70, 15)), 10
#: Groups of consecutive frames with a mean picture each, for each image; and fewest pictures of a group.
_GROUPS, _FEWEST = 4, 3
#: Weight of gradients along the outline, which belong to other edges, relative to those across it.
_OTHER_EDGES = 0.6
_END = 0.6  # weight of the half ellipse; the sides have the rest
_STEEPEST = 0.9  # largest sine; a steeper shaft shows its end from above
#: A longer outline explains more edges, so the mean score counts times this power of the radius.  A highlight is shorter.
_LARGE = 0.75
#: Of maxima with this share of the largest, the one whose ellipse reaches farthest to the tips is the end, since steps lie
#: behind it; of those that reach as far within these pixels, the clearest, since a highlight of the shaft ends there, too.
#: The score of its half ellipse must exceed the median of all positions by this much, and the mean score must be this large.
_AS_CLEAR, _SAME_FRONT_PX, _CLEAR, _LEAST = 0.75, 4.0, 0.13, 0.2
AHEAD = np.array([1.0, 0.0, 0.0])  # the direction of a shaft that points to the tips, in the tool's axes
#: Search of the shaft's direction, at half the scale of `_SIZE_PX`: side of the pictures, and the part of them that is used:
#: its distance behind the base, its width and height.
_AROUND_PX, _GAP_PX, _BEHIND_PX = 121, 8.0, (38, 71)
#: Largest angle from the direction of the tips, and factor by which the best energy exceeds the median of all directions.
_WIDEST_DEG, _SHARP = 64, 3.0
#: The edge of the end is sharp, rounded or bevelled.  So the base is a little nearer to the tips than the middle of the
#: fitted ellipse, by this share of its half axis along the tool, with this standard deviation; the share had a median of
#: 0.06 to 0.11 in each of five groups of 9 to 12 recordings by other renderers.  With it the end's standard deviation is 1.2
#: times as large as its errors in 31 recordings, of two of these groups and a sixth one.  A wide shaft that is seen steeply
#: does not show the base: there this half axis is longer than the third number, in tool lengths.
_BEVEL, _BEVEL_SD, _LONGEST = 0.1, 0.1, 0.167
#: Standard deviation of the measured end: a share of the tool's length, and pixels of the image.  The first was chosen on 53
#: recordings by other renderers; what stands above, on fourteen others and on validation recordings.  The neck of a tapered
#: shaft goes on into the jaws.
_SD, _SD_TAPERED, _SD_PX = 0.006, 0.02, 1.0
#: Searched positions of the shaft's axis across, differences from the radius that was found, length of the sides that show
#: the axis, and blur, in pixels of the aligned pictures.  These and the next three settings were chosen on 26 recordings, by
#: other renderers and of the validation population.
_ASIDE_PX, _WIDER_PX, _ASIDE_LONG_PX, _ASIDE_BLUR_PX = np.arange(-9.0, 9.1, 0.25), np.arange(-3.0, 3.1, 0.25), 45.0, 1.5
#: Least step of colour at one side, relative to the other side's.  Positions with this share of the best score may be right,
#: too: half of their range is one part of the standard deviation.  Light from one side causes the other part, which is a
#: share of the tool's length.
_LEAST_STEP, _NEARLY_AS_CLEAR, _ASIDE_SD = 0.1, 0.9, 0.003
#: Searched slopes of the shaft in the pictures, since its direction is known to some degrees; share of the ground's steps.
_LEANS, _OF_GROUND = np.arange(-0.12, 0.121, 0.02), 0.8
#: Least length of the mean image of a step across the shaft, relative to one without roll: else the roll varies too much.
_LEAST_ASIDE = 0.5


class Aside(NamedTuple):
    """The distance of the shaft's axis from the given base, across the shaft.

    Attributes:
        axis: Unit vector (3,) across the shaft, in the tool's axes: the one that all images together show longest.
        across: The image (m, 2, 2) px of a step along `axis` that is as long as the tool.
        moved, sd: Shift from the given base along `axis`, and its standard deviation: shares of the tool's length.
    """

    axis: np.ndarray
    across: np.ndarray
    moved: float
    sd: float


class ShaftEnd(NamedTuple):
    """The base as measured in the aligned pictures.

    Attributes:
        frame: Numbers (m,) of the frames.
        u: The base (m, 2, 2) px in both images; NaN where it is unknown.
        axis: Unit vector (3,) along the shaft towards the tips, in the tool's axes.
        along: The image (m, 2, 2) px of a step along `axis` that is as long as the tool.
        moved, sd: Shift from the given base towards the tips, and its standard deviation: shares of the tool's length.
        pictures: Means of the aligned pictures (2, 141, 161, 3) uint8 of left and right.
        outline: Points (2, n, 2) px of the fitted outline in them.
        aside: How far the shaft's axis lies aside; None if the sides do not show it clearly.
    """

    frame: np.ndarray
    u: np.ndarray
    axis: np.ndarray
    along: np.ndarray
    moved: float
    sd: float
    pictures: np.ndarray
    outline: np.ndarray
    aside: Aside | None = None


def shaft_axis(recording: Recording, frames: np.ndarray, base: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The unit vector (3,) along the shaft towards the tips, in the tool's axes; `AHEAD` if no direction is clear.

    Arguments as of `shaft_end`.  Behind the base the mean of the frames, each turned so that the shaft points right, is
    averaged along the rows.  If all frames are turned rightly, the sides of the shaft are steep steps of this profile.
    """
    facing = np.where(np.isfinite(axes).all(axis=(2, 3)), np.nanmedian(_facing(axes), axis=0), np.nan)
    upright = _aligned(recording, frames, base, 2 * facing[..., None] * [1, 0], (_AROUND_PX, _AROUND_PX))
    views = [(_even(pictures), axes[kept, side]) for side, (pictures, kept) in enumerate(upright)]
    if min(len(shown) for _, shown in views) < _GROUPS * _FEWEST:
        return AHEAD

    def profile(picture: np.ndarray, angle: float) -> np.ndarray:
        """Colours (high, 3) across the shaft: the mean along it of a picture, turned back by `angle` rad."""
        (long, high), x, y = _BEHIND_PX, np.cos(angle), np.sin(angle)
        corner = [[x, -y], [y, x]] @ np.array([-_GAP_PX - long, -(high - 1) / 2]) + (_AROUND_PX - 1) / 2
        matrix = np.column_stack([[-y, x], [x, y], corner])  # along the shaft downwards, since rows are added faster
        return cv2.warpAffine(picture, matrix, (high, long), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP).mean(axis=0)

    def steps(turns: np.ndarray, rounded: float) -> np.ndarray:
        """Energy of the steps of the mean profile across the shaft, if these rotation vectors turn `AHEAD` along it.

        Angles in the images are `rounded` to multiples of this, in rad: turns that differ little share their profiles.
        """
        directions, energy = Rotation.from_rotvec(turns).apply(AHEAD), np.zeros(len(turns))
        for pictures, shown in views:
            x, y = np.einsum("kij,tj->itk", shown, directions)
            angle = np.rint(np.arctan2(y, x) / rounded)
            own = np.stack(np.broadcast_arrays(np.arange(len(pictures)), angle), axis=-1).reshape(-1, 2)
            different, which = np.unique(own, axis=0, return_inverse=True)
            profiles = np.array([profile(pictures[int(k)], rounded * one) for k, one in different])
            mean = np.array([profiles[rows].mean(axis=0) for rows in which.reshape(angle.shape)])
            smooth = cv2.GaussianBlur(np.hstack(mean), (1, 3), 0.8)
            energy += (np.diff(smooth, axis=0) ** 2).sum(axis=0).reshape(len(turns), -1).sum(axis=1)
        return energy

    def grid(half: float, step: float) -> np.ndarray:
        """Rotation vectors (n, 3) about axes across `AHEAD`, up to `half` degrees in steps; the smallest first."""
        angles = np.radians(np.arange(-half, half + 1, step))
        turns = np.stack(np.meshgrid(0.0, angles, angles), axis=-1).reshape(-1, 3)
        return turns[np.linalg.norm(turns, axis=1).argsort(kind="stable")]

    best, usual = np.zeros(3), 0.0
    for half, step in ((_WIDEST_DEG, 8.0), (4.0, 4.0), (2.0, 2.0), (1.0, 1.0)):
        turns = best + grid(half, step)
        energy = steps(turns, np.radians(step / 4))
        best, usual = turns[energy.argmax()], usual or np.median(energy)  # that of all directions
    return Rotation.from_rotvec(best).apply(AHEAD) if energy.max() > _SHARP * usual else AHEAD


def _facing(axes: np.ndarray) -> np.ndarray:
    """Length (m, 2) px of a tool in the image plane; the images of its three axes have together sqrt(2) times this norm."""
    return np.linalg.norm(axes, axis=(2, 3)) / np.sqrt(2)


def shaft_end(recording: Recording, frames: np.ndarray, base: np.ndarray, axes: np.ndarray) -> ShaftEnd | None:
    """Measure where the shaft ends, or return None if the pictures do not show it clearly.

    Args:
        frames: Numbers (m,) of the frames.
        base: Where the base is expected (m, 2, 2) px in them; it may be off along the shaft, and a little across.
        axes: The images (m, 2, 2, 3) px of the tool's axes, each as long as the tool; images where it is NaN are left out.
    """
    axis = shaft_axis(recording, frames, base, axes)
    along = axes @ axis
    size = np.linalg.norm(along, axis=-1)
    sine = np.sqrt((1 - (size / _facing(axes)) ** 2).clip(0, _STEEPEST**2))
    aligned = _aligned(recording, frames, base, along)
    if min(len(pictures) for pictures, _ in aligned) < _GROUPS * _FEWEST:
        return None
    even, found, sines = [_even(pictures) for pictures, _ in aligned], [], []
    for side, (pictures, (_, kept)) in enumerate(zip(even, aligned, strict=True)):
        groups = np.array_split(np.arange(len(pictures)), _GROUPS)
        sines.append(np.array([sine[kept[group], side].mean() for group in groups]))
        found.append(_scores(np.stack([pictures[group].mean(axis=0) for group in groups]), sines[-1]))
    scores, ends = zip(*found, strict=True)
    clear = np.mean([score.max(axis=2) for score in scores], axis=0) * _RADII_PX[:, None] ** _LARGE
    best = clear.max(axis=(0, 1))
    peaks = np.flatnonzero((best[1:-1] >= best[:-2]) & (best[1:-1] > best[2:])) + 1
    peaks = peaks[best[peaks] > _AS_CLEAR * best.max()]
    if not len(peaks):
        return None
    tangent = np.mean([angle / np.sqrt(1 - angle**2) for angle in sines])
    front = _ALONG_PX[peaks] + tangent * _RADII_PX[clear.max(axis=0)[:, peaks].argmax(axis=0)]
    farthest = peaks[front > front.max() - _SAME_FRONT_PX]
    i = farthest[best[farthest].argmax()]
    slope, k = np.unravel_index(clear[:, :, i].argmax(), clear.shape[:2])
    end = np.mean([score[k].max(axis=0) for score in ends], axis=0)
    if end[i] < np.median(end) + _CLEAR:
        return None
    shown = _RADII_PX[k] * tangent / _LENGTH_PX  # half axis of the ellipse along the tool, in tool lengths
    clearest = np.mean([score[slope, k, :, i].max() for score in scores])
    if k == len(_RADII_PX) - 1 or clearest < _LEAST or shown > _LONGEST:
        return None
    before, at, after = best[i - 1 : i + 2]
    moved = (_ALONG_PX[i] + 0.5 * (before - after) / (before - 2 * at + after)) / _LENGTH_PX
    shorter = np.sqrt(1 - np.array([angle.mean() for angle in sines]) ** 2)  # by the angle between tool and image
    long_px = _TAPER_PX if _SLOPES[slope] else _ASIDE_LONG_PX
    of_sides = zip(even, _RADII_PX[k] / shorter, strict=True)
    shifts_px = np.array([_middle(pictures, radius_px, _ALONG_PX[i], long_px) for pictures, radius_px in of_sides])
    aside = _aside(axes, along, shifts_px * shorter[:, None] / _LENGTH_PX)
    outlines = []
    for angle, score, (shift_px, _) in zip(sines, scores, shifts_px, strict=True):
        mean = angle.mean(keepdims=True)
        shift_px = _ACROSS_PX[score[slope, k, :, i].argmax()] if np.isnan(shift_px) else shift_px
        low, high = _sides(_RADII_PX[k], _SLOPES[slope], mean)[0][0]
        points = np.concatenate([low[::-1], _half_ellipse(_RADII_PX[k], mean)[0][0], high])
        outlines.append(points + _MIDDLE_PX + [moved * _LENGTH_PX, shift_px])
    moved += _BEVEL * shown
    sd = float(np.linalg.norm([_SD_TAPERED if _SLOPES[slope] else _SD, _SD_PX / np.nanmedian(size), _BEVEL_SD * shown]))
    means = np.stack([pictures.mean(axis=0) for pictures, _ in aligned]).round().astype(np.uint8)
    u = base + moved * along + (0.0 if aside is None else aside.moved * aside.across)
    return ShaftEnd(frames, u, axis, along, moved, sd, means, np.stack(outlines), aside)


def _middle(pictures: np.ndarray, radius_px: float, end_px: float, long_px: float) -> tuple[float, float]:
    """How far the middle of a shaft's sides lies below that of even pictures (k, h, w, 3), and its standard deviation, in px.

    Both are NaN if the sides are not clear.  The shaft ends at `end_px`, relative to the middle; its last `long_px` are
    averaged, along the line of the clearest sides.  The sides are two steep steps of colour, about twice the radius apart.
    """
    last, high = int(_MIDDLE_PX[0] + end_px) - 2, pictures.shape[1]
    first = max(last - int(long_px), 0)
    row, (middle, radius) = np.arange(high) - _MIDDLE_PX[1], np.meshgrid(_ASIDE_PX, radius_px + _WIDER_PX, indexing="ij")

    def sides(lean: float) -> np.ndarray:
        """(2, middles, radii): the steps of colour at the upper and at the lower side of a shaft with this slope."""
        level = np.array([[1, 0, 0], [-lean, 1, lean * last]])  # levels the shaft, and keeps its end in place
        levelled = (cut(picture, level, (last, high), border=cv2.BORDER_REPLICATE) for picture in pictures)
        profiles = np.stack([picture[:, first:].mean(axis=1) for picture in levelled])
        # In the mean picture soft sides would fade; but in each picture the ground has steps, too, about the median.
        steep = np.linalg.norm(gaussian_filter1d(profiles, _ASIDE_BLUR_PX, axis=1, order=1), axis=2).mean(axis=0)
        steep_at = make_interp_spline(row, np.maximum(steep - _OF_GROUND * np.median(steep), 1e-3))
        return np.stack([steep_at((middle + side * radius).clip(row[0], row[-1])) for side in (-1, 1)])

    steps = np.stack([sides(lean) for lean in _LEANS], axis=1)
    clear = steps.prod(axis=0)
    best = np.unravel_index(clear.argmax(), clear.shape)
    # A maximum at the border is not one: a step nearer to the middle is a highlight, one farther away a shadow.
    inner = all(0 < i < n - 1 for i, n in zip(best, clear.shape, strict=True))
    if not inner or steps[:, *best].min() < _LEAST_STEP * steps[:, *best].max():
        return np.nan, np.nan
    return _ASIDE_PX[best[1]], np.ptp(_ASIDE_PX[clear[best[0]].max(axis=1) > _NEARLY_AS_CLEAR * clear[best]]) / 2


def _aside(axes: np.ndarray, along: np.ndarray, shifts: np.ndarray) -> Aside | None:
    """How far the shaft's axis lies aside, by the mean shifts of the images and their standard deviations (2, 2).

    None if one is NaN or the roll varies too much.
    """
    across = along[..., ::-1] * [-1, 1] / np.linalg.norm(along, axis=-1, keepdims=True)  # downwards in the pictures
    shown = np.nanmean(np.einsum("mvi,mvij->mvj", across, axes) / _facing(axes)[..., None], axis=0)  # by steps along the axes
    axis = shown.sum(axis=0) / np.linalg.norm(shown.sum(axis=0))
    if np.isnan(shifts).any() or (size := shown @ axis).min() < _LEAST_ASIDE:
        return None
    (left, left_sd), (right, right_sd) = shifts / size[:, None]
    sd = np.linalg.norm([_ASIDE_SD, (left_sd + right_sd) / 2, (left - right) / 2])  # the same light falls on both
    return Aside(axis, axes @ axis, float(left + right) / 2, float(sd))


def _even(pictures: np.ndarray) -> np.ndarray:
    """Pictures (k, h, w, 3) of equal mean colour and contrast."""
    even = pictures - pictures.mean(axis=(1, 2), keepdims=True)
    return even / np.maximum(even.std(axis=(1, 2, 3), keepdims=True), 1.0)


def _aligned(
    recording: Recording, frames: np.ndarray, base: np.ndarray, along: np.ndarray, size_px: tuple[int, int] = _SIZE_PX
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each image, pictures (k, h, w, 3) around the base, in which `along` points right, and which frames they show."""
    shown = np.isfinite(base + along).all(axis=2) & inside(base, recording.image_size_px)
    zoom, angle = _LENGTH_PX / np.linalg.norm(along, axis=-1), np.arctan2(along[..., 1], along[..., 0])
    found: tuple[list[np.ndarray], ...] = ([], [])
    for k in np.flatnonzero(shown.any(axis=1)):
        frame = recording.frames[int(frames[k])]
        for side in np.flatnonzero(shown[k]):
            matrix = window_from_image(base[k, side], angle[k, side], size_px, zoom[k, side])
            found[side].append(cut((frame.left, frame.right)[side], matrix, size_px, border=cv2.BORDER_REPLICATE))
    return [
        (np.array(pictures, np.float32).reshape(-1, *size_px[::-1], 3), np.flatnonzero(shown[:, side]))
        for side, pictures in enumerate(found)
    ]


def _half_ellipse(radius: float, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (g, 15, 2) of the end of a shaft in g pictures, relative to the base."""
    across = (radius / np.sqrt(1 - sine**2))[:, None]  # relative to the tool's length, which the angle shortens
    along = np.maximum(across * sine[:, None], 0.5)
    x, y = np.cos(_DIRECTIONS_RAD), np.sin(_DIRECTIONS_RAD)
    normal = np.stack([x / along, y / across], axis=-1)
    points = np.stack(np.broadcast_arrays(along * x, across * y), axis=-1)
    return points, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _sides(radius: float, slope: float, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (g, 2, 10, 2) of the two sides of a shaft in g pictures, relative to the base, and normals (2, 10, 2)."""
    back = np.linspace(2, max(1.2 * radius, 16), _STRAIGHT)
    back = np.minimum(back, _TAPER_PX) if slope else back
    across = (radius / np.sqrt(1 - sine**2))[:, None] + slope * back
    points = np.stack([np.stack(np.broadcast_arrays(-back, sign * across), axis=-1) for sign in (-1, 1)], axis=1)
    normal = np.array([[slope, -1], [slope, 1]]) / np.hypot(slope, 1)
    return points, np.broadcast_to(normal[:, None], (2, _STRAIGHT, 2))


def _scores(pictures: np.ndarray, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How clearly pictures (g, h, w, 3) show the outline of a shaft's end.

    Of the whole outline (slopes, radii, positions across, positions along), and of its half ellipse alone (without slopes).
    """
    smooth = [cv2.GaussianBlur(picture, (0, 0), 1.2) for picture in pictures]
    gradient = np.stack([[cv2.Sobel(one, cv2.CV_32F, *order) for one in smooth] for order in ((1, 0), (0, 1))])
    level = np.quantile(np.hypot(*gradient).max(axis=-1).reshape(len(pictures), -1), 0.9, axis=1)[:, None]
    found = np.full((len(_SLOPES), len(_RADII_PX), len(_ACROSS_PX), len(_ALONG_PX)), -1.0)  # less than any score
    ends = found[0].copy()
    if not level.all():  # pictures without any edge
        return found, ends
    g, (w, h), gradient = np.arange(len(pictures))[:, None], _SIZE_PX, gradient.reshape(2, -1, 3)

    def clear(points: np.ndarray, normal: np.ndarray, across: float) -> np.ndarray:
        """At all positions along: the gradient across an outline less that beside it, relative to both; mean over points."""
        x, y = np.moveaxis(points + _MIDDLE_PX + [0, across], -1, 0)
        column = np.rint(x + _ALONG_PX[:, None, None]).astype(int).clip(0, w - 1)
        dx, dy = gradient[:, (g * h + np.rint(y).astype(int).clip(0, h - 1)) * w + column]
        nx, ny = np.moveaxis(normal.astype(np.float32)[..., None], -2, 0)
        over, beside = (np.sqrt(np.einsum("...i,...i", part, part)) for part in (dx * nx + dy * ny, dx * ny - dy * nx))
        return ((over - _OTHER_EDGES * beside) / (over + beside + level)).mean(axis=(-2, -1))

    for i, radius in enumerate(_RADII_PX):
        for j, across in enumerate(_ACROSS_PX):
            ends[i, j] = clear(*_half_ellipse(radius, sine), across)
            for k, slope in enumerate(_SLOPES if across == 0 else _SLOPES[:1]):
                sides, normal = _sides(radius, slope, sine)
                lines = clear(sides.reshape(len(sine), -1, 2), normal.reshape(-1, 2), across)
                found[k, i, j] = _END * ends[i, j] + (1 - _END) * lines
    return found, ends


def outlined(end: ShaftEnd, zoom: int = 3) -> np.ndarray:
    """The aligned pictures of left and right side by side, with the fitted outline of the shaft's end; RGB."""
    pictures = []
    for picture, outline in zip(end.pictures, end.outline, strict=True):
        large = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        points = np.rint(zoom * (outline + 0.5) - 0.5).astype(np.int32)
        pictures.append(cv2.polylines(large, [points], False, (0, 255, 0), 1, cv2.LINE_AA))
    return np.hstack(pictures)
