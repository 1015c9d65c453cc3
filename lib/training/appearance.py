"""Strong random changes of an image's colours, light, optics and camera, which leave the landmarks in place.

`disguised` is much stronger than the photometric part of `lib.training.augmentation`.  It removes cues on which a network
could otherwise rely (orange ground, grey tool, sharp edges), so that the shape decides.
"""

import cv2
import numpy as np

from lib.simulator.video import compressed
from lib.simulator.window import motion_blur
from lib.training.drawings import fill


def disguised(
    image: np.ndarray, u: np.ndarray, visibility: np.ndarray, rng: np.random.Generator, length_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change the look of an image (h, w, 3) uint8 at random.  Returns the image, and `u` and `visibility` of its landmarks.

    Args:
        u, visibility: Landmarks (3, 2) px and (3,).  A covered landmark becomes hidden, one blurred too much unlabelled.
        length_px: The tool's length, which scales blur and occluders; NaN without a tool.

    >>> rng, u = np.random.default_rng(0), np.full((3, 2), 20.0)
    >>> disguised(np.full((32, 48, 3), 90, np.uint8), u, np.full(3, 2), rng, 9.0)[0].shape
    (32, 48, 3)
    """
    kind = rng.random()
    if kind < 0.1:
        return image, u, visibility
    x, hidden = image.astype(np.float32) / 255, np.zeros(3, bool)
    length_px = 40.0 if np.isnan(length_px) else length_px
    if kind < 0.4:  # another camera of the same scene
        return (255 * _colours(x, rng) + 0.5).astype(np.uint8), u, visibility
    x = _colours(_occluders(x, u, hidden, rng, length_px), rng)
    x = _light(x, u, hidden, rng, length_px)
    x, blur_px = _optics(x, rng, length_px)
    x = _camera(x, rng)
    if blur_px > 0.16 * length_px:  # nobody could label them
        u = np.where((visibility > 0)[:, None], np.nan, u)
    return x, u, np.where(hidden & (visibility == 2), 1, visibility)


def _colours(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    kind = rng.choice(6, p=[0.25, 0.15, 0.3, 0.15, 0.1, 0.05])
    if kind == 1:
        x = x[..., rng.permutation(3)]
    elif kind == 2:  # grey, from random weights of the channels
        x = np.repeat((x @ rng.dirichlet((2, 2, 2)).astype(np.float32))[..., None], 3, axis=2)
    elif kind == 3:  # hues rotated about the grey axis
        x = x @ cv2.Rodrigues(np.full(3, rng.uniform(-np.pi, np.pi) / np.sqrt(3)))[0].astype(np.float32)
    elif kind == 4:
        x = x @ rng.dirichlet((0.7, 0.7, 0.7), 3).T.astype(np.float32)
    elif kind == 5:
        x = 1 - x
    if rng.random() < 0.5:  # saturation
        x = x.mean(axis=2, keepdims=True) * (1 - (s := np.float32(rng.uniform(0, 1.5)))) + x * s
    if rng.random() < 0.6:
        x = x * np.exp(rng.normal(0, 0.2, 3) + rng.uniform(-0.9, 0.9)).astype(np.float32)
    if rng.random() < 0.6:
        x = np.clip(x, 0, 1) ** np.float32(np.exp(rng.normal(0, 0.4)))
    if rng.random() < 0.15:  # haze and veil
        x = x + np.float32(rng.uniform(0.05, 0.6)) * (rng.uniform(0.1, 1, 3).astype(np.float32) - x)
    return np.clip(x, 0, 1)


def _field(shape: tuple[int, int], rng: np.random.Generator, cells: int) -> np.ndarray:
    """A smooth random field (h, w) between 0 and 1."""
    small = rng.random((cells, cells)).astype(np.float32)
    return cv2.resize(small, shape[::-1], interpolation=cv2.INTER_CUBIC).clip(0, 1)


def _light(x: np.ndarray, u: np.ndarray, hidden: np.ndarray, rng: np.random.Generator, length_px: float) -> np.ndarray:
    h, w = x.shape[:2]
    rows, columns = np.mgrid[:h, :w].astype(np.float32)
    if rng.random() < 0.3:
        x = x * (0.3 + 1.2 * _field((h, w), rng, int(rng.integers(2, 6))))[..., None]
    if rng.random() < 0.12:  # a lit disc, or a pupil, around the tool
        known = np.isfinite(u).all(1)
        centre = (u[known].mean(0) if known.any() else np.array([w, h]) / 2) + rng.normal(0, 0.4, 2) * length_px
        radius, soft = rng.uniform(0.8, 2.5) * max(length_px, 15.0), rng.uniform(0.5, 0.15 * length_px + 1)
        inside = 1 / (1 + np.exp(np.clip((np.hypot(columns - centre[0], rows - centre[1]) - radius) / soft, -30, 30)))
        dark = np.float32(rng.uniform(0, 0.25))
        x = x * (dark + (1 - dark) * inside)[..., None].astype(np.float32)
        hidden |= (np.linalg.norm(u - centre, axis=1) > radius + 2 * soft) & (dark < 0.08)
    if rng.random() < 0.2:  # glare
        for _ in range(rng.integers(1, 4)):
            centre, size = rng.uniform((0, 0), (w, h)), rng.uniform(0.01, 0.12) * w
            distance = np.hypot(columns - centre[0], (rows - centre[1]) * rng.uniform(0.5, 2)) / size
            x = x + (rng.uniform(0.3, 1.5) * np.exp(-(distance ** rng.uniform(2, 8)))).astype(np.float32)[..., None]
    return np.clip(x, 0, 1)


def _occluders(x, u, hidden, rng: np.random.Generator, length_px: float) -> np.ndarray:
    """Draw bars, blobs and copied pieces of the image: other instruments, shadows, blood, debris.  Updates `hidden`."""
    h, w = x.shape[:2]
    for _ in range(rng.choice(4, p=[0.62, 0.2, 0.12, 0.06])):
        mask, centre = np.zeros((h, w), np.float32), rng.uniform((0, 0), (w, h))
        angle, long = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 8) * length_px
        if rng.random() < 0.6:  # a bar that enters from somewhere
            ahead, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            wide = rng.uniform(0.05, 0.3, 2) * length_px
            corners = [centre + s * wide[0] * across for s in (-1, 1)]
            corners += [centre + long * ahead + s * wide[1] * across for s in (1, -1)]
            fill(mask, np.array(corners), 1.0)
        else:
            axes = tuple(int(v) + 1 for v in rng.uniform(0.05, 0.6, 2) * length_px)
            cv2.ellipse(mask, tuple(int(v) for v in centre), axes, np.degrees(angle), 0, 360, 1.0, -1, cv2.LINE_AA)
        if rng.random() < 0.5:
            mask = cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.4, 0.15 * length_px + 0.5))
        kind = rng.random()
        if kind < 0.35:  # a shadow hides nothing
            x = x * (1 - np.float32(rng.uniform(0.3, 0.85)) * mask)[..., None]
            continue
        if kind < 0.75:
            shade = 0.5 + _field((h, w), rng, int(rng.integers(2, 20)))
            content = shade[..., None] * rng.uniform(0.02, 0.9) * rng.uniform(0.5, 1, 3)
        else:
            content = np.roll(x, tuple(rng.integers((h, w))), axis=(0, 1))
        x = x * (1 - mask[..., None]) + content.astype(np.float32) * mask[..., None]
        for k in np.flatnonzero(np.isfinite(u).all(1)):
            column, row = np.round(u[k]).astype(int)
            hidden[k] |= 0 <= row < h and 0 <= column < w and mask[row, column] > 0.5
    return x


def _optics(x: np.ndarray, rng: np.random.Generator, length_px: float) -> tuple[np.ndarray, float]:
    blur_px = float(np.exp(rng.uniform(np.log(0.4), np.log(max(0.1 * length_px, 0.8))))) if rng.random() < 0.35 else 0.0
    if rng.random() < 0.04:
        blur_px = rng.uniform(0.1, 0.4) * length_px
    if blur_px:
        x = cv2.GaussianBlur(x, (0, 0), blur_px)
    if rng.random() < 0.15:
        x = motion_blur(x, rng.normal(0, 0.05 * length_px, 2))
    if rng.random() < 0.2:  # a lower resolution, scaled up again
        small, whole = rng.uniform(0.3, 0.9), x.shape[1::-1]
        size = [max(int(side * small), 8) for side in whole]
        x = cv2.resize(cv2.resize(x, size, interpolation=cv2.INTER_AREA), whole, interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.12:  # sharpening
        x = x + np.float32(rng.uniform(0.3, 2.0)) * (x - cv2.GaussianBlur(x, (0, 0), rng.uniform(0.7, 2.0)))
    return x, blur_px


def _camera(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add noise, interlacing and compression; returns uint8."""
    if rng.random() < 0.5:
        noise = rng.standard_normal(x.shape[:2] + (rng.choice([1, 3]),), dtype=np.float32)
        if rng.random() < 0.3:
            noise = 2 * cv2.GaussianBlur(noise, (0, 0), 0.8).reshape(noise.shape)
        x = x + np.float32(np.exp(rng.uniform(np.log(0.004), np.log(0.09)))) * noise
    if rng.random() < 0.05:
        x = x.copy()
        x[1::2] = np.roll(x[1::2], int(rng.integers(-2, 3)), axis=1)
    image = np.clip(x * 255 + 0.5, 0, 255).astype(np.uint8)
    return compressed(image, int(rng.integers(15, 92))) if rng.random() < 0.35 else image
