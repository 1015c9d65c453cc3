"""What the README shows works."""

from __future__ import annotations

import re

import numpy as np
import pytest

from lib import paths
from lib.files import digest
from lib.matching import RECTIFIED, match
from lib.recordings import Recording


def code_blocks():
    return re.findall(r"```python\n(.*?)```", (paths.ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)


def test_one_frame_from_image_to_distance(monkeypatch, capsys):
    code = next(block for block in code_blocks() if "along_view_mm" in block)
    steps = [line for line in code.splitlines() if line and not line.startswith("from ")]
    assert len(steps) == 10
    monkeypatch.chdir(paths.ROOT)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    truth = Recording.open(paths.SHIPPED_RECORDING).truth
    true_mm = truth.rig.triangulate(truth.u_left[8], truth.u_right[8]).x_mm
    off = truth.surface(truth.rig.left.project(true_mm)) - true_mm
    expected = off @ truth.rig.left.viewing_direction
    assert np.abs(names["distance"].along_view_mm - expected).max() < 0.15
    assert capsys.readouterr().out.startswith("[")


def test_a_learned_matcher_from_an_onnx_file(tmp_path):
    """The README's function runs a network: that of seven disparities whose 9 x 9 blocks differ least."""
    pytest.importorskip("openvino", reason="OpenVINO runs the file; there is no wheel for this machine")
    from onnx import TensorProto, checker, helper, save

    names: dict = {}
    exec(compile(next(block for block in code_blocks() if "onnx_matcher" in block), "README.md", "exec"), names)
    disparities, shape = [9, 10, 11, 12, 13, 14, 15], [1, 1, None, None]
    nodes, initial = [], []
    for k, d in enumerate(disparities):  # cost of x_right = x_left - d: the right image moved by d to the right
        initial.append(helper.make_tensor(f"pads{k}", TensorProto.INT64, [8], [0, 0, 0, d, 0, 0, 0, -d]))
        nodes += [
            helper.make_node("Pad", ["right", f"pads{k}"], [f"moved{k}"], mode="constant"),
            helper.make_node("Sub", ["left", f"moved{k}"], [f"off{k}"]),
            helper.make_node("Abs", [f"off{k}"], [f"abs{k}"]),
            helper.make_node("AveragePool", [f"abs{k}"], [f"cost{k}"], kernel_shape=[9, 9], pads=[4, 4, 4, 4]),
        ]
    nodes += [
        helper.make_node("Concat", [f"cost{k}" for k in range(len(disparities))], ["costs"], axis=1),
        helper.make_node("ArgMin", ["costs"], ["best"], axis=1, keepdims=1),
        helper.make_node("Cast", ["best"], ["number"], to=TensorProto.FLOAT),
        helper.make_node("Add", ["number", "first"], ["disparity"]),
    ]
    initial.append(helper.make_tensor("first", TensorProto.FLOAT, [1], [disparities[0]]))
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("left", "right", "disparity")]
    graph = helper.make_graph(nodes, "blocks", ends[:2], ends[2:], initial)
    network = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    checker.check_model(network)
    path = tmp_path / "blocks.onnx"
    save(network, path)
    with pytest.raises(ValueError, match="SHA-256"):
        names["onnx_matcher"](path, "0" * 64)
    left = np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8)
    right = np.roll(left, -12, axis=1)
    found = match(left, right, method=names["onnx_matcher"](path, digest(path, length=64)), rig=RECTIFIED)
    off = found.u_left[:, 0] - found.u_right[:, 0] - 12
    assert len(found) > 100 and np.median(np.abs(off)) < 0.1
