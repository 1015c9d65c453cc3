"""OpenVINO runs the same network as torch; both from one weights file."""

import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from lib import paths
from lib.landmarks import Detector, Landmarks
from lib.landmarks import export as module
from lib.landmarks.engines import OpenVinoNetwork, accelerated, default_engine, openvino
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.export import LARGEST, export, run_onnx
from lib.landmarks.images import as_tensor
from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork, StackedHourglass
from lib.recordings import Recording
from lib.training.command import main as training_main
from lib.training.config import PRESETS
from lib.training.evaluation import evaluate_recording
from lib.training.loop import train

needs_openvino = pytest.mark.skipif(not importlib.util.find_spec("openvino"), reason="OpenVINO is not installed here")
needs_shipped = pytest.mark.skipif(
    not ((paths.MODELS / "default.safetensors").is_file() and paths.SHIPPED_RECORDING.is_dir()),
    reason="the shipped weights and recording are not there",
)
needs_onnx = pytest.mark.skipif(not importlib.util.find_spec("onnx"), reason="onnx is not installed here")


@pytest.fixture(scope="module")
def trained(toy):
    """A whole-frame detector that finds toys, and two toys."""
    config = replace(
        PRESETS["best"], network=HourglassConfig(12, 1, 2), steps=40, batch_size=6, ema=0.9, learning_rate=4e-3,
        validate_every=40, precision="fp32",
    )  # fmt: skip
    network = train(config, toy(60), toy(4, seed=2), progress=False).network
    fit = ErrorModel(((-0.1, 0.4, 0.5, 0.9, -0.2, 0.1), (0.3, 0.1, -0.2, 0.8, 0.1, 0.0)), (3.0, -0.1, 2.0, -0.3))
    return Detector(network, 1, error_models={"frame": fit}), toy(3, seed=7).images


@needs_openvino
def test_openvino_gives_the_heatmaps_of_torch():
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(8, 2, 2)).eval()
    for head in network.heads:
        torch.nn.init.normal_(head.weight)
    fast = OpenVinoNetwork(network, precision="f32")
    for shape in ((5, 3, 40, 56), (1, 3, 40, 56), (2, 3, 33, 47)):  # more images than threads, odd sizes
        images = torch.rand(shape)
        with torch.inference_mode():
            expected = network(images)[-1]
        assert torch.allclose(fast(images)[-1], expected, atol=1e-4 * expected.abs().max())
    with pytest.raises(ValueError, match="takes"):
        fast(torch.rand(1, 4, 32, 32))


@needs_openvino
def test_a_detector_finds_the_same_with_either_engine(trained, tmp_path):
    detector, images = trained
    detector.save(tmp_path / "weights.safetensors")
    slow, fast = (Detector.load(tmp_path / "weights.safetensors", engine=e) for e in ("torch", "openvino"))
    a, b = slow(images), fast(images)
    # bfloat16 where the processor has it: a network trained for seconds may then prefer the other of two equal peaks.
    assert np.nanmedian(np.linalg.norm(a.u - b.u, axis=2)) < 0.2
    assert Detector.load(tmp_path / "weights.safetensors").engine == default_engine() == "openvino"


@pytest.mark.parametrize("engine", ["torch", pytest.param("openvino", marks=needs_openvino)])
def test_an_offset_network_says_the_same_with_either_engine(engine):
    torch.manual_seed(0)
    network = OffsetNetwork(OffsetConfig(8, 32)).eval()
    torch.nn.init.normal_(network.head[-1].weight, std=0.3)
    images = torch.rand(4, 3, 32, 32)
    with torch.inference_mode():
        expected = network(images)[-1]
        found = accelerated(network, engine)(images)[-1]
    assert found.shape == (4, 4)
    assert expected.std() > 0.1
    assert torch.allclose(found, expected, atol=0.03 * float(expected.abs().max()))  # bfloat16 where there is


@pytest.mark.parametrize("engine", ["torch", pytest.param("openvino", marks=needs_openvino)])
def test_the_mean_with_the_mirror_image_does_not_know_left_from_right(engine):
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(8, 1, 2)).eval()
    for head in network.heads:
        torch.nn.init.normal_(head.weight)
    images = torch.rand(2, 3, 48, 64)
    mirrored = accelerated(network, engine, mirror=True)
    with torch.inference_mode():
        seen, turned = mirrored(images)[-1].clone(), mirrored(images.flip(-2))[-1]
        single = network(images)[-1]
    close = {"atol": 0.02 * float(seen.abs().max())}  # bfloat16 where the processor has it
    assert torch.allclose(turned, seen.flip(-2)[:, [0, 2, 1]], **close)
    assert not torch.allclose(seen, single, **close)
    windows = np.random.default_rng(0).integers(0, 256, (3, 128, 128, 3), dtype=np.uint8)
    plain = Detector(network, window_network=network, engine=engine)
    both = replace(plain, mirror=True)
    assert not torch.allclose(both.outputs(windows, "window"), plain.outputs(windows, "window"), **close)
    with pytest.raises(ValueError, match="mirror: needs window_px"):
        Detector(network, window_network=network, window_px=126, mirror=True)


@needs_openvino
def test_openvino_tells_nobody():
    openvino()
    assert sys.modules["openvino_telemetry"] is None


def test_unknown_and_missing_engines_are_named(monkeypatch):
    network = StackedHourglass(HourglassConfig(8, 1, 2))
    with pytest.raises(ValueError, match="'abacus' is none"):
        Detector(network, engine="abacus")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert default_engine() == "torch"
    with pytest.raises(ValueError, match="not installed here"):
        accelerated(network, "openvino")


@needs_onnx
@needs_openvino
def test_onnx_holds_network_decoding_and_calibration(trained, tmp_path):
    detector, images = trained
    written = export(detector, tmp_path, images)
    path, difference = written["frame"]
    assert difference <= LARGEST["px"]
    u, covariance, confidence = run_onnx(path, as_tensor(images[:2]).contiguous().numpy())  # another batch size
    expected = detector(images[:2])
    found = expected.confidence > 0
    assert found.any()
    np.testing.assert_allclose(u[found], expected.u[found], atol=LARGEST["px"])
    np.testing.assert_allclose(confidence[found], expected.confidence[found], atol=LARGEST["of confidence"])
    np.testing.assert_allclose(covariance[found], expected.covariance[found], rtol=2e-2, atol=1e-4)


@needs_onnx
@needs_openvino
@needs_shipped
def test_every_exported_stage_is_that_of_the_detector(tmp_path):
    """The shipped detector put together from its ONNX files, by the README of the stages: same landmarks."""
    written = export(Detector.load(), tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {
        f"{stage}.onnx" for stage in ("frame", "tool", "window", "closeup", "tracking")
    }
    assert all(difference <= LARGEST["px"] for _, difference in written.values())
    images, detector = shipped_pairs(1), Detector.load(engine="torch")
    found = Landmarks(*run_onnx(tmp_path / "frame.onnx", rgb(detector.reduced(images))))
    finder = replace(detector, window_network=None, closeup_network=None)
    np.testing.assert_allclose(found.u, replace(finder, tool_network=None)(images).u, atol=0.02)
    windows, matrices, which = detector.windows(images, found.u, "tool")
    u, covariance, confidence = run_onnx(tmp_path / "tool.onnx", rgb(windows))
    back = np.linalg.inv(matrices[:, None, :, :2])
    u = (back @ (u - matrices[:, None, :, 2])[..., None])[..., 0]
    expected = finder(images)
    np.testing.assert_allclose(u, expected.u[which], atol=5 * LARGEST["px"])  # the stage's pixels are 5 of the frame
    np.testing.assert_allclose(back @ covariance @ back.mT, expected.covariance[which], rtol=2e-2, atol=1e-3)
    np.testing.assert_allclose(confidence, expected.confidence[which], atol=LARGEST["of confidence"])
    looks = {
        "window": replace(detector, closeup_network=None),
        "closeup": detector,
        "tracking": lambda images: detector.refine(images, expected, "tracking"),
    }
    for stage, reference in looks.items():
        windows, matrices, which = detector.windows(images, expected.u, stage)
        own = tuple(np.arange(len(which))), tuple(which[:, 1])  # of each window its own landmark
        u, covariance, confidence = (part[own] for part in run_onnx(tmp_path / f"{stage}.onnx", rgb(windows)))
        back = np.linalg.inv(matrices[:, :, :2])
        expected, (image, landmark) = reference(images), which.T
        assert len(which)
        u = (back @ (u - matrices[:, :, 2])[..., None])[..., 0]
        np.testing.assert_allclose(u, expected.u[image, landmark], atol=LARGEST["px"])
        turned = back @ covariance @ back.mT
        np.testing.assert_allclose(turned, expected.covariance[image, landmark], rtol=2e-2, atol=1e-3)
        if stage != "closeup":  # there the windows' confidence is kept
            np.testing.assert_allclose(confidence, expected.confidence[image, landmark], atol=LARGEST["of confidence"])


@needs_onnx
@needs_openvino
@pytest.mark.parametrize(("part", "off", "unit"), [(0, 0.02, "px"), (2, 0.01, "of confidence")])
def test_an_export_that_differs_is_not_written(trained, tmp_path, monkeypatch, part, off, unit):
    right = run_onnx
    monkeypatch.setattr(module, "run_onnx", lambda *a: tuple(v + off * (i == part) for i, v in enumerate(right(*a))))
    with pytest.raises(ValueError, match=f"frame: ONNX and torch differ by .* {unit}"):
        export(*trained[:1], tmp_path, trained[1])
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_one_line_with_the_cure(trained, tmp_path, monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "onnx" else find(name))
    with pytest.raises(ValueError, match=r"needs the package onnx, which is not installed here; `pip install onnx`"):
        export(*trained[:1], tmp_path, trained[1])
    assert training_main(["export", "--onnx", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@needs_openvino
@needs_shipped
def test_the_default_engine_on_the_shipped_weights_agrees_with_torch():
    """The whole chain as it ships, in the precision that OpenVINO chooses here, on frames with known truth."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    fast, slow = (evaluate_recording(Detector.load(engine=e), recording, every=3) for e in (None, "torch"))
    assert default_engine() == "openvino"
    apart = np.linalg.norm(fast.landmarks.u - slow.landmarks.u, axis=2)
    assert np.nanmedian(apart) < 0.1
    assert abs(fast.scores.pck_0_05 - slow.scores.pck_0_05) <= 0.3


def rgb(images: np.ndarray) -> np.ndarray:
    """(n, 3, h, w) in [0, 1], what a stage takes."""
    return as_tensor(images).contiguous().numpy()


def shipped_pairs(n: int) -> np.ndarray:
    """Left and right images (2 n, h, w, 3) of the first pairs of the shipped recording."""
    frames = Recording.open(paths.SHIPPED_RECORDING).frames
    return np.stack([image for i in range(n) for image in (frames[i].left, frames[i].right)])
