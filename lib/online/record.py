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

__all__ = ["Recorder"]

_SOURCES = ("landmarks", "robot", "rig", "surface")
_QUANTITIES = ("distance_mm", "distance_sd_mm", "normal_mm", "normal_sd_mm", "approach_mm_s")
#: Of frames.csv.  Times of stages stand in seconds.csv, so that a replay gives the same frames.csv, byte for byte.
COLUMNS = [
    "frame", "time_s", "state", "cause", *(f"{name}_{what}" for what in _QUANTITIES for name in LANDMARKS),
    *(f"{name}_too_close" for name in LANDMARKS),
    *(f"{side}_{name}_{axis}_px" for side in ("left", "right") for name in LANDMARKS for axis in "xy"),
    *(f"rests_on_{source}_s" for source in _SOURCES), "drift", "moved", "surface_frame", "failures",
]  # fmt: skip


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
            heads = COLUMNS, ["frame", *STAGES], ["frame", "time_s"]
            files = [path.open("w", encoding="utf-8", newline="\n") for path in paths]
            try:
                for file, head in zip(files, heads, strict=True):
                    file.write(",".join(head) + "\n")
                while (item := self._queue.get()) is not None:
                    arrival, cells, seconds = item
                    self._write_images(arrival)
                    files[0].write(",".join(cells) + "\n")
                    files[1].write(",".join([cells[0], *(f"{value:.6f}" for value in seconds)]) + "\n")
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


def row(result: FrameResult) -> list[str]:
    """The cells of a frame in frames.csv; numbers as Python writes them, so that equal text is an equal number."""
    numbers = [
        *(value for what in _QUANTITIES for value in getattr(result, what)),
        *result.too_close.astype(float),
        *np.stack([result.landmarks.u_left, result.landmarks.u_right]).ravel(),
        *(result.rests_on.get(source, np.nan) for source in _SOURCES),
        result.drift,
    ]
    failures = "; ".join(f"{name}: {why}" for name, why in result.failures.items())
    surface = "" if result.reconstructed_at is None else str(result.reconstructed_at)
    return [
        str(result.index), repr(float(result.time_s)), result.state, _plain(result.cause),
        *("" if np.isnan(value) else repr(float(value)) for value in numbers),
        result.motion.moved if result.motion else "", surface, _plain(failures),
    ]  # fmt: skip


def _plain(text: str) -> str:
    return text.replace(",", ";").replace("\n", " ").replace('"', "'")
