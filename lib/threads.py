"""Torch on one thread, where its threads cost more than they give."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["single_threaded_torch"]


@contextmanager
def single_threaded_torch() -> Iterator[None]:
    """Many small tensors: torch's own threads gain nothing here, and spin where the machine has other work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
