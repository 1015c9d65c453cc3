import pytest
import torch

from lib.training.shards import write_frames
from tests.toys import toy_images, toy_samples


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Networks as small as these gain nothing from a second thread, and wait for it on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def toy():
    """`toy(n, seed=0, size=(h, w))` -> Samples."""
    return toy_samples


@pytest.fixture(scope="session")
def toy_shards():
    """`toy_shards(folder, n, size=(h, w))`: one training and one validation shard of n large toys -> their images."""

    def write(folder, n: int, size=(540, 960)):
        images = toy_images(n, size=size)
        write_frames(folder / "training_0000.npz", images, keep_frames=False)
        write_frames(folder / "validation_0000.npz", images, keep_frames=True)
        return images

    return write
