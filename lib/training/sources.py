"""Training data of the stages: frames of any size, windows around the tool, and closeups of a landmark."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

import cv2
import numpy as np

from lib.landmarks import windows
from lib.landmarks.metrics import tool_length_px
from lib.recordings.annotations import inside
from lib.simulator.window import motion_blur
from lib.training import shards
from lib.training.appearance import disguised
from lib.training.drawings import bent, drawn_ground, drawn_tool
from lib.training.samples import LabelledImage, Source

#: Input size (width, height) of the first stage, whose width is the longer side of a shrunken frame.  It is trained on parts
#: of a frame, of the second size, which takes a third of the time, since a frame is mostly background.
FRAME_PX, PART_PX = (320, 192), (160, 128)
_TOOL_SIZE = windows.TOOL_PX, windows.TOOL_PX
#: Drawings are made on a part of the frame of this (width, height): drawing on a whole frame would dominate the time.
_DRAWN_PX = 320, 180
#: Shorter tools have no loss, in pixels of the network's input.
SHORTEST_PX = 5.0
#: Tools in an image whose values have a smaller standard deviation (of 255) have no loss either.
FLAT = 5.0
#: Errors of a window's angle (rad), scale (log) and position (its pixels) with which it shows the tool, and does not.
_SHOWS, _SHOWS_NOT = ((0.0, 0.7), (0.0, 0.6), (0.0, 30.0)), ((1.0, np.pi), (0.8, 1.6), (60.0, 150.0))
#: Share of the windows that are cut at a proposal of a first stage, in scenes that have proposals.
_PROPOSED = 0.4
#: A closeup shows only a part of the tool.  Its blur and occluders are drawn as for a tool of this length.
_DISGUISE_PX = 40.0
#: Drawn tools in closeups: ranges of their length, and of the blur by lens and sensor, px.
_DRAWN_LENGTH_PX, _DRAWN_BLUR_PX = (90.0, 450.0), (0.4, 3.0)


@dataclass(frozen=True)
class SceneSource(Source):
    """Frames as joined JPEGs, which end at bytes `ends` (n,), with u (n, 3, 2) in their pixels and visibility (n, 3).

    In frames without a tool all landmarks have visibility 0.  The others are shares: `disguise` of the draws whose look is
    changed, `drawn` of the draws whose tool is a drawing, `bent` of the remaining draws whose jaws are bent (both in
    `drawings.py`), and `weight` (n, 3) of the draws in which a label counts.
    """

    stored_px: ClassVar[float] = 0.0  # least length of a tool in an image that `of` stores
    ends: np.ndarray
    jpegs: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    disguise: float = 0.5
    weight: np.ndarray | None = None
    drawn: float = 0.0
    bent: float = 0.0

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Load the shards of a folder, for training."""
        return cls(*shards.read_scenes(folder), disguise=0.7, drawn=0.35, bent=0.4)

    @classmethod
    def of(cls, images: Iterable[LabelledImage], *, still: bool = False, weight: np.ndarray | None = None) -> Self:
        """Make a source from labelled images of any size; for validation `still`: unchanged, as the detector sees them."""
        return cls(*shards.packed(images, shards.SCENE_PX, cls.stored_px), disguise=0.0 if still else 0.5, weight=weight)

    def scene(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The frame, or a drawn tool on a ground made from it, with landmarks (3, 2) px, visibility and weight (3,)."""
        image, *labels = self.frame(index)
        if self.drawn and rng.random() < self.drawn:
            x, y = rng.integers(0, np.maximum(np.subtract(image.shape[1::-1], _DRAWN_PX), 0), endpoint=True)
            image = image[y : y + _DRAWN_PX[1], x : x + _DRAWN_PX[0]]
            bare = not self.visibility[index].any() and rng.random() < 0.5
            return *drawn_tool(image if bare else drawn_ground(image, rng), rng), np.ones(3)
        if self.bent and self.visibility[index].any() and rng.random() < self.bent and np.isfinite(labels[0]).all():
            return *bent(image, *labels[:2], rng), labels[2]
        return image, *labels

    def frame(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The stored frame, with landmarks (3, 2) px, visibility and weight (3,)."""
        image = cv2.imdecode(self.jpegs[self.ends[index - 1] if index else 0 : self.ends[index]], cv2.IMREAD_COLOR_RGB)
        return image, self.u[index], self.visibility[index], np.ones(3) if self.weight is None else self.weight[index]

    def _seen(self, scene, centre: np.ndarray, angle: float, size: tuple[int, int], zoom: float, rng: np.random.Generator):
        """Cut a window of a scene and perhaps disguise it; landmarks of a tool that is too small to see become unlabelled."""
        image, u, visibility, weight = scene
        matrix = windows.window_from_image(centre, angle, size, zoom)
        scale = np.sqrt(abs(np.linalg.det(matrix[:, :2])))
        if scale < 0.8:  # interpolation alone would alias
            image = cv2.GaussianBlur(image, (0, 0), 0.45 * np.sqrt(1 / scale**2 - 1))
        fill = np.zeros(3)
        if self.disguise and rng.random() < 0.35:
            fill = np.array(cv2.mean(image)[:3]) * rng.uniform(0.5, 1.2)
        image = cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR, borderValue=fill.tolist())
        length = scale * _length_px(u, visibility)
        u = windows.map_points(matrix, u)
        if rng.random() < self.disguise:
            image, u, visibility = disguised(image, u, visibility, rng, length)
        if length < SHORTEST_PX or image.std() < FLAT:
            u = np.where((visibility > 0)[:, None], np.nan, u)
        return image, np.where((rng.random(3) > weight)[:, None], np.nan, u), visibility


def _length_px(u: np.ndarray, visibility: np.ndarray) -> float:
    """The tool's length; NaN without a tool."""
    return float(tool_length_px(u)) if visibility.any() else np.nan


class FrameSource(SceneSource):
    """Frames for the first stage: rotated, zoomed, shifted and mirrored.  A sixth of them show no landmark."""

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        frame, u, visibility, _ = scene = self.scene(index, rng)
        fit, length = FRAME_PX[0] / max(frame.shape[:2]), _length_px(u, visibility)
        middle = (np.array(frame.shape[1::-1]) - 1) / 2
        if not self.disguise:  # for validation, as `Detector` sees it
            return self._seen(scene, middle, 0.0, FRAME_PX, fit, rng)
        zoom = np.clip(fit * np.exp(rng.normal(0, 0.45)), 0.4 * fit, None)
        if np.isfinite(length):
            zoom = np.clip(zoom, 7 / length, 85 / length)
            spread = (1.5 if rng.random() < 0.25 else 0.4) * np.array(PART_PX) / zoom
            middle = np.nanmean(u, axis=0) + rng.uniform(-1, 1, 2) * spread
        else:
            middle = rng.uniform((0, 0), frame.shape[1::-1])
        turn = rng.uniform(-np.pi, np.pi) if rng.random() < 0.5 else np.pi * rng.integers(2) + rng.normal(0, 0.2)
        return _mirrored(*self._seen(scene, middle, turn, PART_PX, zoom, rng), rng)


@dataclass(frozen=True)
class ToolSource(SceneSource):
    """Upright windows of `windows.TOOL_PX` around the tool, with the previous stage's errors of position, angle and scale.

    Three in ten show no tool in upright pose and right size.  Their peaks must be low, since the heights decide between
    candidates.  In scenes with `proposals` (n, m, 3, 2) px of a first stage, padded with NaN, four in ten show a proposal.
    """

    stored_px: ClassVar[float] = 60.0  # the windows show tools with about this length
    proposals: np.ndarray | None = None

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        return replace(super().load(folder), proposals=shards.read_proposals(folder))

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if self.proposals is not None and rng.random() < _PROPOSED:
            if len(known := self.proposals[index][np.isfinite(self.proposals[index]).all((1, 2))]):
                return self._proposed(self.frame(index), known[rng.integers(len(known))], rng)
        _, u, visibility, _ = scene = self.scene(index, rng)
        (centre,), (angle,) = windows.tool_pose(u[None])
        length = _length_px(u, visibility)
        if not np.isfinite(angle + length) or (self.disguise and rng.random() < 0.3):
            return self._elsewhere(scene, centre, angle, length, rng)
        worse = 3.0 if rng.random() < 0.15 else 1.0
        zoom = windows.tool_zoom(length) * np.exp(np.clip(rng.normal(0, 0.12 * worse), -0.6, 0.6))
        centre = centre + np.clip(rng.normal(0, 7 * worse, 2), -30, 30) / zoom
        angle = angle + np.clip(rng.normal(0, 0.12 * worse), -0.7, 0.7)
        return _mirrored(*self._seen(scene, centre, angle, _TOOL_SIZE, zoom, rng), rng if self.disguise else None)

    def _proposed(self, scene, tool: np.ndarray, rng: np.random.Generator):
        """The window of a tool (3, 2) px that a first stage proposed, labelled if it shows the tool, else without one."""
        (centre, own), (angle, direction) = windows.tool_pose(np.stack([tool, scene[1]]))
        zoom = windows.tool_zoom(max(_length_px(tool, np.ones(3)), SHORTEST_PX)) * np.exp(rng.normal(0, 0.1))
        centre, angle = centre + rng.normal(0, 4, 2) / zoom, angle + rng.normal(0, 0.1)
        image, u, visibility = self._seen(scene, centre, angle, _TOOL_SIZE, zoom, rng)
        turn, scale = np.angle(np.exp(1j * (angle - direction))), zoom / windows.tool_zoom(_length_px(*scene[1:3]))
        off = np.array([abs(turn), abs(np.log(scale)), zoom * np.linalg.norm(own - centre)])
        if not np.isfinite(off).all() or (off > np.array(_SHOWS_NOT)[:, 0]).any():
            return image, np.full((3, 2), -float(windows.TOOL_PX)), np.zeros(3, int)
        shows = (off < np.array(_SHOWS)[:, 1]).all()
        return _mirrored(image, u if shows else np.full((3, 2), np.nan), visibility, rng)

    def _elsewhere(self, scene, centre: np.ndarray, angle: float, length: float, rng: np.random.Generator):
        """A window anywhere, or one near the tool with too large an error of angle, scale or position."""
        wrong = np.zeros(3, bool)
        if np.isfinite(angle + length) and rng.random() < 0.7 * scene[3].min():  # not by a doubtful label
            wrong = rng.random(3) < 0.4
            wrong[rng.integers(3)] = True
            by = [rng.uniform(*(_SHOWS_NOT if bad else _SHOWS)[i]) for i, bad in enumerate(wrong)]
            sign, way = rng.choice([-1, 1], 2), rng.uniform(-np.pi, np.pi)
            angle, zoom = angle + sign[0] * by[0], windows.tool_zoom(length) * np.exp(sign[1] * by[1])
            centre = centre + by[2] / zoom * np.array([np.cos(way), np.sin(way)])
        else:
            zoom = np.exp(rng.uniform(np.log(0.4), np.log(2.5)))
            centre, angle = rng.uniform((0, 0), scene[0].shape[1::-1]), rng.uniform(-np.pi, np.pi)
        image, at, visibility = self._seen(scene, centre, angle, _TOOL_SIZE, zoom, rng)
        if wrong.any():
            return image, np.full((3, 2), -float(windows.TOOL_PX)), np.zeros(3, int)
        seen = inside(at, _TOOL_SIZE) & (visibility > 0)
        return image, np.where(seen[:, None], np.nan, at), visibility  # a tool of any other scale or direction has no loss


def _mirrored(image, u, visibility, rng: np.random.Generator | None):
    """Exchange top and bottom, and so the tips, with probability 1/2; never without `rng`."""
    if rng is None or rng.random() < 0.5:
        return image, u, visibility
    u = np.column_stack([u[:, 0], image.shape[0] - 1 - u[:, 1]])[[0, 2, 1]]
    return np.ascontiguousarray(image[::-1]), u, visibility[[0, 2, 1]]


@dataclass(frozen=True)
class CloseupSource(Source):
    """Closeups of visible landmarks, displaced by the errors of the previous stage or frame, of stretched tools.

    Stretching and shearing an image makes many tools from one, and the labels stay right.

    Attributes:
        shifts_px, shift_shares: Standard deviations of the error of position, image pixels at closeup scale 1; their shares.
        turn_rad, length: Standard deviations of the errors of direction and of the logarithm of the tool's length.
        alone: Share of closeups whose direction is from the base to one tip, as if the other tip were missing.
        stretch, shear: Standard deviations of the logarithms of the stretches along and across the tool, and of the shear.
        motion_px: Standard deviation along x and y of the motion that blurs half of the closeups, in their pixels.
        disguise: Share of closeups whose appearance is changed.
        drawn: Share of closeups that show a drawn tool on a ground made from the crop (`drawings.py`).
        weight: (n,) share of the draws in which a label counts.
    """

    crops: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    landmark: np.ndarray
    size: int = 64
    shifts_px: tuple[float, ...] = (2.0, 5.0, 11.0)
    shift_shares: tuple[float, ...] = (0.35, 0.3, 0.35)
    turn_rad: float = 0.03
    length: float = 0.08
    alone: float = 0.05
    stretch: float = 0.1
    shear: float = 0.05
    motion_px: float = 1.7
    disguise: float = 0.5
    drawn: float = 0.0
    weight: np.ndarray | None = None

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Load the visible landmarks of a folder's shards, for training."""
        parts = shards.read_shards(folder, "closeups", ("crops", "crop_u", "crop_visibility", "crop_landmark"))
        seen = parts[2][np.arange(len(parts[3])), parts[3]] == 2
        return cls(*(parts if seen.all() else (part[seen] for part in parts)), drawn=0.3)

    @classmethod
    def of(cls, images: Sequence[LabelledImage], *, still: bool = False, weight: np.ndarray | None = None) -> Self:
        """Make a source from labelled images of any size; for validation `still`: not stretched, blurred or disguised."""
        usable = [np.isfinite(one.u).all(1) & (one.visibility == 2) & np.isfinite(tool_length_px(one.u)) for one in images]
        if not len(which := np.argwhere(usable)):
            raise ValueError("images: no visible landmark of a tool with base and tip; label some.")
        shown = ((images[i], k) for i, k in which)
        parts = ((*shards.square_round(one.image, one.u, k, shards.CLOSEUP_CROP_PX), one.visibility, k) for one, k in shown)
        weight = None if weight is None else weight[tuple(which.T)]
        source = cls(*map(np.array, zip(*parts, strict=True)), weight=weight)
        return source if not still else replace(source, stretch=0.0, shear=0.0, motion_px=0.0, disguise=0.0)

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw a closeup, in which only its own landmark counts as visible."""
        k = self.landmark[index]
        # A rotated closeup's corners lie outside the crop.  Shift the crop, so that its border does not reveal its centre.
        x, y = rng.integers(0, shards.BLOCK_PX, 2, endpoint=True)
        h, w = (side - shards.BLOCK_PX for side in self.crops.shape[1:3])
        crop, u = self.crops[index, y : y + h, x : x + w], self.u[index] - (x, y)
        if rng.random() < self.drawn:
            length, blur = (np.exp(rng.uniform(*np.log(r))) for r in (_DRAWN_LENGTH_PX, _DRAWN_BLUR_PX))
            crop, u, _ = drawn_tool(drawn_ground(crop, rng), rng, length_px=length, around=k)
            crop = cv2.GaussianBlur(crop, (0, 0), blur)
        length = tool_length_px(u) * np.exp(rng.normal(0, self.length))
        shift = rng.normal(0, self.shifts_px[rng.choice(len(self.shifts_px), p=self.shift_shares)], 2)
        shift *= min(1.0, windows.CLOSEUP_REACH_PX / max(np.linalg.norm(shift), 1e-9)) / windows.closeup_scale(length)
        known = u.copy()
        if rng.random() < self.alone and np.isfinite(u).all():
            known[rng.choice([j for j in (1, 2) if j != k])] = np.nan
        angle = windows.tool_pose(known[None])[1][0] + rng.normal(0, self.turn_rad)
        matrix = windows.closeup_from_image(u[k] + shift, angle, self.size, k, length)
        along, across = np.exp(rng.normal(0, self.stretch, 2))
        deform = np.array([[along, 0.0], [rng.normal(0, self.shear), across]])
        middle = (self.size - 1) / 2
        matrix = np.column_stack([deform @ matrix[:, :2], deform @ (matrix[:, 2] - middle) + middle])
        image = windows.cut(crop, matrix, self.size, border=cv2.BORDER_REPLICATE)
        if self.motion_px and rng.random() < 0.5:
            image = motion_blur(image, rng.normal(0, self.motion_px, 2))
        u, seen = windows.map_points(matrix, u), np.where(np.arange(3) == k, 2, 0)
        if rng.random() < self.disguise:
            image, u, seen = disguised(image, u, seen, rng, _DISGUISE_PX)
        if self.weight is not None and rng.random() > self.weight[index]:
            seen = np.zeros(3, int)
        return image, u, seen
