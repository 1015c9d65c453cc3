"""The health of the detector without labels: where its detections contradict each other, the other image or the robot.

A network that does not know a picture gives different landmarks when the picture is mirrored or shifted; one that knows it
gives the same.  Pictures whose colours and details are unlike the training pictures are unfamiliar, whatever is detected.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Self

import cv2
import numpy as np

from lib.calibration import Calibration, with_offsets
from lib.correspondences import Correspondences
from lib.landmarks import with_ground
from lib.recordings import Recording
from lib.trust.fitting import Hypothesis

#: Part of the score -> limit for a landmark of a frame; see `Health.false_alarm_rate`.
LIMITS = {
    "looks": 0.02,  # largest shift of the landmark when the frame is mirrored or shifted, as a share of the tool's length
    "epipolar": 0.03,  # distance of left and right from a common epipolar geometry, as a share of the tool's length
    "robot": 8.0,  # distance from the robot's report, over the RMS residual of the calibration (at least 1 px)
    "smoothness": 0.05,  # change of that distance vector from the frames before and after, as a share of the tool's length
    "shape": 0.2,  # relative error of the tool's triangulated length by the robot's; of a frame, not of a landmark
    # Of a frame: RMS z-score of the image features of `unfamiliar`.  2 % of 96 validation pictures exceed it.
    "unfamiliar": 2.1,
}
#: Parts that belong to a frame and show no wrong landmark.
_OF_FRAMES = ("shape", "unfamiliar")
#: Parts that assume that the robot's report is right.
_BY_ROBOT = ("robot", "smoothness", "shape")
#: Medians and standard deviations of the image features of `unfamiliar` over 288 pictures of the training population.
_FAMILIAR = np.array([
    [0.32, -0.23, -2.49, -2.54, -0.76, -1.80, -3.38, -2.91, -2.76], [0.32, 0.31, 0.82, 0.82, 0.47, 0.52, 0.66, 0.60, 0.59],
])  # fmt: skip
_WIDTH_PX = 240  # width to which a picture is reduced for `unfamiliar`
_LOOKS, _PICTURES = 12, 60  # frames detected again, mirrored and shifted; pictures compared with those of the training
#: Frames further apart in time are not compared for smoothness.
_NEXT_S = 0.15
_MIRRORED = partial(np.flip, axis=2)
_TAILS = 3.0  # largest ratio of the RMS of residuals to their median without gross errors
#: Shift of an image that is detected again, (x, y) px: no multiple of a network's stride.
_SHIFT_PX = (37, 21)
#: Images are matched at half size: features of the retina are larger than a pixel, and it takes a quarter of the time.
_HALVED = 2
_RATIO = 0.8  # Lowe's ratio test
_OVERLAY_PX = 2.0  # a feature with less disparity is text or a mark that a recorder wrote into both images
_FEWEST = 20  # least number of agreeing matches in a frame that is used
_AGREE_PX = 4.0  # largest median distance of these from their geometry; beyond it matches are accidental, as in a pattern


@dataclass(frozen=True, eq=False)
class Health:
    """How consistent each landmark is with other evidence, and one score for each frame.

    Attributes:
        frame, seen: (m,) numbers of the frames, and (m, 3) bool: found in at least one image.
        parts: Name -> (m, 3) in units of its limit, the worse of the two images; NaN where it could not be computed.
        false_alarm_rate: Upper bound of the share of frames with right landmarks (all within 5 % of the tool's length) whose
            score exceeds 1: 3 of 35 frames of the validation population without `unfamiliar`, and the 2 % that this may add.
    """

    frame: np.ndarray
    parts: dict[str, np.ndarray]
    seen: np.ndarray
    false_alarm_rate: float = 0.11

    @property
    def score(self) -> np.ndarray:
        """(m,) the worst part of the worst landmark; above 1 the frame is in doubt; NaN where no part could be computed."""
        return np.fmax.reduce([np.full(len(self.frame), np.nan), *(np.fmax.reduce(p, axis=1) for p in self.parts.values())])

    @property
    def bad(self) -> np.ndarray:
        """(m, 3) bool: seen, and a part of the landmark itself exceeds its limit."""
        return self.seen & np.any([part > 1 for name, part in self.parts.items() if name not in _OF_FRAMES], axis=0)

    @property
    def unhealthy(self) -> float:
        """Share of the landmarks seen that are bad; 1 where none is seen."""
        return float(self.bad.sum() / self.seen.sum()) if self.seen.any() else 1.0

    @property
    def worst_part(self) -> str:
        """The part whose limit most landmarks exceed, without the parts of whole frames."""
        names = (name for name in self.parts if name not in _OF_FRAMES)
        return max(names, key=lambda name: np.sum(self.parts[name] > 1), default="")

    def beside(self, cause: Hypothesis) -> Self:
        """The same without the parts that another cause than the detector spoils: it is not to blame for them."""
        apart = len(cause.images) == 1 or cause.name == "exchanged_eyes"  # then the images of a pair contradict each other
        spoilt = (*_BY_ROBOT, "epipolar") if apart else _BY_ROBOT
        return replace(self, parts={name: part for name, part in self.parts.items() if name not in spoilt})

    @property
    def text(self) -> str:
        """The share of bad landmarks, in words without a full stop."""
        if not self.seen.any():
            return "No frame has a landmark"
        names = {"epipolar": "the other image", "robot": "the robot", "looks": "themselves when mirrored or shifted"}
        what = " or ".join(text for name, text in names.items() if name in self.parts)
        return f"{100 * self.unhealthy:.0f} % of the detected landmarks contradict {what}"


def health(
    recording: Recording | None, data: Correspondences, calibration: Calibration | None = None, *,
    detector: Callable | None = None,
) -> Health:  # fmt: skip
    """Compare the detections `data` with everything that is known without labels; ValueError if `data` has no row.

    `calibration` was made from `data`.  `detector` detects again in some frames, mirrored and shifted.  Parts that need a
    recording, calibration or detector that is None are left out.
    """
    if not len(data):
        raise ValueError("data: no row; run the detector over some frames.")
    frame = np.unique(data.frame)
    u = data.grid("stacked_px").reshape(len(frame), -1, 2, 2)  # (m, 3, 2, 2)
    with warnings.catch_warnings(action="ignore"):  # means of all-NaN slices
        length = np.nanmedian(np.linalg.norm(u[:, 1:] - u[:, :1], axis=-1))
        time = np.nanmean(data.grid("time_s"), axis=1)
    shape, y = u.shape[:2], u.reshape(-1, 4)
    parts = {"epipolar": affine_epipolar(y)[0].reshape(shape) / length}
    if calibration is not None and calibration.rig is not None:
        rig, x = calibration.rig, with_offsets(data, calibration.offsets).grid("x_mm")
        off = u - np.hstack(rig.project(x.reshape(-1, 3))).reshape(u.shape)
        # Deviation from the median of a frame and its two neighbours, if these are close in time.
        jump = np.full(off.shape, np.nan)
        near = (time[2:] - time[:-2] <= 2 * _NEXT_S)[:, None, None, None]
        jump[1:-1] = np.where(near, off[1:-1] - np.median([off[:-2], off[1:-1], off[2:]], axis=0), np.nan)
        distance, jump = (np.fmax.reduce(np.linalg.norm(one, axis=-1), axis=2) for one in (off, jump))  # in the worse image
        usual = min(calibration.reprojection_rms_px, _TAILS * np.nanmedian(distance))  # gross errors must not hide others
        parts["robot"] = distance / max(usual, 1.0)
        parts["smoothness"] = jump / length
        seen = rig.triangulate(y[:, :2], y[:, 2:]).x_mm.reshape(x.shape)
        lengths = [np.linalg.norm(one[:, 1:].mean(axis=1) - one[:, 0], axis=1) for one in (seen, x)]
        parts["shape"] = np.broadcast_to(np.abs(lengths[0] / lengths[1] - 1.0)[:, None], shape)
    if detector is not None:
        parts["looks"] = np.fmax.reduce(_looks_px(recording, frame, u, detector), axis=2) / length
    if recording is not None:
        parts["unfamiliar"] = np.full(shape, np.nan)
        for i in spread(len(frame), _PICTURES):
            parts["unfamiliar"][i] = unfamiliar(recording.frames[int(frame[i])].left)
    return Health(frame, {n: parts[n] / LIMITS[n] for n in LIMITS if n in parts}, np.isfinite(u[..., 0]).any(axis=2))


def spread(n: int, count: int) -> np.ndarray:
    """At most `count` of the numbers 0 to n - 1, evenly spaced."""
    return np.unique(np.linspace(0, n - 1, min(count, n)).round().astype(int))


def unfamiliar(image: np.ndarray) -> float:
    """How unlike the training pictures an image (h, w, 3) uint8 RGB is: the RMS of its features' z-scores.

    The features are medians and spreads of the colours, brightness, contrast, and the contrast of three sizes of detail.
    """
    size = _WIDTH_PX, max(8, round(_WIDTH_PX * image.shape[0] / image.shape[1]))
    log = np.log(cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255 + 0.02)
    grey, chroma = log.mean(axis=2), log[..., [0, 2]] - log[..., 1:2]
    blurred = [grey, *(cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1, 4, 16))]
    detail = [np.std(fine - coarse) + 1e-3 for fine, coarse in pairwise(blurred)]
    spread = np.log([*(chroma.std(axis=(0, 1)) + 3e-3), grey.std() + 1e-6, *detail])
    features = np.array([*np.median(chroma, axis=(0, 1)), *spread[:2], grey.mean(), *spread[2:]])
    return float(np.sqrt((((features - _FAMILIAR[0]) / _FAMILIAR[1]) ** 2).mean()))


def _looks_px(recording: Recording, frame: np.ndarray, u: np.ndarray, detector: Callable) -> np.ndarray:
    """(m, 3, 2) px: largest shift of each landmark in a mirrored and a shifted image; infinite where it is lost there."""
    moved = np.full(u.shape[:3], np.nan)
    for i in spread(len(frame), _LOOKS):
        pair = recording.frames[int(frame[i])]
        images = np.stack([pair.left, pair.right])
        mirrored, again = (detector(f(images), **with_ground(detector, recording, f)).u for f in (_MIRRORED, _shifted))
        back = np.stack([images.shape[2] - 1 - mirrored[..., 0], mirrored[..., 1]], axis=-1)[:, [0, 2, 1]]
        distance = np.linalg.norm(np.stack([back, again - _SHIFT_PX]) - np.swapaxes(u[i], 0, 1), axis=-1).max(axis=0)
        moved[i] = np.where(np.isnan(u[i, ..., 0]), np.nan, np.nan_to_num(distance, nan=np.inf).T)
    return moved


def _shifted(images: np.ndarray) -> np.ndarray:
    shifted = np.pad(images, ((0, 0), (_SHIFT_PX[1], 0), (_SHIFT_PX[0], 0), (0, 0)))
    return shifted[:, : images.shape[1], : images.shape[2]]


def affine_epipolar(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) px of matches y (n, 4) from the affine epipolar geometry of most of them, and (n,) bool which agree.

    Least median of squares, then a refit.  Distances of NaN rows are NaN; with fewer than 12 finite rows all are.
    """
    rows = np.flatnonzero(np.isfinite(y).all(axis=1))
    found, agree = np.full(len(y), np.nan), np.zeros(len(y), dtype=bool)
    if len(rows) < 12:
        return found, agree
    known = y[rows]
    sets = known[np.random.default_rng(0).integers(0, len(rows), (300, 4))]
    middle = sets.mean(axis=1, keepdims=True)
    normal = np.linalg.svd(sets - middle)[2][:, 3]
    distance = np.abs(normal @ known.T - (middle[:, 0] * normal).sum(axis=1, keepdims=True))
    best = distance[np.median(distance, axis=1).argmin()]
    for _ in range(5):
        kept = best <= 4.0 * max(float(np.median(best)), 0.1)
        middle = known[kept].mean(axis=0)
        best = np.abs((known - middle) @ np.linalg.svd(known[kept] - middle)[2][3])
    found[rows], agree[rows] = best, kept
    return found, agree


def feature_matches(recording: Recording, frames: np.ndarray) -> np.ndarray:
    """SIFT features (n, 4) px matched between left and right; those of one frame agree on some affine epipolar geometry."""
    sift, found = cv2.SIFT_create(2000), [np.zeros((0, 4))]
    for i in frames:
        pair = recording.frames[int(i)]
        grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[::_HALVED, ::_HALVED] for image in (pair.left, pair.right)]
        (left, a), (right, b) = (sift.detectAndCompute(image, None) for image in grey)
        if a is None or b is None or min(len(a), len(b)) < _FEWEST:
            continue
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a, b, k=2)
        pairs = [best for best, second in pairs if best.distance < _RATIO * second.distance]
        times = np.bincount([m.trainIdx for m in pairs], minlength=len(b))
        pairs = [m for m in pairs if times[m.trainIdx] == 1]  # a feature that matches several others is ambiguous
        y = _HALVED * np.array([[*left[m.queryIdx].pt, *right[m.trainIdx].pt] for m in pairs]).reshape(-1, 4)
        y = y[np.abs(y[:, :2] - y[:, 2:]).max(axis=1) > _OVERLAY_PX]
        distance, agree = affine_epipolar(y)
        if agree.sum() >= _FEWEST and np.median(distance[agree]) <= _AGREE_PX:
            found.append(y[agree])
    return np.concatenate(found)
