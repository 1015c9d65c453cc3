"""The ground: the image behind the tool in both cameras.  As the tool moves, most frames show each place without it."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Self

import cv2
import numpy as np

_FRAMES = 9  # number of frames in the median; more take longer and hardly improve it
_FEWEST = 5  # with fewer frames the tool may cover a place in most of them
_APART = 0.5  # least distance between the tool's places in two of these frames, in units of its length
_STEP = 4  # the light of an image is estimated on every fourth row and column
_DARK = 8  # grey value up to which a pixel may belong to the black surround of a round field


class Ground:
    """The images (2, h, w, 3) uint8 RGB behind the tool; a call returns them, and the first call computes them.

    `key` identifies the frames that they are computed from.

    >>> ground = Ground(lambda: np.zeros((2, 4, 6, 3), np.uint8), "dark")
    >>> ground().shape, ground.changed(lambda images: images[:, :2]).key, ground.changed(lambda images: images[:, :2])().shape
    ((2, 4, 6, 3), 'dark', (2, 2, 6, 3))
    """

    def __init__(self, see: Callable[[], np.ndarray], key: str) -> None:
        self._see, self.key = cache(see), key

    def __call__(self) -> np.ndarray:
        return self._see()

    @classmethod
    def of_frames(cls, frames: Sequence, x_mm: np.ndarray, name: str) -> Self | None:
        """The median of those frames of a recording (`name`) between which the robot's tool x_mm (n, k, 3) moves farthest.

        The frames are brought to one light before, else the brightest or the darkest would show the tool in it.  If the robot
        reports fewer than three positions, the frames are evenly spaced.  What moves all the time is blurred.  None if fewer
        than five frames show the tool in different places.  The ground would then contain the tool, and frames that do not
        show it there would seem to.
        """
        chosen = apart(x_mm.mean(axis=1), _FRAMES, _APART * _length(x_mm))
        if len(chosen) < _FEWEST:
            return None

        def see() -> np.ndarray:
            return _of_pairs([(frame.left, frame.right) for frame in (frames[int(i)] for i in chosen)])

        return cls(see, f"{name} in one light {chosen.tolist()}")

    def changed(self, change: Callable[[np.ndarray], np.ndarray]) -> Self:
        """The ground of images that `change` has processed: the same change of the cameras' ground."""
        return type(self)(lambda: change(self()), self.key)


class GrowingGround:
    """The `ground` of frames that arrive one by one, chosen as in `Ground.of_frames`; None until five are kept.

    >>> growing = GrowingGround()
    >>> for k in range(5):
    ...     growing.take(np.full((2, 4, 6, 3), 90 + k, np.uint8), np.full((3, 3), float(k)))
    >>> growing.ground().max()
    np.uint8(90)
    """

    def __init__(self) -> None:
        self._kept: list[np.ndarray] = []
        self._centre_mm, self._length_mm = np.empty((0, 3)), 0.0
        self.ground: Ground | None = None

    def take(self, images: np.ndarray, x_mm: np.ndarray) -> None:
        """Add a stereo frame (2, h, w, 3) uint8, which is copied if it is kept, and the robot's landmarks (k, 3) mm."""
        centre_mm, new = np.vstack([self._centre_mm, x_mm.mean(axis=0)]), len(self._kept)
        self._length_mm = np.fmax(self._length_mm, _length(x_mm[None]))
        chosen = apart(centre_mm, _FRAMES, _APART * self._length_mm)
        if new not in chosen or np.isnan(centre_mm[new]).any():
            return
        self._kept, self._centre_mm = [images.copy() if i == new else self._kept[i] for i in chosen], centre_mm[chosen]
        if len(chosen) >= _FEWEST:
            self.ground = Ground(partial(_of_pairs, self._kept), str(self._centre_mm.tolist()))


def lit(image: np.ndarray) -> np.ndarray:
    """Which pixels of every fourth row and column of an image (h, w, 3) tell of its light: a black surround does not."""
    bright = image[::_STEP, ::_STEP].max(axis=2) > _DARK
    return bright if bright.any() else ~bright


def relit(image: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Scale each channel of an image (h, w, 3) uint8 RGB to the light of another one of the same scene.

    >>> relit(np.full((8, 8, 3), 99, np.uint8), np.full((8, 8, 3), 49, np.uint8)).max()
    np.uint8(50)
    """
    where = lit(image)
    thinned = (part[::_STEP, ::_STEP][where] + 1.0 for part in (like, image))
    return cv2.multiply(image, (*np.median(np.divide(*thinned), axis=0), 0.0))  # the median ignores the tool


def _of_pairs(pairs: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    return np.stack([_median(images) for images in zip(*pairs, strict=True)])


def _median(images: Sequence[np.ndarray]) -> np.ndarray:
    """The median of images (h, w, 3) uint8 RGB in the light of the first one."""
    ranked, middle = [relit(image, images[0]) for image in images], len(images) // 2
    for last in range(len(ranked) - 1, middle - 1, -1):  # move the maximum of 0 to `last` to `last`
        for i in range(last):
            ranked[i : i + 2] = np.minimum(*ranked[i : i + 2]), np.maximum(*ranked[i : i + 2])
    return ranked[middle]


def _length(x_mm: np.ndarray) -> float:
    """The largest distance of a landmark from the first one of the tool, x_mm (n, k, 3), in the usual frame; 0 if unknown."""
    size = np.linalg.norm(x_mm - x_mm[:, :1], axis=2).max(axis=1)
    return float(np.median(size[np.isfinite(size)])) if np.isfinite(size).any() else 0.0


def apart(x: np.ndarray, count: int, least: float = 0.0) -> np.ndarray:
    """Ascending indices of at most `count` points x (n, d), each the farthest from those chosen before; NaN is no point.

    If fewer than three points are known, the indices are evenly spaced.  Points nearer than `least` are not chosen.

    >>> apart(np.array([[0.0], [1.0], [2.0], [np.nan], [9.0]]), 3)
    array([0, 2, 4])
    """
    known = np.flatnonzero(np.isfinite(x).all(axis=1))
    if len(known) < 3:
        return np.unique(np.linspace(0, len(x) - 1, min(count, len(x))).round().astype(int))
    chosen, distance = [known[0]], np.full(len(known), np.inf)
    while len(chosen) < min(count, len(known)):
        distance = np.minimum(distance, np.linalg.norm(x[known] - x[chosen[-1]], axis=1))
        if distance.max() < least:
            break
        chosen.append(known[distance.argmax()])
    return np.unique(chosen)
