"""Every study runs to its end, at its smallest: those that no other test of this folder runs."""

from __future__ import annotations

import re

import numpy as np
import pytest

from lib import paths

SMALLEST = {
    "ablation": {"steps": 5, "shards": 2},
    "calibrated_surfaces": {"n_frames": 30, "setting": "fast"},
    "dataset": {"pairs": 1, "shrink": 4},
    "engines_and_speed": {"repeats": 1},
    "few_labels": {"frames": 5, "minutes": 0.1},
    "ground": {"pairs": 4},
    "l1_solver": {"n_points": 2000, "control": 20},
    "label_noise": {"steps": 100},
    "left_out": {"steps": 4, "n": 2},
    "matching": {"scene": "eye", "repeats": 1},
    "noise_and_coverage": {"runs": 4},
    "noticed_motion": {"recordings": 1, "before": 60, "after": 10, "scenes": 1},
    "papers_network": {"minutes": 0.05, "every": 40},
    "real_robot": {},
    "realism": {"windows": 8},
    "reconstruction_speed": {},
    "robot_and_clicks": {"pairs": 14, "minutes": 0.1},
    "robot_labels": {"pairs": 14, "minutes": 0.1},
    "rungs": {"n": 2},
    "shipped_detector": {"every": 12},
    "surfaces": {"scene": "eye 200"},
}
NEED_DATA = {"few_labels", "matching", "papers_network", "real_robot", "realism", "rungs"}
#: Numbers that a picture or a motion does not have.
MAY_LACK = {"matching", "noticed_motion", "papers_network", "robot_and_clicks", "robot_labels", "rungs"}


def test_every_study_is_run_by_a_test():
    files = (paths.ROOT / "tests").glob("**/*.py")
    run = {name for file in files for name in re.findall(r'run_study\("(\w+)"', file.read_text(encoding="utf-8"))}
    assert run | set(SMALLEST) == {notebook.stem for notebook in (paths.NOTEBOOKS / "studies").glob("*.ipynb")}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLEST)
def test_a_study_runs_to_its_end(run_study, name, capsys):
    metrics, _ = run_study(name, **SMALLEST[name])
    assert metrics or (name in NEED_DATA and re.search(r"at hand|MICROSTEREO_DATA", capsys.readouterr().out))
    assert np.isfinite(list(metrics.values())).all() or name in MAY_LACK
