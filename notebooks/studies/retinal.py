"""The Retinal Microsurgery sequences: real frames with clicked landmarks, of one camera and without kinematics."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lib.landmarks.metrics import pck, tool_length_px
from lib.recordings import read_image
from lib.recordings.annotations import CLICK_SD_PX
from lib.recordings.tables import columns, read_table
from lib.training.samples import LabelledImage


@dataclass(frozen=True)
class MonocularSequence:
    """Labelled frames of one camera, no kinematics.

    Attributes:
        frame_numbers: (n,) int, the numbers in the original video; `paths` are their n image files.
        u: (n, 3, 2) px of base, tip_1, tip_2; NaN where not visible.
        image_size_px: (width, height).
    """

    name: str
    frame_numbers: np.ndarray
    paths: tuple[Path, ...]
    u: np.ndarray
    image_size_px: tuple[int, int]

    def __len__(self) -> int:
        return len(self.paths)

    def image(self, index: int) -> np.ndarray:
        """Frame `index` as (h, w, 3) uint8 RGB."""
        return read_image(self.paths[index], self.image_size_px)

    def labelled(self, *, second_half: bool | None = None, every: int = 1) -> Iterator[LabelledImage]:
        """Every `every`-th frame, if it has a label: of the whole sequence, or of its first or second half.

        A landmark without a click counts as unlabelled, since it is unknown whether it is hidden or outside.
        Consecutive frames are alike, so the sequence is split into halves in time.
        """
        middle = len(self) // 2
        for i in {None: range(len(self)), False: range(middle), True: range(middle, len(self))}[second_half][::every]:
            seen = np.isfinite(self.u[i]).all(axis=1)
            if seen.any():
                name, visibility = f"{self.name} {self.frame_numbers[i]}", np.where(seen, 2, 1)
                yield LabelledImage(name, self.image(i), self.u[i], visibility, CLICK_SD_PX)


def import_retinal_microsurgery(folder: str | Path) -> list[MonocularSequence]:
    """The Retinal Microsurgery sequences (Sznitman et al., MICCAI 2012): in-vivo frames with tool landmarks.

    Args:
        folder: Holds ``seq1/``, ``seq2/``, ...: images named by frame number and ``landmarks.csv`` (frame, then x and y
            of shaft, base, tip_1, tip_2 in whole pixels, empty = not visible).  Its tip_1 is the right one, seen from
            base to tips; the result has the left one first, as every recording here.

    Raises:
        FileNotFoundError, ValueError: Naming the file.
    """
    folder = Path(folder)
    tables = sorted(folder.glob("*/landmarks.csv"))
    if not tables:
        raise FileNotFoundError(f"{folder}: no SEQUENCE/landmarks.csv; expected seq1/landmarks.csv and so on.")
    sequences = []
    for path in tables:
        table = read_table(path, ["frame", "shaft_x", "shaft_y", *columns(["x", "y"])])
        if not len(table) or np.isnan(table[:, 0]).any():
            raise ValueError(f"{path}: empty, or a row without a frame number.")
        numbers = table[:, 0].astype(np.int64)
        images = tuple(path.with_name(f"{number:06d}.jpg") for number in numbers)
        missing = [image for image in images if not image.is_file()]
        if missing:
            raise FileNotFoundError(f"{missing[0]}: no such image ({len(missing)} of {len(images)} missing).")
        u = table[:, 3:].reshape(-1, 3, 2)[:, [0, 2, 1]]
        u[np.isnan(u).any(axis=2)] = np.nan
        first = read_image(images[0])
        sequences.append(MonocularSequence(path.parent.name, numbers, images, u, (first.shape[1], first.shape[0])))
    return sequences


def label_repeatability(sequence: MonocularSequence, threshold: float = 0.2) -> float:
    """PCK in percent that a detector without error would reach on the second half, since clicks jitter.

    Each click is compared with the mean of those one frame before and after.  If all clicks have the same variance, this
    difference has 3/2 of it, so it is divided by sqrt(3/2).  Uneven motion of the tool increases it.
    """
    middle = len(sequence) // 2
    u, number = sequence.u[middle:], np.asarray(sequence.frame_numbers)[middle:]
    consecutive = (np.diff(number[:-1]) == 1) & (np.diff(number[1:]) == 1)
    click, between = u[1:-1], (u[:-2] + u[2:]) / 2
    compared = np.where(consecutive[:, None, None] & np.isfinite(between), click, np.nan)
    return float(pck(click + (between - click) / np.sqrt(1.5), compared, threshold, length_px=tool_length_px(click)))
