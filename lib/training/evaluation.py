"""Scores of a detector on labelled images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from lib.correspondences import LANDMARKS
from lib.landmarks import Landmarks
from lib.landmarks.metrics import Scores, calibration_error, errors_px, pck, score, tool_length_px
from lib.recordings import Recording
from lib.training.samples import LabelledImage, labelled_images

__all__ = ["Evaluation", "evaluate", "evaluate_recording"]


@dataclass(frozen=True)
class Evaluation:
    """Detections in n images beside their labels.

    Attributes:
        u_true: (n, 3, 2) labels in view, NaN elsewhere.
        visibility: (n, 3) 0, 1, 2, and -1 where nothing is labelled.
        length_px: (n,) the tool's length, the unit of PCK, also where a tip is out of the frame.
    """

    landmarks: Landmarks
    u_true: np.ndarray
    visibility: np.ndarray
    length_px: np.ndarray
    names: list[str]

    @classmethod
    def joined(cls, parts: Iterable[Evaluation]) -> Evaluation:
        """Several evaluations as one."""
        parts = list(parts)
        arrays = (np.concatenate([getattr(e, name) for e in parts]) for name in ("u_true", "visibility", "length_px"))
        return cls(Landmarks.join([e.landmarks for e in parts]), *arrays, [name for e in parts for name in e.names])

    @property
    def scores(self) -> Scores:
        """Over all landmarks."""
        return self.by({"all": True})["all"]

    @property
    def error_px(self) -> np.ndarray:
        """(n, 3): infinite where missed, NaN without a label."""
        return errors_px(self.landmarks.u, self.u_true)

    @property
    def correct(self) -> np.ndarray:
        """(n, 3) bool: in view and within 5 % of the tool's length; confidence is the probability of this."""
        return self.error_px <= 0.05 * self.length_px[:, None]

    @property
    def confidence_error(self) -> float:
        """Calibration error of confidence as the probability of being `correct`; no landmark out of view is."""
        known = np.isfinite(self.u_true).all(2) | (self.visibility == 0)
        return calibration_error(self.landmarks.confidence[known], self.correct[known])

    def by(self, groups: Mapping[str, np.ndarray | bool]) -> dict[str, Scores]:
        """Scores of groups of landmarks, each a mask that fits (n, 3); groups without a label are left out."""
        masks = {name: np.broadcast_to(mask, self.visibility.shape) for name, mask in groups.items()}
        labels = {name: np.where(mask[..., None], self.u_true, np.nan) for name, mask in masks.items()}
        found = self.landmarks
        return {
            name: score(found.u, u, found.covariance, length_px=self.length_px)
            for name, u in labels.items()
            if np.isfinite(u).any()
        }

    def by_landmark(self) -> dict[str, Scores]:
        """Scores of base, tip_1, tip_2."""
        return self.by({name: np.arange(3) == k for k, name in enumerate(LANDMARKS)})

    def by_visibility(self) -> dict[str, Scores]:
        """Scores of visible and of hidden landmarks."""
        return self.by({"visible": self.visibility == 2, "occluded": self.visibility == 1})

    def detection(self, min_confidence: float = 0.5) -> dict[str, float]:
        """Precision and recall of detections above `min_confidence`, in percent.

        ``"in_view"``: the landmark lies in the frame, hidden or not.  ``"visible"``: it is not hidden either.
        """
        detected = (self.landmarks.confidence >= min_confidence) & (self.visibility >= 0)
        result: dict[str, float] = {}
        for name, there in (("in_view", self.visibility > 0), ("visible", self.visibility == 2)):
            hit = int((detected & there).sum())
            result[f"{name}_precision"] = 100 * hit / int(detected.sum()) if detected.any() else np.nan
            result[f"{name}_recall"] = 100 * hit / int(there.sum()) if there.any() else np.nan
        return result

    def curve(self, thresholds: np.ndarray) -> np.ndarray:
        """PCK in percent at thresholds (fractions of the tool's length)."""
        return pck(self.landmarks.u, self.u_true, thresholds, length_px=self.length_px)

    def worst(self, n: int) -> np.ndarray:
        """Indices of the n images with the largest error."""
        return np.argsort(-np.nan_to_num(self.error_px, nan=-1.0, posinf=1e9).max(1), kind="stable")[:n]


def evaluate(
    detector: Callable[[np.ndarray], Landmarks], images: Iterable[LabelledImage], *, progress: bool = False
) -> Evaluation:
    """Run a detector over labelled images.

    Args:
        detector: A `lib.landmarks.Detector`, or any function from images (n, h, w, 3) to their `Landmarks`.

    Raises:
        ValueError: If there is no image.

    >>> from lib import paths
    >>> from lib.landmarks import Detector
    >>> first = next(labelled_images(Recording.open(paths.SHIPPED_RECORDING)))
    >>> bool(evaluate(Detector.load(), [first]).scores.median_px < 3)
    True
    """
    names, found, labels, visibility, length = [], [], [], [], []
    for labelled in tqdm(images, disable=not progress, unit="image"):
        names.append(labelled.name)
        found.append(detector(labelled.image[None]))
        labels.append(labelled.in_view)
        unknown = ~np.isfinite(labelled.u).all(1) & (labelled.visibility > 0)
        visibility.append(np.where(unknown, -1, labelled.visibility))
        length.append(tool_length_px(np.asarray(labelled.u, dtype=float)[None])[0])
    if not names:
        raise ValueError("images: no labelled image to evaluate on.")
    return Evaluation(Landmarks.join(found), np.stack(labels), np.stack(visibility), np.array(length), names)


def evaluate_recording(
    detector: Callable[[np.ndarray], Landmarks], recording: Recording | str | Path, *, every: int = 1, progress: bool = False
) -> Evaluation:
    """`evaluate` on both cameras' images of a recording, every `every`-th frame."""
    recording = recording if isinstance(recording, Recording) else Recording.open(recording)
    return evaluate(detector, labelled_images(recording, every=every), progress=progress)
