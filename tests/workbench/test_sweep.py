"""A sweep: the grid, one row a run, what is kept, what fails, what is recorded."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lib import paths
from lib.__main__ import COMMANDS
from lib.provenance import commit
from lib.workbench import results
from lib.workbench import sweep as sweeping
from lib.workbench.execution import split_values
from lib.workbench.sweep import save_plots, sweep
from tests.processes import children

main = COMMANDS["sweep"]
PARAMETERS = """\
seed: int = 0  # of the noise; grid: 0, 1
distance_mm: float = 200.0  # to the eye; inf is an affine microscope; grid: 200, inf
method: str = "band"  # of matching
"""
STUDY = """\
from lib.workbench import report
assert not (seed == 1 and distance_mm == 200 and method == "band"), "bad luck"
report.record("depth_error", 10 * seed + (distance_mm == 200), "um", note=method)
"""


@pytest.fixture(scope="module")
def scheduler():
    """A scheduler with two workers in this process, which start at once."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, protocol="tcp://", dashboard_address=None) as it:
        yield it.scheduler_address


def read(table: Path) -> list[dict]:
    return list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))


def test_a_sweep_makes_a_table_and_goes_on(write_notebook, tmp_path, scheduler, monkeypatch):
    """Four runs, one of which fails; after the cause has gone, only that one runs."""
    (tmp_path / "studies").mkdir()
    book = write_notebook(tmp_path / "studies", "luck", STUDY, parameters=PARAMETERS)
    places = {"scheduler": scheduler, "runs": tmp_path / "runs", "notebooks": tmp_path, "recorded": tmp_path / "recorded"}
    monkeypatch.setattr(sweeping, "_code_digest", lambda book: "same")
    table, failures = sweep("studies/luck", record=True, **places)
    (point,) = failures
    assert point == "seed=1, distance_mm=200.0" and "error in cell 3: AssertionError: bad luck" in failures[point]
    (log,) = table.parent.glob("*.log")
    assert str(log) in failures[point] and "bad luck" in log.read_text(encoding="utf-8")
    assert read(table) == [
        {"seed": "0", "distance_mm": "200.0", "depth_error_um": "1"},
        {"seed": "0", "distance_mm": "inf", "depth_error_um": "0"},
        {"seed": "1", "distance_mm": "inf", "depth_error_um": "10"},
    ]
    assert not (tmp_path / "recorded").exists()  # a table with a hole is no record
    before = {file: file.stat().st_mtime_ns for file in table.parent.glob("*.ipynb") if "failed" not in file.name}
    book.write_text(book.read_text(encoding="utf-8").replace("assert not", "assert True or"), encoding="utf-8")
    table, failures = sweep("luck", record=True, **places)
    assert not failures and [row["depth_error_um"] for row in read(table)] == ["1", "0", "11", "10"]
    assert len(before) == 3 and all(file.stat().st_mtime_ns == time_ns for file, time_ns in before.items())
    assert {file.suffix for file in table.parent.iterdir()} == {".ipynb", ".csv", ".png"}
    recorded = results.read("luck", tmp_path / "recorded")
    np.testing.assert_array_equal(recorded.where(distance_mm=np.inf).columns["depth_error_um"], [0, 10])
    assert recorded.provenance["command"] == "python3 -m lib sweep luck -p seed 0,1 -p distance_mm 200,inf"
    assert recorded.provenance["runs"] == 4 and recorded.provenance["seconds"] > 0
    assert recorded.provenance["commit"] == commit() and recorded.provenance["machine"]["cores"] >= 1
    monkeypatch.setattr(sweeping, "run_point", None)  # nothing is left to run
    assert sweep("luck", **places) == (table, {})


def test_a_run_without_a_number_is_no_record_and_runs_again(write_notebook, tmp_path, scheduler, monkeypatch):
    """The data of a study may be at hand the next time."""
    data = tmp_path / "data"
    study = f"from pathlib import Path\nfrom lib.workbench import report\nif Path({str(data)!r}).exists():\n"
    study += '    report.record("depth_error", 1, "um", note="")'
    book = write_notebook(tmp_path, "absent", study, parameters="seed: int = 0  # of the noise; grid: 0, 1")
    places = {"scheduler": scheduler, "runs": tmp_path / "runs", "notebooks": tmp_path, "recorded": tmp_path / "recorded"}
    table, failures = sweep(str(book), **places)
    assert not failures and read(table) == [{"seed": "0"}, {"seed": "1"}]
    data.touch()
    kept = {file: file.stat().st_mtime_ns for file in table.parent.glob("*.ipynb")}
    table, failures = sweep(str(book), record=True, **places)
    assert not failures and [row["depth_error_um"] for row in read(table)] == ["1", "1"]
    assert all(file.stat().st_mtime_ns != time_ns for file, time_ns in kept.items())
    data.unlink()
    (table.parent / min(file.name for file in kept)).unlink()
    before = (tmp_path / "recorded" / "absent.csv").read_bytes()
    _, failures = sweep(str(book), record=True, **places)
    (why,) = failures.values()
    assert "stated no number" in why and (tmp_path / "recorded" / "absent.csv").read_bytes() == before


def test_the_digest_changes_with_notebook_and_code(write_notebook, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "ROOT", tmp_path)
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "code.py").write_text("a = 1")
    book = write_notebook(tmp_path, "study", "1")
    digests = [sweeping._code_digest(book)]
    (tmp_path / "lib" / "code.py").write_text("a = 2")
    digests.append(sweeping._code_digest(book))
    (tmp_path / "lib" / "template.html").write_text("a = 3")
    digests.append(sweeping._code_digest(book))
    (tmp_path / "lib" / "code.pyc").write_bytes(b"compiled")
    (tmp_path / "lib" / ".ipynb_checkpoints").mkdir()  # JupyterLab makes it
    assert sweeping._code_digest(book) == digests[-1]
    write_notebook(tmp_path, "study", "2")
    digests.append(sweeping._code_digest(book))
    assert len(set(digests)) == 4


def test_what_cannot_run_is_told_in_one_line(write_notebook, tmp_path, capsys):
    book = str(write_notebook(tmp_path, "study", "1"))
    for words, text in [
        (["nothing"], "unknown notebook: nothing"),
        ([book, "-p", "sede", "0,1"], "unknown parameter: sede"),
        ([book, "-p", "seed", "0,x"], "parameter seed: 'x' is not of type int"),
        ([book, "-p", "seed", ","], "values for each parameter"),
        ([book, "--runs", book], "study.ipynb"),
    ]:
        assert main([*words[:1], "--runs", str(tmp_path / "runs"), *words[1:]]) == 2
        said = capsys.readouterr().err
        assert text in said and said.count("\n") == 1, said
    for words in (["--cell-timeout", "nan"], ["--workers", "0"], ["--workers", "2", "--scheduler", "tcp://a:1"]):
        with pytest.raises(SystemExit):
            main([book, *words])
    with pytest.raises(ValueError, match="one notebook"):
        sweep(book, {"seed": []}, runs=tmp_path)


def test_values_are_split_outside_brackets():
    assert split_values(" 75, 300,inf") == ["75", "300", "inf"]
    assert split_values("[1, 2], [], (3, 4)") == ["[1, 2]", "[]", "(3, 4)"]


def test_plots(tmp_path):
    rows = [{"seed": s, "n": n, "method": m, "error_um": s + n, "name": "x", "none_px": np.nan}
            for s in (0, 1) for n in (75, 300) for m in ("a", "b")]  # fmt: skip
    save_plots(rows[:1], ["seed", "n", "method"], tmp_path)
    assert not list(tmp_path.iterdir())
    save_plots(rows, ["seed", "n", "method"], tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["error_um.png"]
    assert (tmp_path / "error_um.png").read_bytes().startswith(b"\x89PNG")
    save_plots([{"sizes": sizes, "depth_um": 1.0} for sizes in ([1, 2], [3])], ["sizes"], tmp_path)
    assert (tmp_path / "depth_um.png").is_file()


@pytest.mark.slow
def test_sixty_runs_outlive_a_killed_worker_and_an_external_cluster_agrees(write_notebook, tmp_path):
    """60 runs on two local workers, one killed with -9 halfway: 60 rows; again: nothing runs; `dask worker`: the same."""
    code = "from lib.workbench import report; report.record('depth_error', seed + noise_px, 'um')"
    book = write_notebook(tmp_path, "small", code)
    grid = ["-p", "seed", ",".join(map(str, range(30))), "-p", "noise_px", "0.5,1"]
    command = [sys.executable, "-m", "lib.workbench.sweep", str(book), *grid]
    command[1:3] = ["-c", "import sys; from lib.workbench.sweep import main; sys.exit(main(sys.argv[1:]))"]
    run = subprocess.Popen([*command, "--workers", "2", "--runs", str(tmp_path / "local")], stdout=subprocess.DEVNULL)

    def finished(runs: str) -> list[Path]:
        return [file for file in (tmp_path / runs).glob("sweeps/*/*.ipynb") if "." not in file.stem]

    while len(finished("local")) < 30:
        assert run.poll() is None
        time.sleep(0.1)
    workers = [pid for pid in children(run.pid) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(workers[-1], signal.SIGKILL)
    assert run.wait() == 0 and len(finished("local")) == 60
    (table,) = (tmp_path / "local").glob("sweeps/*/results.csv")
    assert len(read(table)) == 60
    before = {file: file.stat().st_mtime_ns for file in finished("local")}
    assert main([str(book), *grid, "--workers", "2", "--runs", str(tmp_path / "local")]) == 0
    assert {file: file.stat().st_mtime_ns for file in finished("local")} == before
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
            "--scheduler-file", str(tmp_path / "scheduler.json")]  # fmt: skip
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(tmp_path / "scheduler.json"),
              "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1", "--local-directory", str(tmp_path)]  # fmt: skip
    cluster = [subprocess.Popen(words, stderr=subprocess.DEVNULL) for words in (dask, worker, worker)]
    try:
        while not (tmp_path / "scheduler.json").exists():
            time.sleep(0.1)
        address = json.loads((tmp_path / "scheduler.json").read_text())["address"]
        assert main([str(book), *grid, "--scheduler", address, "--runs", str(tmp_path / "external")]) == 0
    finally:
        for process in cluster:
            process.terminate()
    assert len(finished("external")) == 60
    (external,) = (tmp_path / "external").glob("sweeps/*/results.csv")
    assert external.read_text() == table.read_text()
