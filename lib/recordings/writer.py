"""Writing a recording: the folder appears whole and valid, or not at all."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.recordings.annotations import Annotations, write_coco
from lib.recordings.recording import FORMAT, GLINT_COLUMNS, KINEMATICS_COLUMNS, TRUTH_COLUMNS, UNITS, Recording
from lib.recordings.tables import LANDMARKS, write_table, write_text

__all__ = ["RecordingWriter"]


class RecordingWriter:
    """Context manager that writes a recording beside its final place and moves it there when it is valid.

    ::

        with RecordingWriter("my_eye", name="my eye", fps=25.0, image_size_px=(1920, 1080)) as writer:
            for left, right in frames:
                writer.add(left, right)
            writer.kinematics(time_s, x_mm)

    Parameters
    ----------
    folder:
        Where the recording appears.  Files are written to ``folder.partial`` first.
    image_size_px:
        (width, height).
    suffix, jpeg_quality:
        ".jpg" or ".png", and the quality of a JPEG.
    details:
        Own notes (numbers and text), kept in ``[details]`` of recording.toml.
    overwrite:
        Replace a recording of that name.

    Raises
    ------
    FileExistsError
        If `folder` exists and `overwrite` is False.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        name: str,
        fps: float,
        image_size_px: tuple[int, int],
        description: str = "",
        readout_s: float = 0.0,
        offset_s: float = 0.0,
        robot_accuracy_mm: float = 0.010,
        details: Mapping[str, float | int | str] | None = None,
        suffix: str = ".jpg",
        jpeg_quality: int = 90,
        overwrite: bool = False,
    ) -> None:
        if suffix not in {".jpg", ".png"}:
            raise ValueError(f"suffix: '.jpg' or '.png', got {suffix!r}.")
        self.target = Path(folder)
        self.folder = self.target.with_name(self.target.name + ".partial")
        if self.target.exists() and not overwrite:
            raise FileExistsError(f"{self.target}: exists already; pass overwrite=True to replace it.")
        self.fps, self.image_size_px = float(fps), (int(image_size_px[0]), int(image_size_px[1]))
        self._suffix, self._quality = suffix, int(jpeg_quality)
        self._header = {
            "format": FORMAT,
            "name": name,
            "description": description,
            "fps": self.fps,
            "image_size_px": list(self.image_size_px),
            "skeleton": list(LANDMARKS),
            "robot_accuracy_mm": float(robot_accuracy_mm),
            "readout_s": float(readout_s),
            "offset_s": float(offset_s),
        }
        self._details = dict(details or {})
        self._time_s: list[float] = []
        self._kinematics: list[np.ndarray] = []
        self._annotations: Annotations | None = None

    def __enter__(self) -> RecordingWriter:
        shutil.rmtree(self.folder, ignore_errors=True)  # what a killed run left
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
        """truth/ of the unfinished recording, for further files of a simulator."""
        folder = self.folder / "truth"
        folder.mkdir(exist_ok=True)
        return folder

    def add(self, left: np.ndarray, right: np.ndarray, time_s: float | None = None) -> None:
        """Append a stereo pair, (h, w, 3) uint8 RGB each; `time_s` on the video clock, None = uniform at fps."""
        index = len(self._time_s)
        shape = (self.image_size_px[1], self.image_size_px[0], 3)
        options = [cv2.IMWRITE_JPEG_QUALITY, self._quality] if self._suffix == ".jpg" else []
        for side, image in (("left", left), ("right", right)):
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"{side}: expected {shape} uint8 RGB, got {image.shape} {image.dtype}.")
            ok, data = cv2.imencode(self._suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
            if not ok:
                raise ValueError(f"{side}: the image could not be encoded as {self._suffix}.")
            data.tofile(self.folder / side / f"{index:06d}{self._suffix}")
        self._time_s.append(index / self.fps if time_s is None else float(time_s))

    def kinematics(self, time_s: ArrayLike, x_mm: ArrayLike) -> None:
        """Append samples: robot times (m,) and landmarks (m, 3, 3) mm, NaN where a landmark was dropped."""
        time = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        x = np.asarray(x_mm, dtype=np.float64)
        if x.shape != (len(time), len(LANDMARKS), 3):
            raise ValueError(f"x_mm: expected ({len(time)}, 3, 3), got {x.shape}.")
        self._kinematics.append(np.column_stack([time, x.reshape(len(time), 9)]))

    def annotations(
        self,
        u_left: ArrayLike,
        u_right: ArrayLike,
        visibility_left: ArrayLike | None = None,
        visibility_right: ArrayLike | None = None,
    ) -> None:
        """Landmarks of all frames, (n, 3, 2) px each, NaN = not labelled; visibility (n, 3), None = all visible (2)."""
        sides = []
        for name, u, visibility in (("left", u_left, visibility_left), ("right", u_right, visibility_right)):
            u = np.asarray(u, dtype=np.float64)
            v = np.full(u.shape[:2], 2) if visibility is None else np.asarray(visibility)
            if u.ndim != 3 or u.shape[1:] != (len(LANDMARKS), 2) or v.shape != u.shape[:2]:
                raise ValueError(f"u_{name}: expected (n, 3, 2) with visibility (n, 3), got {u.shape} and {v.shape}.")
            sides.append((u, np.where(np.isfinite(u).all(axis=2), v, 0).astype(np.int64)))
        (u_l, v_l), (u_r, v_r) = sides
        self._annotations = Annotations(u_l, u_r, v_l, v_r)

    def truth(
        self,
        rig: StereoRig,
        landmarks_mm: ArrayLike,
        u_left: ArrayLike,
        u_right: ArrayLike,
        visibility_left: ArrayLike,
        visibility_right: ArrayLike,
        surface: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
        in_glint: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        """What the simulator knows; shapes as in `Truth`.

        Parameters
        ----------
        surface:
            (x_px (a,), y_px (b,), x_mm (b, a, 3)): surface points seen on a grid of left pixels.
        in_glint:
            (left, right), (n, 3) bool each: whether saturated light lies on the landmark or right beside it.
        """
        rig.save(self.truth_folder / "rig.json")
        x = np.asarray(landmarks_mm, dtype=np.float64)
        n = len(x)
        image = np.empty((n, len(LANDMARKS), 2, 3))
        for side, (u, visibility) in enumerate(((u_left, visibility_left), (u_right, visibility_right))):
            image[:, :, side, :2], image[:, :, side, 2] = u, visibility
        table = np.column_stack([np.arange(n), x.reshape(n, 9), image.reshape(n, 18)])
        names, decimals = TRUTH_COLUMNS, [0] + [7] * 9 + [5, 5, 0] * 6
        if in_glint is not None:
            glints = np.stack([np.asarray(side, dtype=bool) for side in in_glint], axis=-1)
            table = np.column_stack([table, glints.reshape(n, 6)])
            names, decimals = [*names, *GLINT_COLUMNS], decimals + [0] * 6
        write_table(self.truth_folder / "landmarks.csv", names, table, decimals)
        if surface is not None:
            x_px, y_px, x_mm = (np.asarray(values) for values in surface)
            np.savez_compressed(self.truth_folder / "surface.npz", x_px=x_px, y_px=y_px, x_mm=x_mm.astype(np.float32))

    def _finish(self) -> None:
        lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in self._header.items()]
        for table, values in (("units", UNITS), ("details", self._details)):
            lines += ["", f"[{table}]"] if values else []
            lines += [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in values.items()]
        write_text(self.folder / "recording.toml", "\n".join(lines) + "\n")
        time = np.array(self._time_s)
        if not np.allclose(time, np.arange(len(time)) / self.fps, rtol=0, atol=1e-7):
            table = np.column_stack([np.arange(len(time)), time])
            write_table(self.folder / "frames.csv", ["frame", "time_s"], table, [0, 7])
        if self._kinematics:
            table = np.vstack(self._kinematics)
            write_table(self.folder / "kinematics.csv", KINEMATICS_COLUMNS, table, [7] + [6] * 9)
        if self._annotations is not None:
            write_coco(self.folder / "annotations.json", self._annotations, self.image_size_px, self._suffix)
        Recording.open(self.folder)  # what is not valid must not appear
        if self.target.exists():
            shutil.rmtree(self.target)
        os.replace(self.folder, self.target)
