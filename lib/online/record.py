"""What went in and what came out, in a folder: `input/` is a recording that can be given again, `frames.csv` the outputs."""

import queue
import shutil
import threading
from pathlib import Path

import cv2
import numpy as np

from lib.correspondences import LANDMARKS
from lib.online.feeds import Arrival
from lib.online.result import STAGES, FrameResult
from lib.recordings import Recording

_QUANTITIES = ("distance_mm", "distance_sd_mm", "normal_mm", "normal_sd_mm", "approach_mm_s", "too_close")


class Recorder:
    """Writes each frame as it comes, in a thread of its own; a full disk ends the recording and not the run.

    Args:
        folder: New, or empty.
        recording: Where the frames come from: its kinematics and clocks make `input/` a recording like it.
        patient: Wait for the disk; else images are left out where it is too slow (`left_out`).

    Attributes:
        failure: Why the recording ended early, "" where it did not.

    Raises:
        FileExistsError: If the folder holds something.
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
        if self.failure:
            return
        if not self._patient and self._queue.full():
            self.left_out += 1
            return
        self._queue.put((arrival, row(result), [result.seconds.get(stage, 0.0) for stage in STAGES]))

    def close(self) -> None:
        """Wait until all is written."""
        self._queue.put(None)
        self._thread.join()

    def _work(self) -> None:
        try:
            paths = [self.folder / "frames.csv", self.folder / "seconds.csv", self.folder / "input" / "frames.csv"]
            heads = row(FrameResult(0)), ["frame", *STAGES], ["frame", "time_s"]
            files = [path.open("w", encoding="utf-8", newline="\n") for path in paths]
            try:
                for file, head in zip(files, heads, strict=True):
                    file.write(",".join(head) + "\n")
                while (item := self._queue.get()) is not None:
                    arrival, cells, seconds = item
                    self._write_images(arrival)
                    files[0].write(",".join(cells.values()) + "\n")
                    files[1].write(",".join([cells["frame"], *(f"{value:.6f}" for value in seconds)]) + "\n")
                    files[2].write(f"{self._count},{float(arrival.time_s)!r}\n")
                    self._count += 1
                    for file in files:
                        file.flush()
            finally:
                for file in files:
                    file.close()
        except OSError as error:
            self.failure = f"{self.folder}: the recording ended after {self._count} frames ({error})."
            while self._queue.get() is not None:  # nobody waits for a place
                pass

    def _write_images(self, arrival: Arrival) -> None:
        for side, image in (("left", arrival.left), ("right", arrival.right)):
            target = self.folder / "input" / side / f"{self._count:06d}"
            there = [p for p in (self._source / side).glob(f"{arrival.source:06d}.*") if arrival.source >= 0]
            if there:
                shutil.copyfile(there[0], target.with_suffix(there[0].suffix))
            else:
                flat = [cv2.IMWRITE_PNG_COMPRESSION, 1]
                data = cv2.imencode(".png", cv2.cvtColor(np.asarray(image), cv2.COLOR_RGB2BGR), flat)[1]
                target.with_suffix(".png").write_bytes(data.tobytes())


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
