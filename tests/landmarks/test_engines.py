"""OpenVINO runs the same network as torch; both from one weights file."""

import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from lib.landmarks import Detector
from lib.landmarks.engines import OpenVinoNetwork, accelerated, default_engine, openvino
from lib.landmarks.export import PARITY_PX, export, run_onnx
from lib.landmarks.inference import Calibration, as_tensor
from lib.landmarks.network import HourglassConfig, StackedHourglass
from lib.landmarks.training import PRESETS, train

needs_openvino = pytest.mark.skipif(not importlib.util.find_spec("openvino"), reason="OpenVINO is not installed here")
needs_onnx = pytest.mark.skipif(not importlib.util.find_spec("onnx"), reason="onnx is not installed here")


@pytest.fixture(scope="module")
def trained(toy):
    """A whole-frame detector that finds toys, and two toys."""
    config = replace(
        PRESETS["best"], network=HourglassConfig(12, 1, 2), steps=40, batch_size=6, ema=0.9, learning_rate=4e-3,
        validate_every=40, precision="fp32",
    )  # fmt: skip
    network = train(config, toy(60), toy(4, seed=2), progress=False).network
    fit = Calibration((0.3, 0.9, -0.2, 0.1), (3.0, -0.1, 2.0, -0.3))
    return Detector(network, 1, calibration={"frame": fit}), toy(3, seed=7).images


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
    assert difference <= PARITY_PX
    u, covariance, confidence = run_onnx(path, as_tensor(images[:2]).contiguous().numpy())  # another batch size
    expected = detector(images[:2])
    found = expected.confidence > 0
    assert found.any()
    np.testing.assert_allclose(u[found], expected.u[found], atol=PARITY_PX)
    np.testing.assert_allclose(confidence[found], expected.confidence[found], atol=1e-3)
    np.testing.assert_allclose(covariance[found], expected.covariance[found], rtol=2e-2, atol=1e-4)


@needs_onnx
@needs_openvino
def test_an_export_that_differs_is_not_written(trained, tmp_path, monkeypatch):
    from lib.landmarks import export as module

    right = run_onnx
    monkeypatch.setattr(module, "run_onnx", lambda *a: tuple(v + 0.02 * (v.ndim == 3) for v in right(*a)))
    with pytest.raises(ValueError, match="frame: ONNX and torch differ"):
        module.export(*trained[:1], tmp_path, trained[1])
    assert not list(tmp_path.iterdir())
