"""The paper's data set, simulated: 10 sequences of 10 eyes, both kinds of motion, 7 to train and 3 to test."""

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lib import files, paths
from lib.parallel import cores, lives, run_jobs
from lib.recordings import Recording
from lib.simulator.eye import Eye
from lib.simulator.families import FAR
from lib.simulator.population import RESERVED_SEEDS, random_forceps, random_setup, reserved_forceps
from lib.simulator.recording import Design, simulate
from lib.simulator.rig import Microscope

TRAIN_SEQUENCES, TEST_SEQUENCES = range(0, 7), range(7, 10)
_SEQUENCES = (*TRAIN_SEQUENCES, *TEST_SEQUENCES)
_MB_PER_PAIR = 0.62


def sequence_name(index: int) -> str:
    """Name of a sequence's folder: ``train_00`` to ``test_09``."""
    return f"{'train' if index in TRAIN_SEQUENCES else 'test'}_{index:02d}"


def sequence_design(seed: int, index: int, *, shrink: int = 1, duration_s: float = 60.0) -> Design:
    """Draw eye, tool, microscope and clock of sequence `index` of the data set `seed`; images are `shrink` times smaller."""
    rng = np.random.default_rng([seed, 211, index])
    # Test sequences have eyes and tools that the training sampler never draws.
    if index in TEST_SEQUENCES:
        eye_seed = RESERVED_SEEDS[1000 + (37 * seed + index) % 8000]
        forceps = reserved_forceps(rng, eye_seed)
    else:
        eye_seed = RESERVED_SEEDS.stop + 1000 + 100 * seed + index
        forceps = random_forceps(rng, eye_seed)
    eye = Eye(
        seed=eye_seed, depth_mm=rng.uniform(1.6, 2.6), fold_mm=rng.uniform(0.05, 0.15), tilt_rad=rng.uniform(0.02, 0.06),
        gloss=rng.uniform(0.6, 1.2), texture_px=max(Eye.texture_px // shrink, 64),
    )  # fmt: skip
    gain = tuple(map(tuple, np.exp(rng.normal(0, 0.06, (2, 3))).tolist()))
    microscope = Microscope(
        image_size_px=tuple(side // shrink for side in Microscope.image_size_px),
        pixels_per_mm=tuple((rng.uniform(95, 105, 2) / shrink).tolist()),
        image_rotation_rad=tuple(rng.normal(0, 0.03, 2).tolist()), light_slope=tuple(rng.uniform(-0.5, 0.5, 2).tolist()),
        spot_mm=tuple(rng.normal(0, 1.2, 2).tolist()), brightness=rng.uniform(0.8, 1.15), gain=gain,
    )  # fmt: skip
    offset_s = float(np.round(rng.uniform(-0.05, 0.05), 4))
    return Design(eye, forceps, microscope, duration_s=duration_s, offset_s=offset_s, dropout=0.01)


def rung_design(rung: str, seed: int, *, shrink: int = 1) -> Design:
    """Design of recording `seed` with a distribution shift: stereo, with new eyes and tools, as `sample` draws for one view.

    `rung` is the kind of shift: "near" (the families of the reference rig), "validation", or one of `families.FAR`.
    """
    if rung == "near":  # seeds that no data set of the paper's size uses
        return sequence_design(1000 + seed, TEST_SEQUENCES[seed % len(TEST_SEQUENCES)], shrink=shrink)
    drawn = random_setup(np.random.default_rng([seed, 307, *rung.encode()]), rung, centred=True)
    like = sequence_design(2000 + seed, TEST_SEQUENCES[0], shrink=shrink)
    names = ("image_size_px", "pixels_per_mm", "image_rotation_rad", "readout_s")
    rig = {name: getattr(like.microscope, name) for name in names}
    camera = replace(drawn.microscope, video=drawn.microscope.video.shrunk(1 / shrink), **rig)
    return replace(like, eye=drawn.scene, forceps=drawn.forceps, microscope=camera)


def make_dataset(
    folder: Path, *, seed: int = 0, n_pairs: int = 80, duration_s: float = 60.0, workers: int | None = None, shrink: int = 1
) -> list[Path]:  # fmt: skip
    """Make the sequences of `n_pairs` that `folder` lacks, in parallel.  The files depend only on seed and size.

    A sequence appears whole or not at all: after a kill, the next call keeps the finished ones and makes the others.
    `workers` is the number of processes; None = one per core.  Raises ValueError if `folder` holds another data set.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stamp = folder / "dataset.json"
    size = {"pairs_a_sequence": n_pairs, "duration_s": duration_s, "shrink": shrink}
    text = json.dumps({"seed": seed, **size}, indent=1) + "\n"
    if stamp.is_file() and (found := stamp.read_text(encoding="utf-8", errors="replace").split()) != text.split():
        raise ValueError(f"{folder}: holds another data set ({' '.join(found)}); delete it or choose another folder.")
    files.write_text(stamp, text)
    for leftover in folder.glob("t*_??.[0-9]*-*.partial"):  # of a killed run, unless another run is writing it
        if not lives(int(leftover.suffixes[0][1:].partition("-")[0])):
            shutil.rmtree(leftover, ignore_errors=True)
    designs = {k: sequence_design(seed, k, shrink=shrink, duration_s=duration_s) for k in _SEQUENCES}
    jobs = {folder / sequence_name(k): (design, 1000 * seed + k, n_pairs) for k, design in designs.items()}
    make = partial(simulate, description="Simulated data set: calibration sweep, then a surgeon's movements.", progress=False)
    for sequence, error in run_jobs(make, jobs, workers=workers, title="Simulating", unit="sequence"):
        if error and not sequence.exists():  # else another run was faster
            raise error
    return list(jobs)


def seconds_a_pair(shrink: int) -> float:
    """CPU seconds per stereo pair of the data set on this machine, measured on two pairs, without the eye's texture."""
    design = sequence_design(0, TEST_SEQUENCES[0], shrink=shrink, duration_s=1.5)
    design.eye.texture  # noqa: B018 - made once per eye, not once per pair
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        simulate(Path(folder) / "pairs", design, n_frames=2, progress=False)
        return (time.process_time() - start) / 2


def main(argv: Sequence[str] | None = None) -> None:
    """`python3 -m lib simulate`: make or continue the data set, make the shipped recording, or one with another shift."""
    parser = argparse.ArgumentParser(prog="python3 -m lib simulate", description=__doc__)
    parser.add_argument("--folder", type=Path, help="folder to write (default: data/cache/dataset-SEED)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=80, help="stereo pairs per sequence (default: 80, 1600 images in all)")
    parser.add_argument("--duration", type=float, default=60.0, help="seconds of motion per sequence (default: 60)")
    parser.add_argument("--workers", type=int, help="number of processes (default: one per core)")
    parser.add_argument("--shrink", type=int, default=1, help="make images this many times smaller, for a quick look")
    parser.add_argument("--overwrite", action="store_true", help="--rung: replace the recording of the folder")
    only = parser.add_mutually_exclusive_group().add_argument
    only("--dry-run", action="store_true", help="only print the time and the disk space that the data set takes")
    only("--shipped", action="store_true", help="make data/open_sky_eye instead, rightly shaded; takes no other option")
    only("--rung", choices=("near", "validation", *FAR), help="make one recording with this shift instead")
    arguments = parser.parse_args(argv)
    given = {name for name, value in vars(arguments).items() if value != parser.get_default(name)}
    if (arguments.shipped and given != {"shipped"}) or (arguments.overwrite and not arguments.rung):
        parser.error("--shipped takes no other option, and --overwrite is for --rung.")
    if min(arguments.pairs, arguments.shrink, 1 if arguments.workers is None else arguments.workers) < 1:
        parser.error("--pairs, --workers and --shrink must be at least 1.")
    if arguments.seed < 0 or not max((arguments.pairs - 1) / Microscope.fps, 1e-3) <= arguments.duration < float("inf"):
        parser.error(f"--seed: at least 0; --duration: finite, and long enough for --pairs at {Microscope.fps:g} Hz.")
    pairs, shrink, seed = arguments.pairs, arguments.shrink, arguments.seed
    if arguments.shipped or arguments.rung:
        if arguments.shipped:  # with an eye and a tool that no training saw
            recording = simulate(
                paths.SHIPPED_RECORDING, Design(microscope=Microscope(jpeg_quality=88)), seed=27, n_frames=34,
                name="Open-sky eye, simulated", overwrite=True,
                description="Calibration sweep at several depths, then approach, grasp and peel. Made by lib.simulator.",
            )  # fmt: skip
        else:
            folder = arguments.folder or paths.CACHE / "rungs" / f"{arguments.rung}-{seed}"
            design = replace(rung_design(arguments.rung, seed, shrink=shrink), duration_s=arguments.duration)
            recording = simulate(folder, design, seed=5000 + seed, n_frames=pairs, overwrite=arguments.overwrite)
        print(f"{recording.folder}: {len(recording)} pairs.")
        return
    folder = arguments.folder or paths.CACHE / f"dataset-{seed}"
    made = [sequence for index in _SEQUENCES if (sequence := folder / sequence_name(index)).exists()]
    for sequence in made:  # finished sequences must open as recordings
        try:
            Recording.open(sequence)
        except (ValueError, OSError) as error:
            raise ValueError(f"{sequence}: damaged ({error}). Delete the folder to make it again.") from error
    left = (len(_SEQUENCES) - len(made)) * pairs
    workers = min(arguments.workers or cores(), len(_SEQUENCES))
    minutes = left * seconds_a_pair(shrink) / workers / 60 if left else 0.0
    cost = f"{minutes:.0f} min on {workers} idle core{'s' * (workers > 1)}, {left * _MB_PER_PAIR / shrink**2 / 1000:.2f} GB"
    print(f"{paths.shown(folder)}: {left} of {len(_SEQUENCES) * pairs} stereo pairs to make, about {cost}.", flush=True)
    if not arguments.dry_run:
        start = time.perf_counter()
        make_dataset(folder, seed=seed, workers=workers, n_pairs=pairs, duration_s=arguments.duration, shrink=shrink)
        seconds = time.perf_counter() - start
        if left:
            print(f"{left} pairs in {seconds / 60:.1f} min, {seconds / left:.2f} s a pair.")
