"""Provenance: what a record says of its origin, and that records are written whole."""

from __future__ import annotations

import datetime
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lib import files, paths
from lib.provenance import Provenance, commit, commit_id, machine, plain, read_records, write_record

ENTRIES = {"result", "command", "commit", "machine", "date", "seconds", "cpu_seconds"}


def test_a_record_has_its_circumstances(tmp_path):
    path = tmp_path / "results" / "some.json"
    provenance = Provenance("python3 -m lib something")
    sum(k * k for k in range(300_000))
    written = write_record(
        path, "first", {"rms_um": np.float64(12.34567891)}, provenance, budget={"steps": 3}, threads=1
    )
    assert read_records(path) == {"first": written}
    assert set(written) == ENTRIES | {"budget", "threads"}
    assert written["result"] == {"rms_um": 12.3457} and written["budget"] == {"steps": 3}
    assert written["command"] == "python3 -m lib something" and written["date"] == datetime.date.today().isoformat()
    assert 0 < written["seconds"] < 60 and 0 <= written["cpu_seconds"] < 60
    assert set(write_record(path, "second", {}, provenance)) == ENTRIES
    assert [file.name for file in path.parent.iterdir()] == ["some.json"]


def test_cpu_seconds_count_finished_child_processes(tmp_path):
    provenance = Provenance("a study with workers")
    work = "import time\nwhile time.process_time() < 0.3: pass"
    subprocess.run([sys.executable, "-c", work], check=True)
    record = write_record(tmp_path / "r.json", "study", {}, provenance)
    assert record["cpu_seconds"] >= 0.3 or os.name == "nt"


def test_what_another_study_wrote_meanwhile_is_kept(tmp_path):
    path = tmp_path / "r.json"
    provenance = Provenance("slow")
    write_record(path, "quick", {"n": 1}, Provenance("quick"))
    write_record(path, "slow", {"n": 2}, provenance)
    write_record(path, "slow", {"n": 3}, provenance)
    assert {name: record["result"]["n"] for name, record in read_records(path).items()} == {"quick": 1, "slow": 3}


@pytest.mark.parametrize("where", ["write", "rename"])
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, where):
    path = tmp_path / "r.json"
    write_record(path, "study", {"n": 1}, Provenance("before"))
    before = path.read_bytes()

    def full_disk(file, data):
        file.write_text("torn")
        raise OSError(errno.ENOSPC, "No space left on device")

    def interrupted(*_):
        raise KeyboardInterrupt

    if where == "write":
        monkeypatch.setattr(Path, "write_bytes", full_disk)
    else:
        monkeypatch.setattr(files.os, "replace", interrupted)
    with pytest.raises((OSError, KeyboardInterrupt)):
        write_record(path, "study", {"n": 2}, Provenance("after"))
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["r.json"]


def test_what_json_cannot_hold_leaves_the_old_file(tmp_path):
    path = tmp_path / "r.json"
    write_record(path, "study", {"n": 1}, Provenance("before"))
    with pytest.raises(TypeError, match="not JSON serializable"):
        write_record(path, "study", {"n": object()}, Provenance("after"))
    assert read_records(path)["study"]["result"] == {"n": 1}


def test_missing_numbers_become_null():
    value = {"a": float("nan"), "b": [np.float32(np.inf), (1, np.int64(2))], "c": np.array([[1.0, np.nan]])}
    value |= {"flag": np.bool_(True), "text": "x", "none": None}
    assert plain(value) == {"a": None, "b": [None, [1, 2]], "c": [[1.0, None]], "flag": True, "text": "x", "none": None}
    json.dumps(plain(value), allow_nan=False)
    assert plain(1.23456789e-9) == 1.23457e-9 and plain(123456789) == 123456789


def test_reading_nothing_and_something_broken(tmp_path):
    assert read_records(tmp_path / "none.json") == {}
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(ValueError, match=r"broken\.json: no JSON .*restore or delete"):
        read_records(tmp_path / "broken.json")


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


@pytest.mark.parametrize("path", sorted(paths.RESULTS.glob("*.json")), ids=lambda path: path.stem)
def test_recorded_files_have_one_layout(path):
    for name, record in read_records(path).items():
        assert {"result", "command", "commit", "machine", "date"} <= set(record), name


def test_paths_are_shown_as_typed(tmp_path):
    assert paths.shown(paths.CACHE / "x") == os.path.join("data", "cache", "x")
    assert paths.shown(tmp_path) == str(tmp_path)
