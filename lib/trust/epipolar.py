"""Epipolar geometry that no calibration knows: of the landmarks, and of features that both images share."""

import cv2
import numpy as np

from lib.cameras import StereoRig
from lib.recordings import Recording

__all__ = ["affine_epipolar", "feature_epipolar_px"]

#: The images are halved: features of the retina are larger than a pixel, and it takes a quarter of the time.
_HALVED = 2
_RATIO = 0.8  # Lowe's ratio test
_FEWEST = 20  # matches that agree, below which a frame is no witness


def affine_epipolar(y: np.ndarray, samples: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) px of matches y (n, 4) from the affine epipolar geometry that most share, and which (n,) agree.

    Least median of squares, then a refit; NaN rows stay NaN, all of them are where fewer than 12 are known.
    """
    rows = np.flatnonzero(np.isfinite(y).all(axis=1))
    found, agree = np.full(len(y), np.nan), np.zeros(len(y), dtype=bool)
    if len(rows) < 12:
        return found, agree
    known = y[rows]
    sets = known[np.random.default_rng(0).integers(0, len(rows), (samples, 4))]
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


def feature_epipolar_px(recording: Recording, rig: StereoRig, frames: int = 3) -> float:
    """Median epipolar distance under the rig of features matched freely between left and right; NaN where there are too few.

    Matches count that agree on some affine epipolar geometry, whichever it is.
    """
    sift, found = cv2.SIFT_create(2000), []
    for i in np.unique(np.linspace(0, len(recording) - 1, frames).round().astype(int)):
        pair = recording.frames[int(i)]
        grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[::_HALVED, ::_HALVED] for image in (pair.left, pair.right)]
        (left, a), (right, b) = (sift.detectAndCompute(image, None) for image in grey)
        if a is None or b is None or min(len(a), len(b)) < _FEWEST:
            continue
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a, b, k=2)
        pairs = [best for best, second in pairs if best.distance < _RATIO * second.distance]
        y = _HALVED * np.array([[*left[m.queryIdx].pt, *right[m.trainIdx].pt] for m in pairs]).reshape(-1, 4)
        agree = affine_epipolar(y)[1]
        if agree.sum() >= _FEWEST:
            found.append(np.abs(rig.epipolar_distance(y[agree, :2], y[agree, 2:])))
    return float(np.median(np.concatenate(found))) if found else np.nan
