"""A detector whose last stage sees the frame at one of the paper's four input resolutions (paper Sec. V-B).

The frame is shrunk to the resolution under study, so that nothing finer reaches the windows.  The first two stages, which
find the tool and need less than any of the four, are those of the shipped detector.  Results are full-HD pixels.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib import paths
from lib.files import write_json
from lib.geometry import cell_from_image, image_from_cell
from lib.landmarks import Detector, Landmarks
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.metrics import GROSS_PX
from lib.landmarks.network import StackedHourglass
from lib.training.error_models import Seen, seen_by
from lib.training.loop import load_training
from lib.training.samples import LabelledImage
from notebooks.studies.windows import WindowSource

#: (width, height) of the network's frames, by the paper's names.
RESOLUTIONS = {"1080p": (1920, 1080), "480p": (854, 480), "480x640": (640, 480), "256x448": (448, 256)}
#: What a window shows, in full-HD pixels, at any resolution.
FIELD_PX = 128
_FULL = np.array(RESOLUTIONS["1080p"], dtype=float)


def window_side_px(size_px: tuple[int, int]) -> int:
    """Side of the windows in frames of this (width, height): `FIELD_PX` shrunk, a multiple of 4."""
    return 4 * round(FIELD_PX * np.sqrt(np.prod(np.array(size_px) / _FULL)) / 4)


def resolution_windows(source: WindowSource, size_px: tuple[int, int]) -> WindowSource:
    """Full-HD crops shrunk as frames of (width, height) are, for windows of `window_side_px`."""
    h, w = source.crops.shape[1:3]
    small, side = tuple(round(s) for s in np.array([w, h]) * size_px / _FULL), window_side_px(size_px)
    if small == (w, h):
        return replace(source, size=side)
    stride = np.array([w, h]) / small  # whole pixels, so up to 0.6 % off the frame's own
    crops = np.stack([cv2.resize(crop, small, interpolation=cv2.INTER_AREA) for crop in source.crops])
    u, shift_px = cell_from_image(source.u, stride), source.shift_px * side / FIELD_PX
    return replace(source, crops=crops, u=u, size=side, shift_px=shift_px)


@dataclass(frozen=True, eq=False)
class ReducedDetector:
    """Called as `Detector` is, on full-HD images.

    Attributes
    ----------
    finder:
        Finds the rough landmarks: the shipped stages before the last.
    network:
        The windows' stage, trained at this resolution.
    size_px:
        (width, height) of the frames it sees.
    errors:
        Its error model.
    """

    finder: Detector
    network: StackedHourglass
    size_px: tuple[int, int]
    errors: ErrorModel = field(default_factory=ErrorModel)

    @cached_property
    def last(self) -> Detector:
        """The windows' stage alone, for frames of `size_px`."""
        models, side = {"window": self.errors}, window_side_px(self.size_px)
        return Detector(self.finder.frame_network, window_network=self.network, window_px=side, error_models=models)

    def __call__(self, images: ArrayLike, *, batch: int = 4) -> Landmarks:
        """Landmarks of images (n, h, w, 3), in their own pixels."""
        return self.refine(np.asarray(images), self.finder(images, batch=batch))

    def reduced(self, images: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Images and points as the windows' stage sees them, and the stride (x, y) of its pixels in image pixels."""
        stride = np.array(images.shape[2:0:-1]) / self.size_px
        if (stride != 1).any():
            images = np.stack([cv2.resize(image, self.size_px, interpolation=cv2.INTER_AREA) for image in images])
        return images, cell_from_image(u, stride), stride

    def refine(self, images: np.ndarray, rough: Landmarks) -> Landmarks:
        """The windows' stage alone, from rough landmarks in the images' pixels."""
        small, u, stride = self.reduced(images, rough.u)
        scale = np.outer(stride, stride)
        found = self.last.refine(small, Landmarks(u, rough.covariance / scale, rough.confidence), "window")
        return Landmarks(image_from_cell(found.u, stride), found.covariance * scale, found.confidence)

    def fitted(self, images: Sequence[LabelledImage], rough: Landmarks) -> ReducedDetector:
        """A copy whose error model is fitted on validation images, `rough` being the finder's landmarks in them."""
        parts = []
        for i, labelled in enumerate(images):
            small, at, stride = self.reduced(labelled.image[None], rough.u[i : i + 1])
            sd_px = np.asarray(labelled.sd_px) / stride.mean()
            true = labelled._replace(image=small[0], u=cell_from_image(labelled.u, stride), sd_px=sd_px)
            parts.append(seen_by(self.last, "window", true, replace(rough[i : i + 1], u=at)))
        seen = Seen.joined([part for part in parts if len(part.landmark)])
        return replace(self, errors=seen.fit(GROSS_PX * window_side_px(self.size_px) / FIELD_PX))

    def save_errors(self, folder: Path) -> None:
        """Keep the error model beside the checkpoint."""
        write_json(folder / "errors.json", asdict(self.errors))


def load_resolution(
    name: str, *, seed: int = 0, folder: str | Path | None = None, finder: Detector | None = None
) -> ReducedDetector:
    """The detector that ``studies/resolution`` trained for one of `RESOLUTIONS`.

    Parameters
    ----------
    folder:
        Of the study's trainings; None = ``data/cache/studies/resolution``.
    finder:
        Finds the tool; None = the shipped detector.

    Raises
    ------
    ValueError, FileNotFoundError
        For an unknown resolution, or one that is not trained here.
    """
    if name not in RESOLUTIONS:
        raise ValueError(f"name: {name!r} is no resolution of the paper; choose one of {', '.join(RESOLUTIONS)}.")
    folder = Path(folder or paths.CACHE / "studies" / "resolution") / name / f"seed{seed}"
    if not (folder / "errors.json").is_file():  # written when the training is done
        raise FileNotFoundError(f"{folder}: not trained; run `python3 -m lib sweep studies/resolution`.")
    network = load_training(folder / "last.safetensors").network
    errors = ErrorModel(**json.loads((folder / "errors.json").read_text(encoding="utf-8")))
    finder = replace(finder or Detector.load(), window_network=None, closeup_network=None)
    return ReducedDetector(finder, network, RESOLUTIONS[name], errors)
