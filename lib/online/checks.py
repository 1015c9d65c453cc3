"""Whether a frame is usable, judged by the images and the robot's report alone, without a rig."""

import cv2
import numpy as np

from lib.correspondences import Correspondences
from lib.recordings import Scene

_DARK, _FLAT = 6.0, 1.5  # grey levels: an image with a lower mean, or a lower standard deviation, shows nothing
_REPEATED_PX = 0.3  # detections in an image and its copy differ by less
_MOVED_PX = 5.0  # the tool has moved if all its landmarks moved farther
_RESTARTED = 10  # after more frames in order that are older than an earlier one, the clock has been restarted
_FAR_MM = 300.0  # a larger jump of the robot's report is beyond any tool's reach
_REPEATS_S = 0.5  # a report that repeats for longer may be frozen; slow robots report a few times per second


class FrameChecks:
    """Compares each frame with the ones before it; `changed_s` is the time at which the robot's report last changed."""

    def __init__(self) -> None:
        self.scene = Scene(np.empty((0, 0, 3), np.uint8), np.empty((0, 0, 3), np.uint8))  # of the newest frame
        self._same, self._u = np.zeros(2, dtype=bool), np.full((2, 3, 2), np.nan)
        self._believed: tuple[np.ndarray, np.ndarray] | None = None  # the newest report, and the landmarks when it came
        self._doubted, self._time, self._older = 0, -np.inf, []
        self.changed_s = self._shown_s = -np.inf  # the latter: when the report changed, or images showed the tool

    def images(self, left: object, right: object, time_s: float) -> str:
        """The reason why this pair of images is not usable, or ""; call `landmarks` next."""
        pair = [np.asarray(left), np.asarray(right)]
        if pair[0].ndim != 3 or pair[0].shape[2] != 3 or pair[0].dtype != np.uint8 or pair[1].shape != pair[0].shape:
            shapes = " and ".join(str(image.shape) for image in pair)
            raise ValueError(f"left, right: expected two (h, w, 3) uint8 images, got {shapes}.")
        scene = Scene.of(*pair)
        looks = zip(("left", "right"), map(cv2.meanStdDev, scene), strict=True)
        names = [name for name, (mean, sd) in looks if mean.mean() < _DARK or sd.max() < _FLAT]
        self._same = np.array([np.array_equal(now, before) for now, before in zip(scene, self.scene, strict=True)])
        self.scene = scene
        wrong = self._wrong_time(time_s)
        return f"the {' and the '.join(names)} image is black or blank" if names else wrong

    def _wrong_time(self, time_s: float) -> str:
        if not np.isfinite(time_s):
            return "the frame has no time"
        if self._older and time_s <= self._older[-1]:
            self._older = []
        self._older = [*self._older, time_s] if time_s <= self._time else []
        if self._older and len(self._older) <= _RESTARTED:
            return "the frame is older than the one before"
        if time_s <= self._time:  # the clock has been restarted
            self.changed_s = self._shown_s = time_s
        self._time, self._older = time_s, []
        return ""

    def landmarks(self, u: np.ndarray) -> str:
        """The reason why the images count as frozen, or "": landmarks u (2, 3, 2) px, NaN = missing, repeat those before."""
        before, self._u = self._u, u
        step = np.fmax.reduce(np.abs(u - before), axis=(1, 2))  # NaN where nothing can be compared
        nothing = ~np.isfinite([u, before]).any(axis=(0, 2, 3))
        frozen = (step == 0.0) | (self._same & (nothing | (step < _REPEATED_PX)))
        names = " and the ".join(name for name, is_frozen in zip(("left", "right"), frozen, strict=True) if is_frozen)
        return f"frozen video: the {names} image repeats the one before" if names else ""

    def robot(self, data: Correspondences) -> str:
        """The reason why the robot's report is not usable, or ""."""
        x, y, before = data.x_mm, np.hstack([data.u_left, data.u_right]), self._believed
        if not np.isfinite(x).all(axis=1).any():
            return "the robot reports nothing"
        same = before is not None and np.array_equal(x, before[0], equal_nan=True)
        if before is not None and self._doubted < 10:
            jump = np.nanmax(np.linalg.norm(x - before[0], axis=1), initial=0.0)
            if jump > _FAR_MM:
                self._doubted += 1
                return f"the robot's report jumped by {jump:.0f} mm"
            step = np.linalg.norm(y - before[1], axis=1) / np.sqrt(2.0)
            if same and np.fmin.reduce(step) > _MOVED_PX:
                return "the robot's report is frozen while the tool moves"
        if not same:
            self._doubted, self.changed_s = 0, self._time
        # A report that stands still is compared with the landmarks at its last change, or when they were first seen since.
        self._believed = x.copy(), np.where(np.isnan(before[1]), y, before[1]) if same else y
        if not same or data.seen.all(axis=1).any():
            self._shown_s = self._time
        frozen = self._time - self._shown_s > _REPEATS_S
        return "the robot's report repeats, and no image shows whether the tool rests" if frozen else ""
