"""Is a frame fit to be used?  What images and report tell by themselves, before any rig is asked."""

import cv2
import numpy as np

from lib.correspondences import Correspondences

__all__ = ["FrameChecks"]

_STEP = 4  # every n-th pixel is compared; the noise of a sensor never repeats
_DARK, _FLAT = 6.0, 1.5  # grey levels: an image that is darker on average, or varies less, shows nothing
_REPEATED_PX = 0.3  # a detector finds the same landmarks in the same image within this
_MOVED_PX = 5.0  # landmarks that all moved farther than this moved
_FAR_MM = 300.0  # from where the robot was: beyond any tool's reach


class FrameChecks:
    """Compares each frame with the ones before it."""

    def __init__(self) -> None:
        self._thumbs: tuple[np.ndarray, ...] = ()
        self._u: np.ndarray | None = None
        self._x: np.ndarray | None = None  # the newest report that was believed
        self._doubted, self._time = 0, -np.inf

    def images(self, left: object, right: object, time_s: float) -> str:
        """Why this pair of images shows nothing new, "" where it does; call `landmarks` next."""
        pair = [np.asarray(left), np.asarray(right)]
        if pair[0].ndim != 3 or pair[0].shape[2] != 3 or pair[0].dtype != np.uint8 or pair[1].shape != pair[0].shape:
            shapes = " and ".join(str(image.shape) for image in pair)
            raise ValueError(f"left, right: expected two (h, w, 3) uint8 images, got {shapes}.")
        thumbs = tuple(np.ascontiguousarray(image[::_STEP, ::_STEP]) for image in pair)
        looks = zip(("left", "right"), map(cv2.meanStdDev, thumbs), strict=True)
        names = [name for name, (mean, sd) in looks if mean.mean() < _DARK or sd.max() < _FLAT]
        self._same = [len(self._thumbs) == 2 and np.array_equal(a, b) for a, b in zip(thumbs, self._thumbs, strict=False)]
        self._same, self._thumbs = self._same or [False, False], thumbs
        late, self._time = time_s <= self._time, max(time_s, self._time)
        if names:
            return f"the {' and the '.join(names)} image is black or blank"
        return "the frame is older than the one before" if late else ""

    def landmarks(self, u: np.ndarray) -> str:
        """Why landmarks u (2, 3, 2) px, NaN = missing, are those of the frame before, "" where they are not."""
        before, self._u = self._u, u
        frozen = []
        for side, same in enumerate(self._same):
            step = np.full((3, 2), np.nan) if before is None else np.abs(u[side] - before[side])
            known = np.isfinite(step)
            nothing = same and not np.isfinite(u[side]).any() and (before is None or not np.isfinite(before[side]).any())
            if nothing or (known.any() and (step[known].max() == 0.0 or (same and step[known].max() < _REPEATED_PX))):
                frozen.append(("left", "right")[side])
        return f"frozen video: the {' and the '.join(frozen)} image repeats the one before" if frozen else ""

    def robot(self, data: Correspondences) -> str:
        """Why the robot's report is not to be used, "" where it is."""
        x, seen = data.x_mm, np.isfinite(np.hstack([data.u_left, data.u_right])).all(axis=1)
        if not np.isfinite(x).all(axis=1).any():
            return "the robot reports nothing"
        before, y = self._x, np.hstack([data.u_left, data.u_right])
        if before is not None and self._doubted < 10:
            jump = np.nanmax(np.linalg.norm(x - before[0], axis=1), initial=0.0)
            if jump > _FAR_MM:
                self._doubted += 1
                return f"the robot's report jumped by {jump:.0f} mm"
            if np.array_equal(x, before[0]) and seen.any():
                step = np.linalg.norm((y - before[1])[seen], axis=1) / np.sqrt(2.0)
                if np.isfinite(step).any() and np.nanmin(step) > _MOVED_PX:
                    return "the robot's report is frozen while the tool moves"
        if np.array_equal(x, before[0]) if before is not None else False:
            return ""  # compared with where the tool was seen when the report last changed
        self._x, self._doubted = (x.copy(), y), 0
        return ""
