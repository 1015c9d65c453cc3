"""Contrast enhancement.  If the detector is unsure, it looks again with more contrast, where a dull tool is easier to see."""

import cv2
import numpy as np

from lib.recordings.ground import lit, relit

#: `equalised`: number of tiles along each side, and the approximate limit of the contrast gain (CLAHE's clip limit).
_TILES, _LIMIT = 8, 2.0
#: `levelled`: sigma of the smoothing against noise, as a share of the longer side.  The gain brings this percentile of the
#: absolute differences to this value (of 255), within the given range.  Chosen on validation recordings.
_SMOOTHING, _DIFFERENCE_PERCENTILE, _TARGET_DIFFERENCE, _GAIN_RANGE = 1e-3, 99.5, 80.0, (1.0, 4.0)
#: `stretched`: the percentiles that become black and white.  Percentiles are estimated on every `_STEP`-th row and column.
_STRETCH_PERCENTILES, _STEP = (1.0, 99.0), 4


def equalised(image: np.ndarray) -> np.ndarray:
    """Equalise the lightness of an image (h, w, 3) uint8 RGB tile by tile (CLAHE; Zuiderveld 1994).

    >>> dull = np.random.default_rng(0).integers(90, 99, (64, 64, 1), np.uint8).repeat(3, axis=2)
    >>> bool(equalised(dull).std() > 1.5 * dull.std())
    True
    """
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.createCLAHE(_LIMIT, (_TILES, _TILES)).apply(lab[..., 0])
    return cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)


def stretched(image: np.ndarray) -> np.ndarray:
    """Stretch each channel of an image (h, w, 3) uint8 RGB to the full range 0 to 255.

    >>> stretched(np.full((8, 8, 3), 90, np.uint8) + np.arange(8, dtype=np.uint8)[:, None]).max()
    np.uint8(255)
    """
    low, high = np.percentile(image[::_STEP, ::_STEP], _STRETCH_PERCENTILES, axis=(0, 1))
    values = (np.arange(256)[:, None] - low) * (255 / np.maximum(high - low, 1.0))
    return cv2.LUT(image, np.clip(np.round(values), 0, 255).astype(np.uint8).reshape(256, 1, 3))


def levelled(image: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Replace the ground of an image (h, w, 3) uint8 RGB by its mean colour and amplify what differs from the ground.

    `ground` is an image without the tool; it is scaled to the light of `image`.  Raises ValueError if its size differs.

    >>> ground = np.random.default_rng(0).integers(0, 200, (64, 64, 3), np.uint8)
    >>> tool = np.zeros((64, 64, 1), np.uint8)
    >>> tool[20:30] = 20
    >>> even = levelled(ground + tool, ground).astype(int)
    >>> (even[25] - even[5]).max()
    np.int64(80)
    """
    if image.shape != ground.shape:
        raise ValueError(f"ground: expected {image.shape}, the same as the image, got {ground.shape}.")
    where, ground = lit(ground), relit(ground, image)
    difference = cv2.GaussianBlur(cv2.subtract(image, ground, dtype=cv2.CV_16S), (0, 0), _SMOOTHING * max(image.shape))
    largest = np.percentile(np.abs(difference[::_STEP, ::_STEP][where]).max(axis=1), _DIFFERENCE_PERCENTILE)
    gain = float(np.clip(_TARGET_DIFFERENCE / max(largest, 1.0), *_GAIN_RANGE))
    # OpenCV clips at 0 and 255.
    mean = np.full_like(difference, ground[::_STEP, ::_STEP][where].mean(axis=0))
    return cv2.addWeighted(difference, gain, mean, 1.0, 0.0, dtype=cv2.CV_8U)
