"""The detector at the paper's four input resolutions (paper Sec. V-B, figure of PCK over thresholds).

The frame is first shrunk to the resolution under study, so nothing finer reaches the windows; the first two stages, which
find the tool and need less than any of the four, are those of the shipped detector.  Results are full-HD pixels again.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib import paths
from lib.geometry import cell_from_image, image_from_cell
from lib.landmarks import Detector, Landmarks
from lib.landmarks.error_model import ErrorModel, features_of
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.network import StackedHourglass
from lib.landmarks.windows import map_points
from lib.training.evaluation import GROSS_PX, _fit
from lib.training.loop import load_training
from lib.training.samples import WindowSource

__all__ = ["FIELD_PX", "RESOLUTIONS", "ReducedDetector", "load_resolution", "resolution_windows", "window_side_px"]

#: (width, height) of the network's frames, by the paper's names.
RESOLUTIONS = {"1080p": (1920, 1080), "480p": (854, 480), "480x640": (640, 480), "256x448": (448, 256)}
#: What a window shows, in full-HD pixels, whatever the resolution.
FIELD_PX = 128
_FULL = np.array(RESOLUTIONS["1080p"], dtype=float)


def window_side_px(size_px: tuple[int, int]) -> int:
    """Side of the windows in frames of this (width, height): `FIELD_PX` shrunk, a multiple of 4."""
    return 4 * round(FIELD_PX * np.sqrt(np.prod(np.array(size_px) / _FULL)) / 4)


def resolution_windows(source: WindowSource, size_px: tuple[int, int]) -> WindowSource:
    """Full-HD crops shrunk as frames of (width, height) are, for windows of `window_side_px`."""
    h, w = source.crops.shape[1:3]
    small = tuple(round(s) for s in np.array([w, h]) * size_px / _FULL)
    if small == (w, h):
        return replace(source, size=window_side_px(size_px))
    stride = np.array([w, h]) / small  # whole pixels, so up to 0.6 % off the frame's own
    crops = np.stack([cv2.resize(crop, small, interpolation=cv2.INTER_AREA) for crop in source.crops])
    side = window_side_px(size_px)
    return replace(
        source,
        crops=crops,
        u=cell_from_image(source.u, stride),
        size=side,
        shift_px=source.shift_px * side / FIELD_PX,
    )


@dataclass(frozen=True, eq=False)
class ReducedDetector:
    """A detector whose windows are of the frame at another resolution; called as `Detector` is, on full-HD images.

    Attributes
    ----------
    finder:
        Names the tool's rough landmarks: the shipped stages before the last.
    network:
        The windows' stage, trained at this resolution.
    size_px:
        (width, height) of the frames it sees.
    calibration:
        Of its covariance and confidence.
    """

    finder: Detector
    network: StackedHourglass
    size_px: tuple[int, int]
    calibration: ErrorModel = field(default_factory=ErrorModel)

    @cached_property
    def _last(self) -> Detector:
        return Detector(
            self.finder.frame_network,
            window_network=self.network,
            window_px=window_side_px(self.size_px),
            error_models={"window": self.calibration},
        )

    def __call__(self, images: ArrayLike, *, batch: int = 4) -> Landmarks:
        """Landmarks of images (n, h, w, 3), in their own pixels."""
        return self.refine(np.asarray(images), self.finder(images, batch=batch))

    def reduced(self, images: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Images and points as the windows' stage sees them, and the stride (x, y) of its pixels, in pixels of `images`."""
        stride = np.array(images.shape[2:0:-1]) / self.size_px
        if (stride != 1).any():
            images = np.stack([cv2.resize(image, self.size_px, interpolation=cv2.INTER_AREA) for image in images])
        return images, cell_from_image(u, stride), stride

    def refine(self, images: np.ndarray, rough: Landmarks) -> Landmarks:
        """The windows' stage alone, from rough landmarks in the images' pixels."""
        small, u, stride = self.reduced(images, rough.u)
        scale = np.outer(stride, stride)
        found = self._last.refine(small, Landmarks(u, rough.covariance / scale, rough.confidence), "window")
        return Landmarks(image_from_cell(found.u, stride), found.covariance * scale, found.confidence)

    def calibrated(
        self, images: np.ndarray, rough: Landmarks, u: np.ndarray, visibility: np.ndarray
    ) -> ReducedDetector:
        """A copy whose covariance and confidence are fitted to its errors on validation images (n, h, w, 3).

        `u` (n, 3, 2) and `visibility` (n, 3) are their labels, `rough` where the finder sees the landmarks.
        """
        labels = np.where((np.isfinite(u).all(2) & (visibility > 0))[..., None], u, np.nan)
        features, errors, correct, landmark = [], [], [], []
        for i in range(len(images)):
            small, at, stride = self.reduced(images[i : i + 1], rough.u[i : i + 1])
            peaks, matrices, which = self._last.stage_peaks(small, at, "window")
            if not len(which):
                continue
            feature = features_of(peaks.double(), 1)[:, 0].numpy()
            true = cell_from_image(labels[i], stride)[which[:, 1]]
            difference = peaks.u[:, 0].double().numpy() - map_points(matrices, true)
            turned = np.linalg.inv(matrices[:, :, :2]) @ difference[..., None]
            distance = np.linalg.norm(turned[..., 0] * stride, axis=1)
            with np.errstate(invalid="ignore"):
                correct.append(distance <= 0.05 * tool_length_px(u[i : i + 1])[0])
            features.append(feature)
            errors.append(difference)
            landmark.append(which[:, 1])
        gross = GROSS_PX * window_side_px(self.size_px) / FIELD_PX
        fit = _fit(*(np.concatenate(part) for part in (features, errors, correct, landmark)), gross_px=gross)
        return replace(self, calibration=fit)

    def save_calibration(self, folder: Path) -> None:
        """Beside the checkpoint, as ``calibration.json``."""
        (folder / "calibration.json").write_text(json.dumps(asdict(self.calibration)) + "\n", encoding="utf-8")


def load_resolution(
    name: str, *, seed: int = 0, folder: str | Path | None = None, finder: Detector | None = None
) -> ReducedDetector:
    """The detector that the resolution study trained for one of `RESOLUTIONS`.

    Parameters
    ----------
    folder:
        Of the study; None = ``data/cache/studies/resolution``.
    finder:
        Finds the tool; None = the shipped detector.

    Raises
    ------
    ValueError, FileNotFoundError
        For an unknown resolution, or one that no study has trained here.
    """
    if name not in RESOLUTIONS:
        raise ValueError(f"name: {name!r} is no resolution of the paper; choose one of {', '.join(RESOLUTIONS)}.")
    folder = Path(folder or paths.CACHE / "studies" / "resolution") / name / f"seed{seed}"
    if not (folder / "last.safetensors").is_file():
        raise FileNotFoundError(f"{folder}: not trained; run `python3 -m notebooks.studies.detector_studies resolution`.")
    network = load_training(folder / "last.safetensors").network
    fit = ErrorModel()
    if (folder / "calibration.json").is_file():
        fit = ErrorModel.of(**json.loads((folder / "calibration.json").read_text()))
    finder = finder or Detector.load()
    return ReducedDetector(replace(finder, window_network=None, closeup_network=None), network, RESOLUTIONS[name], fit)
