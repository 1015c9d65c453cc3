"""Threads and processes: torch on one thread where more cost time, and work shared out over processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TypeVar

import cv2
import torch

__all__ = ["in_processes", "single_threaded_torch"]

_T = TypeVar("_T")


@contextmanager
def single_threaded_torch() -> Iterator[None]:
    """Many small tensors: torch's own threads gain nothing here, and spin where the machine has other work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def in_processes(function: Callable[..., _T], arguments: Iterable[tuple], workers: int | None = None) -> Iterator[_T]:
    """Results of ``function(*arguments[i])`` in the order in which they come, `workers` at a time (default: one a core).

    An error, or Ctrl-C, drops what has not begun and passes on.  `function` must be importable, not a closure.
    """
    jobs_arguments = list(arguments)
    if not jobs_arguments:
        return
    with ProcessPoolExecutor(min(workers or os.cpu_count() or 1, len(jobs_arguments)), initializer=_alone) as pool:
        jobs = [pool.submit(function, *a) for a in jobs_arguments]
        try:
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _alone() -> None:
    """A worker keeps to one core: the others have theirs."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
