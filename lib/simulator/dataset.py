"""The paper's data set, simulated: 10 sequences of 10 eyes, both kinds of motion, 7 to train and 3 to test.

python3 -m lib simulate                    # data/cache/dataset-0, resumes where it stopped
python3 -m lib simulate --dry-run          # says how long and how many GB
python3 -m lib simulate --record           # also writes what was made, and its cost, to data/results/dataset.json
python3 -m lib simulate --shipped          # remakes data/open_sky_eye
"""

from __future__ import annotations

import argparse
import cProfile
import csv
import datetime
import json
import os
import pstats
import shlex
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lib import paths
from lib.parallel import cores, run_jobs, step
from lib.provenance import Provenance, write_record
from lib.recordings import LANDMARKS, Recording
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps
from lib.simulator.microscope import Microscope
from lib.simulator.population import RESERVED_SEEDS, random_forceps, reserved_forceps
from lib.simulator.recording import simulate

__all__ = [
    "TEST_SEQUENCES",
    "TRAIN_SEQUENCES",
    "SequenceDesign",
    "landmark_counts",
    "main",
    "make_dataset",
    "make_shipped_recording",
    "seconds_by_stage",
    "sequence_design",
    "sequence_name",
]

TRAIN_SEQUENCES = range(0, 7)
TEST_SEQUENCES = range(7, 10)
_SHIPPED_SEED = 27
_MB_PER_PAIR = 0.62
_LOG_COLUMNS = ("sequence", "finished", "wall_s", "cpu_s")
#: Stage of the making of a pair -> the functions (Python's, numpy's, OpenCV's) whose own time belongs to it.
_STAGES = {
    "surface under every pixel": ("_intersect", "_ray_points", "height", "full", "surface_grid"),
    "texture, light, glints": ("render_view", "remap", "LUT", "exp", "_shadow", "line"),
    "tool": (
        "rasterise",
        "_tool_layer",
        "_metal",
        "_to_camera",
        "_visibility",
        "_behind_its_jaw",
        "total",
        "bincount",
        "_compose",
    ),
    "defocus and motion blur": ("_blur", "_blur_by_depth", "GaussianBlur", "filter2D", "copyMakeBorder", "blur"),
    "sensor noise and gamma": ("_develop", "standard_normal", "pow", "convertScaleAbs"),
    "JPEG and files": ("imencode", "cvtColor", "tofile", "add"),
}
_THE_REST = "motion, kinematics, the rest"


def sequence_name(index: int) -> str:
    """Folder of a sequence: ``train_00`` ... ``test_09``."""
    return f"{'train' if index in TRAIN_SEQUENCES else 'test'}_{index:02d}"


def make_shipped_recording(folder: Path = paths.SHIPPED_RECORDING) -> Recording:
    """The recording that ships: one eye and tool never trained on, a calibration sweep, then a surgeon."""
    return simulate(
        folder,
        seed=_SHIPPED_SEED,
        n_frames=34,
        motion="both",
        microscope=Microscope(jpeg_quality=88),
        name="Open-sky eye, simulated",
        description="Calibration sweep at several depths, then approach, grasp and peel. Made by lib.simulator.",
        overwrite=True,
    )


class SequenceDesign(NamedTuple):
    """What a sequence of the data set shows, and through what: all but its movement."""

    eye: Eye
    forceps: Forceps
    microscope: Microscope
    offset_s: float


def sequence_design(seed: int, index: int, *, shrink: int = 1) -> SequenceDesign:
    """Eye, tool and microscope of sequence `index` of the data set of this seed."""
    rng = np.random.default_rng([seed, 211, index])
    # Test sequences have eyes and tools that the training sampler never draws either.
    if index in TEST_SEQUENCES:
        eye_seed = RESERVED_SEEDS[1000 + (37 * seed + index) % 8000]
        forceps = reserved_forceps(rng, eye_seed)
    else:
        eye_seed = RESERVED_SEEDS.stop + 1000 + 100 * seed + index
        forceps = random_forceps(rng, eye_seed)
    eye = Eye(
        seed=eye_seed,
        depth_mm=float(rng.uniform(1.6, 2.6)),
        fold_mm=float(rng.uniform(0.05, 0.15)),
        tilt_rad=float(rng.uniform(0.02, 0.06)),
        gloss=float(rng.uniform(0.6, 1.2)),
        texture_px=max(Eye.texture_px // shrink, 64),
    )
    gain = tuple(tuple(float(g) for g in np.exp(rng.normal(0, 0.06, 3))) for _ in range(2))
    microscope = Microscope(
        image_size_px=tuple(side // shrink for side in Microscope.image_size_px),
        pixels_per_mm=tuple(float(v) / shrink for v in rng.uniform(95, 105, 2)),
        image_rotation_rad=tuple(float(v) for v in rng.normal(0, 0.03, 2)),
        light_slope=tuple(float(v) for v in rng.uniform(-0.5, 0.5, 2)),
        spot_mm=tuple(float(v) for v in rng.normal(0, 1.2, 2)),
        brightness=float(rng.uniform(0.8, 1.15)),
        gain=gain,
    )
    return SequenceDesign(eye, forceps, microscope, float(np.round(rng.uniform(-0.05, 0.05), 4)))


def _make_sequence(
    target: Path, seed: int, index: int, n_pairs: int, duration_s: float, shrink: int
) -> tuple[float, float]:
    """Make one sequence in a worker process; returns the wall and CPU seconds that it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    design = sequence_design(seed, index, shrink=shrink)
    simulate(
        target,
        seed=1000 * seed + index,
        n_frames=n_pairs,
        motion="both",
        eye=design.eye,
        forceps=design.forceps,
        microscope=design.microscope,
        duration_s=duration_s,
        offset_s=design.offset_s,
        dropout=0.01,
        name=target.name,
        description="Simulated data set: calibration sweep, then a surgeon's movements.",
        progress=step,
    )
    return time.perf_counter() - wall, time.process_time() - cpu


def make_dataset(
    folder: Path,
    *,
    seed: int = 0,
    n_pairs: int = 80,
    duration_s: float = 60.0,
    workers: int | None = None,
    shrink: int = 1,
) -> list[Path]:
    """Make the sequences that are missing in `folder`, in parallel; identical for the same seed and size.

    A sequence appears whole or not at all, so after a kill the ones that stand are kept and the others are made anew.
    ``log.csv`` in `folder` gains a line for each.

    Parameters
    ----------
    n_pairs, duration_s:
        Of each sequence.
    shrink:
        Images and textures this many times smaller, for a quick look.

    Raises
    ------
    ValueError
        If the folder holds a data set of another seed or size.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stamp = folder / "dataset.json"
    description = {"seed": seed, "pairs_a_sequence": n_pairs, "duration_s": duration_s, "shrink": shrink}
    if stamp.is_file() and json.loads(stamp.read_text()) != description:
        raise ValueError(
            f"{folder}: holds another data set ({stamp.read_text().strip()}); delete it or choose another folder."
        )
    partial = stamp.with_name("dataset.json.partial")
    partial.write_text(json.dumps(description) + "\n")
    os.replace(partial, stamp)
    jobs = {
        folder / sequence_name(k): (seed, k, n_pairs, duration_s, shrink) for k in [*TRAIN_SEQUENCES, *TEST_SEQUENCES]
    }
    for done in run_jobs(_make_sequence, jobs, workers=workers, title="Simulating", unit="pair", steps=n_pairs):
        if done.error:
            raise done.error
        if done.value is None:  # made by a worker that was lost just after
            continue
        wall_s, cpu_s = done.value
        finished = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        with (folder / "log.csv").open("a", newline="", encoding="utf-8") as stream:
            if not stream.tell():
                csv.writer(stream).writerow(_LOG_COLUMNS)
            csv.writer(stream).writerow([done.path.name, finished, f"{wall_s:.2f}", f"{cpu_s:.2f}"])
    return list(jobs)


def landmark_counts(recordings: Sequence[Recording]) -> dict[str, dict[str, int]]:
    """How many landmarks of both cameras are visible, hidden by the tool, outside, and in glint, for each landmark."""
    truths = [recording.truth for recording in recordings]
    if None in truths:
        raise ValueError("recordings: one has no truth; take simulated ones.")
    visibility = np.concatenate([np.stack([t.visibility_left, t.visibility_right]) for t in truths], axis=1)
    counts = {
        name: {
            "visible": int((visibility[..., k] == 2).sum()),
            "hidden": int((visibility[..., k] == 1).sum()),
            "outside": int((visibility[..., k] == 0).sum()),
        }
        for k, name in enumerate(LANDMARKS)
    }
    if all(t.in_glint_left is not None for t in truths):
        in_glint = np.concatenate([np.stack([t.in_glint_left, t.in_glint_right]) for t in truths], axis=1)
        for k, name in enumerate(LANDMARKS):
            counts[name]["in_glint"] = int(in_glint[..., k].sum())
    return counts


def seconds_by_stage(n_pairs: int = 6, shrink: int = 1) -> dict[str, float]:
    """CPU seconds of a pair of the data set, truth and files included, by stage of its making.

    From a profile of `n_pairs` pairs of one recording, which slows small functions a little.  The eye's texture, once a
    recording, is not in it.
    """
    eye = Eye(seed=27, texture_px=max(Eye.texture_px // shrink, 64))
    microscope = Microscope(
        image_size_px=tuple(side // shrink for side in Microscope.image_size_px),
        pixels_per_mm=tuple(zoom / shrink for zoom in Microscope.pixels_per_mm),
    )
    eye.texture  # noqa: B018 - once an eye, not once a pair
    profile = cProfile.Profile(time.process_time)
    duration_s = n_pairs * 60 / 80
    with tempfile.TemporaryDirectory() as folder:
        profile.enable()
        simulate(
            Path(folder) / "pairs", seed=27, n_frames=n_pairs, eye=eye, forceps=Forceps(), microscope=microscope,
            duration_s=duration_s, progress=False,
        )  # fmt: skip
        profile.disable()
    stages = dict.fromkeys([*_STAGES, _THE_REST], 0.0)
    stage_of = {function: stage for stage, functions in _STAGES.items() for function in functions}
    for (_, _, name), (_, _, own_s, _, _) in pstats.Stats(profile).stats.items():
        # "<built-in method numpy.array>", "<method 'exp' of ...>", "<GaussianBlur>" or a plain name.
        words = name.strip("<>").removeprefix("built-in ").removeprefix("method ")
        function = words.split(" of ")[0].strip("'").split(".")[-1]
        stages[stage_of.get(function, _THE_REST)] += own_s / n_pairs
    return stages


def _seconds_a_pair(shrink: int) -> float:
    """CPU seconds of a stereo pair of the data set on this machine, from two of them."""
    return sum(seconds_by_stage(2, shrink).values())


def _record(target: Path, folder: Path, provenance: Provenance, workers: int, shrink: int, seconds: float) -> None:
    """Write what the data set in `folder` holds and what it cost to the results file `target`.

    Parameters
    ----------
    seconds:
        What this run spent on the sequences that were missing.
    """
    recordings = [Recording.open(folder / sequence_name(k)) for k in [*TRAIN_SEQUENCES, *TEST_SEQUENCES]]
    pairs = sum(len(recording) for recording in recordings)
    with (folder / "log.csv").open(encoding="utf-8", newline="") as stream:
        # A sequence that was made anew counts once.
        log = list({row["sequence"]: row for row in csv.DictReader(stream)}.values())
    result = {
        "sequences": len(recordings),
        "pairs": pairs,
        "gigabytes": sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e9,
        "workers": workers,
        "minutes_of_the_last_run": seconds / 60,
        "minutes_of_all_sequences_one_by_one": sum(float(row["wall_s"]) for row in log) / 60,
        "wall_seconds_a_pair": sum(float(row["wall_s"]) for row in log) / pairs,
        "cpu_seconds_a_pair": sum(float(row["cpu_s"]) for row in log) / pairs,
        "cpu_seconds_a_pair_by_stage": seconds_by_stage(shrink=shrink),
        "landmarks": {
            kind: landmark_counts([r for r in recordings if r.name.startswith(kind)]) for kind in ("train", "test")
        },
        "log": log,
    }
    write_record(target, "dataset", result, provenance)


def main(argv: Sequence[str] | None = None) -> int:
    """`python3 -m lib simulate`: see the module's text."""
    parser = argparse.ArgumentParser(prog="python3 -m lib simulate", description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, help="where (default: data/cache/dataset-SEED)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--pairs", type=int, default=80, help="stereo pairs a sequence (default: 80, 1600 images in all)"
    )
    parser.add_argument("--duration", type=float, default=60.0, help="seconds of motion a sequence (default: 60)")
    parser.add_argument("--workers", type=int, help="processes (default: one a core)")
    parser.add_argument("--shrink", type=int, default=1, help="images this many times smaller, for a quick look")
    parser.add_argument("--dry-run", action="store_true", help="only say how long it takes and how many GB")
    parser.add_argument("--record", action="store_true", help="also write what was made, and its cost, to --out")
    parser.add_argument("--out", type=Path, default=paths.RESULTS / "dataset.json", help="record: results file")
    parser.add_argument("--shipped", action="store_true", help="remake data/open_sky_eye instead")
    arguments = parser.parse_args(argv)
    if arguments.shipped:
        recording = make_shipped_recording()
        print(f"{recording.folder}: {len(recording.frames)} pairs.")
        return 0
    if min(arguments.pairs, arguments.shrink, 1 if arguments.workers is None else arguments.workers) < 1:
        parser.error("--pairs, --workers and --shrink must be at least 1.")
    folder = arguments.folder or paths.CACHE / f"dataset-{arguments.seed}"
    left = sum(not (folder / sequence_name(k)).exists() for k in range(10)) * arguments.pairs
    workers = min(arguments.workers or cores(), 10)
    minutes = left * _seconds_a_pair(arguments.shrink) / workers / 60 if left else 0.0
    print(
        f"{paths.shown(folder)}: {left} of {10 * arguments.pairs} stereo pairs to make, about {minutes:.0f} min on "
        f"{workers} idle core{'s' if workers > 1 else ''}, {left * _MB_PER_PAIR / arguments.shrink**2 / 1000:.2f} GB.",
        flush=True,
    )
    if arguments.dry_run:
        return 0
    provenance = Provenance(shlex.join(["python3", "-m", "lib", "simulate", *(argv or [])]))
    start = time.perf_counter()
    make_dataset(
        folder,
        seed=arguments.seed,
        n_pairs=arguments.pairs,
        duration_s=arguments.duration,
        workers=arguments.workers,
        shrink=arguments.shrink,
    )
    seconds = time.perf_counter() - start
    if left:
        print(f"{left} pairs in {seconds / 60:.1f} min, {seconds / left:.2f} s a pair.")
    if arguments.record:
        _record(arguments.out, folder, provenance, workers, arguments.shrink, seconds)
        print(paths.shown(arguments.out))
    return 0
