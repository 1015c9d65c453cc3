"""ONNX files hold network, decoding and error model; together they are the detector."""

import copy
import importlib.util
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from lib.landmarks import Detector, Landmarks
from lib.landmarks import export as module
from lib.landmarks.engines import openvino
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.export import LARGEST, StageWithDecoding, export
from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork, StackedHourglass, as_tensor
from lib.landmarks.windows import map_points
from lib.parallel import single_threaded_torch

pytestmark = pytest.mark.skipif(
    not (importlib.util.find_spec("onnx") and importlib.util.find_spec("openvino")), reason="onnx or OpenVINO is missing"
)
SURE = ErrorModel(
    ((-0.1, 0.4, 0.5, 0.0, -0.2, 0.1, 0.1, 0.2, 0.0, 0.1), (0.3, 0.1, -0.2, 0.0, 0.1, 0.0, 0.0, 0.3, -0.1, 0.0)),
    (3.0, 0.0, 2.0, -0.3, -0.5, 0.05, 0.1, 0.1),
)


@cache
def compiled(content: bytes):
    core = openvino().Core()
    return core.compile_model(core.read_model(content), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})


def run_onnx(path, *inputs: np.ndarray) -> tuple[np.ndarray, ...]:
    """`lib.landmarks.export.run_onnx`, which compiles a file only once."""
    found = compiled(path.read_bytes())(list(inputs))
    return found["u"], found["covariance"], found["confidence"]


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(module, "run_onnx", run_onnx)


@pytest.fixture(scope="module")
def small():
    """A detector of every stage with small networks that are not trained, and two frames."""
    torch.manual_seed(0)
    networks = [StackedHourglass(HourglassConfig(4, 1, 1)).eval() for _ in range(2)]
    closeup = OffsetNetwork(OffsetConfig(4, 32)).eval()
    for head in [*(network.heads[0] for network in networks), closeup.head[-1]]:
        torch.nn.init.normal_(head.weight, std=0.1)
    models = dict.fromkeys(("frame", "tool", "again"), SURE)
    models |= dict.fromkeys(("closeup", "tracking"), replace(SURE, gain=((0.5, 0.8),) * 3, bias=((0.2, -0.1),) * 3))
    detector = Detector(networks[0], 80, networks[1], "paper", models, closeup_network=closeup)
    return detector, np.random.default_rng(0).integers(0, 256, (2, 120, 160, 3), dtype=np.uint8)


def rgb(images: np.ndarray) -> np.ndarray:
    """(n, 3, h, w) in [0, 1], the input of a stage."""
    return as_tensor(images).contiguous().numpy()


def check_every_stage(detector: Detector, images: np.ndarray, folder) -> None:
    """The detector put together from its ONNX files, as the export's docstring says: the same landmarks."""
    written = export(detector, folder, images)
    assert {file.name for file in folder.iterdir()} == {f"{stage}.onnx" for stage in detector.stages}
    assert all(difference <= LARGEST["px"] for _, difference in written.values())
    images = images[:2]  # another number of images than the export saw
    found = Landmarks(*run_onnx(folder / "frame.onnx", rgb(detector.reduced(images))))
    rough = detector.coarse(images)
    np.testing.assert_allclose(found.u, rough.u, atol=0.02)
    for stage in detector.stages[1:]:
        expected = detector.refine(images, rough, stage)
        windows, matrices, which = detector.windows(images, rough.u, stage)
        assert len(which)
        image = which if which.ndim == 1 else which[:, 0]
        evidence = map_points(matrices[:, None], rough.u[image]), rough.confidence[image]
        evidence = () if stage == "tracking" else tuple(part.astype(np.float32) for part in evidence)
        u, covariance, confidence = run_onnx(folder / f"{stage}.onnx", rgb(windows), *evidence)
        back = np.linalg.inv(matrices[:, None, :, :2])
        u = (back @ (u - matrices[:, None, :, 2])[..., None])[..., 0]
        # Of each window its own landmark, or all three.
        own = (np.arange(len(which)), which[:, 1]) if which.ndim == 2 else np.s_[:]
        true = expected[image]
        np.testing.assert_allclose(u[own], true.u[own], atol=5 * LARGEST["px"])  # a stage's pixels may be larger
        np.testing.assert_allclose((back @ covariance @ back.mT)[own], true.covariance[own], rtol=3e-2, atol=1e-3)
        np.testing.assert_allclose(confidence[own], true.confidence[own], atol=2 * LARGEST["of confidence"])
        rough = expected


def test_every_exported_stage_is_that_of_the_detector(small, tmp_path, quick):
    detector, images = small
    with single_threaded_torch():  # the same bits every time: a last digit can move a window by OpenCV's 1/32 px
        check_every_stage(detector, np.concatenate([images, images[:1]]), tmp_path)


def test_what_lies_beyond_the_reach_of_a_closeup_is_not_found(small):
    detector = replace(small[0], closeup_network=copy.deepcopy(small[0].closeup_network))
    windows = torch.from_numpy(np.random.default_rng(1).random((4, 3, 32, 32), dtype=np.float32))
    for far_px in (0.0, 500.0):
        with torch.no_grad():
            detector.closeup_network.head[-1].bias[0] += far_px
            confidence = StageWithDecoding(detector, "tracking", np.ones(2))(windows)[2]
        assert bool((confidence == 0).all()) == (far_px > 0)


@pytest.mark.slow
def test_every_exported_stage_of_the_shipped_detector_is_its_own(shipped, tmp_path, quick):
    check_every_stage(shipped.torch, shipped.images[:4], tmp_path)


def test_the_first_stage_that_ships_is_exported_with_its_gaussian_fit(shipped, tmp_path, quick):
    whole = shipped.torch
    detector = Detector(whole.frame_network, whole.frame_px, error_models=whole.error_models)
    path, difference = export(detector, tmp_path, shipped.images[:2])["frame"]
    assert difference <= LARGEST["px"]
    u, covariance, confidence = run_onnx(path, rgb(detector.reduced(shipped.images[2:3])))  # another number of images
    expected = detector(shipped.images[2:3])
    seen = expected.confidence > 0
    assert seen.any()
    np.testing.assert_allclose(u[seen], expected.u[seen], atol=LARGEST["px"])
    np.testing.assert_allclose(confidence[seen], expected.confidence[seen], atol=LARGEST["of confidence"])
    np.testing.assert_allclose(covariance[seen], expected.covariance[seen], rtol=2e-2, atol=1e-4)


def test_an_export_that_differs_is_not_written(small, tmp_path, monkeypatch):
    detector = Detector(small[0].frame_network, 40, method="paper", error_models={"frame": SURE})
    written = export(detector, tmp_path, small[1])["frame"][0]
    content = written.read_bytes()
    written.unlink()
    monkeypatch.setattr(module, "_write", lambda stage, images, path: path.write_bytes(content))
    changes = {"px": (0, 1.0, 0.02), "of variance": (1, 1.1, 0.0), "of confidence": (2, 1.0, 0.01)}
    for unit, (part, factor, shift) in changes.items():

        def wrong(path, *inputs, changed=part, factor=factor, shift=shift):
            return tuple(factor * v + shift if i == changed else v for i, v in enumerate(run_onnx(path, *inputs)))

        monkeypatch.setattr(module, "run_onnx", wrong)
        with pytest.raises(ValueError, match=f"frame: ONNX and torch differ by .* {unit}"):
            export(detector, tmp_path, small[1])
        assert not list(tmp_path.iterdir())


def test_a_missing_package_is_one_line_with_the_cure(small, tmp_path, monkeypatch, capsys):
    from lib.__main__ import COMMANDS

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "onnx" else find(name))
    with pytest.raises(ValueError, match=r"needs the package onnx, which is not installed here; `pip install onnx`"):
        export(small[0], tmp_path, small[1])
    assert COMMANDS["train"](["export", "--onnx", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
