"""Scores of a detector on labelled images."""

from collections.abc import Callable, Iterable, Mapping
from itertools import chain
from typing import NamedTuple, Self

import numpy as np
from tqdm.auto import tqdm

from lib.correspondences import LANDMARKS
from lib.landmarks import Landmarks
from lib.landmarks.metrics import Scores, calibration_error, errors_px, pck, score, tool_length_px
from lib.training.samples import LabelledImage


class Evaluation(NamedTuple):
    """Detections in n images, and their labels.

    Attributes:
        u_true: (n, 3, 2) labels in view, NaN elsewhere.
        visibility: (n, 3) 0, 1, 2, and -1 where nothing is labelled.
        length_px: (n,) the tool's length, the unit of PCK, also where a tip is out of the frame.
        label_sd_px: (n, 3) standard deviation of the labels.  Scores add it to the covariances, as labels have errors, too.
    """

    landmarks: Landmarks
    u_true: np.ndarray
    visibility: np.ndarray
    length_px: np.ndarray
    label_sd_px: np.ndarray
    names: list[str]

    @classmethod
    def joined(cls, parts: Iterable[Self]) -> Self:
        """Join several evaluations."""
        found, *arrays, names = zip(*parts, strict=True)
        return cls(Landmarks.join(found), *map(np.concatenate, arrays), list(chain(*names)))

    @property
    def scores(self) -> Scores:
        """Scores of all landmarks; a ValueError if no label is in view."""
        if not (found := self.by({"all": True})):
            raise ValueError("images: no label is in view; give images that show a labelled tool.")
        return found["all"]

    @property
    def error_px(self) -> np.ndarray:
        """(n, 3) distance from the label: infinite if missed, NaN without a label."""
        return errors_px(self.landmarks.u, self.u_true)

    @property
    def correct(self) -> np.ndarray:
        """(n, 3) bool: in view and within 5 % of the tool's length; confidence is the probability of this."""
        return self.error_px <= 0.05 * self.length_px[:, None]

    @property
    def confidence_error(self) -> float:
        """Calibration error of the confidence as the probability of `correct`; a landmark out of view is never correct.

        Images whose labels do not show the tool's length do not count.
        """
        known = (np.isfinite(self.u_true).all(2) & np.isfinite(self.length_px)[:, None]) | (self.visibility == 0)
        return calibration_error(self.landmarks.confidence[known], self.correct[known])

    def by(self, groups: Mapping[str, np.ndarray | bool]) -> dict[str, Scores]:
        """Scores of groups of landmarks, each a mask that broadcasts to (n, 3); groups without a label are left out."""
        found, result = self.landmarks, {}
        covariance = found.covariance + self.label_sd_px[..., None, None] ** 2 * np.eye(2)
        for name, mask in groups.items():
            u = np.where(np.broadcast_to(mask, self.visibility.shape)[..., None], self.u_true, np.nan)
            if np.isfinite(u).any():
                result[name] = score(found.u, u, covariance, length_px=self.length_px)
        return result

    def by_landmark(self) -> dict[str, Scores]:
        """Scores of base, tip_1, tip_2."""
        return self.by({name: np.arange(3) == k for k, name in enumerate(LANDMARKS)})

    def by_visibility(self) -> dict[str, Scores]:
        """Scores of visible and of hidden landmarks."""
        return self.by({"visible": self.visibility == 2, "occluded": self.visibility == 1})

    def detection(self) -> dict[str, float]:
        """Precision and recall in percent, at confidence 0.5, of landmarks in the frame, and of those visible there."""
        detected = (self.landmarks.confidence >= 0.5) & (self.visibility >= 0)
        result: dict[str, float] = {}
        for name, there in (("in_view", self.visibility > 0), ("visible", self.visibility == 2)):
            for measure, among in (("precision", detected), ("recall", there)):
                result[f"{name}_{measure}"] = 100 * float((detected & there)[among].mean()) if among.any() else np.nan
        return result

    def curve(self, thresholds: np.ndarray) -> np.ndarray:
        """PCK in percent at thresholds (fractions of the tool's length)."""
        return pck(self.landmarks.u, self.u_true, thresholds, length_px=self.length_px)


def evaluate(
    detector: Callable[[np.ndarray], Landmarks], images: Iterable[LabelledImage], *, progress: bool = False
) -> Evaluation:
    """Run a detector over labelled images, such as `lib.training.samples.labelled_images` of a recording.

    `detector` is a `lib.landmarks.Detector`, or any function from images (n, h, w, 3) to their `Landmarks`.  Raises
    ValueError if there is no image.

    >>> missed = LabelledImage("dark", np.zeros((90, 90, 3), np.uint8), np.full((3, 2), 30.0), np.full(3, 2))
    >>> evaluate(lambda images: Landmarks.none(len(images)), [missed]).scores.missed
    3
    """
    parts = []
    for labelled in tqdm(images, disable=not progress, unit="image"):
        unknown = ~np.isfinite(labelled.u).all(1) & (labelled.visibility > 0)
        labels = labelled.in_view[None], np.where(unknown, -1, labelled.visibility)[None], tool_length_px(labelled.u[None])
        parts.append(Evaluation(detector(labelled.image[None]), *labels, np.full((1, 3), labelled.sd_px), [labelled.name]))
    if not parts:
        raise ValueError("images: no labelled image to evaluate on.")
    return Evaluation.joined(parts)
