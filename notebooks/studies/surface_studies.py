"""Evidence: every claim on matching and surfaces measured anew and written to ``data/results/reconstruction.json``.

python3 -m notebooks.studies.surface_studies [--out FILE] [--recordings 3] [STUDY ...]

`calibrated` needs recordings of 75 stereo frames, which are simulated once (80 CPU seconds each) and kept in
data/cache/reconstruction; so with new detector weights the same command only detects, calibrates and judges anew.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lib import paths
from lib.calibration import calibrate
from lib.landmarks import Detector, detect
from lib.matching import RECTIFIED, match
from lib.provenance import Provenance, read_records, write_record
from lib.recordings import Recording
from lib.simulator.eye import Eye
from lib.simulator.microscope import Microscope
from lib.simulator.population import RESERVED_SEEDS
from lib.simulator.recording import simulate
from lib.surface.reconstruct import reconstruct
from notebooks.studies import surface_evaluation as evaluation
from notebooks.studies import surface_speed as speed

__all__ = ["STUDIES", "main", "recorded"]

#: Stereo frames of the calibration, as many as the paper's.
N_FRAMES = 75
FIRST_SEED = 61
#: Frames that are reconstructed: of the calibration sweep, and of the surgeon's movements.
RECONSTRUCTED = (20, 60)
SETTINGS = ("quality", "fast")


def eyes(options: argparse.Namespace) -> dict:
    """True cameras: RMS surface error (um) of eyes of the reference rig and of the three test sequences, and of a sphere."""
    result = {}
    reference = (
        evaluation.simulated_pair(f"eye {seed}", Eye(seed=RESERVED_SEEDS[seed]), Microscope(), seed=seed)
        for seed in range(200, 200 + options.eyes)
    )
    for group in (reference, evaluation.eyes()):
        for pair in group:
            found = {setting: evaluation.case(pair, setting=setting) for setting in SETTINGS}
            result[pair.name] = {setting: found[setting].rms_um for setting in SETTINGS} | {
                "sphere prior": found["quality"].sphere_rms_um
            }
    return result | {"mean": _mean(result)}


def objects(options: argparse.Namespace) -> dict:
    """True cameras: RMS and median surface error (um) of the four objects, with the paper's grid and a finer one."""
    result = {}
    for pair in evaluation.objects():
        result[pair.name] = {}
        for control in ((20, 20), (40, 40)):
            found = evaluation.case(pair, control=control)
            length = 1e3 * np.linalg.norm(found.error_mm[found.seen], axis=-1)
            result[pair.name][f"{control[0]} x {control[1]}"] = {
                "rms": found.rms_um,
                "median": np.nanmedian(length),
            }
    return result


def calibrated(options: argparse.Namespace) -> dict:
    """Cameras calibrated from 75 frames of the detector: surface errors (um) in the robot frame and after alignments.

    "refined" gives `reconstruct` the calibration, so that the matches correct its epipolar geometry.
    """
    detector, result = Detector.load(), {"weights": _digest(paths.MODELS / "default.safetensors")}
    for seed in range(FIRST_SEED, FIRST_SEED + options.recordings):
        recording = _recording(seed)
        found = detect(recording, detector)
        seen, truth = found.complete, recording.truth
        pixels = [seen.u_left, seen.u_right]
        plain = calibrate(seen.x_mm, pixels)
        own = calibrate(seen.x_mm, pixels, covariance_px2=seen.pair_covariance_px2)
        rigs = {
            "true cameras": truth.rig,
            "calibrated": plain.rig,
            "calibrated, refined": plain,
            "calibrated with the detector's covariances, refined": own,
        }
        errors: dict[str, dict[str, list]] = {}
        for k in RECONSTRUCTED:
            pair, u = recording.frames[k], (found.grid("u_left")[k], found.grid("u_right")[k])
            lattice = tuple(np.arange(0, side, 12) for side in pair.left.shape[1::-1])
            x_true = truth.surface(np.stack(np.meshgrid(*lattice), axis=-1).reshape(-1, 2).astype(float))
            for name, rig in rigs.items():
                for setting in SETTINGS:
                    made = reconstruct(pair.left, pair.right, rig, u_landmarks=u, setting=setting)
                    error = evaluation.surface_error_mm(made.surface, truth.surface, *lattice)
                    visible = ~made.mask_left[np.ix_(*lattice[::-1])]
                    rms = evaluation.aligned_rms_um(error, x_true.reshape(error.shape), visible)
                    for alignment, value in rms.items():
                        errors.setdefault(f"{name}, {setting}", {}).setdefault(alignment, []).append(value)
        offsets = [found.grid("u_left") - truth.u_left, found.grid("u_right") - truth.u_right]
        result[recording.folder.name] = {
            "correspondences": len(seen),
            "inliers": plain.inliers.mean(),
            "sigma_u_px": plain.sigma_u_px,
            "detector_bias_px": [np.nanmedian(offset, axis=0) for offset in offsets],
            "surface_rms_um": {
                name: {alignment: np.mean(values) for alignment, values in by.items()} for name, by in errors.items()
            },
        }
    result["mean surface_rms_um"] = _mean(
        {name: entry["surface_rms_um"] for name, entry in result.items() if isinstance(entry, dict)}
    )
    return result


def confidence(options: argparse.Namespace) -> dict:
    """How well each confidence tells the wrong matches (error above 2 px), reciprocal or not: area under the ROC curve."""
    result = {}
    for name, matches, wrong in _judged_matches():
        judged = np.isfinite(wrong)
        bad, passed = wrong[judged] > 0, matches.reciprocal[judged]
        curves = evaluation.confidence_curves(matches, wrong, np.array([1.0]))
        result[name] = {f"auc_{measure}": auc for measure, (auc, _) in curves.items()}
        result[name] |= {
            "matches": int(judged.sum()),
            "wrong_share": bad.mean(),
            "wrong_share_of_reciprocal": bad[passed].mean(),
            "wrong_share_of_others": bad[~passed].mean() if (~passed).any() else None,
        }
    return result


def _judged_matches():
    """(name, matches, wrong (n,)) of every method on the real pairs and of those with a rig on the shipped recording."""
    every = {"reciprocal": False, "min_score": 0.0}
    folder = paths.real_data("stereo_pairs")
    if folder is None:
        print(paths.missing_data_line("stereo_pairs"))
    for name in ("motorcycle", "cones") if folder is not None else ():
        pair = evaluation.real_pair(folder / name)
        for method in ("deepmatching", "band", "sgbm", "dis"):
            matches = match(pair.left, pair.right, method=method, rig=RECTIFIED, **every)
            yield f"{name}, {method}", matches, pair.wrong_matches(matches)
    recording = Recording.open(paths.SHIPPED_RECORDING)
    frame, truth = recording.frames[0], recording.truth
    for method in ("band", "sgbm", "dis"):
        matches = match(frame.left, frame.right, method=method, rig=truth.rig, **every)
        yield f"simulated eye, {method}", matches, evaluation.wrong_matches(matches, truth.surface, truth.rig)


def recorded(path: Path = paths.RESULTS / "reconstruction.json") -> dict[str, dict]:
    """What the studies recorded last, by name; empty where nothing is."""
    return read_records(path)


def solver(options: argparse.Namespace) -> dict:
    """Our L1 solver beside CLARABEL: CPU seconds in the same run, and how far the objectives are apart."""
    return {f"{c} x {c}, n = {n}": speed.solver(c, n) for c in speed.CONTROL for n in speed.POINTS}


def pair(options: argparse.Namespace) -> dict:
    """A full-HD pair to its surface, seconds by stage and error: the depth alone, and the paper's three splines."""
    return {
        f"{setting}, {'depth' if depth else 'three splines'}": speed.pair_to_surface(setting, depth_only=depth)
        for setting in SETTINGS
        for depth in (True, False)
    }


def motorcycle(options: argparse.Namespace) -> dict:
    """Every matcher on the Middlebury pair that the published implementation was run on: seconds and errors."""
    folder = paths.real_data("stereo_pairs")
    if folder is None:
        print(paths.missing_data_line("stereo_pairs"))
        return {}
    result = {"deepmatching, 512 px": speed.motorcycle(folder / "motorcycle", "deepmatching", 512, rounds=0)}
    for method in ("band", "sgbm", "dis"):
        for width in (512, 1024):
            result[f"{method}, {width} px"] = speed.motorcycle(folder / "motorcycle", method, width)
    return result


STUDIES: dict[str, Callable[[argparse.Namespace], dict]] = {
    f.__name__: f for f in (eyes, objects, calibrated, confidence, solver, pair, motorcycle)
}


def _recording(seed: int) -> Recording:
    """A sweep and a surgeon's movements over an eye of the reference rig, from the cache or simulated."""
    folder = paths.CACHE / "reconstruction" / f"eye_{seed}_{N_FRAMES}"
    if folder.is_dir():
        return Recording.open(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    return simulate(folder, seed=seed, n_frames=N_FRAMES)


def _mean(results: dict[str, dict]) -> dict:
    """Mean over the entries of nested dictionaries of the same keys."""
    first = next(iter(results.values()))
    return {
        key: _mean({name: entry[key] for name, entry in results.items()})
        if isinstance(first[key], dict)
        else float(np.mean([entry[key] for entry in results.values()]))
        for key in first
    }


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def main(argv: list[str] | None = None) -> int:
    """Run the studies named (all by default) and merge them into the results file, which is written whole after each."""
    parser = argparse.ArgumentParser(
        prog="python3 -m notebooks.studies.surface_studies", description="Measure matching and surfaces."
    )
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=f"some of: {', '.join(STUDIES)}; default all")
    parser.add_argument("--eyes", type=int, default=5, help="eyes of the reference rig, beside the three test eyes")
    parser.add_argument("--recordings", type=int, default=3, help=f"recordings of {N_FRAMES} frames of `calibrated`")
    parser.add_argument("--out", type=Path, default=paths.RESULTS / "reconstruction.json")
    options = parser.parse_args(argv)
    unknown = set(options.studies) - set(STUDIES)
    if unknown:
        parser.error(f"unknown study {', '.join(sorted(unknown))}; take some of {', '.join(STUDIES)}")
    for name in options.studies or STUDIES:
        command = f"surface_studies {name} --eyes {options.eyes} --recordings {options.recordings}"
        provenance = Provenance(command)
        record = write_record(options.out, name, STUDIES[name](options), provenance)
        print(f"{name}: {json.dumps(record['result'])}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
