"""The studies' arithmetic and their bookkeeping; resolutions keep the half-pixel rule."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lib import paths
from lib.landmarks import Detector, Landmarks
from lib.landmarks.network import HourglassConfig, StackedHourglass
from lib.training.samples import WindowSource
from notebooks.studies import detector_studies as studies
from notebooks.studies.detector_studies import main, read_results, summary, verdicts
from notebooks.studies.resolution import (
    FIELD_PX,
    RESOLUTIONS,
    ReducedDetector,
    load_resolution,
    resolution_windows,
    window_side_px,
)


def test_summary_and_ties():
    rows = {
        "a": summary([10, 12, 14]),
        "b": summary([13, 15, 14]),
        "c": summary([90, 91, 92]),
        "d": summary([50, 51, 49]),
    }
    assert rows["a"]["mean"] == 12
    assert rows["a"]["standard_error"] == pytest.approx(2 / np.sqrt(3))
    assert verdicts(rows) == {"a -> b": "tie", "b -> c": "better", "c -> d": "worse"}
    assert verdicts({"a": summary([1]), "b": summary([2])}) == {"a -> b": "one seed: no statement"}


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


def test_a_study_goes_on_where_it_was_and_records(tmp_path, toy_shards):
    toy_shards(tmp_path, 4)
    arguments = [
        "ablation",
        "--steps",
        "2",
        "--shards",
        "1",
        "--features",
        "4",
        "--batch",
        "2",
        "--data",
        str(tmp_path),
    ]
    arguments += [
        "--test",
        str(tmp_path / "none"),
        "--folder",
        str(tmp_path / "kept"),
        "--out",
        str(tmp_path / "r.json"),
    ]
    assert main([*arguments, "--seeds", "1"]) == 0
    first = read_results(tmp_path / "r.json")["ablation"]
    checkpoint = tmp_path / "kept" / "ablation" / "encoder" / "seed0" / "last.safetensors"
    written = checkpoint.stat().st_mtime_ns
    assert main([*arguments, "--seeds", "2"]) == 0
    assert checkpoint.stat().st_mtime_ns == written
    second = read_results(tmp_path / "r.json")["ablation"]
    assert {"command", "commit", "machine", "date", "budget", "seconds"} <= set(second)
    # What differs from the defaults is named; what the trainings took is theirs, not this evaluation's.
    words = second["command"].split()
    assert words[:4] == ["python3", "-m", "notebooks.studies.detector_studies", "ablation"]
    assert {"--steps", "--shards", "--features", "--batch", "--data", "--folder", "--seeds"} <= set(words)
    assert "--seeds" in first["command"].split() and "--threads" not in words
    assert second["training_seconds"] > first["training_seconds"] > 0
    for name, row in second["result"]["columns"].items():
        assert row["median_px"]["per_seed"][0] == first["result"]["columns"][name]["median_px"]["per_seed"][0]
        assert len(row["median_px"]["per_seed"]) == 2
    json.dumps(second, allow_nan=False)


def test_noisy_labels_are_the_same_in_all_crops_of_a_frame(tmp_path, toy_shards):
    toy_shards(tmp_path, 3)
    source = WindowSource.load(tmp_path)
    options = studies.Options(tmp_path, tmp_path, tmp_path, 1, 1, 1, 4, 1)
    noise = studies._noisy(source, options, 1.0).u - source.u
    for frame in range(3):
        np.testing.assert_allclose(noise[3 * frame : 3 * frame + 3], noise[[3 * frame] * 3])
    assert 0.4 < noise.std() < 1.8
    with pytest.raises(ValueError, match="do not belong together"):
        studies._noisy(replace(source, landmark=source.landmark[::-1]), options, 1.0)


def test_speed_is_of_both_ways_and_every_resolution(tmp_path, monkeypatch):
    recorded = {}
    options = studies.Options(tmp_path, tmp_path, tmp_path, 1, 1, 1, 4, 1, record=recorded.update)
    monkeypatch.setattr(studies, "RESOLUTIONS", {"small": (96, 64), "smaller": (64, 64)})
    studies.speed(options, repeats=1)
    assert list(recorded["rows"]) == [
        "whole frames",
        "tracking",
        "paper's network, 96 x 64",
        "paper's network, 64 x 64",
    ]
    assert all(row["pairs_per_second"] > 0 for row in recorded["rows"].values())


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(ValueError, match="'4k' is no resolution"):
        load_resolution("4k")
    with pytest.raises(FileNotFoundError, match="not trained"):
        load_resolution("480p", folder=tmp_path)
    assert main(["ablation", "--data", str(tmp_path), "--out", str(tmp_path / "r.json")]) == 2
    assert read_results(tmp_path / "r.json") == {}


@pytest.mark.skipif(not (paths.CACHE / "studies" / "resolution" / "1080p").is_dir(), reason="no study was made here")
def test_a_trained_resolution_works_on_full_hd():
    found = load_resolution("1080p")(np.zeros((1, 1080, 1920, 3), np.uint8))
    assert found.u.shape == (1, 3, 2)
