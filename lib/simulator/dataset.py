"""The paper's data set, simulated: 10 sequences of 10 eyes, both kinds of motion, 7 to train and 3 to test.

python3 -m lib simulate                    # data/cache/dataset-0, resumes where it stopped
python3 -m lib simulate --dry-run          # says how long and how many GB
python3 -m lib simulate --shipped          # remakes data/open_sky_eye
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from lib import paths
from lib.parallel import in_processes
from lib.recordings import Recording
from lib.simulator.eye import Eye
from lib.simulator.microscope import Microscope
from lib.simulator.recording import simulate
from lib.simulator.render import render_pair
from lib.simulator.training import RESERVED_SEEDS, random_forceps, reserved_forceps

__all__ = ["TEST_SEQUENCES", "TRAIN_SEQUENCES", "main", "make_dataset", "make_shipped_recording", "sequence_name"]

TRAIN_SEQUENCES = range(0, 7)
TEST_SEQUENCES = range(7, 10)
_SHIPPED_SEED = 27
_MB_PER_PAIR = 0.62


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


def _make_sequence(folder: Path, seed: int, index: int, n_pairs: int) -> str:
    """One sequence, unless it is there already; runs in its own process."""
    target = folder / sequence_name(index)
    if target.exists():
        return target.name
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
    )
    gain = tuple(tuple(float(g) for g in np.exp(rng.normal(0, 0.06, 3))) for _ in range(2))
    microscope = Microscope(
        pixels_per_mm=tuple(float(v) for v in rng.uniform(95, 105, 2)),
        image_rotation_rad=tuple(float(v) for v in rng.normal(0, 0.03, 2)),
        light_slope=tuple(float(v) for v in rng.uniform(-0.5, 0.5, 2)),
        spot_mm=tuple(float(v) for v in rng.normal(0, 1.2, 2)),
        brightness=float(rng.uniform(0.8, 1.15)),
        gain=gain,
    )
    simulate(
        target,
        seed=1000 * seed + index,
        n_frames=n_pairs,
        motion="both",
        eye=eye,
        forceps=forceps,
        microscope=microscope,
        duration_s=60.0,
        offset_s=float(np.round(rng.uniform(-0.05, 0.05), 4)),
        dropout=0.01,
        name=target.name,
        description="Simulated data set: calibration sweep, then a surgeon's movements.",
        progress=False,
    )
    return target.name


def _seconds_a_pair() -> float:
    """CPU seconds of a stereo pair on this machine: of one pair without a tool, and half as much for the rest."""
    eye = Eye(texture_px=256)
    eye.texture  # noqa: B018 - once an eye, not once a pair
    start = time.process_time()
    render_pair(eye, Microscope(), rng=np.random.default_rng(0))
    return 1.5 * (time.process_time() - start)


def make_dataset(folder: Path, *, seed: int = 0, n_pairs: int = 80, workers: int | None = None) -> list[Path]:
    """Make the sequences that are missing in `folder`, in parallel; identical for the same seed and size.

    Raises
    ------
    ValueError
        If the folder holds a data set of another seed or size.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stamp, description = folder / "dataset.json", {"seed": seed, "pairs_a_sequence": n_pairs, "version": 1}
    if stamp.is_file() and json.loads(stamp.read_text()) != description:
        raise ValueError(
            f"{folder}: holds another data set ({stamp.read_text().strip()}); delete it or choose another folder."
        )
    partial = stamp.with_name("dataset.json.partial")
    partial.write_text(json.dumps(description) + "\n")
    os.replace(partial, stamp)
    indices = [*TRAIN_SEQUENCES, *TEST_SEQUENCES]
    missing = [k for k in indices if not (folder / sequence_name(k)).exists()]
    with tqdm(total=len(indices), initial=len(indices) - len(missing), desc="Simulating", unit="sequence") as bar:
        for name in in_processes(_make_sequence, [(folder, seed, k, n_pairs) for k in missing], workers):
            bar.set_postfix_str(name)
            bar.update()
    return [folder / sequence_name(k) for k in indices]


def main(argv: Sequence[str] | None = None) -> int:
    """`python3 -m lib simulate`: see the module's text."""
    parser = argparse.ArgumentParser(prog="python3 -m lib simulate", description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, help="where (default: data/cache/dataset-SEED)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--pairs", type=int, default=80, help="stereo pairs a sequence (default: 80, 1600 images in all)"
    )
    parser.add_argument("--workers", type=int, help="processes (default: one a core)")
    parser.add_argument("--dry-run", action="store_true", help="only say how long it takes and how many GB")
    parser.add_argument("--shipped", action="store_true", help="remake data/open_sky_eye instead")
    arguments = parser.parse_args(argv)
    if arguments.shipped:
        recording = make_shipped_recording()
        print(f"{recording.folder}: {len(recording.frames)} pairs.")
        return 0
    if arguments.pairs < 1 or (arguments.workers is not None and arguments.workers < 1):
        parser.error("--pairs and --workers must be at least 1.")
    folder = arguments.folder or paths.CACHE / f"dataset-{arguments.seed}"
    left = sum(not (folder / sequence_name(k)).exists() for k in range(10)) * arguments.pairs
    workers = min(arguments.workers or os.cpu_count() or 1, 10)
    minutes = left * _seconds_a_pair() / workers / 60
    print(
        f"{folder}: {left} of {10 * arguments.pairs} stereo pairs to make, about {minutes:.0f} min on {workers} "
        f"idle cores, {left * _MB_PER_PAIR / 1000:.2f} GB.",
        flush=True,
    )
    if not arguments.dry_run:
        make_dataset(folder, seed=arguments.seed, n_pairs=arguments.pairs, workers=workers)
    return 0
