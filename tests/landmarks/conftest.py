"""A toy renderer: two bright jaws on a textured ground, quick enough to train on in a test."""

import cv2
import numpy as np
import pytest

from lib.training.loop import Samples
from lib.training.samples import _write_shard


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


@pytest.fixture(scope="session")
def toy():
    """`toy(n, seed=0, size=(h, w))` -> Samples."""
    return toy_samples


@pytest.fixture(scope="session")
def toy_shards():
    """`toy_shards(folder, n, size=(h, w))`: one training and one validation shard of n large toys -> those Samples."""

    def write(folder, n: int, size=(540, 960)) -> Samples:
        samples = toy_samples(n, size=size)
        views = list(zip(samples.images, samples.u, samples.visibility, strict=True))
        _write_shard(folder / "training_0000.npz", views, keep_frames=False)
        _write_shard(folder / "validation_0000.npz", views, keep_frames=True)
        return samples

    return write
