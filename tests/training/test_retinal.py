"""Real sequences: their halves, their labels' names and how well clicks repeat."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lib.landmarks.metrics import tool_length_px
from notebooks import real_data
from notebooks.studies.retinal import MonocularSequence, import_retinal_microsurgery, label_repeatability

RETINAL = real_data.folder("retinal_microsurgery")


def side(u: np.ndarray) -> np.ndarray:
    """Positive where tip_1 lies right of the direction from the base to the tips (y down)."""
    along, across = u[:, 1:].mean(1) - u[:, 0], u[:, 1] - u[:, 2]
    return along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]


def test_halves_are_in_time_and_frames_without_a_label_are_left_out(tmp_path, toy):
    """The first half needs no image of the second."""
    samples = toy(8, size=(144, 160))
    files = tuple(tmp_path / f"{i:06d}.png" for i in range(8))
    for path, image in zip(files[:4], samples.images, strict=False):
        cv2.imwrite(str(path), image[..., ::-1])
    u = samples.u.copy()
    u[1], u[2, 0] = np.nan, np.nan
    first = list(MonocularSequence("toy", np.arange(8), files, u, (160, 144)).labelled(second_half=False))
    assert [one.name for one in first] == ["toy 0", "toy 2", "toy 3"]
    np.testing.assert_array_equal([one.visibility for one in first], [[2, 2, 2], [1, 2, 2], [2, 2, 2]])
    for path, image in zip(files[4:], samples.images[4:], strict=True):
        cv2.imwrite(str(path), image[..., ::-1])
    later = list(MonocularSequence("toy", np.arange(8), files, u, (160, 144)).labelled(second_half=True, every=2))
    assert [one.name for one in later] == ["toy 4", "toy 6"]
    np.testing.assert_array_equal(later[0].image, samples.images[4])


@pytest.mark.skipif(RETINAL is None, reason=real_data.missing_line("retinal_microsurgery"))
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
    assert label_repeatability(still) == 100.0
    jittery = replace(still, u=clicks)
    length = tool_length_px(clicks[n // 2 :])[:, None]
    knowing = 100 * (np.linalg.norm((clicks - u)[n // 2 :], axis=-1) <= 0.2 * length).mean()
    assert label_repeatability(jittery) == pytest.approx(knowing, abs=1.0)
    assert np.isnan(label_repeatability(replace(still, frame_numbers=2 * np.arange(n))))
