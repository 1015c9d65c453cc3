"""The health of the detector without labels: frames in which what it found contradicts itself, the other image or the robot.

Each part is one number a frame, relative to the tool's length in the image where that makes sense, and is divided by its limit.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lib.calibration import Calibration, with_offsets
from lib.correspondences import Correspondences
from lib.recordings import Recording

__all__ = ["LIMITS", "Health", "health"]

#: What a frame may show of each part; see `FALSE_ALARM_RATE`.
LIMITS = {
    "missing": 0.5,  # share of the six landmarks that are not seen
    "looks": 0.02,  # the same frame mirrored and shifted: largest difference of a landmark, of the tool's length
    "epipolar": 0.02,  # distance of left and right from one epipolar geometry, of the tool's length
    "smoothness": 0.05,  # distance from halfway between the frames before and after, of the tool's length
    "shape": 0.1,  # triangulated length of the tool, relative to the robot's
    "robot": 8.0,  # distance from where the robot says, in RMS residuals of the calibration (at least 1 px)
}
#: Share of frames with right landmarks whose score exceeds 1.
FALSE_ALARM_RATE = 0.02
#: Frames further apart in time are not compared for smoothness.
_NEXT_S = 0.15
#: By how much a look is shifted, (x, y) px: no multiple of a network's stride.
_SHIFT_PX = (37, 21)


@dataclass(frozen=True, eq=False)
class Health:
    """One number a frame, and what it is made of.

    Attributes:
        frame: (m,) numbers of the frames.
        parts: Name -> (m,), in units of its limit; NaN where a frame does not have it.
        false_alarm_rate: Share of frames with right landmarks whose score exceeds 1.
    """

    frame: np.ndarray
    parts: dict[str, np.ndarray]
    false_alarm_rate: float = FALSE_ALARM_RATE

    @property
    def score(self) -> np.ndarray:
        """(m,) the worst part of each frame; above 1 the frame is not to be believed."""
        return np.fmax.reduce(list(self.parts.values()))

    @property
    def unhealthy(self) -> float:
        """Share of frames whose score exceeds 1."""
        return float((self.score > 1).mean())

    @property
    def worst_part(self) -> str:
        """The part that most frames fail."""
        return max(self.parts, key=lambda name: np.sum(self.parts[name] > 1))


def health(
    recording: Recording, data: Correspondences, calibration: Calibration | None = None, *,
    detector: Callable | None = None, looks: int = 12,
) -> Health:  # fmt: skip
    """Compare what the detector found with everything that is known without labels.

    Args:
        data: Of `lib.landmarks.detect`, all frames or some.
        calibration: Made from `data`; None leaves out what needs cameras.
        detector: Looks again at `looks` frames, mirrored and shifted; None leaves that out.

    Raises:
        ValueError: If `data` holds no row.
    """
    if not len(data):
        raise ValueError("data: no row; run the detector over some frames.")
    frame = np.unique(data.frame)
    u = np.stack([data.grid("u_left"), data.grid("u_right")], axis=2)  # (m, 3, 2, 2)
    u = np.where((data.grid("seen") > 0)[..., None], u, np.nan)
    with warnings.catch_warnings(action="ignore"):  # means of what no frame shows
        length = np.nanmedian(np.linalg.norm(u[:, 1:] - u[:, :1], axis=-1))
        time = np.nanmean(data.grid("time_s"), axis=1)
    found = {
        "missing": np.isnan(u[..., 0]), "epipolar": _epipolar_px(u) / length, "smoothness": _bent_px(u, time) / length,
    }  # fmt: skip
    if calibration is not None and calibration.rig is not None:
        rig, moved = calibration.rig, with_offsets(data, calibration.offsets)
        x = moved.grid("x_mm")
        told = np.stack([camera.project(x.reshape(-1, 3)) for camera in (rig.left, rig.right)], axis=1)
        distance = np.linalg.norm(u - told.reshape(u.shape), axis=-1)
        found["robot"] = distance / max(calibration.reprojection_rms_px, 1.0)
        seen = rig.triangulate(u[:, :, 0].reshape(-1, 2), u[:, :, 1].reshape(-1, 2)).x_mm.reshape(x.shape)
        found["shape"] = _tool_length(seen) / _tool_length(x) - 1.0
    if detector is not None:
        found["looks"] = _looks_px(recording, frame, u, detector, looks) / length
    parts = {"missing": found.pop("missing").mean(axis=(1, 2))}
    parts |= {name: np.fmax.reduce(np.abs(value).reshape(len(frame), -1), axis=1) for name, value in found.items()}
    return Health(frame, {name: parts[name] / LIMITS[name] for name in LIMITS if name in parts})


def _tool_length(x: np.ndarray) -> np.ndarray:
    """(m,) mm from the base to between the tips of (m, 3, 3)."""
    return np.linalg.norm(x[:, 1:].mean(axis=1) - x[:, 0], axis=1)


def _bent_px(u: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """(m, 3, 2) distance from the straight line between the neighbours in time, NaN where these are far."""
    bent = np.full(u.shape[:3], np.nan)
    if len(u) > 2:
        step = np.diff(time_s)
        share = (step[:-1] / (step[:-1] + step[1:]))[:, None, None, None]
        straight = (1 - share) * u[:-2] + share * u[2:]
        near = np.maximum(step[:-1], step[1:]) <= _NEXT_S
        bent[1:-1] = np.where(near[:, None, None], np.linalg.norm(u[1:-1] - straight, axis=-1), np.nan)
    return bent


def _epipolar_px(u: np.ndarray, samples: int = 300) -> np.ndarray:
    """(m, 3) distance of landmarks from the affine epipolar geometry that most of them share; it knows nothing of the robot."""
    y = u.reshape(-1, 4)
    rows = np.flatnonzero(np.isfinite(y).all(axis=1))
    if len(rows) < 12:
        return np.full(u.shape[:2], np.nan)
    rng = np.random.default_rng(0)
    sets = y[rows][rng.integers(0, len(rows), (samples, 4))]
    normal = np.linalg.svd(sets - sets.mean(axis=1, keepdims=True))[2][:, 3]
    distance = np.abs((y[rows][None] - sets.mean(axis=1, keepdims=True)) @ normal[:, :, None])[..., 0]
    best = distance[np.median(distance, axis=1).argmin()]
    for _ in range(5):  # refit on the rows that agree
        kept = y[rows][best <= 4.0 * max(np.median(best), 0.1)]
        n = np.linalg.svd(kept - kept.mean(axis=0))[2][3]
        best = np.abs((y[rows] - kept.mean(axis=0)) @ n)
    return np.abs((y - kept.mean(axis=0)) @ n).reshape(u.shape[:2])


def _looks_px(recording: Recording, frame: np.ndarray, u: np.ndarray, detector: Callable, looks: int) -> np.ndarray:
    """(m, 3, 2) how far a mirrored and a shifted look at the same image move a landmark; infinite where one finds nothing."""
    moved = np.full(u.shape[:3], np.nan)
    for i in np.unique(np.linspace(0, len(frame) - 1, min(looks, len(frame))).round().astype(int)):
        pair = recording.frames[int(frame[i])]
        images = np.stack([pair.left, pair.right])
        mirrored = detector(images[:, :, ::-1])
        back = np.stack([images.shape[2] - 1 - mirrored.u[..., 0], mirrored.u[..., 1]], axis=-1)[:, [0, 2, 1]]
        shifted = np.pad(images, ((0, 0), (_SHIFT_PX[1], 0), (_SHIFT_PX[0], 0), (0, 0)))
        again = detector(shifted[:, : images.shape[1], : images.shape[2]]).u - _SHIFT_PX
        distance = np.linalg.norm(np.stack([back, again]) - np.swapaxes(u[i], 0, 1), axis=-1).max(axis=0)
        moved[i] = np.where(np.isnan(u[i, ..., 0]), np.nan, np.nan_to_num(distance, nan=np.inf).T)
    return moved
