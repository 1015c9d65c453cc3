"""Training data on disk: .npz shards of simulated frames, cut to what the detector's stages see.

The networks are trained on ``scenes`` (whole frames, small, of the wide population, some without a tool) and ``closeups``
(crops around a landmark).  The error models are fitted on ``held_out`` (whole frames in full resolution, with families that
training never draws).  All come from `lib.simulator.population.sample`, whose eyes and tools no test recording uses.  Shards
are written whole or not at all, so that `generate` can be stopped at any time and continues where it stopped.
"""

import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from lib import paths
from lib.files import whole
from lib.geometry import cell_from_image
from lib.landmarks import Detector
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.windows import cut
from lib.parallel import run_jobs, single_threaded_torch
from lib.simulator.population import TEXTURE_SEEDS, VALIDATION_TEXTURE_SEEDS, sample
from lib.training.appearance import disguised
from lib.training.samples import LabelledImage

#: Longest side of a stored whole scene.
SCENE_PX = 512
_LIKE_SHARDS = 3  # number of shards in the colours of some images
#: Seeds of each kind of shard.
_SEEDS = {"closeups": (5, 77), "scenes": (6,), "held_out": (7,)}
#: Side of the crops that closeups are cut from.
CLOSEUP_CROP_PX = 160
#: Number of closeups in a shard, and largest number of proposals that are kept for a scene.
CLOSEUPS, PROPOSALS = 1024, 12
#: Shards of whole scenes: number of scenes, and share of each population.
SCENES = {
    "scenes": (64, {"training": 0.5, "near": 0.3, "empty": 0.2}),
    "held_out": (16, {"validation": 0.6, "near": 0.2, "empty": 0.2}),
}
#: Sizes of held-out scenes.  They differ, because the error models must hold for frames of any size.
HELD_OUT_SIZES = ((1920, 1080), (1280, 720), (960, 540))
#: A crop is rendered with its landmark anywhere within a JPEG block of this many pixels.  If the place in the block were
#: constant, a network would learn it from the blocks: a quarter of its error would vanish, and return on other images.
BLOCK_PX = 16


def generate(
    folder: str | Path, kind: str, shards: int, *, workers: int | None = None, progress: bool = True,
    photographs: Sequence[Path] = (),
) -> None:  # fmt: skip
    """Write the first `shards` shards of a kind into `folder`, except those that exist.

    A shard depends only on its kind, its number and the `photographs`, which are the ground of some training scenes.  Each
    crop shows an eye and a tool of its own and is rendered without the rest of the frame, which is many times faster.
    `workers` is the number of processes; None = one per core.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    jobs = {Path(folder) / f"{kind}_{i:04d}.npz": (kind, i, photographs) for i in range(shards)}
    for _, error in run_jobs(make_shard, jobs, workers=workers, title=f"Simulating {kind}", unit="shard", progress=progress):
        if error:
            raise error


def make_shard(path: Path, kind: str, index: int, photographs: Sequence[Path] = ()) -> None:
    """Simulate and write one shard."""
    rng = np.random.default_rng([*_SEEDS[kind], index])
    if kind == "closeups":
        _write_closeups(path, rng, photographs)
        return
    n, shares = SCENES[kind]
    sizes = HELD_OUT_SIZES if kind == "held_out" else ((SCENE_PX, round(SCENE_PX * 9 / 16)),)
    textures = VALIDATION_TEXTURE_SEEDS if kind == "held_out" else TEXTURE_SEEDS
    names = rng.choice(list(shares), n, p=list(shares.values())).tolist()
    options = {"textures": textures, "photographs": photographs if kind == "scenes" else ()}
    drawn = (sample(rng, size_px=sizes[rng.integers(len(sizes))], population=name, **options) for name in names)
    ends, jpegs, u, visibility = packed(LabelledImage(name, *one) for name, one in zip(names, drawn, strict=True))
    with whole(path) as partial:
        np.savez(partial, jpegs=jpegs, jpeg_ends=ends, u=u, visibility=visibility)


def _write_closeups(path: Path, rng: np.random.Generator, photographs: Sequence[Path]) -> None:
    n, side_px = CLOSEUPS, CLOSEUP_CROP_PX
    crops, u, seen = np.empty((n, side_px, side_px, 3), np.uint8), np.empty((n, 3, 2)), np.zeros((n, 3), int)
    landmark, rendered_px = rng.integers(3, size=n), side_px + BLOCK_PX
    for i, k in enumerate(landmark):
        while not seen[i, k]:
            # A third shows the reference rig, where the last tenth of a pixel counts.
            population = "near" if rng.random() < 1 / 3 else "training"
            rest = {"around": k, "jitter": BLOCK_PX / 2 / rendered_px, "textures": TEXTURE_SEEDS, "population": population}
            image, at, seen[i] = sample(rng, crop_px=rendered_px, photographs=photographs, **rest)
        crops[i], u[i] = square_round(image, at, k, side_px)  # at the field's border the landmark is off-centre
    with whole(path) as partial:
        np.savez(partial, crops=crops, crop_u=u, crop_visibility=seen, crop_landmark=landmark)


def square_round(image: np.ndarray, u: np.ndarray, k: int, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut the square around landmark k; returns it and the landmarks in its pixels."""
    corner = np.round(u[k] - (side_px - 1) / 2)
    return cut(image, np.column_stack([np.eye(2), -corner]), side_px), u - corner


def _read(path: Path, names: Sequence[str]) -> list[np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as shard:
            return [shard[name] for name in names]
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: corrupt; delete it and generate it again ({error}).") from error


def shards_of(folder: str | Path, kind: str) -> list[Path]:
    """The shards of a kind in a folder, in order, without the partial files that a killed process leaves."""
    return sorted(Path(folder).glob(f"{kind}_[0-9][0-9][0-9][0-9].npz"))


def read_shards(folder: str | Path, kind: str, names: Sequence[str], first: int | None = None) -> list[np.ndarray]:
    """Read and join the arrays of the (`first`) shards of a kind; errors name a missing, corrupt or differently sized one."""
    if not (found := shards_of(folder, kind)[:first]):
        raise FileNotFoundError(f"{folder}: no shard {kind}_*.npz; make some with `python3 -m lib train generate`.")
    shards = [_read(path, names) for path in found]
    for path, shard in zip(found, shards, strict=True):
        if any(own.shape[1:] != first.shape[1:] for own, first in zip(shard, shards[0], strict=True)):
            raise ValueError(f"{path}: its images have another size; keep images of one size in a folder.")
    return [np.concatenate(arrays) for arrays in zip(*shards, strict=True)]


def packed(
    images: Iterable[LabelledImage], long_side_px: int | None = None, tool_px: float = 0.0
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Encode images as (ends (n,), joined JPEGs, u (n, 3, 2) px, visibility (n, 3)).

    Images longer than `long_side_px` shrink to it, but their tools to no less than `tool_px`.
    """
    parts = []
    for _, image, u, visibility, _ in images:
        h, w = image.shape[:2]
        if long_side_px and (scale := max(long_side_px / max(h, w), np.nan_to_num(tool_px / tool_length_px(u)))) < 1:
            size = round(scale * w), round(scale * h)
            image, u = cv2.resize(image, size, interpolation=cv2.INTER_AREA), cell_from_image(u, np.array([w, h]) / size)
        encoded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
        parts.append((encoded.ravel(), u, visibility))
    jpegs, points, seen = zip(*parts, strict=True)
    return np.cumsum([j.size for j in jpegs]), np.concatenate(jpegs), np.stack(points), np.stack(seen)


def read_scenes(folder: str | Path) -> tuple[np.ndarray, ...]:
    """Read all shards of scenes in a folder, as `packed` returns them."""
    parts = read_shards(folder, "scenes", ("jpegs", "u", "visibility"))
    ends = (_read(path, ("jpeg_ends",))[0] for path in shards_of(folder, "scenes"))
    return np.cumsum(np.concatenate([np.diff(own, prepend=0) for own in ends])), *parts


def propose(folder: str | Path, detector: str | Path | None = None, *, workers: int | None = None) -> None:
    """Write the candidates that a detector's first stage proposes in the scenes of a folder, for shards without proposals.

    Most are not tools: they are the most useful negatives for the second stage.  `detector` is as for `Detector.load`.
    """
    jobs = {_proposals(path): (path, detector) for path in shards_of(folder, "scenes")}
    for _, error in run_jobs(make_proposals, jobs, workers=workers, title="Searching scenes", unit="shard"):
        if error:
            raise error


def make_proposals(path: Path, scenes: Path, detector: str | Path | None) -> None:
    """Search the scenes of one shard, half of them disguised; write u (n, PROPOSALS, 3, 2) px, NaN if there are fewer."""
    searching, rng = Detector.load(detector), np.random.default_rng([8, int(scenes.stem[-4:])])
    jpegs, ends, u, visibility = _read(scenes, ("jpegs", "jpeg_ends", "u", "visibility"))
    found = np.full((len(u), PROPOSALS, 3, 2), np.nan)
    with single_threaded_torch():
        for i, piece in enumerate(np.split(jpegs, ends[:-1])):
            image = cv2.imdecode(piece, cv2.IMREAD_COLOR_RGB)
            if rng.random() < 0.5:
                image = disguised(image, u[i], visibility[i], rng, float(tool_length_px(u[i])))[0]
            tools, _, height = searching.proposed(image)
            best = np.argsort(-height)[:PROPOSALS]
            found[i, : len(best)] = tools[best]
    with whole(path) as partial:
        np.savez(partial, u=found)


def _proposals(scenes: Path) -> Path:
    return scenes.with_name(scenes.name.replace("scenes", "proposals"))


def read_proposals(folder: str | Path) -> np.ndarray | None:
    """Read the proposals for a folder's scenes, (n, PROPOSALS, 3, 2) px; NaN for shards without, None if all are without."""
    known, parts = False, []
    for path in shards_of(folder, "scenes"):
        own, n = _proposals(path), len(_read(path, ("jpeg_ends",))[0])
        known |= own.is_file()
        parts.append(_read(own, ("u",))[0] if own.is_file() else np.full((n, PROPOSALS, 3, 2), np.nan))
        if len(parts[-1]) != n:
            raise ValueError(f"{own}: made for other scenes than {path.name}; delete it and run `lib train propose` again.")
    return np.concatenate(parts) if known else None


def validation_images(folder: str | Path, kind: str = "held_out") -> Iterator[LabelledImage]:
    """Yield full frames that no training saw, for `lib.training.evaluation`; `kind` is ``"held_out"`` or ``"validation"``."""
    for path in shards_of(folder, kind):
        jpegs, ends, u, visibility = _read(path, ("jpegs", "jpeg_ends", "u", "visibility"))
        for i, piece in enumerate(np.split(jpegs, ends[:-1])):
            yield LabelledImage(f"{path.stem} {i}", cv2.imdecode(piece, cv2.IMREAD_COLOR_RGB), u[i], visibility[i])


def simulated_like(images: Iterable[np.ndarray], seed: int, progress: bool) -> list[LabelledImage]:
    """Simulated frames in the colours of some images, which keep the networks from forgetting others; kept in the cache."""
    folder = paths.CACHE / "adapt" / "simulated"
    generate(folder, "held_out", _LIKE_SHARDS, progress=progress)
    pixels = (cv2.cvtColor(np.ascontiguousarray(image[::4, ::4]), cv2.COLOR_RGB2LAB).reshape(-1, 3) for image in images)
    like = [(lab.mean(axis=0), lab.std(axis=0)) for lab in pixels]
    rng, found = np.random.default_rng([seed, 1]), []
    for labelled in validation_images(folder):
        lab = cv2.cvtColor(labelled.image, cv2.COLOR_RGB2LAB).astype(np.float32)
        mean, sd = like[rng.integers(len(like))]
        moved = (lab - lab.mean(axis=(0, 1))) * (sd / np.maximum(lab.std(axis=(0, 1)), 1.0)) + mean
        part = np.float32(rng.uniform(0, 1))  # some keep their own colours
        image = np.clip((1 - part) * lab + part * moved, 0, 255).astype(np.uint8)
        found.append(labelled._replace(image=cv2.cvtColor(image, cv2.COLOR_LAB2RGB)))
    return found
