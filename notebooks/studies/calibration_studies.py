"""Simulated experiments on calibration: the same functions feed the notebook and the recorded results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from lib.calibration import Calibration, calibrate
from lib.calibration.advice import box_grid, next_positions
from lib.calibration.affine import Moments, affine_minimum, dlt, paper_variances
from lib.calibration.ladder import compare_models
from lib.calibration.pivot import tool_offsets
from lib.calibration.timing import estimate_time_offset
from lib.cameras import NearAffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.simulator.rig import (
    IMAGE_SIZE_PX,
    ROBOT_FROM_MICROSCOPE,
    SimulatedSweep,
    reference_rig,
    simulate_correspondences,
)
from notebooks.studies.baselines import (
    factorise,
    perspective_dlt,
    similarity,
    triangulate_perspective,
)

__all__ = [
    "BoundStudy",
    "NoiseStudy",
    "advice_study",
    "bound_study",
    "dlt_is_enough",
    "factorisation_study",
    "focal_study",
    "follow_advice",
    "near_affine_rig",
    "nested_study",
    "noise_study",
    "shallow_study",
    "time_offset_study",
    "tool_offset_study",
    "video_of_sweep",
    "working_distance_study",
]

HALF_SIZE_MM = np.array([8.0, 4.5, 1.5])


def near_affine_rig(distance_mm: float) -> StereoRig:
    """The reference rig at a finite working distance (infinity is the reference rig itself)."""
    rig = reference_rig()
    if np.isinf(distance_mm):
        return rig
    centre = (np.array(IMAGE_SIZE_PX) - 1) / 2
    return StereoRig(
        *(NearAffineCamera(c.matrix, 1 / distance_mm, centre, ROBOT_FROM_MICROSCOPE.t) for c in (rig.left, rig.right))
    )


def _noisy(rig: StereoRig, x: np.ndarray, rng: np.random.Generator, sigma_u_px: float, sigma_x_mm: float) -> tuple:
    u = [pixels + rng.normal(0, sigma_u_px, pixels.shape) for pixels in rig.project(x)]
    return x + rng.normal(0, sigma_x_mm, x.shape), u


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


@dataclass(frozen=True)
class NoiseStudy:
    """Held-out errors over noise levels: arrays (levels, runs), triangulation in um, reprojection in px."""

    sigma_u_px: np.ndarray
    affine_um: np.ndarray
    perspective_um: np.ndarray
    affine_px: np.ndarray
    perspective_px: np.ndarray


def noise_study(sigma_u_px: Sequence[float], *, n: int = 75, runs: int = 20, seed: int = 0) -> NoiseStudy:
    """Affine calibration and perspective DLT on the same detections, judged on exact points that they have not seen."""
    rng = np.random.default_rng(seed)
    test = simulate_correspondences(200, rng=rng, sigma_u_px=0, sigma_x_mm=0)
    u_test = [test.u_left, test.u_right]
    results = np.full((4, len(sigma_u_px), runs), np.nan)
    for i, sigma in enumerate(sigma_u_px):
        for j in range(runs):
            c = simulate_correspondences(n, rng=rng, sigma_u_px=sigma)
            found = calibrate(c.x_mm, [c.u_left, c.u_right], ransac_px=np.inf)
            projected = found.rig.project(test.x_mm)
            results[0, i, j] = 1e3 * _rms(found.rig.triangulate(*u_test).x_mm - test.x_mm)
            results[2, i, j] = _rms(np.vstack(projected) - np.vstack(u_test))
            pair = [perspective_dlt(c.x_mm, u) for u in (c.u_left, c.u_right)]
            results[1, i, j] = 1e3 * _rms(triangulate_perspective(pair, u_test) - test.x_mm)
            results[3, i, j] = _rms(np.vstack([p.project(test.x_mm) for p in pair]) - np.vstack(u_test))
    return NoiseStudy(np.array(sigma_u_px), *results)


def focal_study(n: int = 75, *, runs: int = 60, distance_mm: float = 2e4, seed: int = 0) -> tuple[np.ndarray, float]:
    """Focal lengths (runs,) px that perspective DLT decomposes from a camera 20 m away, and the true one."""
    rng = np.random.default_rng(seed)
    camera = near_affine_rig(distance_mm).left
    found = []
    for _ in range(runs):
        x = simulate_correspondences(n, rng=rng).true_x_mm
        noisy, u = x + rng.normal(0, 0.01, x.shape), camera.project(x) + rng.normal(0, 1.5, (n, 2))
        found.append(perspective_dlt(noisy, u).decompose()[0][0, 0])
    return np.array(found), 100.0 * distance_mm


def shallow_study(
    half_depth_mm: Sequence[float], *, n: int = 1000, runs: int = 40, seed: int = 0
) -> dict[str, np.ndarray]:
    """Estimated over true depth column (1 = unbiased), means over runs, for each estimator: {name: (depths,)}."""
    rng = np.random.default_rng(seed)
    rig = reference_rig(robot_from_microscope=RigidTransform.identity())
    true = rig.linear[:, 2]
    sigma_u, sigma_x = 1.5, 0.010
    estimators = {
        "DLT": (1.0, 0.0, 1.0),
        "likelihood": (sigma_u**2, sigma_x**2, 1.0),
        "as printed, mm": (*paper_variances(sigma_u, sigma_x), 1.0),
        "as printed, um": (*paper_variances(sigma_u, 1e3 * sigma_x), 1e3),
    }
    ratios = {name: np.empty((len(half_depth_mm), runs)) for name in estimators}
    for i, depth in enumerate(half_depth_mm):
        for j in range(runs):
            x = rng.uniform(-1, 1, (n, 3)) * [8, 4.5, depth]
            noisy, u = _noisy(rig, x, rng, sigma_u, sigma_x)
            for name, (variance_u, variance_x, unit) in estimators.items():
                A = affine_minimum(Moments.of(unit * noisy, np.hstack(u)), variance_u, variance_x).matrix[:, :3]
                ratios[name][i, j] = unit * A[:, 2] @ true / (true @ true)
    return {name: value.mean(axis=1) for name, value in ratios.items()}


@dataclass(frozen=True)
class BoundStudy:
    """Variance over Cramer-Rao bound of the 16 affine parameters (16,), and mean Mahalanobis distances squared.

    `claimed` uses each run's reported covariance, `expected` the bound's; both should be 16.
    """

    ratio: np.ndarray
    claimed: float
    bound: float
    runs: int


def bound_study(*, n: int = 300, runs: int = 2000, seed: int = 0) -> BoundStudy:
    """Affine calibration of the reference rig, sigma_u 1.5 px and sigma_x 10 um, estimated from the data in each run."""
    rng = np.random.default_rng(seed)
    rig = reference_rig()
    x = simulate_correspondences(n, rng=rng).true_x_mm
    truth = np.concatenate([rig.left.matrix.ravel(), rig.right.matrix.ravel()])
    H = np.column_stack([x, np.ones(n)])
    S = 1.5**2 * np.eye(4) + 0.01**2 * rig.linear @ rig.linear.T
    bound = np.kron(S, np.linalg.inv(H.T @ H))
    errors, claimed = np.empty((runs, 16)), np.empty(runs)
    for i in range(runs):
        noisy, u = _noisy(rig, x, rng, 1.5, 0.01)
        found = calibrate(noisy, u, model="affine", ransac_px=np.inf)
        errors[i] = np.concatenate([c.matrix.ravel() for c in found.cameras]) - truth
        claimed[i] = errors[i] @ np.linalg.solve(found.covariance, errors[i])
    against = np.einsum("ri,ij,rj->r", errors, np.linalg.inv(bound), errors)
    return BoundStudy(errors.var(axis=0) / np.diag(bound), float(claimed.mean()), float(against.mean()), runs)


def nested_study(*, n: int = 300, runs: int = 2000, seed: int = 0) -> dict[str, float]:
    """Share of runs in which a true constraint is rejected at 5 %, by likelihood-ratio test."""
    rng = np.random.default_rng(seed)
    rig = reference_rig(pixels_per_mm=(100.0, 100.0))
    models = ("common_zoom", "square", "zero_skew", "affine")
    known = {"sigma_u_px": 1.5, "sigma_x_mm": 0.01, "ransac_px": np.inf, "checks": False}
    rejected = dict.fromkeys(("affine -> zero_skew", "zero_skew -> square", "square -> common_zoom"), 0)
    for _ in range(runs):
        x = simulate_correspondences(n, rng=rng).true_x_mm
        noisy, u = _noisy(rig, x, rng, 1.5, 0.01)
        fits = [calibrate(noisy, u, model=m, **known) for m in models]
        for free, tied in ((3, 2), (2, 1), (1, 0)):
            more = len(fits[free].parameter_names) - len(fits[tied].parameter_names)
            gain = 2 * (fits[tied].cost - fits[free].cost)
            rejected[f"{models[free]} -> {models[tied]}"] += bool(gain > chi2.isf(0.05, more))
    return {name: count / runs for name, count in rejected.items()}


def working_distance_study(
    distances_mm: Sequence[float], *, n: int = 300, runs: int = 5, seed: int = 0
) -> dict[str, np.ndarray]:
    """Held-out 3D RMS (um) of the affine and the near-affine model, and the share of runs where BIC takes 1/distance.

    Detections of the held-out points are exact, so the error is the calibration's: noise and model.
    """
    rng = np.random.default_rng(seed)
    result = {name: np.empty((len(distances_mm), runs)) for name in ("affine_um", "near_affine_um", "chosen")}
    models = ("square", "zero_skew", "square+distance", "zero_skew+distance")
    for i, distance in enumerate(distances_mm):
        rig = near_affine_rig(distance)
        test = simulate_correspondences(200, rng=rng).true_x_mm
        for j in range(runs):
            x = simulate_correspondences(n, rng=rng).true_x_mm
            noisy, u = _noisy(rig, x, rng, 1.5, 0.01)
            comparison = compare_models(noisy, u, models=models, image_size_px=IMAGE_SIZE_PX)
            for name, model in (("affine_um", "zero_skew"), ("near_affine_um", "zero_skew+distance")):
                found = comparison[model].calibration.rig.triangulate(*rig.project(test)).x_mm
                result[name][i, j] = 1e3 * _rms(found - test)
            result["chosen"][i, j] = "distance" in comparison.best.model
    return {name: value.mean(axis=1) for name, value in result.items()}


def advice_study(*, start: int = 12, more: int = 32, runs: int = 20, seed: int = 0) -> dict[str, np.ndarray]:
    """RMS over the workspace of sqrt(leverage), (more + 1,), after random and after advised positions, means over runs.

    Every run starts from the same number of clustered points.
    """
    rng = np.random.default_rng(seed)
    grid = ROBOT_FROM_MICROSCOPE.apply(box_grid(-HALF_SIZE_MM, HALF_SIZE_MM))
    H_grid = np.column_stack([grid, np.ones(len(grid))])

    def curve(first: np.ndarray, rest: np.ndarray) -> list[float]:
        values = []
        for k in range(more + 1):
            H = np.column_stack([np.vstack([first, rest[:k]]), np.ones(len(first) + k)])
            values.append(np.sqrt(np.einsum("ni,ij,nj->n", H_grid, np.linalg.inv(H.T @ H), H_grid).mean()))
        return values

    curves = {"random": [], "advised": []}
    for _ in range(runs):
        c = simulate_correspondences(start, rng=rng, half_size_mm=tuple(HALF_SIZE_MM / 6))
        found = calibrate(
            c.x_mm, [c.u_left, c.u_right], model="affine", sigma_u_px=1.5, sigma_x_mm=0.01, ransac_px=np.inf
        )
        random = ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-1, 1, (more, 3)) * HALF_SIZE_MM)
        curves["random"].append(curve(c.x_mm, random))
        curves["advised"].append(curve(c.x_mm, next_positions(found, grid, more)[0]))
    return {name: np.mean(value, axis=0) for name, value in curves.items()}


def video_of_sweep(
    offset_s: float, *, rng: np.random.Generator, frames: int = 300, speed_mm_s: float = 2.0, fps: float = 25.0
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]:
    """Frame times, detections of three landmarks, robot times at 100 Hz and reported positions; RMS speed `speed_mm_s`."""
    landmarks = np.array([[0.0, 0.0, 0.0], [1.5, 0.4, 2.0], [1.5, -0.4, 2.0]])
    amplitude, phase = np.array([3.0, 2.0, 1.0]), np.array([0.0, 0.7, 1.9])
    # Each axis a sine of RMS speed speed / sqrt(3).
    frequency = speed_mm_s * np.sqrt(2 / 3) / amplitude

    def position(time: np.ndarray) -> np.ndarray:
        centre = ROBOT_FROM_MICROSCOPE.apply(amplitude * np.sin(time[:, None] * frequency + phase))
        return centre[:, None] + landmarks

    time = np.arange(frames) / fps
    robot_time = np.arange(-1.0, time[-1] + 1.0, 0.01)
    seen, x = position(time + offset_s), position(robot_time)
    u = [p.reshape(seen.shape[:2] + (2,)) for p in reference_rig().project(seen.reshape(-1, 3))]
    u = [p + rng.normal(0, 1.5, p.shape) for p in u]
    return time, u, robot_time, x + rng.normal(0, 0.01, x.shape)


def time_offset_study(*, offset_s: float = 0.030, runs: int = 40, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Errors and claimed standard deviations (runs,) in seconds, 300 frames of three landmarks at 2 mm/s."""
    rng = np.random.default_rng(seed)
    videos = [video_of_sweep(offset_s, rng=rng) for _ in range(runs)]
    found = [estimate_time_offset((time, u), (robot_time, x)) for time, u, robot_time, x in videos]
    return np.array([f.offset_s - offset_s for f in found]), np.array([f.sd_s for f in found])


def tool_offset_study(*, frames: int = 300, runs: int = 10, seed: int = 0) -> np.ndarray:
    """Errors (runs, 3 landmarks, 3) mm of the landmark offsets found from poses (+-30 degrees) and images."""
    rng = np.random.default_rng(seed)
    rig = reference_rig()
    offsets = np.array([[0.0, 0.0, 12.0], [0.6, 0.1, 15.0], [-0.6, 0.1, 15.0]])
    errors = []
    for _ in range(runs):
        poses = [
            RigidTransform.from_rotation_vector(
                rng.uniform(-0.5, 0.5, 3), ROBOT_FROM_MICROSCOPE.t + rng.uniform(-1, 1, 3) * [4, 3, 1.5]
            )
            for _ in range(frames)
        ]
        x = np.stack([pose.apply(offsets) for pose in poses])
        u = [
            np.stack([c.project(row) for row in x]) + rng.normal(0, 1.5, (frames, 3, 2)) for c in (rig.left, rig.right)
        ]
        errors.append(tool_offsets(poses, u).offset_mm - offsets)
    return np.array(errors)


def factorisation_study(
    poses: Sequence[int], *, n: int = 75, runs: int = 10, sigma_u_px: float = 1.5, seed: int = 0
) -> dict[str, np.ndarray]:
    """3D RMS (um) of n points seen from several poses of the stereo head (two views each), medians, {name: (len,)}.

    By factorisation, given the best similarity to the truth for free, and by triangulation with all the views calibrated
    from the robot, which needs none.
    """
    rng = np.random.default_rng(seed)
    result = {"factorisation_um": np.empty((len(poses), runs)), "robot_um": np.empty((len(poses), runs))}
    for i, count in enumerate(poses):
        for j in range(runs):
            x = simulate_correspondences(n, rng=rng).true_x_mm
            images, matrices = [], []
            for k in range(count):
                tilt = (
                    RigidTransform.from_rotation_vector(rng.uniform(-0.1, 0.1, 3)) if k else RigidTransform.identity()
                )
                rig = reference_rig(robot_from_microscope=ROBOT_FROM_MICROSCOPE.compose(tilt))
                noisy, u = _noisy(rig, x, rng, sigma_u_px, 0.01)
                images += u
                matrices += [dlt(noisy, pixels).matrix for pixels in u]
            shape = factorise(np.stack(images)).shape
            result["factorisation_um"][i, j] = 1e3 * _rms(similarity(shape, x) - x)
            M = np.vstack(matrices)
            found = np.linalg.lstsq(M[:, :3], (np.hstack(images) - M[:, 3]).T, rcond=None)[0].T
            result["robot_um"][i, j] = 1e3 * _rms(found - x)
    return {name: np.median(value, axis=1) for name, value in result.items()}


def follow_advice(
    few: SimulatedSweep,
    advised_mm: np.ndarray,
    seen: Sequence[np.ndarray],
    followed: int,
    *,
    sigma_u_px: float,
    sigma_x_mm: float,
) -> Calibration:
    """Affine calibration from `few` rows and the first `followed` advised positions (k, 3), seen at (k, 2) px a camera."""
    x = np.vstack([few.x_mm, advised_mm[:followed]])
    u = [np.vstack([a, b[:followed]]) for a, b in zip((few.u_left, few.u_right), seen, strict=True)]
    return calibrate(x, u, model="affine", sigma_u_px=sigma_u_px, sigma_x_mm=sigma_x_mm, ransac_px=np.inf)


def dlt_is_enough(n: int = 300, *, runs: int = 200, seed: int = 0) -> tuple[float, float]:
    """Mean Mahalanobis distance squared (16 expected) of DLT and of the likelihood minimum, in a deep volume."""
    rng = np.random.default_rng(seed)
    rig = reference_rig()
    x = simulate_correspondences(n, rng=rng).true_x_mm
    H = np.column_stack([x, np.ones(n)])
    S = 1.5**2 * np.eye(4) + 0.01**2 * rig.linear @ rig.linear.T
    inverse = np.linalg.inv(np.kron(S, np.linalg.inv(H.T @ H)))
    truth = np.vstack([rig.left.matrix, rig.right.matrix])
    values = []
    for _ in range(runs):
        noisy, u = _noisy(rig, x, rng, 1.5, 0.01)
        pair = np.vstack([dlt(noisy, p).matrix for p in u]) - truth
        best = affine_minimum(Moments.of(noisy, np.hstack(u)), 2.25, 1e-4).matrix - truth
        values.append([e.ravel() @ inverse @ e.ravel() for e in (pair, best)])
    return tuple(np.mean(values, axis=0).tolist())
