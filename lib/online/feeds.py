"""Sources of stereo frames: a recording as fast as possible, a recording in real time, or any iterable.

`Recorder` writes a run into a folder.
"""

import csv
import queue
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib.correspondences import LANDMARKS, of_recording
from lib.online.result import STAGES, FrameResult
from lib.recordings import Recording, encoded

_WAITING = 4  # most frames in the queue, enough for a pause of the machine; when another comes, the oldest is lost
_QUANTITIES = ("distance_mm", "distance_sd_mm", "normal_mm", "normal_sd_mm", "approach_mm_s", "too_close")


@dataclass(frozen=True, eq=False)
class Arrival:
    """A stereo frame with the arguments of `OnlinePipeline.step`, and its number in its recording."""

    left: np.ndarray
    right: np.ndarray
    kinematics: ArrayLike | Callable | None
    time_s: float
    arrived_s: float = float("nan")  # time of arrival by `time.monotonic`, if frames come in real time
    source: int = -1  # -1: of no recording


def recorded(recording: Recording, frames: Iterable[int] | None = None) -> Iterator[Arrival]:
    """The frames of a recording (None = all), each when it is asked for.

    Any other iterator of `Arrival` can take its place.  A live camera, for example:

        cameras = cv2.VideoCapture(0), cv2.VideoCapture(1)
        while True:
            left, right = (cv2.cvtColor(camera.read()[1], cv2.COLOR_BGR2RGB) for camera in cameras)
            yield Arrival(left, right, robot.landmarks_mm(), time.monotonic())
    """
    for index in range(len(recording)) if frames is None else frames:
        frame = recording.frames[index]
        yield Arrival(frame.left, frame.right, partial(of_recording, recording, frames=[index]), frame.time_s, source=index)


class Live:
    """Yields arrivals in real time, each at its own time, through a short queue; `lost` counts those that were missed."""

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
                    with suppress(queue.Empty):  # the consumer took it meanwhile
                        ready.get_nowait()
                        self.lost += 1
                ready.put(replace(arrival, arrived_s=max(due, time.monotonic())))  # on time, or as late as decoding was
        except Exception as error:  # raised again in the consumer
            last = error
        ready.put(last)


class Recorder:
    """Writes the input and the output of a run: `input/` is a recording that can be run again, `frames.csv` has the results.

    In `frames.csv` and `seconds.csv` frames have their numbers in `recording`; those of `input/` count from 0.
    Frames are written as they come, in a thread of their own.  A full disk ends the recording, but not the run.

    Args:
        folder: New, or empty.
        recording: The source of the frames; its kinematics and clocks are copied to `input/`.
        patient: Wait for a slow disk.  Otherwise frames for which it is too slow are left out, and `left_out` counts them.

    `failure` is the reason why the recording ended early, or "".  A `FileExistsError` if the folder is not empty.
    """

    def __init__(self, folder: str | Path, recording: Recording, *, patient: bool = True) -> None:
        self.folder, self.failure, self.left_out = Path(folder), "", 0
        if self.folder.exists() and any(self.folder.iterdir()):
            raise FileExistsError(f"{self.folder}: exists already and is not empty; choose another folder.")
        for side in ("left", "right"):
            (self.folder / "input" / side).mkdir(parents=True)
        for name in ("recording.toml", "kinematics.csv"):
            shutil.copyfile(recording.folder / name, self.folder / "input" / name)
        self._source, self._patient, self._count = recording.folder, patient, 0
        self._number: dict[int | None, int] = {}  # of each frame in its recording, by its index in the run
        self._queue: queue.Queue = queue.Queue(16)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def add(self, arrival: Arrival, result: FrameResult) -> None:
        """Record a frame and its result."""
        self._number[result.index] = arrival.source if arrival.source >= 0 else result.index
        surface = self._number.get(result.reconstructed_at)
        result = replace(result, index=self._number[result.index], reconstructed_at=surface)
        if not self.failure and not self._patient and self._queue.full():
            self.left_out += 1
        elif not self.failure:
            self._queue.put((arrival, row(result), [f"{result.seconds.get(stage, 0.0):.6f}" for stage in STAGES]))

    def close(self) -> None:
        """Wait until all is written."""
        self._queue.put(None)
        self._thread.join()

    def _work(self) -> None:
        try:
            with ExitStack() as stack:
                how = {"encoding": "utf-8", "newline": "", "buffering": 1}  # a line is in the file as soon as it is written
                paths = (self.folder / name for name in ("frames.csv", "seconds.csv", "input/frames.csv"))
                files = [stack.enter_context(path.open("w", **how)) for path in paths]
                results, spent, times = (csv.writer(file, lineterminator="\n") for file in files)
                results.writerow(row(FrameResult(0)))
                spent.writerow(["frame", *STAGES])
                times.writerow(["frame", "time_s"])
                while (item := self._queue.get()) is not None:
                    arrival, cells, seconds = item
                    self._write_images(arrival)
                    results.writerow(cells.values())
                    spent.writerow([cells["frame"], *seconds])
                    times.writerow([self._count, float(arrival.time_s)])
                    self._count += 1
        except Exception as error:  # stated in `failure`; `add` must not wait for a thread that has ended
            self.failure = f"{self.folder}: the recording ended after {self._count} frames ({error})."
            while self._queue.get() is not None:  # empty the queue, so that `add` never blocks
                pass

    def _write_images(self, arrival: Arrival) -> None:
        for side, image in (("left", arrival.left), ("right", arrival.right)):
            target = self.folder / "input" / side / f"{self._count:06d}"
            there = next((self._source / side).glob(f"{arrival.source:06d}.*"), None) if arrival.source >= 0 else None
            if there:
                shutil.copyfile(there, target.with_suffix(there.suffix))
            else:
                target.with_suffix(".png").write_bytes(encoded(np.asarray(image), ".png", cv2.IMWRITE_PNG_COMPRESSION, 1))


def row(result: FrameResult) -> dict[str, str]:
    """Column of frames.csv -> cell of a frame.  Numbers are written by `repr`, so that equal numbers give equal text.

    Times of stages are in seconds.csv, so that a replay gives the same frames.csv, byte for byte.
    """
    numbers = {f"{name}_{what}": getattr(result, what)[k] for what in _QUANTITIES for k, name in enumerate(LANDMARKS)}
    for side, u in (("left", result.landmarks.u_left), ("right", result.landmarks.u_right)):
        numbers |= {f"{side}_{name}_{axis}_px": u[k, i] for k, name in enumerate(LANDMARKS) for i, axis in enumerate("xy")}
    numbers |= {f"rests_on_{name}_s": result.rests_on.get(name, np.nan) for name in ("landmarks", "robot", "rig", "surface")}
    numbers |= {"working_distance_mm": result.working_distance_mm, "drift": result.drift}
    return {
        "frame": str(result.index), "time_s": repr(float(result.time_s)),
        "state": result.state, "cause": _plain(result.cause),
        **{name: "" if np.isnan(value) else repr(float(value)) for name, value in numbers.items()},
        "moved": result.motion.moved if result.motion else "",
        "surface_frame": "" if result.reconstructed_at is None else str(result.reconstructed_at),
        "failures": _plain("; ".join(f"{name}: {why}" for name, why in result.failures.items())),
    }  # fmt: skip


def _plain(text: str) -> str:
    return text.replace(",", ";").replace("\n", " ").replace('"', "'")
