"""Rendered jaws bent at an elbow: a warp of the image, since the renderer's training families have none."""

import cv2
import numpy as np

#: Where along a jaw its elbow is, by how much it turns there (rad), and how often inward; how often both jaws have one.
_PLACE, _TURN, _INWARD, _BOTH = (0.4, 0.9), (0.4, 1.7), 0.8, 0.75


def bent(image: np.ndarray, u: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """An image (h, w, 3) uint8 with one jaw or both bent, and its landmarks (3, 2) px: a tip stays a tip.

    What lies round the end of a jaw is turned about the elbow, what is farther or behind less, so that nothing tears.

    >>> u = np.array([[20.0, 30], [60, 20], [60, 40]])
    >>> image, moved = bent(np.zeros((60, 90, 3), np.uint8), u, np.random.default_rng(0))
    >>> image.shape, bool((np.abs(moved - u) < 60).all())
    ((60, 90, 3), True)
    """
    place, turn = rng.uniform(*_PLACE), rng.uniform(*_TURN) * (1 if rng.random() < _INWARD else -1)
    jaws = rng.permutation([1, 2])[: 2 if rng.random() < _BOTH else 1]
    for k in jaws:
        ahead, other = u[k] - u[0], u[3 - k] - u[0]
        sign = np.sign(ahead[0] * other[1] - ahead[1] * other[0]) or 1.0
        image, u = _turned(image, u, u[0] + place * ahead, ahead, sign * turn, (1 - place) * np.linalg.norm(ahead))
    return image, u


def _turned(image: np.ndarray, u: np.ndarray, elbow: np.ndarray, ahead: np.ndarray, turn: float, reach: float):
    """What lies within `reach` px `ahead` of the elbow turned about it; nothing moves beyond twice that."""
    radius, first = 2.0 * reach, np.arctan2(*ahead[::-1])
    low = np.clip(np.floor(elbow - radius), 0, image.shape[1::-1]).astype(int)
    high = np.clip(np.ceil(elbow + radius) + 1, 0, image.shape[1::-1]).astype(int)
    if (high <= low).any():
        return image, u

    def source(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The turn (rad) about the elbow by which what is seen at an offset from it has moved, and its distance."""
        far = np.hypot(x, y)
        fade = np.clip((radius - far) / (0.8 * reach), 0, 1)
        return turn * 0.5 * (1 + np.cos(np.arctan2(y, x) - first)) * fade**2 * (3 - 2 * fade), far

    x, y = np.meshgrid(np.arange(low[0], high[0]) - elbow[0], np.arange(low[1], high[1]) - elbow[1])
    by, _ = source(x, y)
    cos, sin = np.cos(by), np.sin(by)
    maps = (cos * x + sin * y + elbow[0]).astype(np.float32), (cos * y - sin * x + elbow[1]).astype(np.float32)
    image = image.copy()
    image[low[1] : high[1], low[0] : high[0]] = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    x, y = (u - elbow).T
    own, moved = np.arctan2(y, x), np.arctan2(y, x)
    for _ in range(60):  # where a landmark is seen: the inverse, which contracts
        by, far = source(np.hypot(x, y) * np.cos(moved), np.hypot(x, y) * np.sin(moved))
        moved = 0.5 * moved + 0.5 * (own + by)
    return image, elbow + np.hypot(x, y)[:, None] * np.column_stack([np.cos(moved), np.sin(moved)])
