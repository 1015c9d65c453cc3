"""What went in and what came out, in a folder: `input/` is a recording that can be given again, `frames.csv` the outputs."""

import csv
import queue
import shutil
import threading
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np

from lib.correspondences import LANDMARKS
from lib.online.feeds import Arrival
from lib.online.result import STAGES, FrameResult
from lib.recordings import Recording, encoded

_QUANTITIES = ("distance_mm", "distance_sd_mm", "normal_mm", "normal_sd_mm", "approach_mm_s", "too_close")


class Recorder:
    """Writes each frame as it comes, in a thread of its own; a full disk ends the recording and not the run.

    Args:
        folder: New, or empty.
        recording: Where the frames come from: its kinematics and clocks make `input/` a recording like it.
        patient: Wait for the disk; else frames are left out where it is too slow, and `left_out` counts them.

    `failure` says why the recording ended early, "" where it did not.  A `FileExistsError` if the folder holds something.
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
        self._queue: queue.Queue = queue.Queue(16)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def add(self, arrival: Arrival, result: FrameResult) -> None:
        """A frame and what was said about it."""
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
                told, spent, times = (csv.writer(file, lineterminator="\n") for file in files)
                told.writerow(row(FrameResult(0)))
                spent.writerow(["frame", *STAGES])
                times.writerow(["frame", "time_s"])
                while (item := self._queue.get()) is not None:
                    arrival, cells, seconds = item
                    self._write_images(arrival)
                    told.writerow(cells.values())
                    spent.writerow([cells["frame"], *seconds])
                    times.writerow([self._count, float(arrival.time_s)])
                    self._count += 1
        except OSError as error:
            self.failure = f"{self.folder}: the recording ended after {self._count} frames ({error})."
            while self._queue.get() is not None:  # nobody waits for a place
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
    """Column of frames.csv -> cell of a frame; numbers as Python writes them, so that equal text is an equal number.

    Times of stages stand in seconds.csv, so that a replay gives the same frames.csv, byte for byte.
    """
    numbers = {f"{name}_{what}": getattr(result, what)[k] for what in _QUANTITIES for k, name in enumerate(LANDMARKS)}
    for side, u in (("left", result.landmarks.u_left), ("right", result.landmarks.u_right)):
        numbers |= {f"{side}_{name}_{axis}_px": u[k, i] for k, name in enumerate(LANDMARKS) for i, axis in enumerate("xy")}
    numbers |= {f"rests_on_{name}_s": result.rests_on.get(name, np.nan) for name in ("landmarks", "robot", "rig", "surface")}
    numbers["drift"] = result.drift
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
