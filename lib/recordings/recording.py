"""Reading a recording: everything is validated when it is opened, frames are decoded when asked for."""

from __future__ import annotations

import math
import tomllib
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator

from lib.cameras import StereoRig
from lib.geometry import points
from lib.recordings.annotations import Annotations, read_coco
from lib.recordings.frames import Frames, open_side
from lib.recordings.tables import LANDMARKS, columns, read_table

__all__ = [
    "FORMAT",
    "GLINT_COLUMNS",
    "KINEMATICS_COLUMNS",
    "TRUTH_COLUMNS",
    "UNITS",
    "Kinematics",
    "Recording",
    "Truth",
]

FORMAT = "microstereo.recording"
UNITS = {"length": "mm", "image": "px", "time": "s"}
KINEMATICS_COLUMNS = ["time_s", *columns(["x_mm", "y_mm", "z_mm"])]
TRUTH_COLUMNS = [
    "frame",
    *columns(["x_mm", "y_mm", "z_mm"]),
    *columns(["left_x_px", "left_y_px", "left_visibility", "right_x_px", "right_y_px", "right_visibility"]),
]
#: Optional, after `TRUTH_COLUMNS`.
GLINT_COLUMNS = columns(["left_in_glint", "right_in_glint"])
# A forceps jaw or shaft in mm; metres and micrometres fall far outside.
_PLAUSIBLE_TOOL_MM = (0.1, 100.0)
_REQUIRED = {"name": str, "fps": float, "image_size_px": list}
_OPTIONAL = {
    "format": str,
    "description": str,
    "units": dict,
    "skeleton": list,
    "robot_accuracy_mm": float,
    "readout_s": float,
    "offset_s": float,
    "details": dict,
}


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The robot's report of the landmarks.

    Attributes
    ----------
    time_s:
        (m,) robot clock, strictly increasing.
    x_mm:
        (m, 3, 3) base, tip_1, tip_2 in the robot frame; NaN where a sample was dropped.
    """

    time_s: np.ndarray
    x_mm: np.ndarray

    def at(self, time_s: ArrayLike) -> np.ndarray:
        """Landmarks at robot times (n,), or (n, 3), one a landmark: (n, 3, 3) mm, linear between samples.

        NaN before the first sample, after the last, and beside a dropped one.
        """
        time = np.asarray(time_s, dtype=np.float64)
        if time.ndim == 1:
            time = np.repeat(time[:, None], len(LANDMARKS), axis=1)
        if time.ndim != 2 or time.shape[1] != len(LANDMARKS):
            raise ValueError(f"time_s: expected (n,) or (n, 3), got {time.shape}.")
        after = np.clip(np.searchsorted(self.time_s, time, side="right"), 1, max(len(self.time_s) - 1, 1))
        before = np.minimum(after - 1, len(self.time_s) - 1)
        after = np.minimum(after, len(self.time_s) - 1)
        span = self.time_s[after] - self.time_s[before]
        weight = np.where(span > 0, (time - self.time_s[before]) / np.where(span > 0, span, 1.0), 0.0)[..., None]
        landmark = np.arange(len(LANDMARKS))
        first, second = self.x_mm[before, landmark], self.x_mm[after, landmark]
        # A weight of exactly 0 or 1 must not mix in a dropped neighbour.
        x = np.where(weight == 0, first, np.where(weight == 1, second, (1 - weight) * first + weight * second))
        with np.errstate(invalid="ignore"):
            inside = (time >= self.time_s[0]) & (time <= self.time_s[-1])
        return np.where(inside[..., None], x, np.nan)


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulator knows.  For evaluation only: no estimator may see it.

    Attributes
    ----------
    rig:
        The exact cameras.
    landmarks_mm:
        (n, 3, 3) exact landmarks at the frames' times, robot frame.
    u_left, u_right:
        (n, 3, 2) exact px.
    visibility_left, visibility_right:
        (n, 3) int: 0 outside the image, 1 hidden, 2 visible.
    folder:
        truth/, for what else a simulator leaves there.
    in_glint_left, in_glint_right:
        (n, 3) bool, whether saturated light lies on the landmark or right beside it; None where a recording does not
        say.
    """

    rig: StereoRig
    landmarks_mm: np.ndarray
    u_left: np.ndarray
    u_right: np.ndarray
    visibility_left: np.ndarray
    visibility_right: np.ndarray
    folder: Path
    in_glint_left: np.ndarray | None = None
    in_glint_right: np.ndarray | None = None

    @cached_property
    def _surface(self) -> RegularGridInterpolator:
        path = self.folder / "surface.npz"
        if not path.is_file():
            raise FileNotFoundError(f"{path}: this recording stores no surface.")
        try:
            with np.load(path, allow_pickle=False) as stored:
                x_px, y_px, x_mm = (np.asarray(stored[key], dtype=np.float64) for key in ("x_px", "y_px", "x_mm"))
            if x_mm.shape != (len(y_px), len(x_px), 3):
                raise ValueError(f"x_mm is {x_mm.shape}, expected {(len(y_px), len(x_px), 3)}")
            return RegularGridInterpolator((y_px, x_px), x_mm, method="linear", bounds_error=False)
        except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: not a surface grid with x_px, y_px, x_mm ({error}).") from None

    def surface(self, u_left: ArrayLike) -> np.ndarray:
        """The surface points (n, 3) mm, robot frame, seen at left pixels (n, 2); NaN off the stored grid."""
        return self._surface(points(u_left, 2, "u_left")[:, ::-1])


@dataclass(frozen=True, eq=False)
class Recording:
    """A validated recording; `Recording.open` makes one.

    Attributes
    ----------
    image_size_px:
        (width, height).
    readout_s:
        Time from the first to the last row of a rolling shutter; 0 is a global shutter.
    offset_s:
        t_robot = t_video + offset_s.
    robot_accuracy_mm:
        Standard deviation of the robot's report, per coordinate.
    annotations, truth:
        None where the recording has none.
    """

    folder: Path
    name: str
    description: str
    fps: float
    image_size_px: tuple[int, int]
    readout_s: float
    offset_s: float
    robot_accuracy_mm: float
    skeleton: tuple[str, ...]
    details: dict
    frames: Frames
    kinematics: Kinematics
    annotations: Annotations | None
    truth: Truth | None

    def __len__(self) -> int:
        return len(self.frames)

    @classmethod
    def open(cls, folder: str | Path) -> Recording:
        """Open and validate a recording.

        Sizes, counts, headers and ends of all images are checked here; pixels are decoded when asked for.

        Raises
        ------
        FileNotFoundError, ValueError
            Naming the file (and line) and the cure.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: no such recording folder.")
        header = _read_header(folder / "recording.toml")
        size = header["image_size_px"]
        left, right = (open_side(folder, side, size) for side in ("left", "right"))
        if len(left) != len(right):
            raise ValueError(f"{folder}: {len(left)} left and {len(right)} right frames; they come in pairs.")
        if not len(left):
            raise ValueError(f"{folder}: the recording is empty; it has no frame.")
        frames = Frames(left, right, _read_times(folder / "frames.csv", len(left), header["fps"]))
        kinematics = _read_kinematics(folder / "kinematics.csv")
        robot_time = frames.time_s + header["offset_s"]
        if robot_time[-1] < kinematics.time_s[0] or robot_time[0] > kinematics.time_s[-1]:
            raise ValueError(
                f"{folder}: the frames ({robot_time[0]:.3f} to {robot_time[-1]:.3f} s, robot clock) and kinematics.csv "
                f"({kinematics.time_s[0]:.3f} to {kinematics.time_s[-1]:.3f} s) do not overlap; check time_s (seconds) "
                "and offset_s."
            )
        path = folder / "annotations.json"
        annotations = read_coco(path, len(frames), size) if path.exists() else None
        truth = _read_truth(folder / "truth", len(frames)) if (folder / "truth").is_dir() else None
        return cls(folder=folder, frames=frames, kinematics=kinematics, annotations=annotations, truth=truth, **header)

    def landmarks_at(self, index: int, u: ArrayLike | None = None) -> np.ndarray:
        """`landmarks_mm` of one frame, (3, 3) mm, for `u` (3, 2) px or None: what arrives while a recording runs."""
        time_s = np.full((1, len(LANDMARKS)), self.frames.time_s[index] + self.offset_s)
        if u is not None:
            time_s = time_s + self._row_delay_s(points(u, 2, "u"))
        return self.kinematics.at(time_s)[0]

    def _row_delay_s(self, u: np.ndarray) -> np.ndarray:
        """When a rolling shutter read the rows of pixels (..., 2), seconds after the frame's time."""
        row = u[..., 1] / (self.image_size_px[1] - 1) - 0.5
        return self.readout_s * np.where(np.isfinite(row), row, 0.0)

    def landmarks_mm(self, u: ArrayLike | None = None) -> np.ndarray:
        """The robot's landmarks (n, 3, 3) mm at the frames' times, NaN where the robot says nothing.

        Parameters
        ----------
        u:
            Pixels (n, 3, 2) of the landmarks, if known: each is then taken at the instant the rolling shutter read its
            row.  Without it, and where u is NaN, the middle row's instant.
        """
        time = np.repeat((self.frames.time_s + self.offset_s)[:, None], len(LANDMARKS), axis=1)
        if u is not None:
            u = np.asarray(u, dtype=np.float64)
            if u.shape != (len(self), len(LANDMARKS), 2):
                raise ValueError(f"u: expected ({len(self)}, {len(LANDMARKS)}, 2), got {u.shape}.")
            time += self._row_delay_s(u)
        return self.kinematics.at(time)


def _read_header(path: Path) -> dict:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a recording starts with its recording.toml.")
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not valid TOML ({error}).") from None
    known = _REQUIRED | _OPTIONAL
    if unknown := sorted(set(content) - set(known)):
        raise ValueError(
            f"{path}: unknown key {', '.join(unknown)}. Known: {', '.join(known)}; own notes go in [details]."
        )
    if missing := sorted(set(_REQUIRED) - set(content)):
        raise ValueError(f"{path}: {', '.join(missing)} is missing.")
    for key, value in content.items():
        number = known[key] is float and isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (number and math.isfinite(value)) and not (known[key] is not float and isinstance(value, known[key])):
            raise ValueError(f"{path}: {key} = {value!r} should be a {known[key].__name__}.")
    for key, unit in content.get("units", {}).items():
        if UNITS.get(key) != unit:
            raise ValueError(f"{path}: units.{key} = {unit!r}; recordings are in {UNITS}. Convert the files.")
    if content.get("format", FORMAT) != FORMAT:
        raise ValueError(f"{path}: format = {content['format']!r}, expected {FORMAT!r}.")
    if tuple(content.get("skeleton", LANDMARKS)) != LANDMARKS:
        raise ValueError(f"{path}: skeleton = {content['skeleton']}, expected {list(LANDMARKS)} in this order.")
    size = content["image_size_px"]
    if len(size) != 2 or not all(isinstance(v, int) and not isinstance(v, bool) and v > 1 for v in size):
        raise ValueError(f"{path}: image_size_px = {size} should be [width, height] in whole pixels.")
    fps, readout_s = float(content["fps"]), float(content.get("readout_s", 0.0))
    if not fps > 0:
        raise ValueError(f"{path}: fps = {fps} must be positive.")
    if not 0 <= readout_s <= 1.001 / fps:
        raise ValueError(f"{path}: readout_s = {readout_s} must lie between 0 and one frame, {1 / fps:.4g} s.")
    accuracy_mm = float(content.get("robot_accuracy_mm", 0.010))
    if not 0 <= accuracy_mm < 1:
        raise ValueError(f"{path}: robot_accuracy_mm = {accuracy_mm} is not plausible in mm (10 um is 0.010).")
    return {
        "name": content["name"],
        "description": content.get("description", ""),
        "fps": fps,
        "image_size_px": (size[0], size[1]),
        "readout_s": readout_s,
        "offset_s": float(content.get("offset_s", 0.0)),
        "robot_accuracy_mm": accuracy_mm,
        "skeleton": LANDMARKS,
        "details": content.get("details", {}),
    }


def _read_times(path: Path, n: int, fps: float) -> np.ndarray:
    if not path.exists():
        return np.arange(n) / fps
    table = read_table(path, ["frame", "time_s"])
    if len(table) != n or not np.array_equal(table[:, 0], np.arange(n)):
        raise ValueError(
            f"{path}: expected one row for each of the {n} frames, numbered 0 to {n - 1}; got {len(table)}."
        )
    _check_increasing(path, table[:, 1])
    return table[:, 1]


def _check_increasing(path: Path, time_s: np.ndarray) -> None:
    bad = np.flatnonzero(~np.isfinite(time_s))
    if not bad.size:
        bad = np.flatnonzero(np.diff(time_s) <= 0) + 1
    if bad.size:
        raise ValueError(f"{path}, line {bad[0] + 2}: time_s must be a number larger than the row before.")


def _read_kinematics(path: Path) -> Kinematics:
    table = read_table(path, KINEMATICS_COLUMNS)
    if not len(table):
        raise ValueError(f"{path}: the table is empty; the robot's landmarks are needed.")
    _check_increasing(path, table[:, 0])
    x = table[:, 1:].reshape(-1, len(LANDMARKS), 3)
    empty = np.isnan(x)
    partial = np.flatnonzero((empty.any(axis=2) & ~empty.all(axis=2)).any(axis=1))
    if partial.size:
        raise ValueError(
            f"{path}, line {partial[0] + 2}: a landmark has some coordinates only; leave all three cells of a dropped "
            "landmark empty."
        )
    reach = np.linalg.norm(x[:, 1:] - x[:, :1], axis=2)
    if not np.isfinite(reach).any():
        raise ValueError(f"{path}: no row holds the base and a tip; the kinematics are empty.")
    reach_mm = float(np.nanmedian(reach))
    if not _PLAUSIBLE_TOOL_MM[0] <= reach_mm <= _PLAUSIBLE_TOOL_MM[1]:
        raise ValueError(
            f"{path}: the median distance from base to tip is {reach_mm:.4g}, not plausible in mm "
            f"({_PLAUSIBLE_TOOL_MM[0]} to {_PLAUSIBLE_TOOL_MM[1]}). Metres or micrometres? Convert to mm."
        )
    return Kinematics(table[:, 0], x)


def _read_truth(folder: Path, n: int) -> Truth:
    path = folder / "landmarks.csv"
    table = read_table(path, TRUTH_COLUMNS, optional=GLINT_COLUMNS)
    if len(table) != n or not np.array_equal(table[:, 0], np.arange(n)):
        raise ValueError(f"{path}: expected one row for each of the {n} frames, got {len(table)}.")
    x = table[:, 1:10].reshape(n, 3, 3)
    image = table[:, 10:28].reshape(n, 3, 2, 3)
    u, visibility = image[..., :2], np.nan_to_num(image[..., 2]).astype(np.int64)
    rig = StereoRig.load(folder / "rig.json")
    glints = table[:, 28:].reshape(n, 3, 2)
    known = not np.isnan(glints).all()
    if known and not np.isin(glints, (0, 1)).all():
        raise ValueError(f"{path}: in_glint is 0 or 1 for every landmark.")
    in_glint = [glints[:, :, side] == 1 if known else None for side in (0, 1)]
    return Truth(rig, x, u[:, :, 0], u[:, :, 1], visibility[:, :, 0], visibility[:, :, 1], folder, *in_glint)
