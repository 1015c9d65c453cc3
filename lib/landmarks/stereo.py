"""Landmarks of a whole recording: what calibration and registration start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from tqdm.auto import tqdm

from lib.landmarks.detector import Detector, Landmarks
from lib.recordings import Recording

__all__ = ["Correspondences", "StereoLandmarks", "detect"]


@dataclass(frozen=True)
class Correspondences:
    """3D-2D-2D correspondences (paper Eq. 2), complete ones only.

    Attributes
    ----------
    x_mm:
        (n, 3) as the robot reports, robot frame.
    u_left, u_right:
        (n, 2) px as detected.
    covariance_px2:
        (n, 4, 4) of (u_left, u_right), the detector's own.
    frame, landmark:
        (n,) which frame of the recording and which landmark (0 base, 1 tip_1, 2 tip_2) each row is.
    """

    x_mm: np.ndarray
    u_left: np.ndarray
    u_right: np.ndarray
    covariance_px2: np.ndarray
    frame: np.ndarray
    landmark: np.ndarray

    def __len__(self) -> int:
        return len(self.x_mm)

    def __getitem__(self, rows: slice | np.ndarray) -> Correspondences:
        return Correspondences(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class StereoLandmarks:
    """Detections `left` and `right` of n stereo frames, and `x_mm` (n, 3, 3), the robot's report when each was seen."""

    left: Landmarks
    right: Landmarks
    x_mm: np.ndarray

    def __len__(self) -> int:
        return len(self.x_mm)

    def correspondences(self, *, min_confidence: float = 0.2) -> Correspondences:
        """All landmarks seen in both images with at least this confidence while the robot reported them."""
        good = np.isfinite(self.x_mm).all(axis=2)
        covariance = np.zeros((*good.shape, 4, 4))
        for rows, side in ((slice(0, 2), self.left), (slice(2, 4), self.right)):
            good &= (side.confidence >= min_confidence) & np.isfinite(side.u).all(axis=2)
            covariance[..., rows, rows] = side.covariance
        frame, landmark = np.nonzero(good)
        return Correspondences(
            self.x_mm[good], self.left.u[good], self.right.u[good], covariance[good], frame, landmark
        )


def detect(
    recording: Recording, detector: Detector | None = None, *, frames: slice | np.ndarray | None = None
) -> StereoLandmarks:
    """Run the detector over a recording, a stereo frame at a time (a full-HD pair takes 12 MB).

    Parameters
    ----------
    detector:
        None is the one that ships.
    frames:
        Which frames; None is all.
    """
    detector = detector or Detector.load()
    chosen = np.arange(len(recording))[slice(None) if frames is None else frames]
    found = []
    for i in tqdm(chosen, desc="landmarks", unit="pair", leave=False):
        frame = recording.frames[int(i)]
        found.append(detector(np.stack([frame.left, frame.right])))
    left, right = (
        Landmarks(
            *(np.stack([getattr(pair, name)[side] for pair in found]) for name in ("u", "covariance", "confidence"))
        )
        for side in (0, 1)
    )
    # A rolling shutter reads the two images alike, so the left one's rows tell when each landmark was seen.
    x_mm = np.stack([recording.landmarks_at(int(i), u) for i, u in zip(chosen, left.u, strict=True)])
    return StereoLandmarks(left, right, x_mm)
