from dataclasses import replace

import numpy as np
import pytest
import torch

from lib.geometry import image_from_cell
from lib.landmarks import Detector, Landmarks
from lib.landmarks.detector import MISSING_BELOW
from lib.landmarks.error_model import ErrorModel, Rough, features_of
from lib.landmarks.heatmaps import Peaks
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork, StackedHourglass, as_tensor
from lib.landmarks.windows import (
    CLOSEUP_BEHIND_PX,
    CLOSEUP_ZOOM,
    TOOL_PX,
    closeup_from_image,
    closeup_scale,
    cut,
    expected_in_closeup,
    map_points,
    tool_pose,
    window_from_image,
)


def sure():
    """A calibration that keeps every detection."""
    return {name: ErrorModel(logit=(5.0, 0.0, 0.0, 0.0)) for name in ("frame", "tool", "again")}


def with_models(detector, **models):
    return replace(detector, error_models=detector.error_models | models)


def untrained(frame_px=66):
    torch.manual_seed(0)
    networks = [StackedHourglass(HourglassConfig(8, 1)) for _ in range(2)]
    return Detector(networks[0], frame_px, networks[1], error_models=sure())


@pytest.fixture(scope="module")
def images():
    return np.random.default_rng(0).integers(0, 256, (2, 98, 131, 3), dtype=np.uint8)


def test_shapes(images):
    found = untrained()(images)
    assert found.u.shape == (2, 3, 2)
    assert found.covariance.shape == (2, 3, 2, 2)
    assert found.confidence.shape == (2, 3)
    assert np.isfinite(found.u).all()
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()
    assert len(found[1:]) == 1


def test_batches_do_not_matter(images):
    detector = untrained()
    together, single = detector(images, batch=2), detector(images, batch=1)
    assert np.allclose(together.u, single.u, atol=1e-2)


def test_float_images_are_the_same_as_uint8(images):
    detector = untrained()
    assert np.allclose(detector(images).u, detector(images / 255.0).u)


def test_save_and_load(images, tmp_path):
    detector = untrained()
    detector.save(tmp_path / "weights.safetensors")
    loaded = Detector.load(tmp_path / "weights.safetensors", engine="torch")
    found, before = loaded(images), detector(images)
    for name in ("u", "covariance", "confidence"):
        assert np.array_equal(getattr(found, name), getattr(before, name), equal_nan=True)


def test_missing_is_nan_with_confidence_zero(images):
    never = {name: ErrorModel(logit=(-50.0, 0.0, 0.0, 0.0)) for name in ("frame", "tool", "again")}
    found = with_models(untrained(), **never)(images)
    assert np.isnan(found.u).all()
    assert np.isnan(found.covariance).all()
    assert (found.confidence == 0).all()


def test_whole_frame_detector_has_no_windows(images):
    detector = Detector(StackedHourglass(HourglassConfig(8, 2)), error_models=sure())
    assert detector.outputs(detector.reduced(images), "frame").shape == (2, 3, 25, 33)
    assert np.isfinite(detector(images).u).all()


def test_windows_point_right_and_are_measured_exactly():
    """A Gaussian dot in the image is found at its mapped place in the turned window, and mapped back."""
    h, w, u = 200, 240, np.array([[[100.3, 90.7], [60.2, 120.9], [75.5, 135.1]]])
    y, x = np.mgrid[:h, :w]
    image = np.zeros((h, w, 3), np.uint8)
    for p in u[0]:
        image = np.maximum(image, (255 * np.exp(-((x - p[0]) ** 2 + (y - p[1]) ** 2) / 32))[..., None].astype(np.uint8))
    angle = tool_pose(u)[1]
    tips = u[0, 1:].mean(0) - u[0, 0]
    assert angle[0] == pytest.approx(np.arctan2(tips[1], tips[0]))
    for k in range(3):
        matrix = window_from_image(u[0, k], angle[0], 64)
        assert np.allclose(map_points(matrix, u[0, k]), 31.5)
        window = cut(image, matrix, 64).astype(float)[20:44, 20:44, 0]
        rows, columns = np.mgrid[20:44, 20:44]
        window = np.where((rows - 31.5) ** 2 + (columns - 31.5) ** 2 < 100, window, 0)
        centre = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum()
        assert np.allclose(centre, 31.5, atol=0.1)
    mapped = map_points(window_from_image(u[0, 0], angle[0], 64), u[0])
    assert mapped[1, 0] > mapped[0, 0]
    assert mapped[2, 0] > mapped[0, 0]


def test_direction_needs_a_base_and_a_tip():
    u = np.array([[[0, 0], [5, 5], [np.nan] * 2], [[np.nan] * 2, [1, 1], [2, 2]], [[0, 0], [np.nan] * 2, [np.nan] * 2]])
    angle = tool_pose(u)[1]
    assert angle[0] == pytest.approx(np.pi / 4)
    assert np.isnan(angle[1:]).all()


@pytest.mark.parametrize("frame_px", [24, 37, 120, 200])
def test_resized_frames_keep_the_half_pixel_rule(frame_px):
    """A blob at u shrinks or grows to cell_from_image(u): the rule of lib.geometry, here with the library's own resize."""
    y, x = np.mgrid[:100, :120]
    image = (255 * np.exp(-((x - 61.7) ** 2 + (y - 44.1) ** 2) / 200)).astype(np.uint8)[..., None].repeat(3, 2)
    detector = untrained(frame_px)
    small, stride = detector.reduced(image[None])[0, ..., 0].astype(float), detector.frame_stride(image[None])
    assert max(small.shape) == frame_px
    rows, columns = np.indices(small.shape)
    centre = np.array([(small * columns).sum(), (small * rows).sum()]) / small.sum()
    assert np.allclose(image_from_cell(centre, stride), (61.7, 44.1), atol=0.1)


@pytest.mark.parametrize("blob", [(110.3, 92.6), (22.3, 14.6)])  # the second window leaves the image
def test_a_finer_or_coarser_cut_keeps_its_place(blob):
    """What a window at any scale shows of a blob lies where its matrix says."""
    y, x = np.mgrid[:200, :241]
    image = (255 * np.exp(-((x - blob[0]) ** 2 + (y - blob[1]) ** 2) / 20)).astype(np.uint8)[..., None].repeat(3, 2)
    for zoom in (0.09, 0.2, 0.45, 1.0, 1.7):
        matrix = window_from_image(np.add(blob, (1.7, -2.6)), 0.4, 64, zoom)
        seen = cut(image, matrix, 64)[..., 0].astype(float)
        rows, columns = np.indices(seen.shape)
        centre = np.array([(seen * columns).sum(), (seen * rows).sum()]) / seen.sum()
        assert np.allclose(centre, map_points(matrix, np.array(blob)), atol=0.06)


def test_every_tool_fills_the_same_share_of_its_window(images):
    """And closeups are no finer than half an image pixel."""
    tool = np.array([[[40.0, 40.0], [60.0, 36.0], [60.0, 44.0]]])
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(4, 1, 1))
    detector = Detector(network, 64, tool_network=network, closeup_network=OffsetNetwork(OffsetConfig(4, 32)))
    assert detector.stages == ["frame", "tool", "again", "closeup", "closer", "tracking"]
    for scale in (0.5, 1.0, 3.0):
        u = 40 + scale * (tool - 40)
        windows, (matrix,), _ = detector.windows(images[:1], u, "tool")
        assert windows.shape == (1, TOOL_PX, TOOL_PX, 3)
        assert tool_length_px(map_points(matrix, u))[0] == pytest.approx(56.0)
        _, matrices, which = detector.windows(images[:1], u, "closeup")
        assert np.sqrt(np.abs(np.linalg.det(matrices[:, :, :2]))).max() <= 2.0 + 1e-9
        at = map_points(matrices, u[0])
        np.testing.assert_allclose(at, expected_in_closeup(32, which[:, 1]), atol=1e-9)


def test_grey_images_are_taken(images):
    grey = images[..., :1]
    np.testing.assert_array_equal(untrained()(grey).u, untrained()(grey.repeat(3, axis=-1)).u)


def test_what_the_stage_before_found_is_evidence(images):
    """Features tell agreement with it, its confidence, and that of the whole tool; a second look has its own model."""
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(4, 1, 1)).eval()
    detector = Detector(network, 64, tool_network=network)
    u, spread = np.array([[[30.0, 50], [60, 40], [60, 60]]]), np.tile(np.eye(2), (1, 3, 1, 1))
    rough = Landmarks(u, spread, np.array([[0.9, 0.5, 0.1]]))
    peaks, matrices, which = detector.stage_peaks(images[:1], rough.u, "tool")
    seen = Rough.in_windows(rough.u, rough.confidence, matrices, which)
    np.testing.assert_allclose(seen.logit[:, 0].numpy(), [np.log(9), 0, -np.log(9)], atol=1e-9)
    np.testing.assert_allclose(seen.together.numpy(), 0, atol=1e-9)
    features = features_of(peaks.double(), seen)
    moved = np.linalg.norm(peaks.u[:, 0].numpy() - map_points(matrices, rough.u[0]), axis=1)
    np.testing.assert_allclose(features[:, 0, 0, 5].numpy(), np.log1p(np.minimum(moved, 100) / 2), rtol=1e-4)
    trusting = ErrorModel(logit=(*7 * (0.0,), 1.0))
    found = with_models(detector, tool=trusting, again=ErrorModel(logit=(2.0,))).refine(images[:1], rough, "tool")
    np.testing.assert_allclose(found.confidence, 0.5, atol=1e-9)
    again = with_models(detector, again=ErrorModel(logit=(2.0,))).refine(images[:1], rough, "again")
    np.testing.assert_allclose(again.confidence, 1 / (1 + np.exp(-2.0)))


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        (np.zeros((1, 64, 64, 2), np.uint8), "grey"),
        (np.zeros((1, 64, 64, 4), np.uint8), "alpha"),
        (np.zeros((64, 64, 3), np.uint8), "first axis"),
        (np.full((1, 64, 64, 3), 200.0), r"must lie in \[0, 1\]"),
        (np.full((1, 64, 64, 3), np.nan), r"must lie in \[0, 1\], but some pixels are NaN"),
        (np.zeros((1, 64, 64, 3), np.int32), "int32"),
        (np.zeros((0, 64, 64, 3), np.uint8), "empty"),
    ],
)
def test_bad_images_are_named(bad, text):
    with pytest.raises(ValueError, match=f"images: .*{text}"):
        untrained()(bad)
    with pytest.raises(ValueError, match="images: "):
        as_tensor(bad)


def test_each_image_needs_its_expected_positions(images):
    with pytest.raises(ValueError, match="u: holds 1 images, but images 2"):
        untrained().near(images, np.zeros((1, 3, 2)))


@pytest.mark.parametrize("batch", [0, -1, 2.5])
def test_a_batch_has_one_image_or_more(images, batch):
    with pytest.raises(ValueError, match="batch: "):
        untrained()(images, batch=batch)


def test_a_closeup_moves_what_the_stage_before_found(images):
    """An offset network that says "10 right of the middle, 2 below" puts each landmark there, turned back into the image."""
    closeup = OffsetNetwork(OffsetConfig(4, 32)).eval()
    size = closeup.config.size_px
    with torch.no_grad():
        closeup.head[-1].bias.copy_(torch.tensor([10 * 8 / size, 2 * 8 / size, -1.0, 0.5]))
    plain = untrained()
    sure_too = replace(ErrorModel(), logit=(5.0,))
    detector = with_models(replace(plain, closeup_network=closeup), closeup=sure_too)
    before = plain(images)
    after = detector.refine(images, before, "closeup")
    seen = np.isfinite(before.u).all(axis=2)
    assert seen.all()
    angle, scale = tool_pose(before.u)[1], closeup_scale(tool_length_px(before.u))
    for i, k in np.argwhere(seen):
        zoom, side = CLOSEUP_ZOOM[k] * scale[i], -1 if k == 2 else 1
        c, s = np.cos(angle[i]), np.sin(angle[i])
        ahead = 10.0 / zoom - CLOSEUP_BEHIND_PX[k] / scale[i]
        turn = np.array([[c, -s], [s, c]])
        moved = turn @ np.array([ahead, side * 2.0 / zoom])
        np.testing.assert_allclose(after.u[i, k] - before.u[i, k], moved, atol=1e-3)
        spread = turn @ np.diag([2 * np.exp(-2.0), 2 * np.exp(1.0)]) @ turn.T / zoom**2  # of Laplace distributions
        spread *= 1 + 3 * (1 - after.confidence[i, k])  # a wrong landmark has four times the variance of a right one
        np.testing.assert_allclose(after.covariance[i, k], spread, rtol=1e-3)
    unsure = with_models(detector, closeup=replace(ErrorModel(), logit=(-5.0,))).refine(images, before, "closeup")
    np.testing.assert_array_equal(unsure.u, before.u)  # it says that nothing is there, so the landmark stays, and is doubted
    assert (unsure.confidence == MISSING_BELOW).all()
    with torch.no_grad():
        closeup.head[-1].bias[0] = 40 * 8 / size  # further than a closeup is believed
    np.testing.assert_array_equal(replace(detector, closeup_network=closeup).refine(images, before, "closeup").u, before.u)


@pytest.mark.parametrize(("way_px", "looks_twice"), [(1.0, False), (5.0, True)])
def test_tracking_looks_twice_where_the_tool_moved_far_and_knows_when_it_lost_it(images, monkeypatch, way_px, looks_twice):
    closeup = OffsetNetwork(OffsetConfig(4, 32)).eval()
    detector = replace(untrained(), closeup_network=closeup)
    looks, every = [], np.ones((1, 3), bool)

    def refined(self, part, rough, stage, *, only=every):
        looks.append(only.sum())
        return Landmarks(
            rough.u + only[..., None] * way_px / closeup_scale(length), rough.covariance,
            np.full((len(part), 3), 0.9 if rough.u[0, 0, 0] < 50 else 0.1),
        )

    monkeypatch.setattr(Detector, "refine", refined)
    before = Landmarks(np.full((1, 3, 2), 20.0), np.tile(np.eye(2), (1, 3, 1, 1)), np.ones((1, 3)))
    length = np.maximum(tool_length_px(before.u), 1.0)
    found = detector.track(images[:1], before).u
    assert looks == [3, 3 * looks_twice]
    np.testing.assert_allclose(found, before.u + sum(looks) / 3 * way_px / closeup_scale(length))
    lost = replace(before, u=before.u + 40)
    monkeypatch.setattr(Detector, "__call__", lambda self, part, ground: before)
    np.testing.assert_array_equal(detector.track(images[:1], lost).u, before.u)


def test_closeups_and_what_is_believed_of_them_are_saved(tmp_path, images):
    fit = ErrorModel(gain=((0.5, 0.25),) * 3, bias=((0.1, -0.1),) * 3)
    detector = replace(untrained(), closeup_network=OffsetNetwork(OffsetConfig(4, 32)).eval())
    detector = with_models(detector, closeup=fit, closer=fit, tracking=ErrorModel())
    detector.save(tmp_path / "weights.safetensors")
    loaded = Detector.load(tmp_path / "weights.safetensors", engine="torch")
    assert loaded.closeup_network.config == OffsetConfig(4, 32)
    assert loaded.error_models["closeup"] == fit
    np.testing.assert_array_equal(loaded(images).u, detector(images).u)


def test_a_closeup_needs_windows():
    with pytest.raises(ValueError, match="closeup_network"):
        Detector(StackedHourglass(HourglassConfig(8, 1, 2)), closeup_network=OffsetNetwork())


def test_closeups_mirror_the_second_tip():
    """What lies 4 px ahead and 2 px towards the middle of the tool, seen from either tip, is one place in their closeups."""
    tips = np.array([[100.0, 80.0], [100.0, 140.0]])
    matrices = closeup_from_image(tips, np.zeros(2), 64, [1, 2])
    at = 31.5 + CLOSEUP_ZOOM[1] * np.array([CLOSEUP_BEHIND_PX[1], 0.0])
    np.testing.assert_allclose(map_points(matrices, tips), [at] * 2)
    ahead = tips + [[4.0, 2.0], [4.0, -2.0]]
    np.testing.assert_allclose(map_points(matrices, ahead), [at + CLOSEUP_ZOOM[1] * np.array([4.0, 2.0])] * 2)


def test_tracking_needs_as_many_landmarks_as_images(images):
    with pytest.raises(ValueError, match="previous"):
        untrained().track(images, Landmarks(np.zeros((1, 3, 2)), np.zeros((1, 3, 2, 2)), np.zeros((1, 3))))


def test_features_are_finite_for_any_peak():
    variance = torch.tensor([0.0, 1e9, torch.nan])[:, None, None] * torch.eye(2)
    peaks = Peaks(torch.zeros(3, 2), torch.tensor([-3.0, 5.0, 1.0]), torch.tensor([0.4, 3.0, 1.0]), variance, torch.zeros(3))
    rough = Rough.of(torch.full((3, 2), torch.nan), torch.tensor([0.0, 0.5, 1.0]))
    assert torch.isfinite(features_of(peaks, rough)).all()


def test_jaws_look_shut_where_the_tips_meet_and_not_where_one_is_missing():
    base, apart = [0.0, 0.0], [[90.0, 40.0], [90.0, -40.0]]
    tools = torch.tensor([[base, [100.0, 0.0], [100.0, 0.0]], [base, *apart], [base, [torch.nan] * 2, apart[1]]])
    shut = Rough.of(tools, torch.full((3, 3), 0.7)).shut
    assert shut.shape == (3, 3)
    assert torch.equal(shut[:, 0], shut[:, 2])
    assert shut[0, 0] == 1
    assert shut[1, 0] < 1e-6
    assert shut[2, 0] == 0
