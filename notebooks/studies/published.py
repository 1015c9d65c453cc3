"""The paper's own detector (Sec. V-B): one network that sees the whole frame, reduced to one of four resolutions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lib import paths
from lib.geometry import cell_from_image, image_from_cell
from lib.landmarks import Detector, Landmarks
from lib.landmarks.heatmaps import decode
from lib.landmarks.network import StackedHourglass
from lib.training.loop import load_training
from lib.training.samples import LabelledImage

#: (width, height) of the network's frames, by the paper's names.
RESOLUTIONS = {"1080p": (1920, 1080), "480p": (854, 480), "480x640": (640, 480), "256x448": (448, 256)}


def shrunk(labelled: LabelledImage, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image as the network sees it, with its landmarks and their visibility."""
    stride = np.array(labelled.image.shape[1::-1]) / size_px
    image = cv2.resize(labelled.image, size_px, interpolation=cv2.INTER_AREA)
    return image, cell_from_image(labelled.u, stride), labelled.visibility


@dataclass(frozen=True, eq=False)
class PublishedDetector:
    """Called like `Detector`.  The position of each heatmap's peak is computed by Eq. (1); every peak counts, even a low one.

    Attributes
    ----------
    network:
        Trained by `studies/papers_network`.
    size_px:
        (width, height) of its input.
    """

    network: StackedHourglass
    size_px: tuple[int, int]

    def __call__(self, images: np.ndarray) -> Landmarks:
        """Landmarks of images (n, h, w, 3), in their own pixels; the confidence is the height of the peak."""
        small = np.stack([cv2.resize(image, self.size_px, interpolation=cv2.INTER_AREA) for image in images])
        peaks = decode(Detector(self.network).outputs(small, "frame"), self.network.stride, method="paper")
        u = image_from_cell(peaks.u.numpy(), np.array(images.shape[2:0:-1]) / self.size_px)
        return Landmarks(u, np.full((*u.shape, 2), np.nan), peaks.value.numpy().clip(0, 1))


def kept(
    resolution: str, *, features: int = 64, epochs: int = 150, batch: int = 4, every: int = 1, seed: int = 0,
    data: str = "dataset-0",
) -> Path:  # fmt: skip
    """The checkpoint of a training of `studies/papers_network`; the parameters are the study's, `data` its folder's name."""
    folder = paths.CACHE / "studies" / "papers_network" / data
    return folder / f"{resolution}-{features}-{epochs}x{batch}-every{every}-seed{seed}" / "last.safetensors"


def load_published(resolution: str) -> PublishedDetector:
    """The detector that `studies/papers_network` trained at a resolution, with its other parameters at their defaults.

    Raises
    ------
    ValueError, FileNotFoundError
        If the resolution is unknown, or was not trained on this machine.
    """
    if resolution not in RESOLUTIONS:
        raise ValueError(f"resolution: {resolution!r} is none of the paper's; choose one of {', '.join(RESOLUTIONS)}.")
    if not (path := kept(resolution)).is_file():
        raise FileNotFoundError(f"{path.parent}: not trained; run `python3 -m lib sweep studies/papers_network`.")
    return PublishedDetector(load_training(path).network, RESOLUTIONS[resolution])
