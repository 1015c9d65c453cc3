from dataclasses import replace

import pytest
from threadpoolctl import threadpool_limits

from lib.landmarks.network import HourglassConfig
from lib.parallel import single_threaded_torch
from lib.training.augmentation import Augmentation
from lib.training.loop import PRESETS, train
from notebooks.studies.windows import write_frames
from tests.toys import toy_images, toy_samples


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Networks and fits as small as these gain nothing from a second thread, and wait for it on a busy machine."""
    with single_threaded_torch(), threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def toy():
    """`toy(n, seed=0, size=(h, w))` -> Samples."""
    return toy_samples


@pytest.fixture(scope="session")
def trained():
    """A training on toys that is long enough to find them."""
    config = replace(
        PRESETS["best"], network=HourglassConfig(12, 1, 2), augmentation=Augmentation(10.0, (0.9, 1.1)), steps=60,
        batch_size=6, ema=0.9, learning_rate=4e-3, validate_every=20, precision="fp32", seed=2,
    )  # fmt: skip
    return train(config, toy_samples(60), toy_samples(12, seed=1), progress=False)


@pytest.fixture(scope="session")
def toy_shards():
    """`toy_shards(folder, n, size=(h, w))`: one training and one validation shard of n large toys -> their images."""

    def write(folder, n: int, size=(540, 960)):
        images = toy_images(n, size=size)
        write_frames(folder / "training_0000.npz", images, keep_frames=False)
        write_frames(folder / "validation_0000.npz", images, keep_frames=True)
        return images

    return write
