"""A toy renderer: two bright jaws on a textured ground, quick enough to train on in a test."""

import cv2
import numpy as np

from lib.training.samples import LabelledImage, Samples


def draw_tool(rng: np.random.Generator, size=(64, 96)) -> tuple[np.ndarray, np.ndarray]:
    """One image (h, w, 3) uint8 and its landmarks (3, 2): base, then the left tip, then the right one."""
    h, w = size
    image = cv2.resize(rng.integers(60, 120, (8, 10, 3), np.uint8), (w, h), interpolation=cv2.INTER_CUBIC)
    base = rng.uniform((0.3 * w, 0.3 * h), (0.6 * w, 0.6 * h))
    angle, half = rng.uniform(-0.6, 0.6), rng.uniform(0.15, 0.45)
    tips = [base + 0.3 * w * np.array([np.cos(angle + s * half), np.sin(angle + s * half)]) for s in (-1, 1)]
    far = base - w * np.array([np.cos(angle), np.sin(angle)])

    def line(a, b, colour, thickness):
        a, b = (tuple(round(v * 256) for v in p) for p in (a, b))
        cv2.line(image, a, b, colour, thickness, cv2.LINE_AA, 8)

    line(far, base, (200, 200, 190), 9)
    for tip in tips:
        line(base, tip, (230, 230, 235), 3)
    return image, np.array([base, *tips])


def toy_samples(n: int, seed: int = 0, size=(64, 96)) -> Samples:
    rng = np.random.default_rng(seed)
    images, u = zip(*[draw_tool(rng, size) for _ in range(n)], strict=True)
    return Samples(np.stack(images), np.stack(u), np.full((n, 3), 2))


def toy_images(n: int, seed: int = 0, size=(64, 96)) -> list[LabelledImage]:
    samples = toy_samples(n, seed, size)
    return [LabelledImage(str(i), *samples.draw(i, None)) for i in range(n)]
