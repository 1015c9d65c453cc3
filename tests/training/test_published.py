"""The paper's own detector keeps the half-pixel rule at each of its resolutions."""

import cv2
import numpy as np
import pytest

from lib.landmarks.heatmaps import decode
from lib.landmarks.network import HourglassConfig, StackedHourglass
from lib.training.samples import LabelledImage
from notebooks.studies import published
from notebooks.studies.published import RESOLUTIONS, PublishedDetector, load_published, shrunk


@pytest.mark.parametrize("name", RESOLUTIONS)
def test_a_resolution_keeps_the_place_of_a_dot(name):
    """A bright dot in a full-HD frame, found again in the shrunk one by its centroid."""
    image = np.zeros((1080, 1920, 3), np.uint8)
    cv2.circle(image, (1203 * 16, 401 * 16), 30 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    dot = LabelledImage("dot", image, np.full((3, 2), (1203.0, 401.0)), np.full(3, 2))
    small, u, visibility = shrunk(dot, RESOLUTIONS[name])
    assert small.shape[1::-1] == RESOLUTIONS[name] and (visibility == 2).all()
    weight = small[:, :, 0].astype(float)
    rows, columns = np.mgrid[: weight.shape[0], : weight.shape[1]]
    centroid = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
    assert np.abs(u[0] - centroid).max() < 0.02


def test_the_way_back_ends_in_full_frames(monkeypatch):
    """Where the heatmap's peak lies in the small frame, there the landmark lies in the full one, along each axis."""
    detector = PublishedDetector(StackedHourglass(HourglassConfig(4, 1, 2)).eval(), RESOLUTIONS["480x640"])
    small = {}

    def outputs(self, images, stage):
        small["shape"] = images.shape
        return original(self, images, stage)

    def decoded(heatmaps, stride, *, method):
        peaks = decode(heatmaps, stride, method=method)
        peaks.u[:] = peaks.u.new_tensor([100.0, 50.0])
        return peaks

    original = published.Detector.outputs
    monkeypatch.setattr(published.Detector, "outputs", outputs)
    monkeypatch.setattr(published, "decode", decoded)
    found = detector(np.zeros((2, 1080, 1920, 3), np.uint8))
    assert small["shape"] == (2, 480, 640, 3)
    np.testing.assert_allclose(found.u, np.broadcast_to([100.5 * 3 - 0.5, 50.5 * 2.25 - 0.5], (2, 3, 2)))


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="'4k' is none of the paper's"):
        load_published("4k")
    monkeypatch.setattr(published.paths, "CACHE", tmp_path)
    with pytest.raises(FileNotFoundError, match="not trained"):
        load_published("480p")
