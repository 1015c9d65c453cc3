"""Labelled images: one by one from a recording, all in memory, or mixed from two sources."""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np

from lib import files
from lib.correspondences import LANDMARKS
from lib.recordings import Recording
from lib.recordings.annotations import CLICK_SD_PX


class LabelledImage(NamedTuple):
    """An image (h, w, 3) uint8 RGB and its landmarks base, tip_1, tip_2: u (3, 2) px and visibility (3,).

    Visibility is 2 visible, 1 hidden, 0 not in the frame.  A landmark is unlabelled if `u` is NaN and its visibility not 0.
    `sd_px` (3,) or a number is the standard deviation of the labels along each axis.
    """

    name: str
    image: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    sd_px: np.ndarray | float = 0.0

    @property
    def in_view(self) -> np.ndarray:
        """`u` where the landmark is labelled and in the frame, else NaN."""
        return np.where((np.isfinite(self.u).all(1) & (self.visibility > 0))[:, None], self.u, np.nan)


def labelled_frames(recording: Recording) -> list[int]:
    """Numbers of the frames with labels: all frames of a simulation, else those with an annotation in either view.

    Raises ValueError if the recording has neither truth nor annotations, or other landmarks than the detector.
    """
    if recording.skeleton != LANDMARKS:
        raise ValueError(f"{recording.name}: its landmarks are {list(recording.skeleton)}; give one with {list(LANDMARKS)}.")
    if recording.truth:
        return list(range(len(recording.frames)))
    if (labels := recording.annotations) is None:
        raise ValueError(f"{recording.name}: it has neither truth/ nor annotations.json; give a labelled recording.")
    return np.flatnonzero(labels.visibility_left.any(1) | labels.visibility_right.any(1)).tolist()


def labelled_images(recording: Recording, *, every: int = 1) -> Iterator[LabelledImage]:
    """Yield the left and right images of every `every`-th of the `labelled_frames`; those without annotations are skipped."""
    labels = recording.truth or recording.annotations
    for i in labelled_frames(recording)[::every]:
        marked = [side for side in ("left", "right") if recording.truth or getattr(labels, f"visibility_{side}")[i].any()]
        frame = recording.frames[i]
        for side in marked:
            u, visibility = getattr(labels, f"u_{side}")[i], getattr(labels, f"visibility_{side}")[i]
            if recording.truth is None:
                u, visibility = np.where(visibility[:, None] > 0, u, np.nan), shown_by_coco(visibility)
            yield LabelledImage(f"{side} {i}", getattr(frame, side), u, visibility, 0.0 if recording.truth else CLICK_SD_PX)


def shown_by_coco(visibility: np.ndarray) -> np.ndarray:
    """Convert the visibility of annotations (0 unlabelled, -1 absent) to that of a `LabelledImage`, where absent is 0.

    >>> shown_by_coco(np.array([-1, 0, 1, 2])).tolist()
    [0, 1, 1, 2]
    """
    return np.where(visibility < 0, 0, np.maximum(visibility, 1))


class Source:
    """Labelled images of one size from which training draws: a data class whose first field has one entry per image."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw image `index`: (h, w, 3) uint8, landmarks (3, 2) px, visibility (3,)."""
        raise NotImplementedError

    @property
    def fingerprint(self) -> str:
        """Digest of all fields: the images, their labels, and how images are drawn from them."""
        parts = []
        for value in (getattr(self, field.name) for field in fields(self)):
            if isinstance(value, np.ndarray):
                parts.append(np.ascontiguousarray(value[:, ::7, ::7] if value.ndim == 4 else value))
            else:
                parts.append((value.fingerprint if isinstance(value, Source) else repr(value)).encode())
        return files.digest(*parts, length=16)


@dataclass(frozen=True)
class Samples(Source):
    """Labelled images in memory, (n, h, w, 3) uint8 RGB, with u (n, 3, 2) and visibility (n, 3) as in `LabelledImage`.

    Raises ValueError for an empty set, arrays of other shapes, or no visible landmark at all.
    """

    images: np.ndarray
    u: np.ndarray
    visibility: np.ndarray

    def __post_init__(self) -> None:
        if not (n := len(self.images)):
            raise ValueError("images: an empty data set; give at least one labelled image.")
        if self.images.ndim != 4 or self.images.shape[-1] != 3 or self.images.dtype != np.uint8:
            raise ValueError(f"images: expected (n, h, w, 3) uint8, got {self.images.shape} {self.images.dtype}.")
        if (shapes := (self.u.shape, self.visibility.shape)) != ((n, 3, 2), (n, 3)):
            raise ValueError(f"u and visibility: expected ({n}, 3, 2) and ({n}, 3), got {shapes[0]} and {shapes[1]}.")
        if not (np.isfinite(self.u).all(2) & (self.visibility == 2)).any():
            raise ValueError("u: all landmarks of all images are missing; there is nothing to learn.")

    @classmethod
    def drawn(cls, source: Source, seed: int = 0) -> Self:
        """Draw one image for each entry of `source`, for validation."""
        rng = np.random.default_rng(seed)
        return cls(*map(np.stack, zip(*(source.draw(i, rng) for i in range(len(source))), strict=True)))

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.images[index], self.u[index], self.visibility[index]


@dataclass(frozen=True)
class Mixed(Source):
    """Draws from `own` with probability `share`, else from `other`, whose images a network must not forget."""

    own: Source
    other: Source
    share: float = 0.5

    def __len__(self) -> int:
        return len(self.own) + len(self.other)

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        part = self.own if rng.random() < self.share else self.other
        return part.draw(index % len(part), rng)
