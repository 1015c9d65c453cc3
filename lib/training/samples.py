"""Training data for the coarse-to-fine detector: simulated frames, cut to what its networks see.

Frames come from `lib.simulator.population.sample`, whose eyes and tools no test recording uses.  A shard is an .npz
file of a few frames.  Of every frame it keeps the whole at a reduced resolution and a crop around each
landmark at full resolution; validation shards keep the full frame as JPEG too.
Shards of windows and of closeups hold crops alone.
Shards are written whole or not at all, so generating them can be stopped at any time and goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
from tqdm.auto import tqdm

from lib.geometry import cell_from_image
from lib.landmarks.windows import (
    CLOSEUP_REACH_PX,
    closeup_from_image,
    cut,
    direction_rad,
    map_points,
    tool_centre,
    window_from_image,
)
from lib.parallel import in_processes
from lib.simulator.optics import motion_kernel
from lib.simulator.population import TEXTURE_SEEDS, VALIDATION_TEXTURE_SEEDS, sample
from lib.training.loop import Samples

__all__ = [
    "REDUCTION",
    "CloseupSource",
    "WindowSource",
    "crop_frames",
    "frame_samples",
    "generate",
    "generate_crops",
    "simulated_samples",
    "validation_frames",
]

#: Of the stored frames, and of the first stage's input.
STORED_REDUCTION, REDUCTION = 5, 8
#: Of the middle stage's windows, and the place of the landmark index that means the whole tool.
TOOL_REDUCTION, TOOL = STORED_REDUCTION, 3
CROP_PX = 288
FRAMES = 16
#: Shards that hold crops alone, by the first part of their names: side in px, how many, and what seeds them.
_CROPS = {"windows": (CROP_PX, 512, 2), "closeups": (128, 2048, 4)}
#: Landmarks lie anywhere within a JPEG's block of this many pixels.  Were their place in it always the same, a network would
#: learn to read it off the blocks: a quarter of its error would vanish, and come back on every other image.
_BLOCK_PX = 16


def generate(
    folder: str | Path,
    shards: int,
    *,
    validation: bool = False,
    first: int = 0,
    workers: int | None = None,
    progress: bool = True,
) -> None:
    """Write shards `first` to `first` + `shards` - 1 of `FRAMES` frames into `folder`, skipping those that stand.

    A shard depends on its number alone.  `workers` processes share the work, by default one a core.
    """
    kind = "validation" if validation else "training"
    _generate(folder, kind, range(first, first + shards), _make_shard, (validation,), workers, progress)


def _generate(
    folder: str | Path,
    kind: str,
    indices: range,
    make: Callable[..., None],
    arguments: tuple,
    workers: int | None,
    progress: bool,
) -> None:
    """Have ``make(path, index, *arguments)`` write the shards of a kind that do not stand yet."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {i: folder / f"{kind}_{i:04d}.npz" for i in indices}
    missing = [(path, i, *arguments) for i, path in wanted.items() if not path.exists()]
    done = len(wanted) - len(missing)
    with tqdm(total=len(wanted), initial=done, desc=f"Simulating {kind}", disable=not progress, unit="shard") as bar:
        for _ in in_processes(make, missing, workers):
            bar.update()


def _make_shard(path: Path, index: int, validation: bool) -> None:
    rng = np.random.default_rng([int(validation), index])
    textures = VALIDATION_TEXTURE_SEEDS if validation else TEXTURE_SEEDS
    _write_shard(path, [sample(rng, textures=textures) for _ in range(FRAMES)], keep_frames=validation)


def generate_crops(
    folder: str | Path, shards: int, kind: str, *, first: int = 0, workers: int | None = None, progress: bool = True
) -> None:
    """Like `generate`, shards of crops round a landmark alone, each of a frame, an eye and a tool of its own.

    `kind` is ``"windows"`` or ``"closeups"``, which are smaller: only what the last stages see is rendered, twenty and forty
    times as many scenes a second as whole frames.
    """
    _generate(folder, kind, range(first, first + shards), _make_crops, _CROPS[kind], workers, progress)


def _make_crops(path: Path, index: int, side_px: int, n: int, kind_seed: int) -> None:
    rng = np.random.default_rng([kind_seed, index])
    crops = np.empty((n, side_px, side_px, 3), np.uint8)
    crop_u, crop_visibility = np.empty((n, 3, 2)), np.empty((n, 3), int)
    crop_landmark = rng.integers(3, size=n)
    for i, k in enumerate(crop_landmark):
        while True:
            rendered_px = side_px + _BLOCK_PX
            image, u, visibility = sample(rng, crop_px=rendered_px, around=k, jitter=_BLOCK_PX / 2 / rendered_px)
            if visibility[k]:
                break
        corner = np.round(u[k] - (side_px - 1) / 2)  # not 0 where the field ends
        crops[i] = cut(image, np.column_stack([np.eye(2), -corner]), side_px)
        crop_u[i], crop_visibility[i] = u - corner, visibility
    _write(
        path, crops=crops, crop_u=crop_u, crop_visibility=crop_visibility, crop_landmark=crop_landmark.astype(np.int64)
    )


def _write_shard(path: Path, views: list[tuple[np.ndarray, np.ndarray, np.ndarray]], *, keep_frames: bool) -> None:
    frames, crops, crop_u, crop_visibility, crop_landmark, jpegs = [], [], [], [], [], []
    for image, u, visibility in views:
        h, w = image.shape[:2]
        frames.append(cv2.resize(image, (w // STORED_REDUCTION, h // STORED_REDUCTION), interpolation=cv2.INTER_AREA))
        for k in np.flatnonzero(visibility):
            corner = np.round(u[k] - (CROP_PX - 1) / 2)
            crops.append(cut(image, np.column_stack([np.eye(2), -corner]), CROP_PX))
            crop_u.append(u - corner)
            crop_visibility.append(visibility)
            crop_landmark.append(k)
        if keep_frames:
            quality = [cv2.IMWRITE_JPEG_QUALITY, 95]
            jpegs.append(cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)[1])
    arrays = {
        "frames": np.stack(frames),
        "u": np.stack([u for _, u, _ in views]),
        "visibility": np.stack([visibility for _, _, visibility in views]),
        "crops": np.stack(crops),
        "crop_u": np.stack(crop_u),
        "crop_visibility": np.stack(crop_visibility),
        "crop_landmark": np.array(crop_landmark),
        "jpegs": np.concatenate([j.ravel() for j in jpegs]) if jpegs else np.zeros(0, np.uint8),
        "jpeg_ends": np.cumsum([j.size for j in jpegs]),
    }
    _write(path, **arrays)


def _write(path: Path, **arrays: np.ndarray) -> None:
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        np.savez(file, **arrays)
    os.replace(partial, path)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """Concatenated, each part given up as soon as it is copied: gigabytes are never held twice."""
    whole = np.empty((sum(len(part) for part in parts), *parts[0].shape[1:]), parts[0].dtype)
    end = len(whole)
    while parts:
        part = parts.pop()
        whole[end - len(part) : end] = part
        end -= len(part)
    return whole


def _read(path: Path, names: tuple[str, ...]) -> list[np.ndarray]:
    """Arrays of one shard."""
    try:
        with np.load(path, allow_pickle=False) as shard:
            return [shard[name] for name in names]
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: corrupt; delete it and generate it again ({error}).") from error


def _load(
    folder: str | Path, patterns: tuple[str, ...], names: tuple[str, ...], first_shards: int | None = None
) -> list[np.ndarray]:
    shards = [path for pattern in patterns for path in sorted(Path(folder).glob(pattern))][:first_shards]
    if not shards:
        raise FileNotFoundError(f"{folder}: no shard {patterns[0]}; make some with `python3 -m lib train generate`.")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for path in shards:
        for name, array in zip(names, _read(path, names), strict=True):
            parts[name].append(array)
    return [_joined(parts.pop(name)) for name in names]


def frame_samples(folder: str | Path, *, validation: bool = False) -> Samples:
    """Whole frames at the first stage's resolution (shards keep more, so that the resolution can be chosen later)."""
    patterns = ("validation_*.npz" if validation else "training_*.npz",)
    frames, u, visibility = _load(folder, patterns, ("frames", "u", "visibility"))
    size = (frames.shape[2] * STORED_REDUCTION // REDUCTION, frames.shape[1] * STORED_REDUCTION // REDUCTION)
    frames = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])
    return Samples(frames, cell_from_image(u, REDUCTION), visibility)


def crop_frames(folder: str | Path, shards: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Frame (n,), counted over the folder, and landmark (n,) of each crop of its first `shards` training shards of frames."""
    (visibility,) = _load(folder, ("training_*.npz",), ("visibility",), shards)
    return np.nonzero(visibility)  # the order in which shards keep crops


def validation_frames(folder: str | Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Full validation frames, for `lib.training.evaluation`: name, image, u, visibility."""
    for path in sorted(Path(folder).glob("validation_*.npz")):
        jpegs, ends, u, visibility = _read(path, ("jpegs", "jpeg_ends", "u", "visibility"))
        for i, piece in enumerate(np.split(jpegs, ends[:-1])):
            image = cv2.cvtColor(cv2.imdecode(piece, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
            yield f"{path.stem} {i}", image, u[i], visibility[i]


@dataclass(frozen=True)
class WindowSource:
    """Upright windows around landmarks, placed as badly as the first stage may place them.

    Attributes
    ----------
    crops, u, visibility, landmark:
        (n, h, w, 3) uint8, labels (n, 3, 2) in crop pixels, (n, 3), and which landmark (n,) each window is round;
        `TOOL` is the middle of the tool.
    size:
        Of the windows.
    shift_px, turn_rad:
        Standard deviations of the error of place and direction; a tenth of the windows has three times as much.
    zoom:
        Range of magnification.
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
    def load(
        cls, folder: str | Path, *, validation: bool = False, size: int = 128, shards: int | None = None
    ) -> WindowSource:
        """From the shards of a folder, those of windows alone included; or from its first `shards` of frames."""
        names = ("crops", "crop_u", "crop_visibility", "crop_landmark")
        patterns = ("validation_*.npz",) if validation else ("training_*.npz", "windows_*.npz")[: 1 if shards else 2]
        return cls(*_load(folder, patterns, names, shards), size=size)

    @classmethod
    def load_tools(
        cls, folder: str | Path, *, validation: bool = False, size: int = 128, shards: int | None = None
    ) -> WindowSource:
        """Windows round the whole tool at `TOOL_REDUCTION`, for the middle stage."""
        patterns = ("validation_*.npz" if validation else "training_*.npz",)
        frames, u, visibility = _load(folder, patterns, ("frames", "u", "visibility"), shards)
        u = cell_from_image(u, TOOL_REDUCTION)
        which = np.full(len(frames), TOOL)
        return cls(frames, u, visibility, which, size, shift_px=8.0, turn_rad=0.2, zoom=(0.75, 1.3))

    def __len__(self) -> int:
        return len(self.crops)

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        u = self.u[index]
        worse = 3.0 if rng.random() < 0.1 else 1.0
        limit = 0.3 * self.size
        at = tool_centre(u[None])[0] if self.landmark[index] == TOOL else u[self.landmark[index]]
        centre = at + np.clip(rng.normal(0, worse * self.shift_px, 2), -limit, limit)
        angle = direction_rad(u[None])[0] + np.clip(rng.normal(0, worse * self.turn_rad), -0.6, 0.6)
        matrix = window_from_image(centre, angle, self.size, rng.uniform(*self.zoom))
        return cut(self.crops[index], matrix, self.size), map_points(matrix, u), self.visibility[index]

    @property
    def fingerprint(self) -> str:
        return _fingerprint(self)


@dataclass(frozen=True)
class CloseupSource:
    """Closeups of landmarks, placed as badly as windows or the frame before may place them, of tools more or less stretched.

    Stretching and shearing the image keeps the labels true and makes many tools of one.

    Attributes
    ----------
    crops, u, landmark:
        (n, h, w, 3) uint8, labels (n, 3, 2) in crop pixels, and which landmark (n,), a visible one, each closeup shows.
    size:
        Of the closeups.
    shifts_px, shift_shares:
        Standard deviations of the error of place, and how many closeups have which.
    turn_rad:
        Standard deviation of the error of direction.
    alone:
        Share of closeups whose direction is that to one tip, the other one being missing.
    stretch, shear:
        Standard deviations of the logarithms of two stretches, along and across the tool, and of the shear.
    motion_px:
        Standard deviation along x and y of the movement that half of the closeups are blurred by, closeup pixels: a tool on
        its way moves more often than the simulator's.
    """

    crops: np.ndarray
    u: np.ndarray
    landmark: np.ndarray
    size: int = 64
    shifts_px: tuple[float, ...] = (2.0, 4.0, 8.0)
    shift_shares: tuple[float, ...] = (0.5, 0.25, 0.25)
    turn_rad: float = 0.03
    alone: float = 0.05
    stretch: float = 0.1
    shear: float = 0.05
    motion_px: float = 1.7

    @classmethod
    def load(cls, folder: str | Path, *, validation: bool = False, shards: int | None = None) -> CloseupSource:
        """From a folder's shards of closeups, or the first `shards`; to validate, from whole frames, not stretched."""
        patterns = ("validation_*.npz",) if validation else ("closeups_*.npz",)
        names = ("crops", "crop_u", "crop_visibility", "crop_landmark")
        crops, u, visibility, landmark = _load(folder, patterns, names, shards)
        seen = visibility[np.arange(len(landmark)), landmark] == 2
        if not seen.all():
            crops, u, landmark = crops[seen], u[seen], landmark[seen]
        return cls(crops, u, landmark, stretch=0.0, shear=0.0, motion_px=0.0) if validation else cls(crops, u, landmark)

    def __len__(self) -> int:
        return len(self.crops)

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A closeup; only its own landmark counts as visible."""
        k = self.landmark[index]
        # A crop ends before a turned closeup's corners do.  Where it ends must not tell where its middle was.
        x, y = rng.integers(0, _BLOCK_PX, 2, endpoint=True)
        h, w = (side - _BLOCK_PX for side in self.crops.shape[1:3])
        crop, u = self.crops[index, y : y + h, x : x + w], self.u[index] - (x, y)
        shift = rng.normal(0, self.shifts_px[rng.choice(len(self.shifts_px), p=self.shift_shares)], 2)
        centre = u[k] + shift * min(1.0, CLOSEUP_REACH_PX / max(np.linalg.norm(shift), 1e-9))
        known = u.copy()
        if rng.random() < self.alone:
            known[rng.choice([j for j in (1, 2) if j != k])] = np.nan
        angle = direction_rad(known[None])[0] + rng.normal(0, self.turn_rad)
        matrix = closeup_from_image(centre, angle, self.size, k)
        along, across = np.exp(rng.normal(0, self.stretch, 2))
        deform = np.array([[along, 0.0], [rng.normal(0, self.shear), across]])
        middle = (self.size - 1) / 2
        matrix = np.column_stack([deform @ matrix[:, :2], deform @ (matrix[:, 2] - middle) + middle])
        image = cut(crop, matrix, self.size, border=cv2.BORDER_REPLICATE)
        kernel = motion_kernel(rng.normal(0, self.motion_px, 2)) if self.motion_px and rng.random() < 0.5 else None
        if kernel is not None:  # centred, so the landmark stays
            image = cv2.filter2D(image, -1, kernel)
        return image, map_points(matrix, u), np.where(np.arange(3) == k, 2, 0)

    @property
    def fingerprint(self) -> str:
        return _fingerprint(self)


def _fingerprint(source: WindowSource | CloseupSource) -> str:
    """Of the images, their labels, and how windows are drawn from them."""
    digest = hashlib.sha256(np.ascontiguousarray(source.crops[:, ::17, ::17]).tobytes())
    for field in fields(source):
        value = getattr(source, field.name)
        if field.name != "crops":
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()[:16]


def simulated_samples(
    n: int,
    *,
    seed: int,
    crop_px: int | None = None,
    size_px: tuple[int, int] | None = None,
    reduction: int = 1,
    textures: int | None = None,
    progress: bool = False,
) -> Samples:
    """n simulated images in memory: windows of `crop_px` at full resolution, or the whole field at `size_px` (w, h).

    Parameters
    ----------
    reduction:
        Shrinks every image, and its landmarks, by this whole number.
    textures:
        How many of the simulator's training textures are used, as each takes a second to make; None = all.
    """
    if n < 1:
        raise ValueError(f"n: must be at least 1, got {n}.")
    rng = np.random.default_rng([3, seed])
    drawn = (sample(rng, crop_px=crop_px, size_px=size_px, textures=TEXTURE_SEEDS[:textures]) for _ in range(n))
    images, u, visibility = zip(*tqdm(drawn, total=n, disable=not progress, unit="image"), strict=True)
    if reduction > 1:
        scale = 1.0 / reduction
        images = [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in images]
        u = [cell_from_image(landmarks, reduction) for landmarks in u]
    return Samples(np.stack(images), np.stack(u), np.stack(visibility))
