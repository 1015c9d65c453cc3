"""Which of several tools that an image may show is the robot's: the one that moves as the robot reports.

A detector that does not know a tool may take another object, or a part of the tool, for it, although it sees the tool, too.
One image does not tell which is right.  But one affine camera shows the tool of all frames where the robot reports it.  So
a few right candidates find that camera, and the camera finds the others.
"""

import numpy as np
from tqdm.auto import tqdm

from lib.landmarks import Detector
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.recorded import Seen, look
from lib.landmarks.search import likelihood
from lib.recordings import Recording

#: Most candidates of an image, their least likelihood, and the least distance between two, as a share of the tool's length.
_MOST, _LIKELY, _APART = 5, 0.35, 0.15
#: Number of cameras that are tried, each from as many candidates; how many at once; and rounds of the final fit.
_TRIALS, _SAMPLE, _AT_ONCE, _ROUNDS = 3000, 2, 300, 5
#: Largest distance of the robot's tool from its image (mean of the landmarks, as a share of its length), and fewest images.
_NEAR, _FEWEST = 0.25, 10


def choose(recording: Recording, detector: Detector, seen: Seen, seed: int = 0, title: str = "") -> Seen:
    """Detections in the frames of `seen`, near those of several candidates in each image that move with the robot.

    Where none does, nothing is detected.  A progress bar is shown if it has a `title`.
    """
    near, x_mm = np.full_like(seen.u, np.nan), recording.landmarks_mm()[seen.frame]
    tools = np.full((*seen.u.shape[:2], _MOST, 3, 2), np.nan)
    for i, number in enumerate(tqdm(seen.frame, desc=title, unit="pair", disable=not title)):
        frame = recording.frames[int(number)]
        tools[i] = [several(detector, *shown) for shown in zip((frame.left, frame.right), seen.u[i], strict=True)]
    for side in range(2):
        best = moving_with(x_mm, tools[:, side], np.random.default_rng([seed, side]))
        near[best >= 0, side] = tools[best >= 0, side, best[best >= 0]]
    return look(recording, detector, seen.frame, near=near, title=title)


def several(detector: Detector, image: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Tools (5, 3, 2) px that an image (h, w, 3) may show: `first` (3, 2) px, then the likeliest others; NaN if fewer."""
    _, u, height = detector.proposed(image, detector.coarse(image[None]).u)
    likely = likelihood(u, height)
    order = [i for i in np.argsort(-likely) if likely[i] >= _LIKELY]
    found: list[np.ndarray] = []
    for tool in (first, *u[order]):
        apart = [np.linalg.norm(tool - other, axis=1).mean() / max(tool_length_px(other[None])[0], 1.0) for other in found]
        if np.isfinite(tool).all() and min(apart, default=1.0) > _APART:
            found.append(tool)
    return np.concatenate([np.array(found).reshape(-1, 3, 2), np.full((_MOST, 3, 2), np.nan)])[:_MOST]


def moving_with(x_mm: np.ndarray, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The candidate in each image of one eye that moves with the robot: (m,) index, or -1 if none does.

    x_mm (m, 3, 3) are the robot's landmarks and u (m, k, 3, 2) px the candidates; NaN where unknown.

    >>> rng = np.random.default_rng(0)
    >>> x_mm = rng.normal(0, 3, (30, 1, 3)) + [[[0, 0, 0], [4, 1, 0], [4, -1, 0]]]
    >>> u = np.stack([rng.uniform(0, 999, (30, 3, 2)), 99 * x_mm[..., :2]], axis=1)
    >>> np.unique(moving_with(x_mm, u, rng)).tolist()
    [1]
    """
    frame, which = np.nonzero(np.isfinite(u).all(axis=(2, 3)) & np.isfinite(x_mm).all(axis=(1, 2))[:, None])
    nobody = np.full(len(u), -1)
    if len(np.unique(frame)) < _FEWEST:
        return nobody
    centre = x_mm[np.unique(frame)].mean(axis=(0, 1))
    H = np.nan_to_num(np.concatenate([x_mm - centre, np.ones((*x_mm.shape[:2], 1))], axis=2))  # (m, 3, 4)

    def away(cameras: np.ndarray) -> np.ndarray:
        """Distances (n, m, k) of the candidates from the tool's images by cameras (n, 4, 2), as shares of its length."""
        told = np.einsum("mlj,njc->nmlc", H, cameras)
        length = np.maximum(tool_length_px(told.reshape(-1, 3, 2)).reshape(told.shape[:2]), 1.0)
        share = np.linalg.norm(u - told[:, :, None], axis=4).mean(axis=3) / length[..., None]
        return np.nan_to_num(share, nan=np.inf)

    trials = rng.integers(0, len(frame), (_TRIALS, _SAMPLE))
    trials = trials[(np.diff(np.sort(frame[trials], axis=1), axis=1) > 0).all(axis=1)]  # of different images
    rows, seen = H[frame[trials]].reshape(len(trials), -1, 4), u[frame[trials], which[trials]].reshape(len(trials), -1, 2)
    normal = rows.mT @ rows
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(4)  # the tool may not have moved
    cameras = np.linalg.solve(normal, rows.mT @ seen)
    parts = np.array_split(cameras, len(cameras) // _AT_ONCE + 1)  # to save memory
    score = [np.clip(1.0 - (away(part).min(axis=2) / _NEAR) ** 2, 0.0, None).sum(axis=1) for part in parts]
    share = away(cameras[[np.concatenate(score).argmax()]])[0]
    for _ in range(_ROUNDS):
        best, near = share.argmin(axis=1), share.min(axis=1) < _NEAR
        if near.sum() < _FEWEST:
            return nobody
        camera = np.linalg.lstsq(H[near].reshape(-1, 4), u[near, best[near]].reshape(-1, 2), rcond=None)[0]
        share = away(camera[None])[0]
    return np.where(share.min(axis=1) < _NEAR, share.argmin(axis=1), -1)
