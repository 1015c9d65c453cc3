"""Training on half a real sequence: what is cut, mixed and named, on toy frames; and the real labels' naming."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lib import paths
from lib.landmarks import Detector
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.network import HourglassConfig, StackedHourglass
from lib.training.samples import Mixed, Samples
from notebooks.studies import finder
from notebooks.studies.retinal import MonocularSequence, import_retinal_microsurgery

RETINAL = paths.real_data("retinal_microsurgery")


@pytest.fixture
def sequence(tmp_path, toy) -> MonocularSequence:
    """Eight toy frames as files."""
    samples = toy(8, size=(144, 160))
    files = tuple(tmp_path / f"{i:06d}.png" for i in range(8))
    for path, image in zip(files, samples.images, strict=True):
        cv2.imwrite(str(path), image[..., ::-1])
    return MonocularSequence("toy", np.arange(8), files, samples.u, (160, 144))


@pytest.fixture
def detector() -> Detector:
    return Detector(StackedHourglass(HourglassConfig(4, 1, 2)), frame_px=60)


def side(u: np.ndarray) -> np.ndarray:
    """Positive where tip_1 lies right of the direction from the base to the tips (y down)."""
    along, across = u[:, 1:].mean(1) - u[:, 0], u[:, 1] - u[:, 2]
    return along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]


def test_crops_keep_their_landmarks(toy):
    """Each landmark in a crop shows the same pixel as in its image."""
    samples = toy(4, size=(144, 160))
    crops = finder.Crops(samples, 64)
    rng = np.random.default_rng(0)
    held = 0
    for i in [0, 1, 2, 3] * 10:
        image, u, visibility = crops.draw(i, rng)
        assert image.shape == (64, 64, 3) and (visibility == 2).all()
        for before, after in zip(samples.u[i], u, strict=True):
            (x, y), (a, b) = np.round(before).astype(int), np.round(after).astype(int)
            if 0 <= a < 64 and 0 <= b < 64:
                held += 1
                np.testing.assert_array_equal(image[b, a], samples.images[i, y, x])
    assert held > 40
    assert Samples.drawn(crops).images.shape == (4, 64, 64, 3)
    with pytest.raises(ValueError, match="do not fit"):
        finder.Crops(samples, 200)


def test_crops_without_labels_lie_anywhere(toy):
    samples = toy(2, size=(144, 160))
    samples.u[0] = np.nan
    image, u, _ = finder.Crops(samples, 64).draw(0, np.random.default_rng(1))
    assert image.shape == (64, 64, 3) and np.isnan(u).all()


def test_half_is_simulated(toy):
    dark, bright = toy(3, size=(64, 64)), toy(5, size=(64, 64))
    dark = Samples(np.zeros_like(dark.images), dark.u, dark.visibility)
    bright = Samples(np.full_like(bright.images, 255), bright.u, bright.visibility)
    mixed = Mixed(finder.Crops(dark, 32), finder.Crops(bright, 32))
    rng = np.random.default_rng(0)
    drawn = [mixed.draw(i % len(mixed), rng)[0].mean() for i in range(400)]
    assert len(mixed) == 8
    assert 0.4 < np.mean(np.array(drawn) > 0) < 0.6
    assert mixed.fingerprint != replace(mixed, own=mixed.other).fingerprint


def test_only_the_first_half_is_trained_on(sequence, toy, detector, tmp_path, monkeypatch):
    """The later frames may be missing altogether; and the same call goes on from its checkpoints."""
    for path in sequence.paths[4:]:
        path.unlink()
    seen = []
    image = MonocularSequence.image
    monkeypatch.setattr(MonocularSequence, "image", lambda self, i: seen.append(i) or image(self, i))
    config = finder.real_config(2, batch=2)
    arguments = (sequence, detector, toy(2, size=(135, 240)), config)
    trained = finder.train_on_first_half(*arguments, folder=tmp_path / "kept")
    assert sorted(set(seen)) == [0, 1, 2, 3]
    again = finder.train_on_first_half(*arguments, folder=tmp_path / "kept")
    assert again.provenance["steps"] == trained.provenance["steps"] == 2
    assert again.provenance["seconds"] == trained.provenance["seconds"]
    assert trained.network.config == detector.frame_network.config
    quick = finder.train_on_first_half(sequence, detector, None, finder.quick_config(1))
    assert quick.provenance["images"] == 4  # no simulated frame
    tuned = finder.finder_alone(detector, trained)
    assert tuned.frame_px is None and list(tuned.networks) == ["frame"]


def test_evaluation_is_of_the_second_half(sequence, detector, toy):
    """And its labels are those of the toys, magnified or not."""
    tested = finder.evaluate_on_sequence(finder.finder_alone(detector), sequence, second_half=True, every=2)
    assert tested.names == ["toy 4", "toy 6"]
    np.testing.assert_array_equal(tested.u_true, toy(8, size=(144, 160)).u[4::2])
    assert np.isfinite(tested.error_px).all()  # every detection counts
    magnified = finder.simulated_to_real(detector, sequence, every=8, zoom=2.0)
    np.testing.assert_allclose(magnified.u_true[0], toy(8, size=(144, 160)).u[0])
    np.testing.assert_allclose(magnified.length_px, tool_length_px(magnified.u_true))


@pytest.mark.skipif(RETINAL is None, reason=paths.missing_data_line("retinal_microsurgery"))
def test_real_tips_are_named_as_the_simulators():
    for sequence in import_retinal_microsurgery(RETINAL):
        u = sequence.u
        assert (side(u[np.isfinite(u).all((1, 2))]) < 0).all()


def test_clicks_that_jitter_bound_what_can_be_hit():
    """Of Gaussian clicks about an even motion, as many are hit as by somebody who knows where the tool is."""
    rng = np.random.default_rng(0)
    n, jitter_px = 4000, 3.0
    u = np.array([[0.0, 0.0], [30.0, 10.0], [30.0, -10.0]]) + 0.5 * np.arange(n)[:, None, None]
    clicks = u + rng.normal(0, jitter_px, u.shape)
    files = tuple(Path(f"{i}.png") for i in range(n))
    still = MonocularSequence("even", np.arange(n), files, u, (640, 480))
    assert finder.label_repeatability(still) == 100.0
    jittery = replace(still, u=clicks)
    length = tool_length_px(clicks[n // 2 :])[:, None]
    knowing = 100 * (np.linalg.norm((clicks - u)[n // 2 :], axis=-1) <= 0.2 * length).mean()
    assert finder.label_repeatability(jittery) == pytest.approx(knowing, abs=1.0)
    assert np.isnan(finder.label_repeatability(replace(still, frame_numbers=2 * np.arange(n))))
