"""Training data for the two-stage detector: simulated frames, cut to what its networks see.

Frames come from `lib.simulator.training.sample`, whose eyes and tools no test recording uses.  A shard is an .npz
file of a few frames.  Of every frame it keeps the whole at a reduced resolution and a crop around each
landmark at full resolution; validation shards keep the full frame as JPEG too.
Shards are written whole or not at all, so generating them can be stopped at any time and goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tqdm.auto import tqdm

from lib.geometry import cell_from_image
from lib.landmarks.training import Samples
from lib.landmarks.windows import cut, direction_rad, map_points, tool_centre, window_from_image
from lib.parallel import in_processes
from lib.simulator.training import TEXTURE_SEEDS, VALIDATION_TEXTURE_SEEDS, sample

__all__ = [
    "REDUCTION",
    "WindowSource",
    "crop_frames",
    "frame_samples",
    "generate",
    "generate_windows",
    "simulated_samples",
    "validation_frames",
]

#: Of the stored frames, and of the first stage's input.
STORED_REDUCTION, REDUCTION = 5, 8
#: Of the middle stage's windows, and the place of the landmark index that means the whole tool.
TOOL_REDUCTION, TOOL = STORED_REDUCTION, 3
CROP_PX = 288
FRAMES = 16
#: Windows of a shard that holds windows alone.
WINDOWS = 512


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
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    kind = "validation" if validation else "training"
    wanted = {i: folder / f"{kind}_{i:04d}.npz" for i in range(first, first + shards)}
    missing = {i: path for i, path in wanted.items() if not path.exists()}
    bar = tqdm(
        total=shards, initial=shards - len(missing), desc=f"Simulating {kind}", disable=not progress, unit="shard"
    )
    with bar:
        for _ in in_processes(_make_shard, [(path, i, validation) for i, path in missing.items()], workers):
            bar.update()


def _make_shard(path: Path, index: int, validation: bool) -> None:
    rng = np.random.default_rng([int(validation), index])
    textures = VALIDATION_TEXTURE_SEEDS if validation else TEXTURE_SEEDS
    _write_shard(path, [sample(rng, textures=textures) for _ in range(FRAMES)], keep_frames=validation)


def generate_windows(
    folder: str | Path, shards: int, *, first: int = 0, workers: int | None = None, progress: bool = True
) -> None:
    """Like `generate`, shards of `WINDOWS` full-resolution crops alone, each of a frame, an eye and a tool of its own.

    Only what the last stage sees is rendered: twenty times as many scenes a second as whole frames.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {i: folder / f"windows_{i:04d}.npz" for i in range(first, first + shards)}
    missing = [(path, i) for i, path in wanted.items() if not path.exists()]
    bar = tqdm(
        total=shards, initial=shards - len(missing), desc="Simulating windows", disable=not progress, unit="shard"
    )
    with bar:
        for _ in in_processes(_make_windows, missing, workers):
            bar.update()


def _make_windows(path: Path, index: int) -> None:
    rng = np.random.default_rng([2, index])
    crops = np.empty((WINDOWS, CROP_PX, CROP_PX, 3), np.uint8)
    crop_u, crop_visibility = np.empty((WINDOWS, 3, 2)), np.empty((WINDOWS, 3), int)
    crop_landmark = rng.integers(3, size=WINDOWS)
    for i, k in enumerate(crop_landmark):
        while True:
            image, u, visibility = sample(rng, crop_px=CROP_PX, around=k, jitter=0.0)
            if visibility[k]:
                break
        corner = np.round(u[k] - (CROP_PX - 1) / 2)  # not 0 where the field ends
        crops[i] = cut(image, np.column_stack([np.eye(2), -corner]), CROP_PX)
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


def _load(
    folder: str | Path, patterns: tuple[str, ...], names: tuple[str, ...], first_shards: int | None = None
) -> list[np.ndarray]:
    shards = [path for pattern in patterns for path in sorted(Path(folder).glob(pattern))][:first_shards]
    if not shards:
        raise FileNotFoundError(f"{folder}: no shard {patterns[0]}; make some with `python3 -m lib train generate`.")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for path in shards:
        try:
            with np.load(path, allow_pickle=False) as shard:
                for name in names:
                    parts[name].append(shard[name])
        except (ValueError, KeyError, OSError) as error:
            raise ValueError(f"{path}: corrupt; delete it and generate it again ({error}).") from error
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
    """Full validation frames, for `lib.landmarks.evaluation`: name, image, u, visibility."""
    for path in sorted(Path(folder).glob("validation_*.npz")):
        with np.load(path, allow_pickle=False) as shard:
            pieces = np.split(shard["jpegs"], shard["jpeg_ends"][:-1])
            for i, piece in enumerate(pieces):
                image = cv2.cvtColor(cv2.imdecode(piece, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
                yield f"{path.stem} {i}", image, shard["u"][i], shard["visibility"][i]


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
        digest = hashlib.sha256(np.ascontiguousarray(self.crops[:, ::17, ::17]).tobytes())
        digest.update(self.u.tobytes())
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
