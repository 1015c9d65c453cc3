"""Jobs on Dask: files once made are kept, lost workers cost nothing, errors are told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lib import files, parallel
from tests.processes import children


def test_jobs_survive_a_lost_worker_and_run_once(tmp_path):
    """One of two workers is killed with -9 after the first job; `files.write_text` is a job that any worker can import."""
    jobs = {tmp_path / f"{k}.txt": (f"job {k}",) for k in range(8)}
    (tmp_path / "0.txt").write_text("made before")
    before = set(children(os.getpid()))
    environment = dict(os.environ)
    finished = []
    for path, error in parallel.run_jobs(files.write_text, jobs, workers=2, progress=False):
        assert error is None
        if not finished and Path("/proc").exists():
            os.kill(max(set(children(os.getpid())) - before), signal.SIGKILL)
        finished.append(path.name)
    assert sorted(finished) == [f"{k}.txt" for k in range(1, 8)]  # the one that was there is not made again
    assert (tmp_path / "0.txt").read_text() == "made before" and (tmp_path / "7.txt").read_text() == "job 7"
    assert dict(os.environ) == environment
    start = time.perf_counter()
    assert list(parallel.run_jobs(files.write_text, jobs, workers=2, progress=False)) == []
    assert time.perf_counter() - start < 0.1  # no cluster is started for nothing


def test_a_script_without_a_main_guard_is_told_what_to_write(tmp_path):
    script, made = tmp_path / "script.py", tmp_path / "made"
    script.write_text(
        "import sys\nfrom pathlib import Path\nfrom lib.parallel import run_jobs\n"
        "list(run_jobs(Path.touch, {Path(sys.argv[1]): ()}, progress=False))\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(parallel.__file__).parents[1])}
    ended = subprocess.run([sys.executable, script, made], capture_output=True, text=True, env=environment)
    assert ended.stderr.count("Traceback") == 1
    assert 'under `if __name__ == "__main__":`' in ended.stderr.splitlines()[-1]
    assert not made.exists()


@pytest.fixture(scope="module")
def scheduler():
    """A scheduler and a worker in this process, as `dask scheduler` and `dask worker` would be."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, protocol="tcp://", dashboard_address=None) as it:
        yield it.scheduler_address


def test_errors_stay_with_their_job(tmp_path, scheduler):
    jobs = {tmp_path / "gone" / "a.txt": ("no such folder",), tmp_path / "b.txt": ("fine",)}
    ends = {path.name: error for path, error in parallel.run_jobs(files.write_text, jobs, scheduler=scheduler)}
    assert ends["b.txt"] is None and isinstance(ends["a.txt"], FileNotFoundError)


def test_no_scheduler_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "ANSWER_S", 0.2)
    with pytest.raises(ConnectionError, match=r"tcp://127\.0\.0\.1:1: no Dask scheduler answers"):
        list(parallel.run_jobs(files.write_text, {tmp_path / "a": ("",)}, scheduler="tcp://127.0.0.1:1"))


def test_no_workers_are_refused(tmp_path):
    with pytest.raises(ValueError, match="workers: at least 1"):
        next(parallel.run_jobs(print, {tmp_path / "a": ()}, workers=-1))
