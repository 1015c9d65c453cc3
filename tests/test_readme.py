"""What the README shows works."""

from __future__ import annotations

import re

import numpy as np

from lib import paths
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
