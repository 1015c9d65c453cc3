"""The scene behind the tool: its shift in the images shows whether the cameras moved."""

from itertools import product
from typing import NamedTuple, Self

import cv2
import numpy as np

_STEP = 4  # every fourth pixel is kept; that also suffices to find repeated images, since a sensor's noise never repeats
_SCENE_PX, _TILES = (384, 216), 4  # size at which scenes are compared, in 4 x 4 tiles; their sides suit OpenCV's transform
_TEXTURE, _FEWEST, _LEAST_PX = 0.1, 4, 16  # least response of a textured tile, fewest such tiles, least side of a tile


class Scene(NamedTuple):
    """Every fourth pixel of a stereo pair, (h, w, 3) uint8 each, to measure whether the scene moved."""

    left: np.ndarray
    right: np.ndarray

    @classmethod
    def of(cls, left: np.ndarray, right: np.ndarray) -> Self:
        """The scene of two images (h, w, 3) uint8."""
        return cls(*(np.ascontiguousarray(image[::_STEP, ::_STEP]) for image in (left, right)))

    def moved_px(self, other: Self) -> np.ndarray:
        """(2,) px of the full images, left and right: the largest shift to `other` among the 80 % of tiles that move least.

        NaN if too few tiles have texture.  The moving tool covers few tiles, so the rest of the image decides.

        >>> dots = np.random.default_rng(0).integers(0, 255, (27, 48), dtype=np.uint8)
        >>> dots = cv2.resize(cv2.merge([dots] * 3), (480, 270), interpolation=cv2.INTER_CUBIC)
        >>> before, now = Scene(dots, dots), Scene(dots, np.roll(dots, 5, axis=1))
        >>> before.moved_px(now).round().astype(int)
        array([ 0, 20])
        """
        return np.array([_moved_px(*pair) for pair in zip(self, other, strict=True)])


def _moved_px(*images: np.ndarray) -> float:
    if min(images[0].shape[:2]) < _TILES * _LEAST_PX or images[0].shape != images[1].shape:
        return np.nan
    scale, tile = _STEP * np.array(images[0].shape[1::-1]) / _SCENE_PX, np.array(_SCENE_PX) // _TILES
    small = [cv2.resize(cv2.cvtColor(one, cv2.COLOR_RGB2GRAY), _SCENE_PX, interpolation=cv2.INTER_AREA) for one in images]
    window, moved = cv2.createHanningWindow(tile, cv2.CV_32F), []
    for x, y in product(*(size * np.arange(_TILES) for size in tile)):
        parts = (one[y : y + tile[1], x : x + tile[0]].astype(np.float32) for one in small)
        shift, response = cv2.phaseCorrelate(*parts, window)
        moved += [np.linalg.norm(scale * shift)] if response > _TEXTURE else []
    return float(np.quantile(moved, 0.8)) if len(moved) >= _FEWEST else np.nan
