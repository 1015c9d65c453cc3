"""Surface reconstruction of stereo frames, also in a separate process, the newest frame first."""

import contextlib
import multiprocessing
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from lib.cameras import StereoRig
from lib.matching import RigMisfitError
from lib.online.distance import Surface
from lib.online.result import told
from lib.surface import Reconstruction, reconstruct

_STAGE_OF = {"mask": "match", "refine": "match"}  # part of a reconstruction -> stage, where the names differ


@dataclass(frozen=True, eq=False)
class SurfaceJob:
    """A stereo frame to reconstruct, and the arguments of `lib.surface.reconstruct`."""

    left: np.ndarray
    right: np.ndarray
    rig: StereoRig
    index: int
    time_s: float
    options: dict


def make(job: SurfaceJob, reconstruct: Callable[..., Reconstruction] = reconstruct) -> Surface:
    """The surface of a job, or the reason why there is none."""
    seconds: dict[str, float] = {}
    epipolar_px = float("nan")
    try:
        found, failures = reconstruct(job.left, job.right, job.rig, seconds=seconds, **job.options), {}
        epipolar_px = found.matches.epipolar_px
        found.surface.covariance(found.u[:1])  # factorises once, so that no frame waits for it
    except Exception as error:  # any error at all: the next frame may have a surface
        part = next(reversed(seconds), "match")
        found, failures = None, {_STAGE_OF.get(part, part): told(error)}
        epipolar_px = float("inf") if isinstance(error, RigMisfitError) else epipolar_px
    spent = Counter()
    for part, duration in seconds.items():
        spent[_STAGE_OF.get(part, part)] += duration
    return Surface(found, job.index, job.time_s, spent, failures, epipolar_px)


class Beside:
    """Makes surfaces in a separate process.  One job is in work and one waits; a newer job replaces the waiting one.

    If the process dies, it is started again.  A pipe passes jobs and results; the images are a tensor in shared memory.
    """

    def __init__(self) -> None:
        self.dropped, self._waiting, self._in_work, self._stale = 0, None, False, False
        self._images: torch.Tensor | None = None  # left and right of the job in work, in shared memory
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs,), daemon=True, name="surface worker")
        self._process.start()
        theirs.close()
        self._in_work = False

    def wait_ready(self) -> None:
        """Wait until the process has started, since starting takes CPU time from the frames."""
        self._pipe.poll(60.0)

    def submit(self, job: SurfaceJob) -> None:
        """Add a job; the one that was waiting is dropped."""
        self.dropped += self._waiting is not None
        self._waiting = job
        self._send()

    def _send(self) -> None:
        job = self._waiting
        if self._in_work or job is None:
            return
        shape = (2, *job.left.shape)
        if self._images is None or self._images.shape != shape:
            self._images = torch.empty(shape, dtype=torch.uint8).share_memory_()
        np.stack([job.left, job.right], out=self._images.numpy())
        with contextlib.suppress(OSError):  # a dead worker is found by `collect`
            self._pipe.send((self._images, replace(job, left=None, right=None)))
        self._waiting, self._in_work, self._stale = None, True, False

    def collect(self) -> tuple[list[Surface], str]:
        """The surfaces made since the last call, and a message if the process died, or ""; never waits."""
        done, event = [], ""
        with contextlib.suppress(EOFError, OSError):  # a dead worker is found below
            while self._pipe.poll():
                if (surface := self._pipe.recv()) is None:  # it has started
                    continue
                self._in_work = False
                if not self._stale:
                    done.append(surface)
        if not self._process.is_alive():
            event = f"the surface worker ended (exit code {self._process.exitcode}) and was started again"
            self._pipe.close()
            self._start()
        self._send()
        return done, event

    def forget(self) -> None:
        """Drop the waiting job and the one in work, since their rig is no longer trusted."""
        self.dropped += self._waiting is not None
        self._waiting, self._stale = None, True

    def close(self) -> None:
        """Kill the process, which holds nothing of value."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _work(pipe: multiprocessing.connection.Connection) -> None:
    """The loop of the process: jobs until the pipe is closed.  Its low priority leaves the CPU to the landmarks."""
    with contextlib.suppress(AttributeError, OSError):  # not every system has priorities
        os.nice(10)
    pipe.send(None)
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            images, job = pipe.recv()
            left, right = images.numpy()
            pipe.send(make(replace(job, left=left, right=right)))
