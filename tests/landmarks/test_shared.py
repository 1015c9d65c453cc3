"""What the notebooks of a run share is what each would have found: never another image's, another detector's, a truth."""

import numpy as np
import pytest

from lib import paths
from lib.landmarks import Detector, Landmarks, SharedDetector
from lib.recordings import Ground


class Counting:
    """Finds the same place in every image; `digest` is that of its weights and settings."""

    def __init__(self, digest="a", x=3.0):
        self.digest, self.x, self.calls = digest, x, 0

    def __call__(self, images):
        self.calls += 1
        u = np.full((2, 3, 2), self.x)
        u[1, 2] = np.nan
        return Landmarks(u, np.tile(np.eye(2), (2, 3, 1, 1)), np.full((2, 3), 0.9))


@pytest.fixture
def shared(tmp_path, monkeypatch):
    monkeypatch.setenv(paths.SHARED_VARIABLE, str(tmp_path))
    return tmp_path


PAIR = np.random.default_rng(0).integers(0, 255, (2, 8, 6, 3), dtype=np.uint8)


def test_a_second_notebook_reads_what_the_first_has_found(shared):
    first, second = SharedDetector(Counting()), SharedDetector(Counting())
    found, read = first(PAIR), second(PAIR.copy())
    assert (first.pairs, first.read, second.pairs, second.read, second.detector.calls) == (1, 0, 1, 1, 0)
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(read, name), value)
    assert second.seconds == first.seconds > 0
    assert "in 1 of 1 stereo pairs were read from the cache" in str(second) and "read" not in str(first)


@pytest.mark.parametrize("change", ["pixel", "mirrored", "shape", "detector", "ground"])
def test_another_image_or_ground_or_detector_is_looked_at_anew(shared, change):
    SharedDetector(Counting())(PAIR)
    other = PAIR.copy()
    if change == "pixel":
        other[1, 7, 5, 2] ^= 1
    elif change == "mirrored":
        other = other[:, :, ::-1]
    elif change == "shape":
        other = other.reshape(2, 6, 8, 3)
    again = SharedDetector(Counting("b" if change == "detector" else "a", 5.0))
    ground = Ground(lambda: PAIR, "another") if change == "ground" else None
    assert again(other, ground=ground).u[0, 0, 0] == 5.0 and again.read == 0


@pytest.mark.parametrize("asks", [False, True])
def test_another_ground_counts_only_if_the_detector_asked_for_it(shared, asks):
    class InDoubt(Detector):
        digest = "a"

        def __init__(self):
            """No networks."""

        def __call__(self, images, ground):
            return Counting(x=float(ground().max()) if asks else 3.0)(images)

    grounds = [Ground(lambda n=n: np.full((2, 8, 6, 3), n, np.uint8), f"ground {n}") for n in (1, 2)]
    detectors = [SharedDetector(InDoubt()) for _ in grounds]
    found = [one(PAIR, ground=ground).u[0, 0, 0] for one, ground in zip(detectors, grounds, strict=True)]
    assert found == ([1.0, 2.0] if asks else [3.0, 3.0]) and detectors[1].read == (0 if asks else 1)
    assert SharedDetector(InDoubt())(PAIR, ground=grounds[1]).u[0, 0, 0] == found[1]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", bytes(200)])
def test_a_damaged_file_is_detected_anew(shared, content):
    SharedDetector(Counting())(PAIR)
    next(shared.glob("*.npz")).write_bytes(content)
    again = SharedDetector(Counting(x=5.0))
    assert again(PAIR).u[0, 0, 0] == 5.0 and again.read == 0
    assert SharedDetector(Counting())(PAIR).u[0, 0, 0] == 5.0  # the file is whole again


def test_outside_a_run_nothing_is_kept(monkeypatch, tmp_path):
    monkeypatch.delenv(paths.SHARED_VARIABLE, raising=False)
    detector = SharedDetector(Counting())
    detector(PAIR), detector(PAIR)
    assert detector.detector.calls == 2 and detector.read == 0


def test_a_disk_that_is_full_costs_time_and_nothing_else(shared, monkeypatch):
    monkeypatch.setenv(paths.SHARED_VARIABLE, str(shared / "gone"))
    detector = SharedDetector(Counting())
    assert detector(PAIR).u[0, 0, 0] == detector(PAIR).u[0, 0, 0] == 3.0 and detector.detector.calls == 2
