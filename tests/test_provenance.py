"""Provenance: what a result says of its origin."""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys

import numpy as np

from lib import paths
from lib.provenance import Provenance, commit, commit_id, machine, plain


def test_what_a_measurement_tells_of_its_origin():
    provenance = Provenance("python3 -m lib something")
    sum(k * k for k in range(300_000))
    told = provenance.so_far()
    assert set(told) == {"command", "commit", "machine", "weights", "date", "seconds", "cpu_seconds"}
    assert told["command"] == "python3 -m lib something" and told["date"] == datetime.date.today().isoformat()
    assert 0 < told["seconds"] < 60 and 0 <= told["cpu_seconds"] < 60


def test_cpu_seconds_count_finished_child_processes():
    provenance = Provenance("a study with workers")
    work = "import time\nwhile time.process_time() < 0.3: pass"
    subprocess.run([sys.executable, "-c", work], check=True)
    assert provenance.so_far()["cpu_seconds"] >= 0.25 or os.name == "nt"


def test_missing_numbers_become_null():
    value = {"a": float("nan"), "b": [np.float32(np.inf), (1, np.int64(2))], "c": np.array([[1.0, np.nan]])}
    value |= {"flag": np.bool_(True), "text": "x", "none": None}
    assert plain(value) == {"a": None, "b": [None, [1, 2]], "c": [[1.0, None]], "flag": True, "text": "x", "none": None}
    json.dumps(plain(value), allow_nan=False)
    assert plain(1.23456789e-9) == 1.23457e-9 and plain(123456789) == 123456789


def test_modified_means_code_and_not_results(tmp_path):
    def git(*words):
        subprocess.run(["git", "-C", tmp_path, "-c", "user.name=n", "-c", "user.email=e", *words], check=True)

    (tmp_path / "lib").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "lib" / "code.py").write_text("a = 1\n")
    (tmp_path / "data" / "results.csv").write_text("1\n")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    (tmp_path / "data" / "results.csv").write_text("2\n")
    assert commit(tmp_path)["modified"] is False
    (tmp_path / "lib" / "code.py").write_text("a = 2\n")
    assert commit(tmp_path)["modified"] is True


def test_the_commit_and_the_machine(tmp_path):
    assert commit(tmp_path) is None
    found = commit()
    assert commit_id() == (found["id"][:12] + ("+modified" if found["modified"] else "") if found else "unknown")
    here = machine()
    assert here["cores"] >= 1 and set(here) == {"system", "processor", "cores", "memory_gb", "gpu"}


def test_paths_are_shown_as_typed(tmp_path):
    assert paths.shown(paths.CACHE / "x") == os.path.join("data", "cache", "x")
    assert paths.shown(tmp_path) == str(tmp_path)
