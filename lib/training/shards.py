"""Training data on disk: .npz shards of simulated frames, cut to what the detector's stages see.

The detector that ships learns from ``scenes`` (whole frames, small, the wide population, some without a tool) and
``closeups`` (crops round a landmark); its doubt is fitted on ``held_out`` (whole frames in full resolution, with families
that training never draws).  The studies use the reference rig alone: ``training`` and ``validation`` keep each frame at a
fifth of its resolution and a crop round each landmark, ``windows`` such crops alone.  All come from
`lib.simulator.population.sample`, whose eyes and tools no test recording uses.  Shards are written whole or not at all, so
that `generate` can be stopped at any time and continues where it stopped.
"""

import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from lib.files import whole
from lib.geometry import cell_from_image
from lib.landmarks.windows import cut
from lib.parallel import run_jobs
from lib.simulator.population import TEXTURE_SEEDS, VALIDATION_TEXTURE_SEEDS, sample
from lib.training.samples import LabelledImage, Samples

__all__ = [
    "BLOCK_PX", "CLOSEUP_CROP_PX", "REDUCTION", "SCENE_PX", "STORED_REDUCTION", "cropped", "frame_samples", "generate",
    "packed", "read_scenes", "read_shards", "validation_images", "write_frames",
]  # fmt: skip

#: Of the stored frames, and of the first stage's input.
STORED_REDUCTION, REDUCTION = 5, 8
CROP_PX = 288
#: Longest side of a stored whole scene.
SCENE_PX = 512
FRAMES = 16
#: Seeds of each kind of shard.
_SEEDS = {"training": 0, "validation": 1, "windows": 2, "closeups": 5, "scenes": 6, "held_out": 7}
#: Side of the crops that closeups are cut from.
CLOSEUP_CROP_PX = 160
#: Shards of crops alone: side in px, and how many.
CROPS = {"windows": (CROP_PX, 512), "closeups": (CLOSEUP_CROP_PX, 1024)}
#: Shards of whole scenes: how many, and the share of each population.
SCENES = {"scenes": (64, {"training": 0.88, "empty": 0.12}), "held_out": (16, {"validation": 0.6, "near": 0.2, "empty": 0.2})}
#: Sizes of held-out scenes: what stage sees what must not depend on them.
HELD_OUT_SIZES = ((1920, 1080), (1280, 720), (960, 540))
#: A crop is rendered with its landmark anywhere within a JPEG block of this many pixels.  Were its place in the block always
#: the same, a network would learn to read it off the blocks: a quarter of its error would vanish, and return on other images.
BLOCK_PX = 16


def generate(folder: str | Path, kind: str, shards: int, *, workers: int | None = None, progress: bool = True) -> None:
    """Write the first `shards` shards of a kind into `folder`, except those that exist.

    A shard depends on its kind and number alone.  Crops are rendered alone, each of an eye and a tool of its own: many times
    as many scenes a second.  `workers` processes share the work (None: all cores).
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    jobs = {Path(folder) / f"{kind}_{i:04d}.npz": (kind, i) for i in range(shards)}
    for done in run_jobs(make_shard, jobs, workers=workers, title=f"Simulating {kind}", unit="shard", progress=progress):
        if done.error:
            raise done.error


def make_shard(path: Path, kind: str, index: int) -> None:
    """Simulate and write one shard."""
    rng = np.random.default_rng([_SEEDS[kind], index])
    if kind in CROPS:
        _write_crops(path, rng, kind, *CROPS[kind])
    elif kind in SCENES:
        n, shares = SCENES[kind]
        sizes = HELD_OUT_SIZES if kind == "held_out" else ((SCENE_PX, round(SCENE_PX * 9 / 16)),)
        textures = VALIDATION_TEXTURE_SEEDS if kind == "held_out" else TEXTURE_SEEDS
        populations = rng.choice(list(shares), n, p=list(shares.values()))
        drawn = (_scene(rng, sizes[rng.integers(len(sizes))], str(population), textures) for population in populations)
        ends, jpegs, u, visibility = packed(drawn)
        with whole(path) as partial:
            np.savez(partial, jpegs=jpegs, jpeg_ends=ends, u=u, visibility=visibility)
    else:
        textures = VALIDATION_TEXTURE_SEEDS if kind == "validation" else TEXTURE_SEEDS
        frames = (LabelledImage(str(i), *sample(rng, textures=textures, population="near")) for i in range(FRAMES))
        write_frames(path, frames, keep_frames=kind == "validation")


def _scene(rng: np.random.Generator, size_px: tuple[int, int], population: str, textures: Sequence[int]) -> LabelledImage:
    image, u, visibility = sample(rng, size_px=size_px, population=population, textures=textures)
    return LabelledImage(population, image, u, visibility)


def _write_crops(path: Path, rng: np.random.Generator, kind: str, side_px: int, n: int) -> None:
    crops, u, seen = np.empty((n, side_px, side_px, 3), np.uint8), np.empty((n, 3, 2)), np.zeros((n, 3), int)
    landmark, rendered_px = rng.integers(3, size=n), side_px + BLOCK_PX
    for i, k in enumerate(landmark):
        while not seen[i, k]:
            # Half of the closeups are of the reference rig, where the last tenth of a pixel counts.
            population = "training" if kind == "closeups" and rng.random() < 0.5 else "near"
            how = {"around": k, "jitter": BLOCK_PX / 2 / rendered_px, "textures": TEXTURE_SEEDS, "population": population}
            image, at, seen[i] = sample(rng, crop_px=rendered_px, **how)
        crops[i], u[i] = _crop(image, at, k, side_px)  # the landmark is not in the middle where the field ends
    with whole(path) as partial:
        np.savez(partial, crops=crops, crop_u=u, crop_visibility=seen, crop_landmark=landmark)


def _crop(image: np.ndarray, u: np.ndarray, k: int, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """The square round landmark k, and the landmarks in its pixels."""
    corner = np.round(u[k] - (side_px - 1) / 2)
    return cut(image, np.column_stack([np.eye(2), -corner]), side_px), u - corner


def cropped(labelled: LabelledImage, k: int, side_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The square round landmark k, the landmarks in its pixels, their visibility, and k."""
    return *_crop(labelled.image, labelled.u, k, side_px), labelled.visibility, k


def write_frames(path: Path, images: Iterable[LabelledImage], *, keep_frames: bool) -> None:
    """Write one shard of full-resolution labelled images of one size; with the images themselves if `keep_frames`."""
    images, r = list(images), STORED_REDUCTION
    sizes = [(image.shape[1] // r, image.shape[0] // r) for _, image, _, _ in images]
    frames = [cv2.resize(part.image, size, interpolation=cv2.INTER_AREA) for part, size in zip(images, sizes, strict=True)]
    u, seen = np.stack([part.u for part in images]), np.stack([part.visibility for part in images])
    frame, landmark = np.nonzero((seen > 0) & np.isfinite(u).all(2))
    crops = [_crop(images[i].image, u[i], k, CROP_PX) for i, k in zip(frame, landmark, strict=True)]
    kept = [cv2.cvtColor(part.image, cv2.COLOR_RGB2BGR) for part in images if keep_frames]
    jpegs = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].ravel() for image in kept]
    with whole(path) as partial:
        np.savez(
            partial, frames=np.stack(frames), u=u, visibility=seen,
            crops=np.array([crop for crop, _ in crops], np.uint8).reshape(-1, CROP_PX, CROP_PX, 3),
            crop_u=np.array([at for _, at in crops]).reshape(-1, 3, 2), crop_visibility=seen[frame], crop_landmark=landmark,
            jpegs=np.concatenate([np.zeros(0, np.uint8), *jpegs]), jpeg_ends=np.cumsum([j.size for j in jpegs]),
        )  # fmt: skip


def _read(path: Path, names: Sequence[str]) -> list[np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as shard:
            return [shard[name] for name in names]
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: corrupt; delete it and generate it again ({error}).") from error


def read_shards(folder: str | Path, kinds: Sequence[str], names: Sequence[str], first: int | None = None) -> list[np.ndarray]:
    """Arrays of the (first) shards of some kinds, joined; an error names a missing, corrupt or differently sized shard."""
    found = [path for kind in kinds for path in sorted(Path(folder).glob(f"{kind}_*.npz"))][:first]
    if not found:
        raise FileNotFoundError(f"{folder}: no shard {kinds[0]}_*.npz; make some with `python3 -m lib train generate`.")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for path in found:
        for name, array in zip(names, _read(path, names), strict=True):
            if parts[name] and array.shape[1:] != parts[name][0].shape[1:]:
                raise ValueError(f"{path}: its images have another size; keep images of one size in a folder.")
            parts[name].append(array)
    return [_joined(parts.pop(name)) for name in names]


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """Concatenated; each part is released as soon as it is copied, so that gigabytes are never held twice."""
    end = sum(map(len, parts))
    result = np.empty((end, *parts[0].shape[1:]), parts[0].dtype)
    while parts:
        part = parts.pop()
        end -= len(part)
        result[end : end + len(part)] = part
    return result


def frame_samples(folder: str | Path, *, validation: bool = False) -> Samples:
    """Whole frames at the first stage's resolution; shards keep more, so that it can be chosen later."""
    kind = "validation" if validation else "training"
    frames, u, visibility = read_shards(folder, (kind,), ("frames", "u", "visibility"))
    size = [side * STORED_REDUCTION // REDUCTION for side in frames.shape[2:0:-1]]
    frames = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])
    return Samples(frames, cell_from_image(u, REDUCTION), visibility)


def packed(images: Iterable[LabelledImage], long_side_px: int | None = None, quality: int = 95) -> tuple[np.ndarray, ...]:
    """Labelled images of any size as (ends (n,), JPEGs one after the other, u (n, 3, 2), visibility (n, 3)), `long_side_px`
    long at most.
    """
    jpegs, points, seen = [], [], []
    for _, image, u, visibility in images:
        h, w = image.shape[:2]
        if long_side_px and max(h, w) > long_side_px:
            size = round(w * long_side_px / max(h, w)), round(h * long_side_px / max(h, w))
            image, u = cv2.resize(image, size, interpolation=cv2.INTER_AREA), cell_from_image(u, np.array([w, h]) / size)
        encoded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        jpegs.append(encoded.ravel())
        points.append(u)
        seen.append(visibility)
    return np.cumsum([j.size for j in jpegs]), np.concatenate(jpegs), np.stack(points), np.stack(seen)


def read_scenes(folder: str | Path) -> tuple[np.ndarray, ...]:
    """What `packed` gives, of all shards of scenes in a folder."""
    found = sorted(Path(folder).glob("scenes_*.npz"))
    if not found:
        raise FileNotFoundError(f"{folder}: no shard scenes_*.npz; make some with `python3 -m lib train generate`.")
    ends, *parts = zip(*(_read(path, ("jpeg_ends", "jpegs", "u", "visibility")) for path in found), strict=True)
    before = np.cumsum([0, *(own[-1] for own in ends[:-1])])
    return tuple(map(np.concatenate, ([own + start for own, start in zip(ends, before, strict=True)], *parts)))


def validation_images(folder: str | Path, kind: str = "held_out") -> Iterator[LabelledImage]:
    """Full frames that no network is trained on, for `lib.training.evaluation`: ``"held_out"``, or ``"validation"``."""
    for path in sorted(Path(folder).glob(f"{kind}_*.npz")):
        jpegs, ends, u, visibility = _read(path, ("jpegs", "jpeg_ends", "u", "visibility"))
        for i, piece in enumerate(np.split(jpegs, ends[:-1])):
            image = cv2.cvtColor(cv2.imdecode(piece, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
            yield LabelledImage(f"{path.stem} {i}", image, u[i], visibility[i])
