"""What the last stage trains on: upright closeups, placed as badly as the stage before places them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from lib.landmarks import windows
from lib.landmarks.metrics import tool_length_px
from lib.simulator.window import motion_kernel
from lib.training.appearance import disguised
from lib.training.samples import LabelledImage, Source
from lib.training.shards import BLOCK_PX, CLOSEUP_CROP_PX, read_shards, square_round

__all__ = ["CloseupSource"]

_CROPS = ("crops", "crop_u", "crop_visibility", "crop_landmark")
#: A closeup shows a part of the tool: blur and things in front are drawn as for a tool of this length.
_DISGUISE_PX = 40.0


@dataclass(frozen=True)
class CloseupSource(Source):
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

    crops: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    landmark: np.ndarray
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
        parts = ((*square_round(images[i].image, images[i].u, k, CLOSEUP_CROP_PX), images[i].visibility, k) for i, k in which)
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
