"""Rendered jaws bent at an elbow: a warp of the image, since the renderer's training families have none."""

import cv2
import numpy as np

#: Where along a jaw its elbow is, by how much it turns there (rad), and how often inward; how often both jaws have one.
_PLACE, _TURN, _INWARD, _BOTH = (0.5, 0.9), (0.4, 2.2), 0.8, 0.75


def bent(
    image: np.ndarray, u: np.ndarray, visibility: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image (h, w, 3) uint8 with one jaw or both bent, its landmarks (3, 2) px and their visibility (3,).

    What lies round the end of a jaw is turned about the elbow, what is farther or behind less, so that nothing tears.  Where
    the jaws cross, the tips exchange their names.

    >>> u = np.array([[20.0, 30], [60, 20], [60, 40]])
    >>> image, moved, _ = bent(np.zeros((60, 90, 3), np.uint8), u, np.full(3, 2), np.random.default_rng(0))
    >>> image.shape, moved.shape
    ((60, 90, 3), (3, 2))
    """
    place, turn = rng.uniform(*_PLACE), rng.uniform(*_TURN) * (1 if rng.random() < _INWARD else -1)
    straight = u
    for k in rng.permutation([1, 2])[: 2 if rng.random() < _BOTH else 1]:
        ahead, other = u[k] - u[0], u[3 - k] - u[0]
        sign = np.sign(ahead[0] * other[1] - ahead[1] * other[0]) or 1.0
        elbow, reach = u[0] + place * ahead, (1 - place) * np.linalg.norm(ahead)
        for _ in range(2):  # a larger turn at once would fold the image
            image, u = _turned(image, u, elbow, u[k] - elbow, sign * turn / 2, reach)
    if np.linalg.det(u[1:] - u[0]) * np.linalg.det(straight[1:] - straight[0]) < 0:
        u, visibility = u[[0, 2, 1]], visibility[[0, 2, 1]]
    return image, u, visibility


def _turned(
    image: np.ndarray, u: np.ndarray, elbow: np.ndarray, ahead: np.ndarray, turn: float, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """What lies `ahead` of the elbow, within `reach` px, turned about it by up to `turn` rad; within twice that, by less."""
    radius, first = 2.0 * reach, np.arctan2(*ahead[::-1])
    low = np.clip(np.floor(elbow - radius), 0, image.shape[1::-1]).astype(int)
    high = np.clip(np.ceil(elbow + radius) + 1, 0, image.shape[1::-1]).astype(int)
    if (high <= low).any():
        return image, u

    def turned_by(far: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """The turn (rad) of what is then seen `far` px from the elbow at an `angle`."""
        fade = np.clip((radius - far) / (0.8 * reach), 0, 1)
        return turn * 0.5 * (1 + np.cos(angle - first)) * fade**2 * (3 - 2 * fade)

    z = np.arange(low[0], high[0]) - elbow[0] + 1j * (np.arange(low[1], high[1]) - elbow[1])[:, None]
    z = z * np.exp(-1j * turned_by(np.abs(z), np.angle(z)))  # where a pixel comes from
    maps = (z.real + elbow[0]).astype(np.float32), (z.imag + elbow[1]).astype(np.float32)
    image = image.copy()
    image[low[1] : high[1], low[0] : high[0]] = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    far, angle = np.linalg.norm(u - elbow, axis=1), np.arctan2(*(u - elbow).T[::-1])
    now = angle
    for _ in range(60):  # the inverse: half a step contracts
        now = (now + angle + turned_by(far, now)) / 2
    return image, elbow + far[:, None] * np.column_stack([np.cos(now), np.sin(now)])
