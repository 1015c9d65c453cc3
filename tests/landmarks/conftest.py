import pytest

from tests.toys import toy_samples


@pytest.fixture(scope="session")
def toy():
    """`toy(n, seed=0, size=(h, w))` -> Samples."""
    return toy_samples
