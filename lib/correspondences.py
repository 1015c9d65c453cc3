"""Correspondences: a landmark's position as the robot reports it and its pixels in two images, each row at its own instant.

All later stages use this type, whether a detector, a person or the simulator found the landmarks (paper Eq. 2).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.geometry import pair_covariance, points

#: The landmarks of the forceps, in the order of every array.
LANDMARKS = ("base", "tip_1", "tip_2")
#: RGB of each landmark in all figures (Okabe and Ito 2008, distinguishable by the colour-blind).
LANDMARK_COLOURS = {"base": (86, 180, 233), "tip_1": (230, 159, 0), "tip_2": (204, 121, 167)}
#: Detections of lower confidence count as not seen.
MIN_CONFIDENCE = 0.2
#: The cure in messages for a detector that is not trained for the images, and the fewest stereo frames that it takes.
TRAIN_FURTHER = "let the robot teach it: `python3 -m lib adapt RECORDING`"
FEWEST_TO_TRAIN = 17
#: Half the time over which a velocity is measured: long enough to average the robot's noise, short against its motion.
_VELOCITY_S = 0.05
#: Shape of a row of each attribute of `Correspondences`, in the order of its arguments.
_SHAPES = {"x_mm": (3,), "u_left": (2,), "u_right": (2,), "covariance_px2": (2, 2, 2), "confidence": (2,), "frame": (),
           "landmark": (), "time_s": ()}  # fmt: skip


class DataError(ValueError):
    """There is too little data, or it is inconsistent; no other argument of the call would help."""


class NoDetectionError(DataError):
    """Hardly any landmark was found in both images; the text states their number and the cure."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Each row is one landmark in one stereo frame, with NaN where the robot reports none or an image does not show it.

    Attributes:
        x_mm: (n, 3) position as the robot reports it, in the robot frame.
        u_left, u_right: (n, 2) px.
        covariance_px2: (n, 2, 2, 2): of the left and of the right pixel; NaN = unknown.
        confidence: (n, 2), left and right; 0 where missing, 1 for labels.
        frame, landmark: (n,) number of the frame in its recording, and of the landmark (0 base, 1 tip_1, 2 tip_2).
        time_s: (n,) video clock: the mean of the instants at which the landmark's row was read in the two images.

    >>> c = Correspondences.of_points([[0, 0, 0], [1, 0, 0]], [[5, 5], [105, 5]], [[9, 5], [np.nan, np.nan]])
    >>> len(c), len(c.complete), c.seen.tolist()
    (2, 1, [[True, True], [True, False]])
    """

    x_mm: np.ndarray
    u_left: np.ndarray
    u_right: np.ndarray
    covariance_px2: np.ndarray
    confidence: np.ndarray
    frame: np.ndarray
    landmark: np.ndarray
    time_s: np.ndarray

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.frame))
        for name, tail in _SHAPES.items():
            given, whole = np.asarray(getattr(self, name)), name in ("frame", "landmark")
            if whole and not (np.isfinite(given) & (given == np.rint(given))).all():
                raise ValueError(f"{name}: expected whole numbers, one for each row; times belong into time_s.")
            if name == "landmark" and given.min(initial=0) < 0:
                raise ValueError(f"landmark: must not be negative, got {given.min()}; leave rows of unknown landmarks out.")
            array = np.asarray(given, dtype=np.int64 if whole else np.float64)
            if array.shape != (n, *tail):
                raise ValueError(f"{name}: expected {(n, *tail)}, got {array.shape}.")
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.x_mm)

    @classmethod
    def of_points(
        cls, x_mm: ArrayLike, u_left: ArrayLike, u_right: ArrayLike, *,
        covariance_px2: ArrayLike | None = None, confidence: ArrayLike | None = None, frame: ArrayLike | None = None,
        landmark: ArrayLike | None = None, time_s: ArrayLike | None = None,
    ) -> Self:  # fmt: skip
        """Correspondences from arrays of n rows.  By default covariance and time are unknown, and the confidence is 1.

        Without `frame` each row is its own frame; without `landmark` all rows are of landmark 0.
        """
        x, left, right = points(x_mm, 3, "x_mm"), points(u_left, 2, "u_left"), points(u_right, 2, "u_right")
        n = len(x)
        if not n == len(left) == len(right):
            raise ValueError(f"x_mm, u_left, u_right: {n}, {len(left)} and {len(right)} rows; give as many of each.")
        confidence = np.isfinite([left, right]).all(axis=2).T if confidence is None else confidence
        return cls(
            x, left, right, np.full((n, 2, 2, 2), np.nan) if covariance_px2 is None else covariance_px2, confidence,
            np.arange(n) if frame is None else frame, np.zeros(n) if landmark is None else landmark,
            np.full(n, np.nan) if time_s is None else time_s,
        )  # fmt: skip

    @classmethod
    def join(cls, parts: Iterable[Self]) -> Self:
        """The rows of several correspondences, one after the other."""
        parts = list(parts)
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in _SHAPES))

    @property
    def seen(self) -> np.ndarray:
        """(n, 2) bool: True if the left or right image shows the landmark with at least `MIN_CONFIDENCE`."""
        return np.isfinite([self.u_left, self.u_right]).all(axis=2).T & (self.confidence >= MIN_CONFIDENCE)

    @property
    def stacked_px(self) -> np.ndarray:
        """(n, 4) px of (u_left, u_right), NaN where an image does not show the landmark."""
        return np.where(np.repeat(self.seen, 2, axis=1), np.hstack([self.u_left, self.u_right]), np.nan)

    @property
    def is_complete(self) -> np.ndarray:
        """(n,) bool: True if both images show the landmark and the robot reports it."""
        return self.seen.all(axis=1) & np.isfinite(self.x_mm).all(axis=1)

    @property
    def complete(self) -> Self:
        """The rows that are complete."""
        return self.subset(self.is_complete)

    def tool_px(self, rig: StereoRig) -> tuple[np.ndarray, np.ndarray]:
        """(u_left, u_right), (n, 2) px: landmarks that an image does not show lie where `rig` projects the robot's report.

        NaN without a report.  For masks, which must hide the tool also where it was not found.
        """
        try:
            projected = rig.project(self.x_mm)
        except ValueError:  # the report is behind a near-affine camera
            projected = np.full((2, len(self), 2), np.nan)
        pairs = zip((self.u_left, self.u_right), projected, self.seen.T, strict=True)
        return tuple(np.where(seen[:, None] | np.isnan(placed), u, placed) for u, placed, seen in pairs)

    @property
    def is_by_hand(self) -> bool:
        """True if landmarks are seen and none has a covariance: labels that a person set."""
        return bool(self.seen.any()) and not np.isfinite(self.covariance_px2).any()

    def check_detections(self) -> None:
        """Raise a `DataError` if an image shows fewer than four landmarks whose position the robot reports."""
        if len(self) < 4:
            raise DataError(f"data: {len(self)} landmarks in all, and a camera needs four. Record more frames; 30 are good.")
        usable = int((self.seen & np.isfinite(self.x_mm).all(axis=1)[:, None]).sum(axis=0).min())
        if usable >= 4:
            return
        left, right = self.seen.sum(axis=0)
        if min(left, right) >= 4:
            what = f"the robot reports a position for {usable} of the {min(left, right)} landmarks that an image shows"
            cure = "check offset_s and the times of frames and kinematics (`python3 -m lib check RECORDING`)"
            raise NoDetectionError(f"data: {what}; {cure}.")
        if self.is_by_hand:
            what = f"{left} landmarks are labelled in left images and {right} in right ones"
            raise NoDetectionError(f"data: {what}, and each camera needs four. Label ten pairs, far apart.")
        raise NoDetectionError(
            f"data: the detector failed on {len(np.unique(self.frame))} frames: of {len(self)} landmarks it found {left} "
            f"in left images and {right} in right ones. Do they show the tool, in colour, sharp, 200 to 400 px "
            f"from base to tip? `python3 -m lib check RECORDING` shows them; where tool or light is new, {TRAIN_FURTHER}."
        )

    @property
    def pair_covariance_px2(self) -> np.ndarray:
        """(n, 4, 4) covariance of (u_left, u_right); the errors in the two images are independent."""
        return pair_covariance(self.covariance_px2, len(self))

    def subset(self, rows: slice | ArrayLike) -> Self:
        """The rows selected by a slice, a mask or an array of indices."""
        rows = rows if isinstance(rows, slice) else np.asarray(rows)
        return type(self)(*(getattr(self, name)[rows] for name in _SHAPES))

    def of_frames(self, frames: ArrayLike) -> Self:
        """The rows of the given frames."""
        return self.subset(np.isin(self.frame, np.atleast_1d(frames)))

    def grid(self, name: str) -> np.ndarray:
        """An attribute as an array (m, k, ...): m frames in ascending order, k >= 3 landmarks; NaN where there is no row.

        >>> x, u = np.zeros((2, 3)), np.ones((2, 2))
        >>> c = Correspondences.of_points(x, u, u, frame=[4, 4], landmark=[0, 2])
        >>> c.grid("u_left").shape, c.grid("u_left")[0, :, 0].tolist()
        ((1, 3, 2), [1.0, nan, 1.0])
        """
        values = getattr(self, name)
        frames, row = np.unique(self.frame, return_inverse=True)
        table = np.full((len(frames), max(len(LANDMARKS), self.landmark.max(initial=0) + 1), *values.shape[1:]), np.nan)
        table[row, self.landmark] = values
        return table


def pair_with_robot(
    u_left: ArrayLike, u_right: ArrayLike, *, position: Callable[[np.ndarray], np.ndarray], time_s: ArrayLike,
    height_px: int, readout_s: float = 0.0, offset_s: float = 0.0, covariance_px2: ArrayLike | None = None,
    confidence: ArrayLike | None = None, frame: ArrayLike | None = None, linear: np.ndarray | None = None,
) -> Correspondences:  # fmt: skip
    """Landmarks of m stereo frames, with the robot's positions at the instants at which their image rows were read.

    A rolling shutter reads the middle row at the frame's time and the last row half `readout_s` later, so the two
    images show a landmark at two instants.  The position is taken at their mean, and each pixel is moved to that
    instant by the landmark's velocity.  If only one image shows a landmark, its instant is used.

    Args:
        u_left, u_right: (m, k, 2) px, NaN = not seen; they give m * k rows, frame by frame.
        position: Robot times (j, k) in s -> (j, k, 3) mm, NaN = no report: `lib.recordings.Kinematics.at`.
        time_s: (m,) times of the frames, video clock.
        height_px, readout_s: Rows of an image, and time from the first to the last; 0 s is a global shutter.
        offset_s: t_robot = t_video + offset_s.
        covariance_px2, confidence: (m, k, 2, 2, 2) and (m, k, 2), left and right; None as in `Correspondences.of_points`.
        frame: (m,) numbers of the frames; None = 0 to m - 1.
        linear: (4, 3) px per mm, left and right, to convert velocities into pixels; None = fitted to these rows.

    A landmark moves down at 10 mm/s.  At 100 px/mm, a shutter of 20 ms reads it in the first and the last row, 20 ms apart:

    >>> def position(time_s):
    ...     return np.stack([0 * time_s, 10 * time_s, 0 * time_s], axis=-1)
    >>> c = pair_with_robot([[[50, 0]]], [[[50, 100]]], position=position, time_s=[1.0], height_px=101, readout_s=0.02,
    ...                     linear=np.array([[100, 0, 0], [0, 100, 0], [100, 0, 0], [0, 100, 0]]))
    >>> c.x_mm.round(3).tolist(), c.u_left.round(1).tolist(), c.u_right.round(1).tolist()
    ([[0.0, 10.0, 0.0]], [[50.0, 10.0]], [[50.0, 90.0]])
    """
    if readout_s < 0 or height_px < 2:
        raise ValueError(f"readout_s, height_px: expected at least 0 s and 2 px, got {readout_s} and {height_px}.")
    time, y = np.asarray(time_s, dtype=np.float64), np.stack([u_left, u_right], axis=2).astype(np.float64)
    if time.ndim != 1 or y.ndim != 4 or y.shape[0] != len(time) or y.shape[3] != 2:
        raise ValueError(f"u_left, u_right: expected ({time.size}, k, 2) px, got {np.shape(u_left)}, {np.shape(u_right)}.")
    m, k = y.shape[:2]
    delay = readout_s * (y[..., 1] / (height_px - 1) - 0.5)  # (m, k, 2), NaN where not seen
    n_seen = np.isfinite(delay).sum(axis=2)
    mean_delay = np.nansum(delay, axis=2) / np.maximum(n_seen, 1)  # 0, the middle row, if seen in neither
    row_time = time[:, None] + mean_delay
    x = np.asarray(position(row_time + offset_s), dtype=np.float64)
    if x.shape != (m, k, 3):
        raise ValueError(f"position: expected ({m}, {k}, 3) mm, got {x.shape}.")
    if readout_s and (n_seen == 2).any():
        after, before = (np.asarray(position(row_time + offset_s + h)) for h in (_VELOCITY_S, -_VELOCITY_S))
        step = np.where(np.isfinite(after), after, x) - np.where(np.isfinite(before), before, x)
        span = _VELOCITY_S * (np.isfinite(after).astype(float) + np.isfinite(before))
        velocity = np.nan_to_num(step / np.maximum(span, _VELOCITY_S))
        if linear is None:
            linear = np.vstack([_affine(x.reshape(-1, 3), y[:, :, c].reshape(-1, 2)) for c in (0, 1)])
        shift = np.nan_to_num(delay - mean_delay[..., None])
        y = y - shift[..., None] * np.einsum("cij,mkj->mkci", np.reshape(linear, (2, 2, 3)), velocity)
    return Correspondences.of_points(
        x.reshape(-1, 3), y[:, :, 0].reshape(-1, 2), y[:, :, 1].reshape(-1, 2),
        covariance_px2=None if covariance_px2 is None else np.reshape(covariance_px2, (m * k, 2, 2, 2)),
        confidence=None if confidence is None else np.reshape(confidence, (m * k, 2)),
        frame=np.repeat(np.arange(m) if frame is None else frame, k), landmark=np.tile(np.arange(k), m),
        time_s=row_time.ravel(),
    )  # fmt: skip


def of_recording(
    recording: object, u_left: ArrayLike, u_right: ArrayLike, *, frames: Sequence[int] | slice | None = None,
    **known: ArrayLike | None,
) -> Correspondences:  # fmt: skip
    """`pair_with_robot` for the `frames` (None = all) of a `lib.recordings.Recording`, with its clock offset and shutter.

    `known`: the arguments covariance_px2, confidence and linear of `pair_with_robot`.
    """
    chosen = np.arange(len(recording.frames))[slice(None) if frames is None else frames]
    return pair_with_robot(
        u_left, u_right, position=recording.kinematics.at, time_s=recording.frames.time_s[chosen], frame=chosen,
        height_px=recording.image_size_px[1], readout_s=recording.readout_s, offset_s=recording.offset_s, **known,
    )  # fmt: skip


def _affine(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A (2, 3) px per mm of the affine camera with the least sum of distances; accurate enough for small shifts."""
    known = np.isfinite(np.hstack([x, u])).all(axis=1)
    if known.sum() < 5:
        return np.zeros((2, 3))
    H, u = np.column_stack([x[known], np.ones(known.sum())]), u[known]
    H[:, :3] -= H[:, :3].mean(axis=0)
    weight = np.ones((len(H), 1))
    for _ in range(10):
        M = np.linalg.lstsq(np.sqrt(weight) * H, np.sqrt(weight) * u, rcond=1e-6)[0]
        weight = 1.0 / np.maximum(np.linalg.norm(u - H @ M, axis=1, keepdims=True), 0.1)
    return M[:3].T
