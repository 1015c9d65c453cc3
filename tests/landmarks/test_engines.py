"""OpenVINO runs the same network as torch; both from one weights file."""

import importlib.util
import sys

import numpy as np
import pytest
import torch

from lib import paths
from lib.landmarks import Detector, engines
from lib.landmarks.engines import OpenVinoNetwork, accelerated, default_engine, openvino
from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork, StackedHourglass, as_tensor

needs_openvino = pytest.mark.skipif(not importlib.util.find_spec("openvino"), reason="OpenVINO is not installed here")


@pytest.fixture(autouse=True)
def no_model_kept(tmp_path, monkeypatch):
    """By an earlier run: every network is converted here."""
    monkeypatch.setattr(paths, "CACHE", tmp_path)


@needs_openvino
def test_openvino_gives_the_heatmaps_of_torch():
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(4, 2, 1)).eval()
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
def test_a_shape_that_is_met_often_is_compiled_for_and_says_the_same(monkeypatch):
    torch.manual_seed(0)
    network, asked, request = StackedHourglass(HourglassConfig(4, 1, 1)).eval(), [], engines._request
    torch.nn.init.normal_(network.heads[0].weight)
    fast, images, side = OpenVinoNetwork(network, precision="f32"), torch.rand(2, 3, 33, 47), network.config.multiple
    monkeypatch.setattr(engines, "_FREQUENT", 2)
    monkeypatch.setattr(engines, "_request", lambda of, shape: asked.append(shape) or request(of, shape))
    said = [fast(images)[-1] for _ in range(4)]
    assert asked[:2] == 2 * [engines._ANY_SHAPE] and asked[2:] == 2 * [(2, 3, *(-(-n // side) * side for n in (33, 47)))]
    for other in said[1:]:
        torch.testing.assert_close(other, said[0], rtol=0, atol=1e-6 * float(said[0].abs().max()))


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


@needs_openvino
@pytest.mark.parametrize(("engine", "units", "precision"), [
    ("openvino", True, "bf16"), ("openvino", False, "f32"), ("openvino float32", True, "f32"),
    ("openvino bfloat16", False, "bf16"),
])  # fmt: skip
def test_bfloat16_is_chosen_where_the_processor_has_matrix_units(monkeypatch, engine, units, precision):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": units})
    assert accelerated(StackedHourglass(HourglassConfig(4, 1, 1)), engine).precision == precision


@pytest.mark.parametrize("engine", ["torch", pytest.param("openvino", marks=needs_openvino)])
def test_the_mean_with_the_mirror_image_does_not_know_left_from_right(engine):
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(4, 1, 1)).eval()
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
    windows = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    detector = Detector(network, tool_network=network, engine=engine)
    with torch.inference_mode():
        plain, both = (accelerated(network, engine, mirror=one)(as_tensor(windows))[-1].clone() for one in (False, True))
    assert not torch.allclose(both, plain, **close)
    assert torch.equal(detector.outputs(windows, "again"), both)
    assert torch.equal(detector.outputs(windows, "tool"), plain)


@needs_openvino
def test_a_converted_network_is_kept_and_read_again(tmp_path, monkeypatch):
    for name in ("_converted", "_request"):  # what this process keeps
        monkeypatch.setattr(engines, name, getattr(engines, name).__wrapped__)
    network, images = OpenVinoNetwork(OffsetNetwork(OffsetConfig(4, 32)).eval()), torch.rand(3, 3, 32, 32)
    first = network(images)[-1]
    assert len(list(tmp_path.rglob("*.xml"))) == len(list(tmp_path.rglob("*.bin"))) == 1
    monkeypatch.setattr(engines, "LastOutput", None)  # nothing is converted again
    assert torch.equal(network(images)[-1], first)


@needs_openvino
def test_openvino_tells_nobody():
    openvino()
    assert sys.modules["openvino_telemetry"] is None


@pytest.mark.cuda
def test_a_gpu_finds_what_a_cpu_finds(gpu):
    torch.manual_seed(0)
    network, images = StackedHourglass(HourglassConfig(4, 2, 1)).eval(), torch.rand(3, 3, 33, 47)
    for head in network.heads:
        torch.nn.init.normal_(head.weight)
    with torch.inference_mode():
        gpu, cpu = (accelerated(network, engine, mirror=False)(images)[-1] for engine in ("cuda", "torch"))
    assert gpu.device.type == "cpu"
    assert torch.allclose(gpu, cpu, atol=0.03 * float(cpu.abs().max()))  # TF32


def test_unknown_and_missing_engines_are_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    network = StackedHourglass(HourglassConfig(8, 1, 2))
    with pytest.raises(ValueError, match="'abacus' is unknown"):
        Detector(network, engine="abacus")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert default_engine() == "torch"
    with pytest.raises(ValueError, match="not installed here"):
        accelerated(network, "openvino")
    with pytest.raises(ValueError, match="sees no NVIDIA GPU here"):
        accelerated(network, "cuda")
