"""The detector's errors from frame to frame, while it follows rendered tools at 25 frames a second."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from lib import files, paths
from lib.correspondences import MIN_CONFIDENCE
from lib.geometry import RigidTransform
from lib.landmarks import Detector, Landmarks
from lib.landmarks.detector import TRACKED_FROM
from lib.simulator import Eye, Microscope, Motion, Window, render_view
from lib.simulator.population import RESERVED_SEEDS, reserved_forceps

_SIDE_PX = 560  # side of the rendered window around the tool; closeups need no more
_LOST_PX = 60.0  # a larger error, or a confidence below `TRACKED_FROM`, makes the detector search the whole next frame


@dataclass(frozen=True, eq=False)
class TrackedErrors:
    """The detector's errors, frame by frame.

    Attributes
    ----------
    error, covariance:
        (n, 3, 2, 2) px, detected minus true, by landmark and view, NaN if missing; and the stated (n, 3, 2, 2, 2) px^2.
    scene, follows:
        (n,) number of the eye and tool; and True if the next row is the next frame.
    """

    error: np.ndarray
    covariance: np.ndarray
    scene: np.ndarray
    follows: np.ndarray

    def correlation(self, lag: int) -> float:
        """Correlation of a coordinate's error with the error `lag` frames later, after subtracting the mean of the scene."""
        e = np.clip(self.error, -5.0, 5.0)
        means = np.stack([np.nanmean(e[self.scene == k], axis=0) for k in np.unique(self.scene)])
        e = e - means[self.scene]
        together = np.ones(len(e) - lag, bool)
        for step in range(lag):
            together &= self.follows[step : len(e) - lag + step]
        return float(np.nanmean((e[:-lag] * e[lag:])[together]) / np.nanmean(e**2))

    def draw(self, n: int, rng: np.random.Generator, *, stretch: int = 50) -> np.ndarray:
        """Rows for n frames from one random scene: stretches of consecutive frames, `stretch` long on average."""
        mine = np.flatnonzero(self.scene == rng.integers(self.scene.max() + 1))
        rows = np.empty(n, int)
        for i in range(n):
            fresh = i == 0 or rng.random() * stretch < 1 or not self.follows[rows[i - 1]]
            rows[i] = rng.choice(mine) if fresh else rows[i - 1] + 1
        return rows


def tracked_errors(
    scenes: int = 8, *, parts: int = 3, frames: int = 32, seed: int = 40, detector: Detector | None = None
) -> TrackedErrors:
    """Errors of a detector that follows the tools of `scenes` eyes, from the cache or rendered (0.2 CPU s a frame).

    Parameters
    ----------
    parts, frames:
        Number of parts of each scene's motion, and of frames in each part.
    seed:
        Seed of the first scene.  Every third scene shows a surgeon's motion, the others a sweep.
    detector:
        None = the one that ships.
    """
    detector = detector or Detector.load()
    file = paths.CACHE / "tracked" / f"{detector.digest[:16]}-{scenes}-{parts}-{frames}-{seed}.npz"
    if not file.is_file():
        found = [list(_followed(detector, seed + k, parts, frames)) for k in range(scenes)]
        rows = [(*row, k) for k, scene in enumerate(found) for row in scene]
        error, covariance, follows, scene = (np.array(column) for column in zip(*rows, strict=True))
        file.parent.mkdir(parents=True, exist_ok=True)
        with files.whole(file) as partial, partial.open("wb") as target:
            np.savez(target, error=error, covariance=covariance, scene=scene, follows=follows)
    with np.load(file) as kept:
        return TrackedErrors(**kept)


def _followed(detector: Detector, seed: int, parts: int, frames: int) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """(error, covariance, True if another frame follows) of each frame of a scene."""
    kind, duration_s = ("surgeon", 18.0) if seed % 3 == 1 else ("sweep", 60.0)
    microscope, rng = Microscope(), np.random.default_rng([seed, 131])
    eye = Eye(seed=RESERVED_SEEDS[seed % len(RESERVED_SEEDS)])
    forceps = reserved_forceps(np.random.default_rng([seed, 103]), seed % len(RESERVED_SEEDS))
    motion = Motion(forceps, eye, kind=kind, seed=seed, duration_s=duration_s)
    rig = microscope.rig(RigidTransform.identity())
    for start in np.linspace(0.3, duration_s - 1.0 - frames / microscope.fps, parts):
        before: Landmarks | None = None
        for i in range(frames):
            time = start + i / microscope.fps
            pose, later = motion.pose(time), (motion.pose(time + 1e-3), 1e-3)
            images, true, origin = [], [], []
            for side, camera in enumerate((rig.left, rig.right)):
                centre = camera.project(forceps.landmarks(pose)).mean(axis=0)
                window = Window.around(camera, centre, (_SIDE_PX, _SIDE_PX), microscope.image_size_px)
                view = render_view(eye, microscope, window, side=side, forceps=forceps, pose=pose, later=later, rng=rng)
                images.append(_compressed(view.image, microscope.jpeg_quality))
                true.append(view.u)
                origin.append(np.array(window.origin_px))
            true, origin = np.array(true), np.array(origin)[:, None]
            lost = before is None or not (np.linalg.norm(before.u - origin - true, axis=2) < _LOST_PX).all()
            lost = lost or (before.confidence < TRACKED_FROM).any()
            # Instead of a search of the whole frame, start from the truth plus an error of a few pixels.
            u = true + rng.normal(0, 3.0, true.shape) if lost else before.u - origin
            near = Landmarks(u, np.tile(np.eye(2), (2, 3, 1, 1)), np.full((2, 3), 0.9))
            found = detector.track(np.stack(images), near, min_confidence=0.0)
            before = Landmarks(found.u + origin, found.covariance, found.confidence)
            seen = (found.confidence >= MIN_CONFIDENCE)[..., None]
            error = np.where(seen, found.u - true, np.nan).transpose(1, 0, 2)
            yield error, found.covariance.transpose(1, 0, 2, 3), i + 1 < frames


def _compressed(image: np.ndarray, quality: int | None) -> np.ndarray:
    if quality is None:
        return image
    data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
