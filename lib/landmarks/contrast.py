"""Images with more contrast, which a detector in doubt sees, too: a dull tool or an odd light often becomes clear there."""

import cv2
import numpy as np

#: Equalising acts on so many tiles along each side, and enlarges contrast by about so much at most.
_TILES, _LIMIT = 8, 2.0
#: Levelling smooths by this share of the longer side, since differences are noisy, and enlarges them until this percentile of
#: them has this size, within limits; chosen on validation recordings.
_SMOOTH, _DIFFERENT, _DIFFERENCE, _GAINS = 1e-3, 99.5, 80.0, (1.0, 4.0)
#: Stretching makes these percentiles black and white; it estimates them on every fourth row and column.
_PERCENTILES, _EVERY = (1.0, 99.0), 4


def equalised(image: np.ndarray) -> np.ndarray:
    """An image (h, w, 3) uint8 RGB whose lightness is equalised tile by tile (CLAHE; Zuiderveld 1994).

    >>> dull = np.random.default_rng(0).integers(90, 99, (64, 64, 1), np.uint8).repeat(3, axis=2)
    >>> bool(equalised(dull).std() > 1.5 * dull.std())
    True
    """
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.createCLAHE(_LIMIT, (_TILES, _TILES)).apply(lab[..., 0])
    return cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)


def stretched(image: np.ndarray) -> np.ndarray:
    """An image (h, w, 3) uint8 RGB each of whose channels is stretched to all of its range.

    >>> stretched(np.full((8, 8, 3), 90, np.uint8) + np.arange(8, dtype=np.uint8)[:, None]).max()
    np.uint8(255)
    """
    low, high = np.percentile(image[::_EVERY, ::_EVERY], _PERCENTILES, axis=(0, 1))
    values = (np.arange(256)[:, None] - low) * (255 / np.maximum(high - low, 1.0))
    return cv2.LUT(image, np.clip(np.round(values), 0, 255).astype(np.uint8).reshape(256, 1, 3))


def levelled(image: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """An image (h, w, 3) uint8 RGB on a ground of one colour: what differs from its ground, seen in its light, enlarged.

    A ValueError if the ground is not of the image's size.

    >>> ground = np.random.default_rng(0).integers(0, 200, (64, 64, 3), np.uint8)
    >>> tool = np.zeros((64, 64, 1), np.uint8)
    >>> tool[20:30] = 20
    >>> even = levelled(ground + tool, ground).astype(int)
    >>> (even[25] - even[5]).max()
    np.int64(80)
    """
    if image.shape != ground.shape:
        raise ValueError(f"ground: expected {image.shape}, as the image, got {ground.shape}.")
    some = (part[::_EVERY, ::_EVERY] + 1.0 for part in (image, ground))
    ground = cv2.multiply(ground, (*np.median(np.divide(*some), axis=(0, 1)), 0.0))
    difference = cv2.GaussianBlur(cv2.subtract(image, ground, dtype=cv2.CV_16S), (0, 0), _SMOOTH * max(image.shape))
    size = np.percentile(np.abs(difference[::_EVERY, ::_EVERY]).max(axis=2), _DIFFERENT)
    gain = float(np.clip(_DIFFERENCE / max(size, 1.0), *_GAINS))
    # OpenCV clips at 0 and 255.
    return cv2.addWeighted(difference, gain, np.full_like(difference, ground.mean(axis=(0, 1))), 1.0, 0.0, dtype=cv2.CV_8U)
