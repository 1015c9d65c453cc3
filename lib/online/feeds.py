"""Where stereo frames come from: a recording as fast as it goes, a recording as if it were live, or anything iterable."""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from lib.correspondences import of_recording
from lib.recordings import Recording

__all__ = ["Arrival", "Live", "recorded"]


@dataclass(frozen=True, eq=False)
class Arrival:
    """A stereo frame as `OnlinePipeline.step` takes it.

    Attributes:
        left, right, kinematics, time_s: As there.
        arrived_s: `time.monotonic` when it came; NaN where frames wait for whoever takes them.
        source: Number of the frame in its recording.
    """

    left: np.ndarray
    right: np.ndarray
    kinematics: ArrayLike | Callable | None
    time_s: float
    arrived_s: float = float("nan")
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
    """Any arrivals, each at its own time: who is busy then finds it in the queue, or lost.

    Args:
        arrivals: Decoded ahead, in a thread.
        waiting: Frames that wait at most; when another comes, the oldest is lost.

    Attributes:
        lost: Frames lost so far.
    """

    def __init__(self, arrivals: Iterator[Arrival], *, waiting: int = 2) -> None:
        self.lost, self._waiting = 0, waiting
        self._arrivals, self._ended = arrivals, threading.Event()

    def __iter__(self) -> Iterator[Arrival]:
        ahead: queue.Queue = queue.Queue(8)
        ready: queue.Queue = queue.Queue()
        threads = [threading.Thread(target=work, daemon=True) for work in
                   (partial(self._decode, ahead), partial(self._deliver, ahead, ready))]  # fmt: skip
        try:
            for thread in threads:
                thread.start()
            while (arrival := ready.get()) is not None:
                if isinstance(arrival, Exception):
                    raise arrival
                yield arrival
        finally:
            self._ended.set()

    def _decode(self, ahead: queue.Queue) -> None:
        last: Arrival | Exception | None = None
        try:
            for arrival in self._arrivals:
                self._put(ahead, arrival)
                if self._ended.is_set():
                    return
        except Exception as error:  # told to whoever takes the frames
            last = error
        self._put(ahead, last)

    def _put(self, ahead: queue.Queue, item: object) -> None:
        while not self._ended.is_set():
            try:
                return ahead.put(item, timeout=0.1)
            except queue.Full:
                continue

    def _deliver(self, ahead: queue.Queue, ready: queue.Queue) -> None:
        start = None
        while not self._ended.is_set():
            arrival = ahead.get()
            if isinstance(arrival, Arrival):
                start = time.monotonic() - arrival.time_s if start is None else start
                due = start + arrival.time_s
                if self._ended.wait(max(due - time.monotonic(), 0.0)):
                    return
                # On time, or as late as decoding was.
                arrival = Arrival(**{**vars(arrival), "arrived_s": max(due, time.monotonic())})
                while ready.qsize() >= self._waiting:
                    ready.get()
                    self.lost += 1
            ready.put(arrival)
            if not isinstance(arrival, Arrival):
                return
