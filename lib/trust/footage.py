"""Defects of images and tables: combs, repeated images, rounded numbers, frozen orientations, which look like other causes.

And images of an eye that are mirrored or turned in some frames, or blurred.
"""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lib.correspondences import Correspondences
from lib.matching import dark_mask
from lib.recordings import Doubt, Recording
from lib.trust.diagnosis import Diagnosis
from lib.trust.fitting import SIDES, Hypothesis
from lib.trust.health import spread

#: Causes that these defects look like.
_OF_TIMES = (
    "clock", "clock_rate", "frame_order", "time_stamps", "robot_noise", "robot_wanders", "smoothed_log", "frozen_video",
)  # fmt: skip
_LOOKED_AT, _AROUND = 8, 0.3  # images in which combs are looked for; margin around the tool, as a share of its extent
#: Number of steps from row to row that alternate in a comb (two do at a thin line); what is added to both means of their
#: sizes, in grey levels; least ratio of rows to columns.  It is 0.5 to 1.5 in 77 recordings with images of one instant.
_ALTERNATE, _EVEN, _COMBED = 4, 0.03, 2.5
_STRETCHES, _STRETCH = 3, 13  # stretches of consecutive images that are compared, and their lengths
#: An image repeats if it differs from the one before by less than the first share of the usual change, although the robot
#: moved by more than the second share of its usual step.  Fewer repeats than the last share do little harm.
_SAME, _MOVES, _LEAST_REPEATED = 0.1, 0.5, 0.05
#: Frames in which both images' detail is compared; number of the sizes of detail; contrasts by rounding, and of no image.
_COMPARED, _SIZES, _ROUNDED, _BLANK = 12, 3, 1e-3, 1e-4
#: Largest share of the other image's detail that an image in doubt shows, and least share of such frames.  In 30 good
#: recordings, of which some have unlike cameras, the lower of both shares was 0.77 or more.
_BLURRED, _OFTEN = 0.6, 0.2
#: Frames in which turned images are looked for; size (width, height) of the reduced images; blur of the shading that is
#: subtracted and of the contrast that divides the rest, so that the border of a lit field counts little; least contrast.
_LOOKED_FOR_TURNS, _SMALL_PX, _SHADING_PX, _FAINT = 24, (96, 54), 3.0, 0.02
#: Steps through rows and columns that turn an image back.  It is turned if its correlation with the usual image is then more
#: than `_ALIKE`, and without turning less than `_UNALIKE` times that.  In 145 recordings without turned images, turning gave
#: 0.53 or less; where it gave more than 0.4, that was 0.6 or less of the correlation without turning.
_BACK = {(1, 1): "", (-1, 1): "mirrored top to bottom", (1, -1): "mirrored left to right", (-1, -1): "turned by 180 degrees"}
_ALIKE, _UNALIKE = 0.5, 0.5
_CERTAIN = 100.0  # gain in log likelihood of what the images show without any fit
_UNITS_S, _UNITS_MM = (1.0, 0.1, 0.01), (1.0, 0.5, 0.2, 0.1, 0.05)  # units to which times and positions may be rounded
#: Angles of the tool from its mean direction (medians over the frames, rad): the largest in a log that never turns the tool,
#: and the least in images that show it turn.  The two images' angles may differ by this share.  And the fewest frames.
_TURNS, _SHOWN_TURNS, _UNLIKE, _FEWEST_TURNS = np.radians(1.0), np.radians(8.0), 0.5, 6


def with_footage(diagnosis: Diagnosis, recording: Recording, data: Correspondences) -> Diagnosis:
    """The diagnosis of `data`, in which a defect of images or tables takes the place of the cause that it looks like.

    Most look like wrong times.  A log that never turns the tool may look like anything.
    """
    best = diagnosis.best
    if best is None:
        return diagnosis
    found = _frozen_orientation(best, recording, data)
    if best.name in _OF_TIMES:
        found = found or _interlaced(best, recording, data) or _repeated(best, recording, data) or _rounded(best, recording)
    return Diagnosis((found, *(h for h in diagnosis.hypotheses if h.name != best.name))) if found else diagnosis


def _frozen_orientation(best: Hypothesis, recording: Recording, data: Correspondences) -> Hypothesis | None:
    """A log in which the tool always points in the same direction, although the images show that it turns."""
    frames = np.unique(data.frame)
    x, u = recording.landmarks_mm()[frames], np.stack([data.grid("u_left"), data.grid("u_right")])
    if x.shape[1] != 3:
        return None
    along, shown = (tool[..., 1:, :].mean(axis=-2) - tool[..., 0, :] for tool in (x, u))
    known = np.isfinite(along).all(axis=1) & np.isfinite(shown).all(axis=(0, 2))
    if known.sum() < _FEWEST_TURNS:
        return None
    along = along[known] / np.linalg.norm(along[known], axis=1, keepdims=True)
    mean = along.mean(axis=0) / np.linalg.norm(along.mean(axis=0))
    logged = np.median(np.arccos((along @ mean).clip(-1, 1)))
    turned = shown[:, known] @ [1, 1j]
    turned /= np.abs(turned)
    turned = np.angle(turned / turned.mean(axis=1, keepdims=True))
    seen, unlike = np.median(np.abs(turned)), np.median(np.abs(turned[0] - turned[1]))
    if logged > _TURNS or seen < _SHOWN_TURNS or unlike > _UNLIKE * seen:
        return None
    text = "In kinematics.csv the tool always points in the same direction, but in the images it turns by "
    text += f"{np.degrees(seen):.0f} degrees (median of the angles to its mean direction)."
    cure = "Does the orientation in the robot's log stand still? Or are the positions in the tool's own axes?"
    size = {"value": float(np.degrees(seen)), "sd": 0.0, "unit": "degrees", "images": (0, 1)}
    return replace(best, name="frozen_orientation", text=text, cure=cure, **size)


def turned_images(recording: Recording, frames: np.ndarray) -> Hypothesis | None:
    """Images of one eye that show the scene mirrored or turned by 180 degrees, unlike most of its images."""
    some = frames[spread(len(frames), _LOOKED_FOR_TURNS)]
    reduced = [_reduced(recording, i) for i in some]
    usual = _even(np.median(reduced, axis=0))

    def turned(own: np.ndarray) -> list[tuple[int, str]]:
        """The sides of a reduced frame that are turned, and how."""
        alike = np.array([(own[:, ::y, ::x] * usual).mean(axis=(1, 2)) for y, x in _BACK])  # (4, 2): the first as they are
        how = np.where((alike.max(axis=0) > _ALIKE) & (alike[0] < _UNALIKE * alike.max(axis=0)), alike.argmax(axis=0), 0)
        return [(side, list(_BACK.values())[k]) for side, k in enumerate(how) if k]

    if not any(map(turned, reduced)):
        return None
    found = [(int(i), *one) for i in frames for one in turned(_reduced(recording, i))]
    side, how = found[0][1:]
    numbers = [i for i, *one in found if one == [side, how]]
    text = f"{len(numbers)} of the {SIDES[side]} images, first in frame {numbers[0]}, last in frame {numbers[-1]}, are "
    text += f"{how} relative to the others."
    cure = "Turn them back where the images are stored, or leave these frames out."
    return Hypothesis("turned_images", text, cure, float(len(numbers)), 0.0, "images", 1.0, _CERTAIN, (side,))


def _reduced(recording: Recording, frame: int) -> np.ndarray:
    """(2, h, w): small grey images of a frame, without their shading."""
    pair, found = recording.frames[int(frame)], []
    for image in (pair.left, pair.right):
        grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
        detail = np.log(cv2.resize(grey, _SMALL_PX, interpolation=cv2.INTER_AREA) + np.float32(8))
        detail -= cv2.GaussianBlur(detail, (0, 0), _SHADING_PX)
        found.append(detail / (np.sqrt(cv2.GaussianBlur(detail**2, (0, 0), _SHADING_PX)) + _FAINT))
    return _even(np.array(found))


def _even(images: np.ndarray) -> np.ndarray:
    """Images (2, h, w) of mean 0 and standard deviation 1."""
    images = images - images.mean(axis=(1, 2), keepdims=True)
    return images / np.maximum(images.std(axis=(1, 2), keepdims=True), 1e-9)


def blurred(recording: Recording, frames: np.ndarray) -> list[Doubt]:
    """The doubt that images of one eye lack the fine detail that the other eye's show, in some of the given frames."""
    frames = frames[spread(len(frames), _COMPARED)]
    pairs = (recording.frames[int(i)] for i in frames)
    left, right = np.array([_details(pair.left, pair.right) for pair in pairs]).swapaxes(0, 1)
    for side, own, other in (("left", left, right), ("right", right, left)):
        found = (own < _BLURRED * other).any(axis=1)
        if found.mean() > _OFTEN:
            text = f"In {found.sum()} of {len(frames)} compared frames, first in frame {frames[found][0]}, the {side} image "
            text += f"has less than {100 * _BLURRED:.0f} % of the other's fine detail: out of focus, covered, or scaled up."
            cure = f"Focus and clean the {side} eye, record both eyes at full size, and leave out what is blurred."
            return [Doubt("blurred", text, cure)]
    return []


def _details(left: np.ndarray, right: np.ndarray) -> list[np.ndarray]:
    """`_detail` of two images, in the box around what either shows lit: a round field has a dark surround."""
    x, y, width, height = cv2.boundingRect((~dark_mask(left) | ~dark_mask(right)).view(np.uint8))
    return [_detail(image[y : y + height, x : x + width]) if width else np.zeros(_SIZES) for image in (left, right)]


def _detail(image: np.ndarray) -> np.ndarray:
    """(3,) contrasts of details of 2, 4 and 8 px relative to that of 16 px, 0 in a blank image.  Single pixels are noise."""
    grey = [np.log(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) + np.float32(8))]
    for _ in range(_SIZES + 2):
        grey.append(cv2.pyrDown(grey[-1]))
    *sizes, coarse = (np.median(np.abs(a - cv2.pyrUp(b, dstsize=a.shape[::-1]))) for a, b in pairwise(grey[1:]))
    return (np.array(sizes) + _ROUNDED) / (coarse + _ROUNDED) * (coarse > _BLANK)


def _interlaced(best: Hypothesis, recording: Recording, data: Correspondences) -> Hypothesis | None:
    """Odd rows of another instant than even rows: edges of the moving tool become combs, jagged from row to row."""
    frames, u, ratios = np.unique(data.frame), data.grid("u_left"), []
    for i in spread(len(frames), _LOOKED_AT):
        if np.isfinite(u[i]).all():
            margin = _AROUND * np.ptp(u[i], axis=0).max() * np.array([[-1], [1]])
            (left, top), (right, bottom) = np.maximum([u[i].min(axis=0), u[i].max(axis=0)] + margin, 0).astype(int)
            tool = recording.frames[int(frames[i])].left[top:bottom, left:right].sum(axis=2, dtype=np.float32)
            ratios.append((_jagged(tool) + _EVEN) / (_jagged(tool.T) + _EVEN))
    if not ratios or np.median(ratios) < _COMBED:
        return None
    text = "The images are interlaced: their odd rows show the tool at another instant than their even rows."
    cure = "Import again with video.deinterlace = true in the mapping: it keeps the even rows, and fills in the odd ones."
    return replace(best, name="interlaced", text=text, cure=cure, value=float(np.median(ratios)), sd=0.0, unit="times")


def _jagged(image: np.ndarray) -> float:
    """Mean size of the steps between rows that alternate, up and down, at least `_ALTERNATE` times."""
    steps = np.diff(image, axis=0)
    steps[1::2] *= -1
    if len(steps) < _ALTERNATE:
        return 0.0
    runs = sliding_window_view(steps, _ALTERNATE, axis=0)
    return float((np.maximum(runs.min(axis=-1), 0) - np.minimum(runs.max(axis=-1), 0)).mean())


def _repeated(best: Hypothesis, recording: Recording, data: Correspondences) -> Hypothesis | None:
    """Images that a converter or camera delivered twice, as when 25 frames per second become 30."""
    first, last = int(data.frame.min()), int(data.frame.max())
    starts = np.linspace(first, max(last - _STRETCH + 1, first), _STRETCHES).astype(int)
    pairs = np.unique(np.concatenate([np.arange(start + 1, min(start + _STRETCH, last + 1)) for start in starts]))
    changes = [cv2.absdiff(recording.frames[int(i)].left, recording.frames[int(i) - 1].left).mean() for i in pairs]
    steps_mm = np.nan_to_num(np.linalg.norm(np.diff(recording.landmarks_mm(), axis=0), axis=2)).max(axis=1)[pairs - 1]
    moves = steps_mm > _MOVES * np.median(steps_mm)
    twice = moves & (changes < _SAME * np.quantile(changes, 0.9))
    if twice.sum() < max(2, _LEAST_REPEATED * moves.sum()):
        return None
    share = 100.0 * float(twice.sum() / moves.sum())
    text = f"{share:.0f} % of the images repeat the one before while the robot moves, first that of frame {pairs[twice][0]}."
    cure = "Drop images that came twice, as from 25 to 30 frames per second, and write the others' true times to frames.csv."
    return replace(best, name="frozen_video", text=text, cure=cure, value=share, sd=0.0, unit="%", images=(0, 1))


def _rounded(best: Hypothesis, recording: Recording) -> Hypothesis | None:
    """Uneven times, or positions, that are multiples of a coarse unit, and errors of the size of its rounding."""
    x_mm, time_s, error = recording.kinematics.x_mm, recording.frames.time_s, 1e-3 * best.value
    unit_s, unit_mm = _unit(time_s, _UNITS_S), _unit(x_mm[np.isfinite(x_mm)], _UNITS_MM)
    uneven = len(np.unique(np.rint(np.diff(time_s) / (unit_s or 1.0)))) > 1
    if best.name == "time_stamps" and uneven and 0.1 * unit_s < error < 0.5 * unit_s:
        text = f"The frames' times are rounded to {unit_s:g} s, and err by up to {500 * unit_s:g} ms."
        cure = "Write the frames' times to frames.csv as they were measured, to the millisecond."
        return replace(best, text=text, cure=cure)
    if best.name == "robot_noise" and 0.2 * unit_mm < error < unit_mm:
        text = f"The robot's positions are rounded to {unit_mm:g} mm, and err by up to {500 * unit_mm:g} um along each axis."
        return replace(best, text=text, cure="Log the robot's positions with all digits, to the micrometre.")
    return None


def _unit(values: np.ndarray, units: tuple[float, ...]) -> float:
    """The first of some units of which all values are multiples; 0 if there is none."""
    return next((unit for unit in units if np.abs(values - unit * np.rint(values / unit)).max() < 1e-6), 0.0)
