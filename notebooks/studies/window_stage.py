"""A detector whose last stage is a network under study: windows round each landmark, at full resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lib.landmarks import Detector, Landmarks
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.metrics import GROSS_PX
from lib.landmarks.network import StackedHourglass
from lib.training.error_models import Seen, seen_by
from lib.training.samples import LabelledImage


@dataclass(frozen=True, eq=False)
class WindowStage:
    """Called as `Detector` is.

    Attributes
    ----------
    finder:
        Finds the rough landmarks: the shipped stages before the last.
    network:
        The windows' stage.
    errors:
        Its error model.
    """

    finder: Detector
    network: StackedHourglass
    errors: ErrorModel = field(default_factory=ErrorModel)

    @cached_property
    def last(self) -> Detector:
        """The windows' stage alone."""
        return Detector(self.finder.frame_network, window_network=self.network, error_models={"window": self.errors})

    def __call__(self, images: ArrayLike) -> Landmarks:
        """Landmarks of images (n, h, w, 3)."""
        return self.last.refine(np.asarray(images), self.finder(images), "window")

    def fitted(self, images: Sequence[LabelledImage], rough: Landmarks) -> WindowStage:
        """A copy whose error model is fitted on validation images, `rough` being the finder's landmarks in them."""
        parts = [seen_by(self.last, "window", one, rough[i : i + 1]) for i, one in enumerate(images)]
        return replace(self, errors=Seen.joined([part for part in parts if len(part.landmark)]).fit(GROSS_PX))
