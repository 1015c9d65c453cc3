"""Detectors at the paper's resolutions keep the half-pixel rule."""

import cv2
import numpy as np
import pytest

from lib.landmarks import Detector, Landmarks
from lib.landmarks.network import HourglassConfig, StackedHourglass
from notebooks.studies.reduced import (
    FIELD_PX,
    RESOLUTIONS,
    ReducedDetector,
    load_resolution,
    resolution_windows,
    window_side_px,
)
from notebooks.studies.windows import WindowSource


@pytest.mark.parametrize("name", RESOLUTIONS)
def test_a_resolution_keeps_the_place_of_a_dot(name):
    """A bright dot in a full-HD frame, found again in the reduced one by its centroid; and the way back is exact."""
    image = np.zeros((1, 1080, 1920, 3), np.uint8)
    cv2.circle(image[0], (1203 * 16, 401 * 16), 30 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    network = StackedHourglass(HourglassConfig(4, 1, 2))
    detector = ReducedDetector(Detector(network), network, RESOLUTIONS[name])
    small, u, stride = detector.reduced(image, np.full((1, 3, 2), (1203.0, 401.0)))
    assert small.shape[2:0:-1] == RESOLUTIONS[name]
    weight = small[0, :, :, 0].astype(float)
    rows, columns = np.mgrid[: weight.shape[0], : weight.shape[1]]
    centroid = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
    assert np.abs(u[0, 0] - centroid).max() < 0.02
    np.testing.assert_allclose(stride, np.array([1920, 1080]) / RESOLUTIONS[name])
    rough = Landmarks(np.full((1, 3, 2), np.nan), np.full((1, 3, 2, 2), np.nan), np.zeros((1, 3)))
    assert np.isnan(detector.refine(image, rough).u).all()
    assert window_side_px(RESOLUTIONS[name]) == pytest.approx(
        FIELD_PX * np.sqrt(np.prod(RESOLUTIONS[name]) / 1920 / 1080), abs=2
    )


def test_windows_of_a_resolution_keep_their_landmarks(toy):
    samples = toy(3, size=(288, 288))
    source = WindowSource(samples.images, samples.u, samples.visibility, np.arange(3), size=128)
    assert resolution_windows(source, RESOLUTIONS["1080p"]).crops is source.crops
    small = resolution_windows(source, RESOLUTIONS["480x640"])
    assert small.crops.shape[1:3] == (128, 96)
    np.testing.assert_allclose((small.u + 0.5) * [3, 2.25] - 0.5, source.u)
    image, u, _ = small.draw(0, np.random.default_rng(0))
    assert image.shape == (48, 48, 3)
    assert np.linalg.norm(u[0] - 23.5) < 24


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(ValueError, match="'4k' is no resolution"):
        load_resolution("4k")
    with pytest.raises(FileNotFoundError, match="not trained"):
        load_resolution("480p", folder=tmp_path)
