"""What the later stages train on: upright windows and closeups, placed as badly as the stage before places them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from lib.geometry import cell_from_image
from lib.landmarks import windows
from lib.landmarks.metrics import tool_length_px
from lib.simulator.window import motion_kernel
from lib.training.appearance import disguised
from lib.training.samples import LabelledImage, Source
from lib.training.shards import BLOCK_PX, CLOSEUP_CROP_PX, STORED_REDUCTION, cropped, read_shards

__all__ = ["TOOL", "TOOL_REDUCTION", "CloseupSource", "WindowSource"]

#: Reduction of the studies' windows round the tool, and the landmark index that means the whole tool.
TOOL_REDUCTION, TOOL = STORED_REDUCTION, 3
_CROPS = ("crops", "crop_u", "crop_visibility", "crop_landmark")
#: A closeup shows a part of the tool: blur and things in front are drawn as for a tool of this length.
_DISGUISE_PX = 40.0


@dataclass(frozen=True)
class _Cut(Source):
    """Windows cut out of crops (n, h, w, 3) uint8 with their labels; each shows one `landmark` (n,)."""

    crops: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    landmark: np.ndarray


@dataclass(frozen=True)
class WindowSource(_Cut):
    """Upright windows of `size` px round landmarks, or, where `landmark` is `TOOL`, round the middle of the tool.

    `shift_px` and `turn_rad` are standard deviations of the error of place and direction; a tenth of the windows has three
    times as much.  `zoom` is the range of magnification.
    """

    size: int = 128
    shift_px: float = 6.0
    turn_rad: float = 0.08
    zoom: tuple[float, float] = (0.85, 1.2)

    @classmethod
    def load(cls, folder: str | Path, *, validation: bool = False, shards: int | None = None) -> Self:
        """From the shards of a folder, those of windows alone included; or from its first `shards` of frames."""
        kinds = ("validation",) if validation else ("training", "windows")[: 1 if shards else 2]
        return cls(*read_shards(folder, kinds, _CROPS, shards))

    @classmethod
    def load_tools(cls, folder: str | Path, *, validation: bool = False, shards: int | None = None) -> Self:
        """Windows round the whole tool at `TOOL_REDUCTION`."""
        kind = "validation" if validation else "training"
        frames, u, visibility = read_shards(folder, (kind,), ("frames", "u", "visibility"), shards)
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


@dataclass(frozen=True)
class CloseupSource(_Cut):
    """Closeups of visible landmarks, displaced as the stage before or the frame before may place them, of stretched tools.

    Stretching and shearing an image keeps its labels true and makes many tools of one.

    Attributes:
        shifts_px, shift_shares: Standard deviations of the error of place, in image pixels at the reference scale, and the
            share of closeups that has each.
        turn_rad, length: Standard deviations of the errors of direction and of the logarithm of the tool's length.
        alone: Share of closeups whose direction is that to one tip, as if the other one were missing.
        stretch, shear: Standard deviations of the logarithms of two stretches, along and across the tool, and of the shear.
        motion_px: Standard deviation of the movement that blurs half of the closeups, in their pixels along x and y.
        disguise: Share of closeups whose appearance is changed.
        weight: (n,) share of the draws in which a label counts.
    """

    size: int = 64
    shifts_px: tuple[float, ...] = (2.0, 4.0, 8.0)
    shift_shares: tuple[float, ...] = (0.5, 0.25, 0.25)
    turn_rad: float = 0.03
    length: float = 0.08
    alone: float = 0.05
    stretch: float = 0.1
    shear: float = 0.05
    motion_px: float = 1.7
    disguise: float = 0.5
    weight: np.ndarray | None = None

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """From a folder's shards, the landmarks that are not hidden."""
        parts = read_shards(folder, ("closeups",), _CROPS)
        seen = parts[2][np.arange(len(parts[3])), parts[3]] == 2
        return cls(*(parts if seen.all() else (part[seen] for part in parts)))

    @classmethod
    def of(cls, images: Sequence[LabelledImage], *, still: bool = False, weight: np.ndarray | None = None) -> Self:
        """From labelled images of any size; for validation `still`, neither stretched nor blurred nor disguised."""
        which = [(i, k) for i, labelled in enumerate(images) for k in np.flatnonzero(_sharp(labelled))]
        if not which:
            raise ValueError("images: no visible landmark of a tool with base and tip; label some.")
        parts = (cropped(images[i], k, CLOSEUP_CROP_PX) for i, k in which)
        weight = None if weight is None else np.array([weight[i, k] for i, k in which])
        source = cls(*map(np.array, zip(*parts, strict=True)), weight=weight)
        return source if not still else replace(source, stretch=0.0, shear=0.0, motion_px=0.0, disguise=0.0)

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A closeup; only its own landmark counts as visible."""
        k = self.landmark[index]
        # A crop ends before a turned closeup's corners do.  Where it ends must not tell where its middle was.
        x, y = rng.integers(0, BLOCK_PX, 2, endpoint=True)
        h, w = (side - BLOCK_PX for side in self.crops.shape[1:3])
        crop, u = self.crops[index, y : y + h, x : x + w], self.u[index] - (x, y)
        length = tool_length_px(u[None])[0] * np.exp(rng.normal(0, self.length))
        shift = rng.normal(0, self.shifts_px[rng.choice(len(self.shifts_px), p=self.shift_shares)], 2)
        shift *= min(1.0, windows.CLOSEUP_REACH_PX / max(np.linalg.norm(shift), 1e-9)) / windows.closeup_scale(length)
        known = u.copy()
        if rng.random() < self.alone:
            known[rng.choice([j for j in (1, 2) if j != k])] = np.nan
        angle = windows.tool_pose(known[None])[1][0] + rng.normal(0, self.turn_rad)
        matrix = windows.closeup_from_image(u[k] + shift, angle, self.size, k, length)
        along, across = np.exp(rng.normal(0, self.stretch, 2))
        deform = np.array([[along, 0.0], [rng.normal(0, self.shear), across]])
        middle = (self.size - 1) / 2
        matrix = np.column_stack([deform @ matrix[:, :2], deform @ (matrix[:, 2] - middle) + middle])
        image = windows.cut(crop, matrix, self.size, border=cv2.BORDER_REPLICATE)
        kernel = motion_kernel(rng.normal(0, self.motion_px, 2)) if self.motion_px and rng.random() < 0.5 else None
        if kernel is not None:  # centred, so the landmark stays
            image = cv2.filter2D(image, -1, kernel)
        u, seen = windows.map_points(matrix, u), np.where(np.arange(3) == k, 2, 0)
        if rng.random() < self.disguise:
            image, u, seen = disguised(image, u, seen, rng, _DISGUISE_PX)
        if self.weight is not None and rng.random() > self.weight[index]:
            seen = np.zeros(3, int)
        return image, u, seen


def _sharp(labelled: LabelledImage) -> np.ndarray:
    """(3,) bool: landmarks that a closeup can show, of tools with a direction."""
    there = np.isfinite(labelled.in_view).all(1) & (labelled.visibility == 2)
    return there & np.isfinite(windows.tool_pose(labelled.u[None])[1])

