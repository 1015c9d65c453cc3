"""Reads and writes recordings.  Opening one validates all but the pixels, which are decoded when a frame is read."""

import contextlib
import filecmp
import math
import os
import re
import shlex
import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib.correspondences import LANDMARKS
from lib.files import toml_entries, write_bytes, write_text
from lib.recordings.annotations import SIDES, Annotations, read_coco, write_coco
from lib.recordings.frames import Frames, encoded, open_side, video_times
from lib.recordings.ground import Ground
from lib.recordings.kinematics import ORDER, Kinematics, kinematics_columns, read_kinematics
from lib.recordings.tables import read_table, read_toml, refuse, write_table
from lib.recordings.truth import Truth

_FORMAT = "microstereo.recording"
_UNITS = {"length": "mm", "image": "px", "time": "s"}
_REQUIRED = {"name": str, "fps": float, "image_size_px": list}
_DEFAULTS = {"description": "", "readout_s": 0.0, "offset_s": 0.0, "robot_accuracy_mm": 0.010, "details": {}}
_DEFAULTS |= {"skeleton": list(LANDMARKS), "bit_depth": 0}
_FIXED = {"format": _FORMAT, "units": _UNITS}
_LONGER = 5.0  # if a log is longer than its video by this factor, the times of the frames may be missing
_COVERED = 0.75  # fewest frames with a position, as a share; with fewer, log and video do not belong together
_JUMP_MM = 20.0  # largest plausible move from one sample to the next; no surgical robot is faster
#: Longest usual time for which a log may repeat a position; the fewest different positions, and their least usual distance in
#: units of the robot's accuracy, from which it is known.
_HELD_S, _FEWEST_NEW, _STEPS = 0.015, 10, 3.0
#: Rows that a buffer delivers together: bursts take less than the first share of the time, and pauses between them are at
#: most this long, in s; longer ones may be breaks in the work.
_BURST_SHARE, _LONGEST_PAUSE_S = 0.1, 1.0
_SHORTEST_MM = 0.8  # least plausible distance of the tips from the base; the jaws of most forceps are 2 to 6 mm long
_SLOW_S = 0.15  # largest plausible median step between samples; robots report 10 to 1000 times a second


class Doubt(NamedTuple):
    """A reason why a readable recording is suspicious: a name, a sentence with the numbers, and the cure."""

    name: str
    text: str
    cure: str

    @property
    def is_of_time(self) -> bool:
        """False if the doubt is about positions or images."""
        return self.name not in ("jump", "filled", "units", "blurred")


@dataclass(frozen=True, eq=False)
class Recording:
    """A validated recording; `Recording.open` makes one.

    Attributes:
        image_size_px: (width, height).
        skeleton: Names of the 2 to 8 landmarks; the detector knows those of a forceps.
        bit_depth: Number of bits that 16-bit frames use; 0 for 8-bit frames.
        readout_s: Time from the first to the last row of a rolling shutter; 0 is a global shutter.
        offset_s: t_robot = t_video + offset_s.
        robot_accuracy_mm: Standard deviation of the robot's report, per coordinate.
        details: Notes of the recording's author.
        annotations, truth: None if the recording has none.
    """

    folder: Path
    name: str
    description: str
    fps: float
    image_size_px: tuple[int, int]
    skeleton: tuple[str, ...]
    bit_depth: int
    readout_s: float
    offset_s: float
    robot_accuracy_mm: float
    details: dict
    frames: Frames
    kinematics: Kinematics
    annotations: Annotations | None
    truth: Truth | None

    def __len__(self) -> int:
        return len(self.frames)

    @classmethod
    def open(cls, folder: str | Path, *, truth: bool = True) -> Self:
        """Open and validate a recording; each of its `doubts` is a `UserWarning`.

        Sizes, counts, headers and ends of all images are checked here.  Errors name the file, the line and the cure.  With
        truth=False the truth of a simulated recording is not read.

        >>> from lib import paths
        >>> recording = Recording.open(paths.SHIPPED_RECORDING)
        >>> recording.frames[0].left.shape, recording.landmarks_mm().shape
        ((1080, 1920, 3), (34, 3, 3))
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: no such recording folder.")
        header = _read_header(folder / "recording.toml")
        size, skeleton = header["image_size_px"], header["skeleton"]
        (n, left), (n_right, right) = (open_side(folder, side, size, header["bit_depth"]) for side in ("left", "right"))
        if n != n_right:
            fewer, more = ("left", "right") if n < n_right else ("right", "left")
            cure = f"Add the frames of the {fewer} camera from {min(n, n_right):06d} on, or remove those of the {more} one"
            raise ValueError(f"{folder}: {n} left and {n_right} right frames; they come in pairs. {cure}.")
        if not n:
            raise ValueError(f"{folder}: the recording is empty; it has no frame.")
        time_s, path = np.arange(n) / header["fps"], folder / "frames.csv"
        if path.exists():
            time_s = read_table(path, ["frame", "time_s"], n_frames=n)[:, 1]
            refuse(path, ~(np.diff(time_s, prepend=-np.inf) > 0), ORDER)
        frames = Frames(left, right, time_s)
        kinematics = read_kinematics(folder / "kinematics.csv", skeleton)
        robot_time = frames.time_s + header["offset_s"]
        if robot_time[-1] < kinematics.time_s[0] or robot_time[0] > kinematics.time_s[-1]:
            seen, logged = ("{:.3f} to {:.3f} s".format(*time[[0, -1]]) for time in (robot_time, kinematics.time_s))
            what = f"the frames ({seen}, robot clock) and kinematics.csv ({logged}) do not overlap"
            raise ValueError(f"{folder}: {what}; check time_s (seconds) and offset_s.")
        path = folder / "annotations.json"
        annotations = read_coco(path, n, size, skeleton) if path.exists() else None
        known = Truth.read(folder / "truth", n) if truth and (folder / "truth").is_dir() else None
        made = cls(folder=folder, frames=frames, kinematics=kinematics, annotations=annotations, truth=known, **header)
        for doubt in made.doubts:
            place = shlex.quote(re.sub(r"\.\d+-\w+\.partial$", "", str(folder)))  # where `RecordingWriter` moves it
            warnings.warn(f"{place}: {doubt.text} {doubt.cure} `python3 -m lib check {place}` says more.", stacklevel=2)
        return made

    @cached_property
    def doubts(self) -> list[Doubt]:
        """The reasons why the recording is suspicious, although it can be read."""
        n, frame_s, log_s = len(self), self.frames.time_s + self.offset_s, self.kinematics.time_s
        span, logged, step = float(np.ptp(frame_s)), float(np.ptp(log_s)), np.diff(log_s)
        own_times = (self.folder / "frames.csv").exists()
        usual_s = float(np.median(step)) if len(step) else 0.0
        reported = np.isfinite(self.landmarks_mm()).all(axis=2).any(axis=1)
        covered = (frame_s >= log_s[0]) & (frame_s <= log_s[-1])
        blank = covered & (np.interp(frame_s, log_s, np.isnan(self.kinematics.x_mm).any(axis=(1, 2))) > 0)  # on purpose
        moved_mm = np.linalg.norm(np.diff(self.kinematics.x_mm, axis=0, prepend=self.kinematics.x_mm[:1]), axis=2)
        jump_mm = np.nan_to_num(moved_mm).max(axis=1)
        k = int(jump_mm.argmax())
        new = np.flatnonzero((moved_mm != 0).any(axis=1))  # NaN is not 0
        large = jump_mm[new[1:]] > _STEPS * self.robot_accuracy_mm  # else the robot rests, or its grid is fine
        held_s = float(np.median(np.diff(log_s[new])[large])) if large.sum() > _FEWEST_NEW else 0.0
        repeats = held_s > max(_HELD_S, 1.5 * usual_s)
        pauses_s = step[step > 5.0 * usual_s]
        bursts = len(pauses_s) > _FEWEST_NEW and pauses_s.sum() > (1.0 - _BURST_SHARE) * logged
        pause_s, burst = (float(np.median(pauses_s)), len(log_s) / (len(pauses_s) + 1)) if bursts else (np.inf, 0.0)
        videos = [] if own_times else self.folder.glob("*.mp4")
        stated = [video_times(path) for path in videos if path.stem in SIDES]
        late_s = max((float(np.abs(t - np.arange(len(t)) / self.fps).max(initial=0)) for t in stated), default=0.0)
        reach_mm = float(np.nanmedian(np.linalg.norm(self.kinematics.x_mm[:, 1:] - self.kinematics.x_mm[:, :1], axis=2)))
        filled = np.zeros(len(log_s), bool) if self.kinematics.filled is None else self.kinematics.filled
        filled_s = float(step[filled[1:] | filled[:-1]].sum())
        longer = not own_times and logged > _LONGER * (span + 1.0 / self.fps) and logged > 2.0
        cases = (
            (usual_s > _SLOW_S, "slow_log", f"The robot's log has a sample every {usual_s:.3g} s.",
             "Is time_s in seconds? Log ten samples a second or more."),
            (repeats, "repeated_samples",
             f"kinematics.csv has a row every {usual_s:.3g} s, but usually a new position only every {held_s:.3g} s.",
             "Keep the first of each run of equal rows: the robot was there then, and not later."),
            (pause_s <= _LONGEST_PAUSE_S, "bursts",
             f"The log's times come in bursts: usually {burst:.0f} rows, then none for {pause_s:.2g} s.",
             "A buffer held the rows back: log the robot's own times, or spread each burst evenly to the next, check again."),
            (late_s > 0.5 / self.fps, "video_times", f"The videos' times are {late_s:.3g} s off those of fps = {self.fps:g}.",
             "Set fps to the videos' rate, or if it varies, write the times of their frames to frames.csv (frame, time_s)."),
            (longer, "frame_times", f"{n} frames at {self.fps:g} fps last {span:.1f} s, but the robot's log {logged:.1f} s.",
             "If frames were left out, write their times to frames.csv (frame, time_s)."),
            ((reported | blank).mean() < _COVERED, "little_overlap",
             f"The robot reports a position in {reported.sum()} of {n} frames; {covered.sum()} lie within its log.",
             "Check offset_s, fps and the time_s columns; export the log of the whole video, with blank cells in its gaps."),
            (jump_mm[k] > _JUMP_MM, "jump",
             f"In kinematics.csv a landmark jumps by {jump_mm[k]:.0f} mm at {log_s[k]:.3f} s (line {k + 2}).",
             "Leave the cells of a wrong sample empty."),
            (filled.any(), "filled",
             f"For {filled_s:.2g} s, first at {log_s[filled.argmax()]:.2f} s, the log is smooth to the last digit, without "
             "the noise of its other samples: a program filled gaps. These samples are not used.",
             "Leave the cells of samples that were not measured empty."),
            (reach_mm < _SHORTEST_MM and self.skeleton == LANDMARKS, "units",
             f"The robot reports the tips only {reach_mm:.2g} mm from the base.",
             "Is kinematics.csv in mm? If it is in cm, multiply its positions by 10: all results in mm depend on it."),
        )  # fmt: skip
        return [Doubt(*doubt) for holds, *doubt in cases if holds]

    @property
    def mistimed(self) -> str:
        """Doubts about times, with their cures, or "".  If no calibration is found, correct these first."""
        return " ".join(f"{doubt.text} {doubt.cure}" for doubt in self.doubts if doubt.is_of_time)

    def frames_of(self, text: str) -> range:
        """The frames of --frames "A:B": from A to before B, negative numbers from the end; a ValueError if there are none."""
        ends = re.fullmatch(r"(-?\d+)?:(-?\d+)?", text)
        frames = range(len(self))[slice(*(int(end) if end else None for end in ends.groups()))] if ends else range(0)
        if not frames:
            what = f"it names none of frames 0 to {len(self) - 1}" if ends else "two numbers and a colon are needed"
            raise ValueError(f"--frames {text}: {what}; give A:B, from A to before B, such as 0:{max(len(self) // 2, 1)}.")
        return frames

    def showing(self, frames: range) -> Self:
        """A copy in which the nearest picture of `frames` replaces each other picture; numbers, times and ground stay.

        Code that samples pictures then sees none that was taken before or after `frames`, when cameras stood elsewhere.
        """
        if len(frames) == len(self):
            return self
        sides = [lambda i, side=side: getattr(self.frames[min(max(i, frames[0]), frames[-1])], side) for side in SIDES]
        part = replace(self, frames=Frames(*sides, self.frames.time_s))
        part.__dict__["ground"] = self.ground  # the detections were made with it
        return part

    @cached_property
    def ground(self) -> Ground | None:
        """The images behind the tool, with sizes and dates of the files as key; None if the tool hardly moves.

        A detector in doubt uses them.
        """
        files = [path for name in ("left*", "right*", "left/*", "right/*") for path in sorted(self.folder.glob(name))]
        changed = [(path.stat().st_size, path.stat().st_mtime_ns) for path in files if path.is_file()]
        return Ground.of_frames(self.frames, self.landmarks_mm(), f"{self.folder.resolve()} {changed}")

    def landmarks_mm(self) -> np.ndarray:
        """The robot's landmarks (n, k, 3) mm at the frames' times, NaN where the robot does not report them.

        `lib.correspondences.of_recording` gives them at the times at which the landmarks' image rows were read.
        """
        return self.kinematics.at(self.frames.time_s + self.offset_s)


def _read_header(path: Path) -> dict:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a recording starts with its recording.toml.")
    content = read_toml(path)
    kinds = _REQUIRED | {key: type(value) for key, value in (_DEFAULTS | _FIXED).items()}
    if unknown := sorted(set(content) - set(kinds)):
        raise ValueError(f"{path}: unknown key {', '.join(unknown)}. Known: {', '.join(kinds)}; own notes go in [details].")
    if missing := sorted(set(_REQUIRED) - set(content)):
        raise ValueError(f"{path}: {', '.join(missing)} is missing.")
    for key, value in content.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not (number if kinds[key] is float else isinstance(value, kinds[key])):
            raise ValueError(f"{path}: {key} = {value!r} should be a {kinds[key].__name__}.")
    for key, unit in content.get("units", {}).items():
        if _UNITS.get(key) != unit:
            raise ValueError(f"{path}: units.{key} = {unit!r}; recordings are in {_UNITS}. Convert the files.")
    header = {key: value for key, value in (_DEFAULTS | content).items() if key not in _FIXED}
    size, fps, readout_s = header["image_size_px"], header["fps"], header["readout_s"]
    whole = len(size) == 2 and all(isinstance(v, int) and not isinstance(v, bool) and v > 1 for v in size)
    accuracy_mm, names, bits = header["robot_accuracy_mm"], header["skeleton"], header["bit_depth"]
    named = [name for name in names if isinstance(name, str) and re.fullmatch(r"[A-Za-z]\w{0,31}", name, re.ASCII)]
    for valid, problem in (
        (content.get("format", _FORMAT) == _FORMAT, f"format = {content.get('format')!r}, expected {_FORMAT!r}"),
        (names == named and 2 <= len(set(names)) == len(names) <= 8, f"skeleton = {names}: 2 to 8 names, such as tip_1"),
        (set(named) != set(LANDMARKS) or names == list(LANDMARKS), f"skeleton = {names}: a forceps has {list(LANDMARKS)}"),
        (bits == 0 or 8 <= bits <= 16, f"bit_depth = {bits} should be 8 to 16, or 0 for frames of 8 bits"),
        (whole, f"image_size_px = {size} should be [width, height] in whole pixels"),
        (fps > 0, f"fps = {fps} must be positive"),
        (fps <= 0 or 0 <= readout_s <= 1.001 / fps, f"readout_s = {readout_s} must lie between 0 and one frame"),
        (0 <= accuracy_mm < 1, f"robot_accuracy_mm = {accuracy_mm} is not plausible in mm (10 um is 0.010)"),
    ):
        if not valid:
            raise ValueError(f"{path}: {problem}.")
    header = {key: float(value) if kinds[key] is float else value for key, value in header.items()}
    return header | {"image_size_px": tuple(size), "skeleton": tuple(names)}


class RecordingWriter:
    """Context manager that writes a recording to a temporary folder, and moves it to `folder` if it is valid.

    Args, apart from those of `Recording`:
        details: Your own notes (numbers and text), kept in ``[details]`` of recording.toml.
        suffix, jpeg_quality: ".jpg" or ".png", and the quality of a JPEG.
        overwrite: Replace a recording of that name; any other existing folder is a FileExistsError.  Labels are kept if all
            frames are the same.  A `UserWarning` names the folder that keeps whatever else differs.
        own_times: The times given are known, so that they are written even if they are uniform.

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
        suffix: str = ".jpg", jpeg_quality: int = 90, overwrite: bool = False, own_times: bool = False,
    ) -> None:  # fmt: skip
        if suffix not in {".jpg", ".png"}:
            raise ValueError(f"suffix: '.jpg' or '.png', got {suffix!r}.")
        self.target, self._overwrite = Path(folder), overwrite
        self._check_target()
        self.folder = self.target.with_name(f"{self.target.name}.{os.getpid()}-{os.urandom(3).hex()}.partial")
        self.fps, self.image_size_px = float(fps), (int(image_size_px[0]), int(image_size_px[1]))
        self._suffix = suffix
        self._options = [cv2.IMWRITE_JPEG_QUALITY, int(jpeg_quality)] if suffix == ".jpg" else []
        self._header = {
            "format": _FORMAT, "name": name, "description": description, "fps": self.fps,
            "image_size_px": list(self.image_size_px), "skeleton": list(skeleton),
            "robot_accuracy_mm": float(robot_accuracy_mm), "readout_s": float(readout_s), "offset_s": float(offset_s),
        }  # fmt: skip
        self._details = dict(details or {})
        self._time_s: list[float] = []
        self._own_times = own_times
        self._kinematics: list[np.ndarray] = []
        self._annotations: Annotations | None = None

    def _check_target(self) -> None:
        if self.target.exists() and not self._overwrite:
            raise FileExistsError(f"{self.target}: exists already; pass overwrite=True (--overwrite) to replace it.")
        if self.target.exists() and not (self.target / "recording.toml").is_file():
            raise FileExistsError(f"{self.target}: is not a recording and is left alone; choose another name.")

    def __enter__(self) -> Self:
        for side in ("left", "right"):
            (self.folder / side).mkdir(parents=True)
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)

    def add(self, left: np.ndarray, right: np.ndarray, time_s: float | None = None) -> None:
        """Append a stereo pair, (h, w, 3) uint8 RGB each; `time_s` on the video clock, None = uniform at fps."""
        index = len(self._time_s)
        shape = (self.image_size_px[1], self.image_size_px[0], 3)
        for side, image in (("left", left), ("right", right)):
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"{side}: expected {shape} uint8 RGB, got {image.shape} {image.dtype}.")
            write_bytes(self.folder / side / f"{index:06d}{self._suffix}", encoded(image, self._suffix, *self._options))
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
        """The recording as written so far, or a ValueError if it is not valid; it lies in the temporary folder.

        `offset_s` replaces the constructor's, for a clock offset that is estimated from a first draft.
        """
        if offset_s is not None:
            self._header["offset_s"] = float(offset_s)
        lines = toml_entries(self._header)
        for table, values in (("units", _UNITS), ("details", self._details)):
            lines += ["", f"[{table}]", *toml_entries(values)] if values else []
        write_text(self.folder / "recording.toml", "\n".join(lines) + "\n")
        time = np.array(self._time_s)
        if self._own_times or not np.allclose(time, np.arange(len(time)) / self.fps, rtol=0, atol=1e-7):
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

    def _carry_labels(self) -> None:
        """Copy the labels of the recording that is replaced, if all frames are the same, byte for byte."""
        old, new = self.target / "annotations.json", self.folder / "annotations.json"
        frames = [path.relative_to(self.folder) for side in SIDES for path in (self.folder / side).iterdir()]
        if old.is_file() and not new.exists() and all(_same(self.target / path, self.folder / path) for path in frames):
            with contextlib.suppress(ValueError):  # raised if the labels are of other landmarks
                read_coco(old, len(self._time_s), self.image_size_px, self._header["skeleton"])
                write_bytes(new, old.read_bytes())

    def _finish(self) -> None:
        self._carry_labels()
        self.draft()  # raises an error if the recording is not valid
        self._check_target()
        old = self.folder.with_suffix(".replaced")
        if self.target.exists():
            os.replace(self.target, old)
        try:
            os.replace(self.folder, self.target)
        except OSError:
            if old.exists():
                os.replace(old, self.target)
            raise
        if old.exists():
            _keep_apart(old, self.target)


def _same(one: Path, other: Path) -> bool:
    return one.is_file() and other.is_file() and filecmp.cmp(one, other, shallow=False)


def _keep_apart(old: Path, new: Path) -> None:
    """Remove from folder `old` what `new` holds too; the rest may be a person's work.  A link `old` itself is removed."""
    if old.is_symlink():
        old.unlink()
        return
    for path in sorted(old.rglob("*"), reverse=True):  # a folder comes after its content
        if _same(path, new / path.relative_to(old)):
            path.unlink()
        elif path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            path.rmdir()
    if kept := sorted({path.name for path in old.iterdir()} - {"import.json"}):
        what = f"the recording that it replaces held other {', '.join(kept)}"
        warnings.warn(f"{new}: {what}, which {old} keeps. Remove what you do not need.", stacklevel=4)
    else:
        shutil.rmtree(old, ignore_errors=True)
