"""Evaluation, calibration and training data; the simulator is replaced by the toy renderer where it would be slow."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from lib import paths
from lib.landmarks import Detector, metrics
from lib.landmarks import detector as detector_module
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork
from lib.training import evaluation
from lib.training import samples as dataset
from lib.training.assembly import card
from lib.training.augmentation import Augmentation
from lib.training.evaluation import _belief, _fit, calibrate, evaluate
from lib.training.loop import PRESETS, Samples, main, train


@pytest.fixture(scope="module")
def small(toy):
    """A whole-frame detector trained for a moment on toys, and toys it has not seen."""
    config = replace(
        PRESETS["best"], network=HourglassConfig(12, 1, 2), augmentation=Augmentation(10.0, (0.9, 1.1)), steps=50,
        batch_size=6, ema=0.9, learning_rate=4e-3, validate_every=50, precision="fp32",
    )  # fmt: skip
    unseen = toy(40, seed=5)
    network = train(config, toy(60), toy(4, seed=2), progress=False).network
    keep = ErrorModel(logit=(5.0, 0.0, 0.0, 0.0))
    frames = [(str(i), unseen.images[i], unseen.u[i], unseen.visibility[i]) for i in range(40)]
    return Detector(network, error_models={"frame": keep}), frames


def test_calibration_makes_covariances_and_confidence_true(small):
    detector, frames = small
    result = evaluate(calibrate(detector, frames[:20]), frames[20:])
    assert 0.5 < result.scores.nees < 6
    assert 75 < result.scores.coverage_95 <= 100
    before = evaluate(detector, frames[20:])
    labelled = ~np.isnan(result.error_px)
    error = [metrics.calibration_error(r.landmarks.confidence[labelled], r.correct[labelled]) for r in (before, result)]
    assert error[1] <= max(error[0], 0.25)


def test_fitted_variance_of_known_errors():
    """Errors drawn with a variance that depends on feature, base or tip, and axis: the fit finds all three, and NEES is 2."""
    rng = np.random.default_rng(0)
    features = np.stack(
        [np.ones((6000, 3)), rng.normal(0, 1, (6000, 3)), rng.uniform(0.2, 1, (6000, 3)), np.zeros((6000, 3))], 2
    )
    landmark = rng.integers(3, size=6000)
    along = 0.3 + 0.8 * features[:, 0, 1] + np.array([-0.6, 0.3, 0.3])[landmark]
    across = -1.2 + 0.2 * features[:, 1, 1]
    sigma = np.exp(np.column_stack([along, across]) / 2)
    errors = rng.normal(0, 1, (6000, 2)) * sigma
    correct = np.linalg.norm(errors, axis=1) < 2
    fit = _fit(features, errors, correct, landmark, gross_px=1e9)
    coefficients = fit.coefficients
    assert coefficients[:, :, 1] == pytest.approx(np.tile([0.8, 0.2], (3, 1)), abs=0.05)
    assert coefficients[1:, :, 0] - coefficients[0, :, 0] == pytest.approx(np.array([[0.9, 0], [0.9, 0]]), abs=0.1)
    log_variance = (coefficients[landmark] * features[:, :2]).sum(-1)
    squared = errors**2 / np.exp(log_variance)
    for own in (landmark == 0, landmark > 0):
        assert squared[own].mean(0) == pytest.approx([1, 1], abs=0.05)
    confidence = 1 / (1 + np.exp(-features[:, 2] @ np.array(fit.logit)))
    assert metrics.calibration_error(confidence, correct) < 0.05


def test_closeups_that_know_nothing_do_no_harm(small, monkeypatch):
    """The corrections of an untrained offset network are a constant, which is bias, or noise, which is not believed."""
    for module in (evaluation, detector_module):
        monkeypatch.setattr(module, "TRACKED_FROM", 0.0)  # toys are too small to be sure of
    detector, frames = small
    torch.manual_seed(0)
    closeup = OffsetNetwork(OffsetConfig(4, 32)).eval()
    torch.nn.init.normal_(closeup.head[-1].weight, std=0.5)
    full = replace(detector, window_network=detector.frame_network, window_px=64, closeup_network=closeup)
    once = calibrate(full, frames)
    assert set(once.error_models) == {"frame", "window", "closeup", "tracking"}
    gain = np.array(once.error_models["closeup"].gain)
    assert ((gain >= 0) & (gain <= 1)).all()
    assert once.error_models["tracking"].gain == ((1.0, 1.0),) * 3
    assert calibrate(once, frames).error_models == once.error_models  # what was believed before does not matter
    errors = [np.nanmedian(evaluate(d, frames).error_px) for d in (once, replace(once, closeup_network=None))]
    assert errors[0] < errors[1] + 0.5


def test_as_much_of_a_correction_is_believed_as_helps():
    """A closeup that overshoots by a known factor and lies off by a known bias; gross errors do not count."""
    rng = np.random.default_rng(1)
    landmark = rng.integers(3, size=3000)
    gain, bias = np.array([[0.2, 0.8], [0.5, 1.0], [0.5, 1.0]]), np.array([[0.3, 0.0], [-0.2, 0.1], [-0.2, 0.1]])
    moved = rng.normal(0, 2, (3000, 2))
    truth = gain[landmark] * moved - bias[landmark] + rng.laplace(0, 0.05, (3000, 2))  # from where it was expected
    errors = moved - truth
    errors[:20], errors[20:40] = 50.0, np.nan
    found, off = _belief(moved, errors, landmark, 20.0, np.linspace(0, 1, 51))
    np.testing.assert_allclose(found, gain, atol=0.021)
    np.testing.assert_allclose(off, bias, atol=0.02)
    whole, _ = _belief(moved, errors, landmark, 20.0, [1.0])
    np.testing.assert_array_equal(whole, np.ones((3, 2)))


def test_calibration_of_another_version_is_named():
    assert ErrorModel.of([[0.0] * 6] * 2, [1.0] * 4).coefficients.shape == (3, 2, 4)
    for parts in (([0.0] * 4, [1.0] * 4), ([[0.0] * 6] * 2, [1.0] * 4, [1.0, 1.0])):
        with pytest.raises(ValueError, match="another version; fit it anew"):
            ErrorModel.of(*parts)


def test_evaluation_counts_only_labels_in_view(small):
    detector, frames = small
    name, image, u, visibility = frames[0]
    hidden = visibility.copy()
    hidden[2] = 0
    result = evaluate(detector, [(name, image, u, hidden)])
    assert result.scores.labels == 2
    assert result.length_px[0] == pytest.approx(metrics.tool_length_px(u[None])[0])
    assert list(result.by_landmark()) == ["base", "tip_1", "tip_2"]
    assert result.worst(1)[0] == 0


def test_nothing_to_evaluate_is_named(small):
    with pytest.raises(ValueError, match="frames: no labelled frame"):
        evaluate(small[0], [])
    with pytest.raises(ValueError, match="to calibrate on"):
        calibrate(small[0], small[1][:2])


def test_shards_hold_what_the_stages_see(tmp_path, toy_shards):
    """Large toys instead of the simulator: crops and reduced frames carry the landmarks of the full frame."""
    samples = toy_shards(tmp_path, 2)
    standing = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    dataset.generate(tmp_path, 1, progress=False)  # stands already: nothing is drawn
    dataset.generate(tmp_path, 1, validation=True, progress=False)
    assert standing == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    frames = dataset.frame_samples(tmp_path)
    assert np.allclose(8 * frames.u + 3.5, samples.u)
    windows = dataset.WindowSource.load(tmp_path)
    assert len(windows) == 6
    rng = np.random.default_rng(0)
    for index in range(6):
        image, u, _ = windows.draw(index, rng)
        assert image.shape == (128, 128, 3)
        k = windows.landmark[index]
        assert np.linalg.norm(u[k] - 63.5) < 60
        assert u[1:, 0].mean() > u[0, 0]  # the tool points right
        assert u[1, 1] < u[2, 1]  # and tip_1 is above
    tools = dataset.WindowSource.load_tools(tmp_path)
    assert len(tools) == 2
    assert len(Samples.drawn(windows)) == 6
    _, image, u, _ = next(iter(dataset.validation_frames(tmp_path)))
    assert image.shape == (540, 960, 3)
    assert np.allclose(u, samples.u[0])


def test_shards_of_windows_alone_are_centred_on_their_landmark(tmp_path, toy_shards, monkeypatch):
    """A stand-in for the simulator, whose landmark lies off the centre where the field ends, and is now and then unseen."""

    def off_centre(rng, *, crop_px, around, jitter):
        image, u = np.zeros((crop_px, crop_px, 3), np.uint8), rng.uniform(60, 200, (3, 2))
        x, y = np.round(u[around]).astype(int)
        image[y, x] = 255
        return image, u, np.where(np.arange(3) == around, rng.integers(0, 3), 2)

    monkeypatch.setattr(dataset, "sample", off_centre)
    for index in range(2):
        dataset._make_crops(tmp_path / f"windows_{index:04d}.npz", index, dataset.CROP_PX, 5, 2)
    dataset.generate_crops(tmp_path, 2, "windows", progress=False)  # they stand already: nothing is drawn
    with np.load(tmp_path / "windows_0001.npz") as shard:
        for crop, u, visibility, k in zip(
            *(shard[name] for name in ("crops", "crop_u", "crop_visibility", "crop_landmark")), strict=True
        ):
            assert np.abs(u[k] - (dataset.CROP_PX - 1) / 2).max() <= 0.5
            assert visibility[k] > 0
            assert np.abs(np.argwhere(crop[..., 0])[0][::-1] - u[k]).max() <= 0.5
    toy_shards(tmp_path, 2)
    both = dataset.WindowSource.load(tmp_path)
    assert len(both) == 2 * 3 + 2 * 5
    assert len(dataset.WindowSource.load(tmp_path, shards=1)) == 6  # frames alone
    first = np.load(tmp_path / "training_0000.npz")["crops"]
    assert np.array_equal(both.crops[: len(first)], first)


def test_where_a_landmark_lies_in_its_jpeg_blocks_does_not_tell_its_place(monkeypatch, tmp_path):
    """A stand-in for the simulator that asks where the landmark will lie in the image that is compressed."""
    places = []

    def sample(rng, *, crop_px, around, jitter):
        u = (crop_px - 1) / 2 - np.round(rng.uniform(-jitter, jitter, (3, 2)) * crop_px)
        places.append(u[around])
        return np.zeros((crop_px, crop_px, 3), np.uint8), u, np.full(3, 2)

    monkeypatch.setattr(dataset, "sample", sample)
    dataset._make_crops(tmp_path / "closeups_0000.npz", 0, 128, 400, 4)
    inside = np.array(places).ravel() % dataset._BLOCK_PX
    assert len(np.unique(inside)) == dataset._BLOCK_PX
    with np.load(tmp_path / "closeups_0000.npz") as shard:
        own = shard["crop_u"][np.arange(400), shard["crop_landmark"]]
    assert np.abs(own - 63.5).max() <= 0.5


def test_closeups_are_stretched_with_their_landmark(tmp_path):
    """A dot at the landmark lies where the label says, in every closeup; its own landmark alone is visible."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:128, :128]
    crops, u, landmark = [], [], np.arange(30) % 3
    for k in landmark:
        points = rng.uniform(-30, 30, (3, 2)) + 64
        points[k] = rng.uniform(63, 64, 2)
        dot = 255 * np.exp(-((columns - points[k, 0]) ** 2 + (rows - points[k, 1]) ** 2) / 8)
        crops.append(np.repeat(dot[..., None], 3, 2).round().astype(np.uint8))
        u.append(points)
    arrays = {"crops": np.stack(crops), "crop_u": np.stack(u), "crop_landmark": landmark}
    visibility = np.full((30, 3), 2)
    visibility[4, 1] = 1  # hidden: not trained on
    np.savez(tmp_path / "closeups_0000.npz", crop_visibility=visibility, **arrays)
    source = dataset.CloseupSource.load(tmp_path)
    assert len(source) == 29
    for i in range(len(source)):
        image, at, seen = source.draw(i, rng)
        k = source.landmark[i]
        assert image.shape == (64, 64, 3)
        assert seen.tolist() == [2 * (j == k) for j in range(3)]
        y, x = np.mgrid[:64, :64]
        mass = image[..., 0].astype(float)
        if (np.abs(at[k] - 31.5) < 18).all():
            found = np.array([(x * mass).sum(), (y * mass).sum()]) / mass.sum()
            assert np.abs(found - at[k]).max() < 0.15
    for change in (
        {"u": source.u + 1},
        {"stretch": 0.3},
        {"shifts_px": (1.0, 2.0, 3.0)},
        {"landmark": 2 - source.landmark},
    ):
        assert source.fingerprint != replace(source, **change).fingerprint


def test_missing_and_corrupt_shards_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no shard training"):
        dataset.frame_samples(tmp_path)
    dataset._write(tmp_path / "whole.npz", **{name: np.zeros((2, 40, 60, 3), np.uint8) for name in ("frames", "jpegs")})
    whole = (tmp_path / "whole.npz").read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 4] ^= 1
    for content in (b"not an archive", b"", whole, whole[: len(whole) // 2], bytes(flipped)):
        for name in ("training_0000.npz", "validation_0000.npz"):
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"training_0000\.npz: corrupt"):
            dataset.frame_samples(tmp_path)
        with pytest.raises(ValueError, match=r"validation_0000\.npz: corrupt"):
            list(dataset.validation_frames(tmp_path))


def test_the_train_command_names_what_is_missing(tmp_path, capsys):
    assert main(["frame", "--data", str(tmp_path), "--folder", str(tmp_path)]) == 2
    assert "no shard" in capsys.readouterr().err
    assert main(["assemble", "--data", str(tmp_path), "--folder", str(tmp_path)]) == 2
    assert "last.safetensors" in capsys.readouterr().err


@pytest.mark.skipif(
    not (paths.SHIPPED_RECORDING.exists() and (paths.MODELS / "default.safetensors").exists()),
    reason="the shipped recording and weights are not there",
)
def test_the_evaluate_command(tmp_path, capsys):
    out = tmp_path / "scores.json"
    assert evaluation.main([str(paths.SHIPPED_RECORDING), "--every", "12", "--json", str(out)]) == 0
    assert "PCK@0.05" in capsys.readouterr().out
    assert set(json.loads(out.read_text())) >= {"all", "base", "tip_1", "tip_2"}
    assert evaluation.main([str(tmp_path)]) == 2


def test_reduced_windows_keep_their_landmarks():
    whole, reduced = (
        dataset.simulated_samples(1, seed=0, crop_px=256, reduction=k, textures=1, progress=False) for k in (1, 4)
    )
    assert reduced.images.shape == (1, 64, 64, 3)
    np.testing.assert_allclose(4 * reduced.u + 1.5, whole.u)
    np.testing.assert_array_equal(reduced.images[0, 3, 5].round(), whole.images[0, 12:16, 20:24].mean((0, 1)).round())


def test_groups_by_focus_and_what_confidence_says(small):
    detector, frames = small
    frames = [(name, image, u, np.array([2, 2, 0]) if int(name) % 2 else v) for name, image, u, v in frames]
    result = evaluate(detector, frames)
    depth = np.tile([-0.2, 0.7, 3.0], (len(frames), 1))
    groups = result.by_depth(depth, (0, 0.5, 1.0, 2.0))
    assert list(groups) == ["0 to 0.5 mm", "0.5 to 1 mm"]  # nothing lies between 1 and 2
    assert groups["0 to 0.5 mm"].labels == len(frames)
    assert groups["0 to 0.5 mm"].median_px == result.by_landmark()["base"].median_px
    said = result.detection(min_confidence=0.0)  # everything is said to be there: of 6 landmarks 5 are
    assert said["in_view_recall"] == said["visible_recall"] == 100
    assert said["in_view_precision"] == pytest.approx(100 * 5 / 6)


@pytest.mark.skipif(not paths.SHIPPED_RECORDING.exists(), reason="the shipped recording is not there")
def test_distance_from_focus_is_within_the_microscopes_reach():
    from lib.recordings import Recording

    recording = Recording.open(paths.SHIPPED_RECORDING)
    depth = evaluation.focus_distance_mm(recording, every=2)
    assert depth.shape == (len(list(evaluation.labelled_frames(recording, every=2))), 3)
    assert np.abs(depth).max() < 5


def test_the_card_beside_the_shipped_weights_is_theirs():
    path = paths.MODELS / "default.safetensors"
    assert card(Detector.load(), path) == path.with_name("README.md").read_text(encoding="utf-8")
