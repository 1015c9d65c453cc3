"""Writing a recording: the folder appears whole and valid, or not at all."""

import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib.correspondences import LANDMARKS
from lib.files import write_bytes, write_text
from lib.recordings.annotations import Annotations, write_coco
from lib.recordings.recording import FORMAT, UNITS, Recording, kinematics_columns
from lib.recordings.tables import toml, write_table


class RecordingWriter:
    """Context manager that writes a recording beside its final place and moves it there when it is valid.

    `python3 -m lib check FOLDER` then says whether it is fit for use.

    Args:
        folder: Where the recording appears.  Until then its files lie beside it, in a folder ending with ``.partial``.
        image_size_px: (width, height).
        skeleton: Names of the landmarks.
        details: Own notes (numbers and text), kept in ``[details]`` of recording.toml.
        suffix, jpeg_quality: ".jpg" or ".png", and the quality of a JPEG.
        overwrite: Replace a recording of that name.  A folder that is no recording is never replaced.

    Raises:
        FileExistsError: If `folder` exists and `overwrite` is False, or if it is not a recording.

    >>> import tempfile
    >>> tool_mm = np.array([[0, 0, 0], [4, 1, 0], [4, -1, 0]])
    >>> image = np.zeros((48, 64, 3), np.uint8)
    >>> with RecordingWriter(tempfile.mkdtemp() + "/mine", name="mine", fps=25, image_size_px=(64, 48)) as writer:
    ...     writer.add(image, image)
    ...     writer.kinematics([0.0, 1.0], [tool_mm, tool_mm])
    >>> len(Recording.open(writer.target))
    1
    """

    def __init__(
        self, folder: str | Path, *, name: str, fps: float, image_size_px: tuple[int, int], description: str = "",
        readout_s: float = 0.0, offset_s: float = 0.0, robot_accuracy_mm: float = 0.010,
        skeleton: Sequence[str] = LANDMARKS, details: Mapping[str, float | int | str] | None = None,
        suffix: str = ".jpg", jpeg_quality: int = 90, overwrite: bool = False,
    ) -> None:  # fmt: skip
        if suffix not in {".jpg", ".png"}:
            raise ValueError(f"suffix: '.jpg' or '.png', got {suffix!r}.")
        self.target, self._overwrite = Path(folder), overwrite
        self._check_target()
        self.folder = self.target.with_name(f"{self.target.name}.{os.getpid()}-{os.urandom(3).hex()}.partial")
        self.fps, self.image_size_px = float(fps), (int(image_size_px[0]), int(image_size_px[1]))
        self._suffix, self._options = suffix, [cv2.IMWRITE_JPEG_QUALITY, int(jpeg_quality)] if suffix == ".jpg" else []
        self._header = {"format": FORMAT, "name": name, "description": description, "fps": self.fps}
        self._header |= {"image_size_px": list(self.image_size_px), "skeleton": list(skeleton)}
        times = {"readout_s": float(readout_s), "offset_s": float(offset_s)}
        self._header |= {"robot_accuracy_mm": float(robot_accuracy_mm), **times}
        self._details = dict(details or {})
        self._time_s: list[float] = []
        self._kinematics: list[np.ndarray] = []
        self._annotations: Annotations | None = None

    def _check_target(self) -> None:
        if self.target.exists() and not self._overwrite:
            raise FileExistsError(f"{self.target}: exists already; pass overwrite=True to replace it.")
        if self.target.exists() and not (self.target / "recording.toml").is_file():
            raise FileExistsError(f"{self.target}: is not a recording and is left alone; choose another name.")

    def __enter__(self) -> Self:
        for side in ("left", "right"):
            (self.folder / side).mkdir(parents=True)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def truth_folder(self) -> Path:
        """truth/ of the unfinished recording, for `lib.recordings.Truth` and what else a simulator knows."""
        folder = self.folder / "truth"
        folder.mkdir(exist_ok=True)
        return folder

    def add(self, left: np.ndarray, right: np.ndarray, time_s: float | None = None) -> None:
        """Append a stereo pair, (h, w, 3) uint8 RGB each; `time_s` on the video clock, None = uniform at fps."""
        index = len(self._time_s)
        shape = (self.image_size_px[1], self.image_size_px[0], 3)
        for side, image in (("left", left), ("right", right)):
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"{side}: expected {shape} uint8 RGB, got {image.shape} {image.dtype}.")
            data = cv2.imencode(self._suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), self._options)[1]
            write_bytes(self.folder / side / f"{index:06d}{self._suffix}", data.tobytes())
        self._time_s.append(index / self.fps if time_s is None else float(time_s))

    def kinematics(self, time_s: ArrayLike, x_mm: ArrayLike) -> None:
        """Append samples: robot times (m,) and landmarks (m, k, 3) mm, NaN where a landmark was dropped."""
        time, x = np.array(time_s, np.float64, ndmin=1), np.asarray(x_mm, np.float64)
        k = len(self._header["skeleton"])
        if x.shape != (len(time), k, 3):
            raise ValueError(f"x_mm: expected ({len(time)}, {k}, 3), got {x.shape}.")
        self._kinematics.append(np.column_stack([time, x.reshape(len(time), 3 * k)]))

    def annotations(self, *u_and_visibility: ArrayLike) -> None:
        """Landmarks of all frames: `u_left`, `u_right` and their visibility, as in `Annotations`."""
        self._annotations = Annotations(*u_and_visibility)

    def draft(self, offset_s: float | None = None) -> Recording:
        """The recording as it is so far, valid or a ValueError; it lies in a folder that is removed if anything fails.

        `offset_s` replaces what was given, where a first draft was needed to find it.
        """
        if offset_s is not None:
            self._header["offset_s"] = float(offset_s)
        lines = [_toml(key, value) for key, value in self._header.items()]
        for table, values in (("units", UNITS), ("details", self._details)):
            lines += ["", f"[{table}]"] if values else []
            lines += [_toml(key, value) for key, value in values.items()]
        write_text(self.folder / "recording.toml", "\n".join(lines) + "\n")
        time = np.array(self._time_s)
        if not np.allclose(time, np.arange(len(time)) / self.fps, rtol=0, atol=1e-7):
            table = np.column_stack([np.arange(len(time)), time])
            write_table(self.folder / "frames.csv", ["frame", "time_s"], table, [0, 7])
        if self._kinematics:
            table = np.vstack(self._kinematics)
            names = kinematics_columns(self._header["skeleton"])
            write_table(self.folder / "kinematics.csv", names, table, [7] + [6] * (len(names) - 1))
        if self._annotations is not None:
            path, names = self.folder / "annotations.json", self._header["skeleton"]
            write_coco(path, self._annotations, self.image_size_px, self._suffix, names)
        return Recording.open(self.folder)

    def _finish(self) -> None:
        self.draft()  # what is not valid must not appear
        self._check_target()
        old = self.folder.with_suffix(".replaced")
        if self.target.exists():
            os.replace(self.target, old)
        try:
            os.replace(self.folder, self.target)
        except OSError:
            os.replace(old, self.target)
            raise
        shutil.rmtree(old, ignore_errors=True)


def _toml(key: str, value: object) -> str:
    key = key if re.fullmatch(r"[\w-]+", key, re.ASCII) else json.dumps(key)
    return f"{key} = {toml(value)}"
