"""The annotator: a person marks landmarks in both views, in JupyterLab, and each mark is saved to annotations.json at once.

`Annotator` holds marks and suggestions and answers the messages of its page, annotator.js, which draws them.
"""

from functools import cached_property
from pathlib import Path

import numpy as np

from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.recordings.annotations import SIDES, inside, mark_coco, read_coco
from lib.recordings.frames import encoded
from lib.recordings.recording import Recording

#: Depths in mm from the tool along a viewing ray, whose projections make the epipolar line.  A depth of field is 3 mm.
_DEPTHS_MM = np.linspace(-20.0, 20.0, 9)


class Annotator:
    """Sets labels by hand.  Displayed in JupyterLab, it is a page with both views; press ? there for the list of its keys.

    Each change is written to annotations.json before the page shows it as saved, so a killed kernel loses nothing.  All
    else in the file stays as it is.

    Args:
        rig: Cameras, if known.  They give the epipolar lines of left marks, and the robot's landmarks as suggestions.
        detected: Detections (`lib.landmarks.detect`), with the robot's position of each landmark.  Both are shown as
            suggestions, and frames in which they disagree most come first.

    >>> import shutil, tempfile
    >>> from lib import paths
    >>> folder = shutil.copytree(paths.SHIPPED_RECORDING, tempfile.mkdtemp() + "/mine")
    >>> annotator = Annotator(Recording.open(folder, truth=False))
    >>> annotator.mark("left", 3, "tip_2", (812.5, 640.0))
    >>> Recording.open(folder).annotations.u_left[3, 2].tolist()
    [812.5, 640.0]
    """

    def __init__(self, recording: Recording, *, rig: StereoRig | None = None, detected: Correspondences | None = None):
        self.recording = recording
        self._path = recording.folder / "annotations.json"
        self._undone, self._done, self._visited = [], [], set()
        self._read()
        self.know(rig=rig, detected=detected)

    def know(self, *, rig: StereoRig | None = None, detected: Correspondences | None = None) -> None:
        """Set the rig and the detections; an open page shows them at once."""
        n, k = len(self.recording), len(self.recording.skeleton)
        nothing = np.full((2, n, k, 2), np.nan)
        detector, self._rig, self._x_mm = nothing.copy(), rig, self.recording.landmarks_mm()
        if rows := detected:
            self._x_mm[rows.frame, rows.landmark] = rows.x_mm
            detector[:, rows.frame, rows.landmark] = np.where(rows.seen.T[..., None], (rows.u_left, rows.u_right), np.nan)
        robot = nothing if rig is None else np.reshape(rig.project(self._x_mm.reshape(-1, 3)), nothing.shape)
        self._suggested = {"robot": robot, "detector": detector}
        # (n,) px: the largest distance between robot and detector in a frame; a missed landmark counts as the tool's length.
        distance = np.linalg.norm(robot - detector, axis=-1)
        length = np.linalg.norm(robot[:, :, 1:] - robot[:, :, :1], axis=-1)
        length = np.nanmedian(length) if np.isfinite(length).any() else 0.0
        missed = inside(robot, self.recording.image_size_px) & ~np.isfinite(detector).all(axis=-1)
        looked = detected is not None and np.isin(np.arange(n), detected.frame)
        self.usefulness = np.where(looked, np.where(missed, length, np.nan_to_num(distance)).max(axis=(0, 2)), 0.0)
        if "widget" in vars(self):
            self.widget.send({"renew": True})

    def __repr__(self) -> str:
        labelled = f"{int(self.complete.sum())} of {len(self.recording)} frames are labelled"
        return f"Annotator of {self.recording.name}: {labelled}, in {self._path.name}."

    @property
    def complete(self) -> np.ndarray:
        """(n,) bool: every landmark of both views has a mark."""
        return (self._marks[..., 2] != 0).all(axis=(0, 2))

    def mark(
        self, side: str, frame: int, landmark: str, u: tuple[float, float] | None = None, visibility: int | None = None
    ) -> None:
        """Mark a landmark at pixel `u`, visible (2, the default) or hidden (1); without `u` absent (-1), or unmarked (0)."""
        visibility = (-1 if u is None else 2) if visibility is None else visibility
        self._change([(side, frame, self.recording.skeleton.index(landmark), *(u or (np.nan, np.nan)), visibility)])

    def undo(self) -> int | None:
        """Undo the last change; returns its frame, or None if there is none."""
        return self._replay(self._done, self._undone)

    def redo(self) -> int | None:
        """Repeat the change that was undone last; returns its frame, or None if there is none."""
        return self._replay(self._undone, self._done)

    def next_frame(self, frame: int) -> int:
        """The most useful frame that is neither labelled nor visited; of equal ones, the farthest from labels and `frame`."""
        self._visited.add(frame)
        left = set(np.flatnonzero(~self.complete).tolist())
        if left <= self._visited:
            self._visited = {frame}
        fresh = np.array(sorted(left - self._visited))
        if not len(fresh):
            return (frame + 1) % len(self.recording)
        touched = np.flatnonzero((self._marks[..., 2] != 0).any(axis=(0, 2)))
        gap = np.abs(fresh[:, None] - np.append(touched, frame)).min(axis=1)
        return int(fresh[np.lexsort((gap, np.nan_to_num(self.usefulness[fresh])))[-1]])

    def _read(self) -> None:
        """Read the marks from the file: x, y, visibility (2, n, k, 3) in the left and the right view."""
        r = self.recording
        self._marks = np.tile([np.nan, np.nan, 0.0], (2, len(r), len(r.skeleton), 1))
        if self._path.exists():
            found = read_coco(self._path, len(r), r.image_size_px, r.skeleton)
            self._marks[..., :2] = found.u_left, found.u_right
            self._marks[..., 2] = found.visibility_left, found.visibility_right

    def _change(self, changes: list[tuple]) -> None:
        """Write changes (side, frame, number of the landmark, x, y, visibility) as one step for `undo`."""
        self._done.append(self._write(changes))
        self._undone.clear()

    def _replay(self, taken: list, given: list) -> int | None:
        if not taken:
            return None
        given.append(self._write(taken[-1]))
        return taken.pop()[0][1]

    def _write(self, changes: list[tuple]) -> list[tuple]:
        """Write changes to the file and return the changes that undo them."""
        r, n = self.recording, len(self.recording)
        for side, frame, landmark, x, y, v in changes:
            if side not in SIDES or not 0 <= frame < n or not 0 <= landmark < len(r.skeleton) or v not in (-1, 0, 1, 2):
                raise ValueError(f"mark: {side!r}, frame {frame}, landmark {landmark}, visibility {v}: does not exist here.")
            if v > 0 and not inside(np.array([x, y], np.float64), r.image_size_px):
                raise ValueError(f"u: ({x}, {y}) lies outside the image of {r.image_size_px[0]} x {r.image_size_px[1]} px.")
        self._read()  # keeps what another program wrote meanwhile
        images = {(side, frame): self._marks[SIDES.index(side), frame].copy() for side, frame, *_ in changes}
        before = [(side, frame, k, *images[side, frame][k]) for side, frame, k, *_ in changes]
        for side, frame, k, x, y, v in changes:
            images[side, frame][k] = (x, y, v) if v > 0 else (np.nan, np.nan, v)
        for (side, frame), values in images.items():
            files = sorted(p for p in (r.folder / side).glob(f"*{frame}.*") if p.stem.isdecimal() and int(p.stem) == frame)
            name = f"{side}/{files[0].name if files else f'{frame:06d}.jpg'}"
            mark_coco(self._path, name, r.image_size_px, r.skeleton, values)
        self._read()
        return before[::-1]

    @cached_property
    def widget(self) -> object:
        """The page as an `anywidget`; displaying the annotator displays it."""
        import anywidget  # imported here, since reading recordings needs no Jupyter

        class Page(anywidget.AnyWidget):
            _esm = Path(__file__).with_name("annotator.js").read_text(encoding="utf-8")

        page = Page()
        page.on_msg(lambda _, message, buffers: page.send(*self.handle(message)))
        return page

    def _repr_mimebundle_(self, **options: object) -> object:
        return self.widget._repr_mimebundle_(**options)

    def handle(self, message: dict) -> tuple[dict, list[bytes]]:
        """Answer a message of the page (hello, show, next, mark, undo or redo); returns the answer and images as JPEG."""
        todo, frame, images = message["do"], int(message.get("frame") or 0), []
        answer = {"id": message.get("id")}
        moves = {"next": lambda: self.next_frame(frame), "undo": self.undo, "redo": self.redo}
        try:
            self._read()  # another page or program may have written
            if todo == "hello":
                r, key = self.recording, str(self.recording.folder.resolve())
                answer |= {"name": r.name, "landmarks": r.skeleton, "n": len(r), "size": r.image_size_px, "key": key}
                frame = int(np.argmax(np.where(self.complete, -1.0, np.nan_to_num(self.usefulness))))
            elif todo == "mark":
                self._change([tuple(mark) for mark in message["marks"]])
            elif todo in moves:
                there = moves[todo]()
                frame = frame if there is None else there
            if todo in ("hello", "next", "show"):
                pair = self.recording.frames[frame]
                images = [encoded(one, ".jpg") for one in (pair.left, pair.right)]
            answer |= self._state(frame)
        except (ValueError, OSError) as error:
            answer["error"] = str(error)
        return answer, images

    def _state(self, frame: int) -> dict:
        """The state that the page shows: a frame's marks, suggestions and epipolar lines, and which frames are labelled."""
        state = {"frame": frame, "marks": _plain(self._marks[:, frame]), "usefulness": float(self.usefulness[frame])}
        state |= {name: _plain(u[:, frame]) for name, u in self._suggested.items()}
        state["lines"] = [self._epipolar_line(u) if v > 0 else None for *u, v in self._marks[0, frame]]
        return state | {"complete": self.complete.tolist(), "file": self._path.name}

    def _epipolar_line(self, u_left: np.ndarray) -> list | None:
        """Right pixels of points on the viewing ray of a left pixel, or None without cameras."""
        if self._rig is None:
            return None
        left, near = self._rig.left, self._x_mm[np.isfinite(self._x_mm).all(axis=-1)]
        x = (near.mean(axis=0) if len(near) else np.zeros(3)) + _DEPTHS_MM[:, None] * left.viewing_direction
        for _ in range(4):  # Gauss-Newton; the first step is exact where the camera is affine
            x = x + np.einsum("nij,nj->ni", np.linalg.pinv(left.jacobian(x)), np.asarray(u_left) - left.project(x))
        return _plain(self._rig.right.project(x))


def _plain(values: np.ndarray) -> list:
    """An array as nested lists with None for NaN, as JSON needs it."""
    return np.where(np.isfinite(values), values.astype(object), None).tolist()
