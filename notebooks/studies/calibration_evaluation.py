"""Evidence: every claim on calibration measured anew and written to ``data/results/calibration.json``.

python3 -m notebooks.studies.calibration_evaluation [--runs 2000] [--out FILE] [STUDY ...]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_array

from lib import paths
from lib.calibration import calibrate, report
from lib.calibration.affine import Moments, affine_minimum
from lib.provenance import Provenance, read_records, write_record
from lib.simulator.rig import simulate_correspondences
from notebooks.studies import calibration_studies as studies
from notebooks.studies import detected

__all__ = ["main", "recorded", "solve_with_ceres", "solve_with_scipy"]


def _problem(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    c = simulate_correspondences(n, rng=np.random.default_rng(seed))
    return c.x_mm, np.hstack([c.u_left, c.u_right]), 1.5, 0.010


def solve_with_scipy(x: np.ndarray, y: np.ndarray, sigma_u: float, sigma_x: float) -> tuple[float, np.ndarray]:
    """Cost and A (4, 3) of scipy's sparse trust-region least squares over the cameras and all points."""
    n, mean = len(x), x.mean(axis=0)
    # Unknowns scaled to about one: A in 100 px/mm, offsets in px, points in units of their noise.
    start = _regression(x - mean, y)
    sparsity = lil_array((7 * n, 16 + 3 * n), dtype=int)
    rows = np.arange(n)
    for j in range(4):
        for k in range(3):
            sparsity[4 * rows + j, 3 * j + k] = 1
            sparsity[4 * rows + j, 16 + 3 * rows + k] = 1
        sparsity[4 * rows + j, 12 + j] = 1
    for k in range(3):
        sparsity[4 * n + 3 * rows + k, 16 + 3 * rows + k] = 1

    def residuals(z: np.ndarray) -> np.ndarray:
        points = x - mean + sigma_x * z[16:].reshape(n, 3)
        projected = points @ (100 * z[:12].reshape(4, 3)).T + z[12:16]
        return np.concatenate([((projected - y) / sigma_u).ravel(), z[16:]])

    found = least_squares(
        residuals, np.concatenate([start[:, :3].ravel() / 100, start[:, 3], np.zeros(3 * n)]), jac_sparsity=sparsity.tocsr(),
        method="trf", tr_solver="lsmr", x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=100,
    )  # fmt: skip
    return float(found.cost), 100 * found.x[:12].reshape(4, 3)


def solve_with_ceres(x: np.ndarray, y: np.ndarray, sigma_u: float, sigma_x: float) -> tuple[float, np.ndarray]:
    """The same by Ceres (SPARSE_SCHUR) with cost functions written in Python, as pyceres users write them."""
    import pyceres

    mean = x.mean(axis=0)

    class Reprojection(pyceres.CostFunction):
        def __init__(self, pixels: np.ndarray) -> None:
            super().__init__()
            self.pixels = pixels
            self.set_num_residuals(4)
            self.set_parameter_block_sizes([16, 3])

        def Evaluate(self, parameters, residuals, jacobians):
            M, point = parameters[0].reshape(4, 4), parameters[1]
            residuals[:] = (M[:, :3] @ point + M[:, 3] - self.pixels) / sigma_u
            if jacobians is not None:
                if jacobians[0] is not None:
                    h = np.append(point, 1.0)
                    jacobians[0][:] = np.kron(np.eye(4), h).ravel() / sigma_u
                if jacobians[1] is not None:
                    jacobians[1][:] = M[:, :3].ravel() / sigma_u
            return True

    class Report(pyceres.CostFunction):
        def __init__(self, position: np.ndarray) -> None:
            super().__init__()
            self.position = position
            self.set_num_residuals(3)
            self.set_parameter_block_sizes([3])

        def Evaluate(self, parameters, residuals, jacobians):
            residuals[:] = (parameters[0] - self.position) / sigma_x
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = np.eye(3).ravel() / sigma_x
            return True

    camera = np.ascontiguousarray(_regression(x - mean, y)).ravel()
    points = [np.array(p) for p in x - mean]
    problem = pyceres.Problem()
    costs = []
    for point, reported, pixels in zip(points, x - mean, y, strict=True):
        costs += [Reprojection(pixels), Report(reported)]
        problem.add_residual_block(costs[-2], None, [camera, point])
        problem.add_residual_block(costs[-1], None, [point])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    options.max_num_iterations = 50
    options.function_tolerance = options.parameter_tolerance = options.gradient_tolerance = 1e-14
    options.minimizer_progress_to_stdout = False
    options.num_threads = 1
    summary = pyceres.SolverSummary()
    pyceres.solve(options, problem, summary)
    return float(summary.final_cost), camera.reshape(4, 4)[:, :3]


def _regression(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return affine_minimum(Moments.of(x, y), 1.0, 0.0).matrix


def _best(function: Callable[[], object], repeats: int) -> float:
    """Least wall seconds of several calls."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def bound(runs: int) -> dict:
    """Variance against the Cramer-Rao bound, and coverage of the reported covariances."""
    study = studies.bound_study(runs=runs)
    return {
        "runs": runs,
        "variance_over_bound_mean": study.ratio.mean(),
        "variance_over_bound_least": study.ratio.min(),
        "variance_over_bound_most": study.ratio.max(),
        "mahalanobis_squared_over_16": study.claimed / 16,
    }


def nested(runs: int) -> dict:
    """Size of the nested likelihood-ratio tests at 5 %."""
    return {"runs": runs, "rejected_share": studies.nested_study(runs=runs)}


def instruments(runs: int) -> dict:
    """Time offset, tool offsets, advice."""
    errors, deviations = studies.time_offset_study(runs=max(10, runs // 20))
    tool = studies.tool_offset_study(runs=max(5, runs // 100))
    curves = studies.advice_study(runs=max(10, runs // 50))
    needed = [int(np.argmax(curves["advised"] <= curves["random"][k])) / k for k in (10, 20, 30)]
    return {
        "time_offset_rms_error_ms": 1e3 * np.sqrt((errors**2).mean()),
        "time_offset_mean_sd_ms": 1e3 * deviations.mean(),
        "tool_offset_rms_error_um": 1e3 * np.sqrt((tool**2).mean()),
        "tool_offset_largest_error_um": 1e3 * np.abs(tool).max(),
        "advised_share_of_random_points_10_20_30": needed,
    }


def minimum(runs: int) -> dict:
    """Same minimum and how much faster: closed form, scipy sparse, Ceres with Python costs, n = 3000."""
    x, y, sigma_u, sigma_x = _problem(3000, 0)
    variances = sigma_u**2, sigma_x**2
    closed = affine_minimum(Moments.of(x, y), *variances)
    seconds = _best(lambda: affine_minimum(Moments.of(x, y), *variances), 20)
    result = {"closed_form_ms": 1e3 * seconds}
    for name, solver in (("scipy", solve_with_scipy), ("ceres", solve_with_ceres)):
        start = time.perf_counter()
        try:
            cost, A = solver(x, y, sigma_u, sigma_x)
        except ImportError:
            result[name] = "not installed"
            continue
        wall = time.perf_counter() - start
        result |= {
            f"{name}_ms": 1e3 * wall,
            f"times_faster_than_{name}": wall / seconds,
            f"cost_above_closed_form_{name}": (cost - closed.cost) / closed.cost,
            f"largest_relative_difference_in_A_{name}": np.abs(A - closed.matrix[:, :3]).max() / np.abs(A).max(),
        }
    return result


def speed(runs: int) -> dict:
    """Whole calibration with 30 % outliers at n = 1500, and triangulation of 100 000 points against OpenCV."""
    rng = np.random.default_rng(0)
    c = simulate_correspondences(1500, rng=rng)
    wrong = rng.random(1500) < 0.3
    u_left = c.u_left.copy()
    u_left[wrong] = rng.uniform(0, 1900, (wrong.sum(), 2))
    found = calibrate(c.x_mm, [u_left, c.u_right])
    whole = _best(lambda: report(calibrate(c.x_mm, [u_left, c.u_right])), 20)
    many = simulate_correspondences(100_000, rng=rng)
    rig = found.rig
    P = [camera.projection_matrix for camera in (rig.left, rig.right)]
    ours = _best(lambda: rig.triangulate(many.u_left, many.u_right), 20)
    near = studies.near_affine_rig(200.0)
    pixels = near.project(many.true_x_mm)
    near_affine = _best(lambda: near.triangulate(*pixels), 5)
    left, right = many.u_left.T.copy(), many.u_right.T.copy()
    theirs = _best(lambda: cv2.triangulatePoints(*P, left, right), 5)
    return {
        "ransac_fit_covariance_report_ms": 1e3 * whole,
        "outliers_found_share": float((~found.inliers[wrong]).mean()),
        "good_rows_kept_share": float(found.inliers[~wrong].mean()),
        "triangulation_ms": 1e3 * ours,
        "near_affine_triangulation_ms": 1e3 * near_affine,
        "opencv_triangulation_ms": 1e3 * theirs,
        "times_faster_than_opencv": theirs / ours,
    }


def outliers(runs: int) -> dict:
    """Gross outliers in 40 % of the rows, and in 40 % of each camera's detections independently (64 % of the rows)."""
    result = {}
    for name, both in (("40 % of rows", False), ("40 % of each camera", True)):
        missed, kept = [], []
        for seed in range(max(20, runs // 20)):
            rng = np.random.default_rng(seed)
            c = simulate_correspondences(300, rng=rng)
            u, bad = [c.u_left.copy(), c.u_right.copy()], np.zeros(300, dtype=bool)
            for pixels in u if both else u[:1]:
                wrong = rng.random(300) < 0.4
                pixels[wrong] = rng.uniform(0, 1900, (wrong.sum(), 2))
                bad |= wrong
            found = calibrate(c.x_mm, u, seed=seed)
            missed.append(found.inliers[bad].mean())
            kept.append(found.inliers[~bad].mean())
        result[name] = {"outliers_missed_share": np.mean(missed), "good_rows_kept_share_least": np.min(kept)}
    return result


def working_distance(runs: int) -> dict:
    """Affine and near-affine model against working distance."""
    distances = [100.0, 200.0, 400.0, 1000.0, np.inf]
    study = studies.working_distance_study(distances, runs=max(3, runs // 200))
    return {
        "distance_mm": [d if np.isfinite(d) else None for d in distances],
        **{k: v.tolist() for k, v in study.items()},
    }


def checkerboard(runs: int) -> dict:
    """0.5 mm checkerboards from rendered images, cameras from 75 detected tool frames: affine optics, and 200 mm away.

    Errors are root mean squares over sweeps and boards; with several sweeps, `*_each` has one value a sweep.
    """
    result = {"tool_frames": detected.FRAMES, "weights": detected.digest(detected.SHIPPED_WEIGHTS)}
    for name, distance, seeds in (("affine optics", np.inf, SWEEPS), ("working distance 200 mm", 200.0, SWEEPS[:1])):
        result[name] = {}
        for rig, errors in detected.board_study(distance, seeds=seeds).items():
            row = result[name][rig] = {"corners": errors[0].corners, "sweeps": len(errors)}
            for key in ("aligned_um", "robot_um"):
                each = [getattr(e, key) for e in errors]
                row[key] = _root_mean_square(each)
                if len(each) > 1:
                    row[f"{key}_each"] = each
    return result


def detector(runs: int) -> dict:
    """The shipped detector in place of labels, against the Cramer-Rao bound; labels with 1 px; factorisation."""
    result = {"sweeps": len(SWEEPS), "weights": detected.digest(detected.SHIPPED_WEIGHTS), "definition": DEFINITION}
    judged = detected.detector_study(SWEEPS)
    result |= {name: _over_bound(each) for name, each in judged.items()}
    fresh = detected.detector_study(FRESH_SWEEPS)
    result["fresh"] = {"sweeps": len(FRESH_SWEEPS)} | {name: _over_bound(each) for name, each in fresh.items()}
    result["bias_px"] = np.mean([j.bias_px for j in judged["detected"]], axis=0).tolist()
    sigma_u = result["detected"]["sigma_u_px"]
    views = [2, 3, 5]
    factors = studies.factorisation_study(views, n=3 * detected.FRAMES, sigma_u_px=sigma_u)
    result["factorisation"] = {"poses_of_the_head": views, "sigma_u_px": sigma_u} | {
        name: value.tolist() for name, value in factors.items()
    }
    return result


#: Seeds of the sweeps: eight tools, eyes and paths.
SWEEPS = range(detected.SEED, detected.SEED + 8)
#: Sweeps drawn after an estimator was recommended on the others.
FRESH_SWEEPS = range(SWEEPS.stop, SWEEPS.stop + 4)
#: What `detector` calls the bound.
DEFINITION = (
    "bound: RMS of the Cramer-Rao prediction of the fitted model at the true cameras and the rows used, for independent "
    "Gaussian noise of the detections' RMS error per coordinate (measured against truth over the rows used, bias included) "
    "and 10 um of the robot. over_bound: 3D RMS of the true landmarks triangulated from their exact pixels over its bound; "
    "projection_over_bound: RMS of their projections over its bound. Pooled over the sweeps (root mean squares). Estimators "
    "that weigh detections by their own covariances may go below 1: the bound takes all detections as equally noisy."
)


def _over_bound(each: list[detected.Judgement]) -> dict:
    """What `detector` states of one estimator on several sweeps."""
    triangulation, projection = detected.pooled_over_bound(each)
    return {
        "over_bound": triangulation,
        "projection_over_bound": projection,
        "over_bound_each": [j.over_bound for j in each],
        "projection_over_bound_each": [j.projection_over_bound for j in each],
    } | {
        key: _root_mean_square([getattr(j, key) for j in each])
        for key in ("sigma_u_px", "calibration_um", "projection_px", "triangulation_um")
    }


def _root_mean_square(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def resolution(runs: int) -> dict:
    """Calibration from labels and from detectors at the paper's four resolutions, affine and perspective."""
    seeds = SWEEPS[:4]
    stated = {"sweeps": len(seeds), "weights": detected.digest(detected.SHIPPED_WEIGHTS)}
    return stated | detected.resolution_study(seeds=seeds)


def robot(runs: int) -> dict:
    """Leave-one-out errors on the real robot, affine and with 1/distance."""
    from notebooks.studies import real_robot

    folder = paths.real_data("dvrk_hand_eye")
    if folder is None:
        return {"skipped": paths.missing_data_line("dvrk_hand_eye")}
    frames = real_robot.read_robot_frames(folder)
    result = {"frames": len(frames.index)}
    for s, sphere in enumerate(("upper", "lower")):
        for model, length in (("affine", 0.0), ("affine", None), ("affine+distance", 0.0), ("near_affine", None)):
            fit = real_robot.calibrate_sphere(
                frames.joint_mm, frames.u[:, s], model=model, image_size_px=frames.image_size_px, along_shaft_mm=length
            )
            at = "joint" if length == 0.0 else "sphere"
            result[f"{sphere}_{model}_at_{at}_leave_one_out_px"] = fit.leave_one_out_rms_px
        result[f"{sphere}_focal_px"] = fit.focal_px
    return result


STUDIES: dict[str, Callable[[int], dict]] = {
    f.__name__: f
    for f in (
        bound,
        nested,
        instruments,
        minimum,
        speed,
        outliers,
        working_distance,
        checkerboard,
        detector,
        resolution,
        robot,
    )
}


def recorded(study: str) -> dict | None:
    """What `study` found when it was last run for the results file; None where it has not been."""
    return read_records(paths.RESULTS / "calibration.json").get(study, {}).get("result")


def main(argv: list[str] | None = None) -> int:
    """Run the studies named (all by default) and merge them into the results file, which is written whole after each."""
    parser = argparse.ArgumentParser(prog="calibration_evaluation", description="Measure the calibration's claims.")
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=f"some of: {', '.join(STUDIES)}; default all")
    parser.add_argument("--runs", type=int, default=2000, help="repetitions of the largest study")
    parser.add_argument("--out", type=Path, default=paths.RESULTS / "calibration.json")
    arguments = parser.parse_args(argv)
    unknown = set(arguments.studies) - set(STUDIES)
    if unknown:
        parser.error(f"unknown study {', '.join(sorted(unknown))}; take some of {', '.join(STUDIES)}")
    for name in arguments.studies or STUDIES:
        provenance = Provenance(f"python3 -m notebooks.studies.calibration_evaluation {name} --runs {arguments.runs}")
        record = write_record(arguments.out, name, STUDIES[name](arguments.runs), provenance)
        print(f"{name}: {json.dumps(record['result'])}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
