"""How fast the surface solver, the way from a pair to its surface, and the matchers are, beside how good: one function
for the benchmarks (``tests/benchmarks``) and for the recorded results (`notebooks.studies.surface_studies`).

CPU seconds are on one thread and hold on a busy machine; wall seconds need an idle one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from lib.matching import RECTIFIED, match
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import Microscope
from lib.simulator.render import render_pair
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE
from lib.surface.grid import SplineGrid
from lib.surface.reconstruct import reconstruct
from lib.surface.solver import L1Problem, interior_point
from notebooks.studies import surface_evaluation as evaluation
from notebooks.studies.l1_reference import cvxpy_reference
from notebooks.studies.matching_evaluation import score_against_disparity

__all__ = ["CONTROL", "POINTS", "full_hd_pair", "motorcycle", "pair_to_surface", "retina_points", "solver"]

CONTROL = (20, 40)
POINTS = (2000, 10000, 50000)
TOLERANCE = 5e-8
DOMAIN = (0.0, 0.0, 1920.0, 1080.0)


def retina_points(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a bowl under the reference rig, 10 % outliers, in a frame turned like the reference robot's."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(DOMAIN[:2], DOMAIN[2:], (n, 2))
    x, y = ((u - (960, 540)) / 100).T
    depth = np.sqrt(144 - x**2 - y**2) - 12 + 0.1 * np.sin(x) * np.cos(1.3 * y)
    points = np.column_stack([x, y, depth]) + rng.normal(size=(n, 3)) * (0.005, 0.005, 0.06)
    wild = rng.random(n) < 0.1
    points[wild, 2] += rng.uniform(-2, 2, wild.sum())
    return u, ROBOT_FROM_MICROSCOPE.apply(points)


def solver(control: int, n: int, *, rounds: int = 3) -> dict[str, float]:
    """Our solver and CLARABEL on the same points, on one thread, in turns: medians of CPU seconds.

    Both are called from nothing but the points: ours with its setup, CLARABEL through cvxpy with the building and
    compiling of its model (not the imports).  CLARABEL has its default tolerance, 1e-8; ours stops when its duality gap
    proves 5e-8, so that the two together lie within 1e-7.  What CLARABEL itself took, its model built, stands beside.
    """
    u, x = retina_points(n)
    grid, mu = SplineGrid(DOMAIN, (control, control)), 5.0 * n
    ours, reference, alone = [], [], []
    with threadpool_limits(1):
        cvxpy_reference(L1Problem(grid, u[:500]), x[:500, :1], mu)  # imports and first compilation
        for _ in range(rounds):
            for _ in range(3):
                found, seconds = _cpu(lambda: interior_point(L1Problem(grid, u), x, mu, tolerance=TOLERANCE))
                ours.append(seconds)
            (exact, solve_seconds), seconds = _cpu(lambda: cvxpy_reference(L1Problem(grid, u), x, mu, tolerance=1e-8))
            reference.append(seconds)
            alone.append(solve_seconds)
    return {
        "tolerance": TOLERANCE,
        "clarabel_tolerance": 1e-8,
        "relative_difference": float(found.objective.sum() / exact.objective.sum() - 1),
        "duality_gap": float(found.duality_gap.sum() / found.objective.sum()),
        "cpu_seconds": float(np.median(ours)),
        "clarabel_cpu_seconds": float(np.median(reference)),
        "clarabel_over_ours": float(np.median(reference) / np.median(ours)),
        "clarabel_without_model_over_ours": float(np.median(alone) / np.median(ours)),
    }


@cache
def full_hd_pair():
    """(left, right, rig, truth) of a simulated eye with forceps and glints under the reference rig; images with landmarks."""
    microscope = Microscope()
    pose = Pose(base_mm=(1.5, 0.5, -1.0), azimuth_rad=2.8)
    eye = Eye(seed=9001)
    left, right = render_pair(eye, microscope, forceps=Forceps(), pose=pose, rng=np.random.default_rng(1))
    rig = microscope.rig()
    return left, right, rig, partial(evaluation.surface_on_rays, rig.left, eye.height)


def pair_to_surface(setting: str, *, depth_only: bool | None = None, rounds: int = 7) -> dict[str, float]:
    """Least wall seconds of each stage from a full-HD pair to its surface with true cameras, their sum, CPU, and error.

    `depth_only` True fits one spline, the depth along the view, in the place of three; None is the setting's default.
    The tool is masked by its true landmarks, so the time to detect them is not in it; the error is over the whole image,
    also under tool and reflections.
    """
    left, right, rig, truth = full_hd_pair()

    def run():
        u = (left.u, right.u)
        return reconstruct(left.image, right.image, rig, setting=setting, u_landmarks=u, depth_only=depth_only)

    run()
    found = [_cpu(run) for _ in range(rounds)]
    stages = {name: min(r.seconds[name] for r, _ in found) for name in found[0][0].seconds}
    error = evaluation.surface_error_mm(found[-1][0].surface, truth, np.arange(10, 1910, 20), np.arange(10, 1070, 20))
    return stages | {
        "total": min(sum(r.seconds.values()) for r, _ in found),
        "cpu_seconds": float(np.median([seconds for _, seconds in found])),
        "matches": len(found[-1][0].matches),
        "surface_rms_um": evaluation.rms_um(error),
    }


def motorcycle(folder: Path, method: str, width_px: int, *, rounds: int = 5) -> dict[str, float]:
    """Seconds and errors on the left 4:3 of the Middlebury pair in `folder`, at this width.

    Errors are over matches that are not occluded: where the truth is flat around them, and of all.
    """
    pair = evaluation.real_pair(folder).left_part(width_px, round(width_px * 3 / 4))
    options = {"method": method, "downscale": 1} if method == "deepmatching" else {"method": method, "rig": RECTIFIED}
    wall, cpu = [], []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        matches, seconds = _cpu(lambda: match(pair.left, pair.right, **options))
        wall.append(time.perf_counter() - start)
        cpu.append(seconds)
    result = {
        "matches": len(matches),
        "seconds": min(wall[1:] or wall),
        "cpu_seconds": float(np.median(cpu[1:] or cpu)),
    }
    for name, window in (("flat", 3), ("all", None)):
        score = score_against_disparity(matches, pair.disparity_px, flat_window_px=window)
        result |= {f"{name}_n": score.n, f"{name}_median_px": score.median_px, f"{name}_above_2": score.above_2}
    return result


def _cpu(call: Callable[[], object]) -> tuple:
    start = time.process_time()
    value = call()
    return value, time.process_time() - start
