"""A detector whose last stage is the network under study, in windows around each landmark, at full resolution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lib.landmarks import Detector, Landmarks
from lib.landmarks.engines import accelerated
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.heatmaps import Peaks, decode
from lib.landmarks.metrics import GROSS_PX
from lib.landmarks.network import StackedHourglass, as_tensor
from lib.landmarks.windows import cut, tool_pose, window_from_image
from lib.training.error_models import Seen, seen_by
from lib.training.samples import LabelledImage

#: Side of the windows, in px.
WINDOW_PX = 128


@dataclass(frozen=True, eq=False)
class WindowStage:
    """A detector, called like `Detector`.

    Attributes
    ----------
    finder:
        Finds the rough landmarks; the shipped stages before the last.
    network:
        The stage that sees the windows.
    errors:
        The error model of that stage.
    """

    finder: Detector
    network: StackedHourglass
    errors: ErrorModel = field(default_factory=ErrorModel)

    @cached_property
    def last(self) -> Detector:
        """A detector with the error model of the windows; it gets the peaks of the network."""
        return Detector(self.finder.frame_network, error_models={"window": self.errors})

    @cached_property
    def _run(self) -> Callable[[Tensor], list[Tensor]]:
        """The network, prepared for fast inference in torch."""
        return accelerated(self.network, "torch")

    def __call__(self, images: ArrayLike) -> Landmarks:
        """Landmarks of images (n, h, w, 3)."""
        images, rough = np.asarray(images), self.finder(images)
        seen = self.stage_peaks(images, rough.u)
        return self.last.refine(images, rough, "window", seen) if seen else rough.without_unsure()

    def stage_peaks(self, images: np.ndarray, u: np.ndarray) -> tuple[Peaks, np.ndarray, np.ndarray] | None:
        """Like `Detector.stage_peaks`, for windows around rough landmarks u (n, 3, 2); None if there is no window."""
        angle = tool_pose(u)[1]
        which = np.argwhere(np.isfinite(u).all(2) & np.isfinite(angle)[:, None])
        if not len(which):
            return None
        image, landmark = which.T
        matrices = window_from_image(u[image, landmark], angle[image], WINDOW_PX)
        windows = np.stack([cut(images[i], matrix, WINDOW_PX) for i, matrix in zip(image, matrices, strict=True)])
        with torch.inference_mode():
            (heatmaps,) = self._run(as_tensor(windows))
        own = heatmaps[torch.arange(len(which)), torch.from_numpy(landmark)][:, None]
        return decode(own, self.network.stride), matrices, which

    def fitted(self, images: Sequence[LabelledImage], rough: Landmarks) -> WindowStage:
        """A copy with its error model fitted to validation images; `rough` are the finder's landmarks in them."""
        parts = []
        for i, one in enumerate(images):
            if seen := self.stage_peaks(one.image[None], rough.u[i : i + 1]):
                parts.append(seen_by(self.last, "window", one, rough[i : i + 1], seen))
        return replace(self, errors=Seen(*map(np.concatenate, zip(*parts, strict=True))).fit(GROSS_PX))
