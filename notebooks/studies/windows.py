"""Data for studies that train on the reference rig: shards of frames, and upright windows cut from them.

A shard has each frame at a fifth of its resolution and a crop around each landmark.  Validation shards also have the frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lib import paths
from lib.files import whole
from lib.geometry import cell_from_image
from lib.landmarks import windows
from lib.simulator.population import TEXTURE_SEEDS, VALIDATION_TEXTURE_SEEDS, sample
from lib.training.samples import LabelledImage, Source
from lib.training.shards import packed, read_shards, square_round

#: Factor by which the stored frames are reduced.
STORED_REDUCTION = 5
#: Reduction of the windows around the tool, and the landmark index that means the whole tool.
TOOL_REDUCTION, TOOL = STORED_REDUCTION, 3
CROP_PX = 288
FRAMES = 16
#: Seeds of each kind of shard.
_SEEDS = {"training": 0, "validation": 1}


def simulated(shards: int, validation: int = 3) -> Path:
    """The folder of the simulated frames, with at least these numbers of shards of 16 frames; missing shards are made."""
    folder = paths.CACHE / "landmarks"
    folder.mkdir(parents=True, exist_ok=True)
    for kind, n in (("training", shards), ("validation", validation)):
        textures = VALIDATION_TEXTURE_SEEDS if kind == "validation" else TEXTURE_SEEDS
        for i in range(n):
            path, rng = folder / f"{kind}_{i:04d}.npz", np.random.default_rng([_SEEDS[kind], i])
            if not path.exists():
                frames = (LabelledImage(str(k), *sample(rng, textures=textures, population="near")) for k in range(FRAMES))
                write_frames(path, frames, keep_frames=kind == "validation")
    return folder


def write_frames(path: Path, images: Iterable[LabelledImage], *, keep_frames: bool) -> None:
    """Write one shard from full-resolution labelled images of one size; with the images themselves if `keep_frames`."""
    images, r = list(images), STORED_REDUCTION
    sizes = [(image.shape[1] // r, image.shape[0] // r) for _, image, *_ in images]
    frames = [cv2.resize(part.image, size, interpolation=cv2.INTER_AREA) for part, size in zip(images, sizes, strict=True)]
    u, seen = np.stack([part.u for part in images]), np.stack([part.visibility for part in images])
    frame, landmark = np.nonzero((seen > 0) & np.isfinite(u).all(2))
    crops = [square_round(images[i].image, u[i], k, CROP_PX) for i, k in zip(frame, landmark, strict=True)]
    ends, jpegs = packed(images)[:2] if keep_frames else (np.zeros(0, int), np.zeros(0, np.uint8))
    with whole(path) as partial:
        np.savez(
            partial,
            frames=np.stack(frames),
            u=u,
            visibility=seen,
            crops=np.array([crop for crop, _ in crops], np.uint8).reshape(-1, CROP_PX, CROP_PX, 3),
            crop_u=np.array([at for _, at in crops]).reshape(-1, 3, 2),
            crop_visibility=seen[frame],
            crop_landmark=landmark,
            jpegs=jpegs,
            jpeg_ends=ends,
        )


@dataclass(frozen=True)
class WindowSource(Source):
    """Upright windows of `size` px, cut out of crops (n, h, w, 3) uint8 with their labels.

    Each is cut around its `landmark` (n,) or, if that is `TOOL`, around the middle of the tool.  `shift_px` and `turn_rad`
    are standard deviations of the error in position and direction, three times as large in a tenth of the windows.  `zoom`
    is the range of magnification.
    """

    crops: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    landmark: np.ndarray
    size: int = 128
    shift_px: float = 6.0
    turn_rad: float = 0.08
    zoom: tuple[float, float] = (0.85, 1.2)

    @classmethod
    def load(cls, folder: str | Path, *, validation: bool = False, shards: int | None = None) -> WindowSource:
        """Windows around the landmarks, from the first `shards` of a folder; None = all."""
        names = "crops", "crop_u", "crop_visibility", "crop_landmark"
        return cls(*read_shards(folder, "validation" if validation else "training", names, shards))

    @classmethod
    def load_tools(cls, folder: str | Path, *, validation: bool = False, shards: int | None = None) -> WindowSource:
        """Windows around the whole tool at `TOOL_REDUCTION`."""
        kind = "validation" if validation else "training"
        frames, u, visibility = read_shards(folder, kind, ("frames", "u", "visibility"), shards)
        labels = cell_from_image(u, TOOL_REDUCTION), visibility, np.full(len(u), TOOL)
        return cls(frames, *labels, shift_px=8.0, turn_rad=0.2, zoom=(0.75, 1.3))

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        u = self.u[index]
        worse = 3.0 if rng.random() < 0.1 else 1.0
        limit = 0.3 * self.size
        (middle,), (direction,) = windows.tool_pose(u[None])
        at = middle if self.landmark[index] == TOOL else u[self.landmark[index]]
        centre = at + np.clip(rng.normal(0, worse * self.shift_px, 2), -limit, limit)
        angle = direction + np.clip(rng.normal(0, worse * self.turn_rad), -0.6, 0.6)
        matrix = windows.window_from_image(centre, angle, self.size, rng.uniform(*self.zoom))
        return windows.cut(self.crops[index], matrix, self.size), windows.map_points(matrix, u), self.visibility[index]
