"""Where stereo frames come from: a recording as fast as it goes, a recording as if it were live, or anything iterable."""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from lib.correspondences import of_recording
from lib.recordings import Recording

_WAITING = 4  # frames at most, for a pause of the machine; when another comes, the oldest is lost


@dataclass(frozen=True, eq=False)
class Arrival:
    """A stereo frame as `OnlinePipeline.step` takes it, and its number in the recording that it is from."""

    left: np.ndarray
    right: np.ndarray
    kinematics: ArrayLike | Callable | None
    time_s: float
    arrived_s: float = float("nan")  # by `time.monotonic`, where frames do not wait for whoever takes them
    source: int = -1


def recorded(recording: Recording, n_frames: int | None = None) -> Iterator[Arrival]:
    """The frames of a recording, each when it is asked for.

    Anything else that yields `Arrival` will do as well.  A live camera, for example:

        cameras = cv2.VideoCapture(0), cv2.VideoCapture(1)
        while True:
            left, right = (cv2.cvtColor(camera.read()[1], cv2.COLOR_BGR2RGB) for camera in cameras)
            yield Arrival(left, right, robot.landmarks_mm(), time.monotonic())
    """
    for index in range(len(recording))[:n_frames]:
        frame = recording.frames[index]
        yield Arrival(frame.left, frame.right, partial(of_recording, recording, frames=[index]), frame.time_s, source=index)


class Live:
    """Any arrivals, each at its own time: who is busy then finds it in the queue, or among the `lost`, which are counted."""

    def __init__(self, arrivals: Iterator[Arrival]) -> None:
        self.lost, self._arrivals = 0, arrivals

    def __iter__(self) -> Iterator[Arrival]:
        ready, ended = queue.Queue(), threading.Event()
        threading.Thread(target=self._deliver, args=(ready, ended), daemon=True).start()
        try:
            while (arrival := ready.get()) is not None:
                if isinstance(arrival, Exception):
                    raise arrival
                yield arrival
        finally:
            ended.set()

    def _deliver(self, ready: queue.Queue, ended: threading.Event) -> None:
        start, last = None, None
        try:
            for arrival in self._arrivals:
                start = time.monotonic() - arrival.time_s if start is None else start
                due = start + arrival.time_s
                if ended.wait(max(due - time.monotonic(), 0.0)):
                    return
                while ready.qsize() >= _WAITING:
                    with suppress(queue.Empty):  # taken meanwhile
                        ready.get_nowait()
                        self.lost += 1
                ready.put(replace(arrival, arrived_s=max(due, time.monotonic())))  # on time, or as late as decoding was
        except Exception as error:  # told to whoever takes the frames
            last = error
        ready.put(last)
