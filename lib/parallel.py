"""Many jobs on a Dask cluster: the cores of this machine, or any cluster whose scheduler is given.

Each job makes one file or folder.  Existing ones are not made again, so stopped work continues where it was.
"""

import contextlib
import logging
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path

from threadpoolctl import ThreadpoolController
from tqdm.auto import tqdm

#: Time within which a scheduler must answer, seconds.
ANSWER_S = 15.0
_loaded_libraries = cache(ThreadpoolController)


def run_jobs(
    function: Callable[..., object], jobs: Mapping[Path, tuple], *, workers: int | None = None,
    scheduler: str | None = None, title: str = "", unit: str = "job", progress: bool = True,
) -> Iterator[tuple[Path, BaseException | None]]:  # fmt: skip
    """Call ``function(path, *jobs[path])`` for every path that does not exist; yield each path with its error or None.

    If a worker is killed, its job is given to another one, at most three times.  Closing the iterator drops waiting jobs.

    Args:
        function: Importable (not a closure).  It makes `path` completely or not at all, as `lib.files.whole` does.
        workers: Number of processes on this machine, at most one for each job; None is one for each core.
        scheduler: Address of a running Dask scheduler, such as ``"tcp://10.0.0.1:8786"``, instead of processes on this
            machine.  Its workers need this environment and the same folders.  If it does not answer: ConnectionError.
        title, unit, progress: Text and unit of the progress bar; False shows no bar.
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers: at least 1 is needed, got {workers}.")
    missing = {path: arguments for path, arguments in jobs.items() if not path.exists()}
    known = {"total": len(jobs), "initial": len(jobs) - len(missing), "desc": title, "unit": unit}
    with tqdm(**known, disable=not progress, smoothing=0.1) as bar:
        if not missing:
            return
        if getattr(multiprocessing.current_process(), "_inheriting", False):  # a worker that imports an unguarded script
            raise SystemExit(1)
        from distributed import KilledWorker, as_completed

        with _client(min(workers or cores(), len(missing)), scheduler) as client:
            futures = {client.submit(_work, function, path, *missing[path], pure=False): path for path in missing}
            try:
                for future in as_completed(futures):
                    error = future.exception() if future.status == "error" else None
                    if isinstance(error, KilledWorker):
                        error = ChildProcessError("its workers were killed again and again, perhaps for lack of memory.")
                    if future.status == "cancelled":
                        error = ConnectionError("the scheduler was lost.")
                    bar.update()
                    yield futures[future], error
            finally:
                with contextlib.suppress(Exception):  # the scheduler may be gone
                    client.cancel(list(futures))


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lives(pid: int) -> bool:
    """True if a process of this machine runs; a zombie, which has ended, does not."""
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    return False


@contextlib.contextmanager
def single_threaded_torch() -> Iterator[None]:
    """Run the block with a single torch thread: for many small tensors more threads only waste time."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextlib.contextmanager
def quick_turns() -> Iterator[None]:
    """Run the block, or the decorated function, with Python's threads taking turns every 0.1 ms in place of 5 ms.

    After each operation outside the interpreter, such as one of numpy, a thread may have to wait for its turn.

    >>> with quick_turns():
    ...     round(sys.getswitchinterval(), 6)
    0.0001
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextlib.contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Run the block, or the decorated function, with a single thread for numpy's and scipy's linear algebra.

    For many small matrices more threads gain nothing, and on busy cores they wait for each other.  The limit applies to the
    whole process: if blocks in several threads overlap, it may stay set.
    """
    with _loaded_libraries().limit(limits=1, user_api="blas"):
        yield


def _work(function: Callable, path: Path, *arguments: object) -> None:
    """Run a job in a worker.  The path may exist already, if an earlier attempt was lost just after it had finished."""
    if not path.exists():
        function(path, *arguments)


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None):
    """A client of the given scheduler, or of processes on this machine that end with the block."""
    from unittest.mock import patch

    import dask
    from distributed import Client, LocalCluster

    if scheduler:
        try:
            client = Client(scheduler, timeout=ANSWER_S)
        except (OSError, ValueError) as error:  # also a timeout
            raise ConnectionError(f"{scheduler}: no Dask scheduler answers ({error or type(error).__name__}).") from None
        with client:
            if not client.scheduler_info()["workers"]:
                print(f"{scheduler} has no workers yet; waiting for the first.", file=sys.stderr)
            yield client
        return
    threads = max(1, cores() // workers)  # libraries read these when a worker, or its notebook's kernel, starts
    libraries = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    settings = {
        "distributed.nanny.pre-spawn-environ": dict.fromkeys(libraries, threads),
        "distributed.worker.profile.enabled": False, "logging": {"distributed": "critical"},
    }  # fmt: skip
    with patch.dict(os.environ), dask.config.set(settings):  # Dask sets the limits in this process too
        try:
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=None, silence_logs=logging.CRITICAL,
                dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},
            )  # fmt: skip
        except RuntimeError as error:
            need = 'Each imports your script: put the code that it runs under `if __name__ == "__main__":`.'
            raise RuntimeError(f"The worker processes did not start ({error}). {need}") from None
        with cluster, Client(cluster) as client:
            yield client
