"""Threads and processes: torch on one thread where more cost time, and work shared out over processes."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

import cv2
import torch

__all__ = ["in_processes", "single_threaded_torch", "step"]

_T = TypeVar("_T")
_steps = None  # in a worker: the queue to the process that waits


@contextmanager
def single_threaded_torch() -> Iterator[None]:
    """Many small tensors: torch's own threads gain nothing here, and spin where the machine has other work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def in_processes(
    function: Callable[..., _T],
    arguments: Iterable[tuple],
    workers: int | None = None,
    *,
    on_step: Callable[[], object] | None = None,
) -> Iterator[_T]:
    """Results of ``function(*arguments[i])`` in the order in which they come, `workers` at a time (default: one a core).

    An error, or Ctrl-C, drops what has not begun and passes on; workers whose parent is killed end too.  `function`
    must be importable, not a closure.

    Parameters
    ----------
    on_step:
        Called here, in a thread of its own, whenever a worker calls `step`: progress within a job.

    Raises
    ------
    ChildProcessError
        If a worker was killed.
    """
    jobs_arguments = list(arguments)
    if not jobs_arguments:
        return
    # A fresh interpreter each: a fork of a program with threads (torch, OpenVINO) can wait for ever for one of their locks.
    context = multiprocessing.get_context("spawn")
    steps = context.SimpleQueue()
    listener = threading.Thread(target=_listen, args=(steps, on_step), daemon=True)
    listener.start()
    workers = min(workers or os.cpu_count() or 1, len(jobs_arguments))
    try:
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(steps,)) as pool:
            jobs = [pool.submit(function, *a) for a in jobs_arguments]
            try:
                for job in as_completed(jobs):
                    yield job.result()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "A worker was killed, perhaps for want of memory; try fewer at a time (workers)."
        ) from error
    finally:
        # A worker that was killed while it told a step still holds the queue: then there is nobody to wake.
        threading.Thread(target=steps.put, args=(False,), daemon=True).start()
        listener.join(timeout=2.0)


def step() -> None:
    """In a worker of `in_processes`: a part of the job is done."""
    if _steps is not None:
        _steps.put(True)


def _listen(steps: multiprocessing.SimpleQueue, on_step: Callable[[], object] | None) -> None:
    while steps.get():
        if on_step is not None:
            on_step()


def _begin(steps: multiprocessing.SimpleQueue) -> None:
    """A worker keeps to one core: the others have theirs."""
    global _steps
    _steps = steps
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A killed parent cannot stop its workers: they would write beside those of the next run, or wait for ever."""
    multiprocessing.parent_process().join()
    os._exit(1)
