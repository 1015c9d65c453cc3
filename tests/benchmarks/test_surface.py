"""Benchmarks of surfaces: our solver beside CLARABEL, and a full-HD pair to its surface by stage.

Run with ``python3 -m lib bench`` or ``pytest tests/benchmarks/test_surface.py``; CPU seconds count, since the machine
may be busy.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import Microscope
from lib.simulator.render import render_pair
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE
from lib.surface import SplineGrid, evaluation, reconstruct
from lib.surface.solver import L1Problem, cvxpy_reference, interior_point

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


def cpu_seconds(call):
    start = time.process_time()
    value = call()
    return value, time.process_time() - start


@pytest.mark.parametrize("n", [2000, 10000, 50000])
@pytest.mark.parametrize("control", [20, 40])
def test_solver_beside_clarabel(benchmark, control, n):
    u, x = retina_points(n)
    grid, mu = SplineGrid(DOMAIN, (control, control)), 5.0 * n
    cvxpy_reference(L1Problem(grid, u[:500]), x[:500, :1], mu)  # imports and compiles

    def ours():
        return interior_point(L1Problem(grid, u), x, mu, tolerance=1e-8)

    found, seconds = cpu_seconds(ours)
    seconds = min(seconds, *(cpu_seconds(ours)[1] for _ in range(3)))
    problem = L1Problem(grid, u)
    reference, reference_seconds = cpu_seconds(lambda: cvxpy_reference(problem, x, mu, tolerance=1e-8))
    benchmark.extra_info |= {
        "relative_difference": float(found.objective.sum() / reference.objective.sum() - 1),
        "duality_gap": float(found.duality_gap.sum() / found.objective.sum()),
        "cpu_seconds": seconds,
        "clarabel_cpu_seconds": reference_seconds,
        "clarabel_over_ours": reference_seconds / seconds,
    }
    print(f"\n{control} x {control}, n = {n}: {benchmark.extra_info}")
    benchmark.pedantic(ours, rounds=3, iterations=1)
    assert abs(benchmark.extra_info["relative_difference"]) < 1e-7


@pytest.fixture(scope="module")
def full_hd_pair():
    microscope = Microscope()
    pose = Pose(base_mm=(1.5, 0.5, -1.0), azimuth_rad=2.8)
    eye = Eye(seed=9001)
    left, right = render_pair(eye, microscope, forceps=Forceps(), pose=pose, rng=np.random.default_rng(1))
    rig = microscope.rig()

    def truth(u):
        ray = (u - rig.left.offset_px) @ np.linalg.pinv(rig.left.linear).T
        along = np.full(len(u), float(rig.left.viewing_direction @ ROBOT_FROM_MICROSCOPE.t))
        for _ in range(60):
            x = ROBOT_FROM_MICROSCOPE.inverse().apply(ray + along[:, None] * rig.left.viewing_direction)
            along -= x[:, 2] - eye.height(x[:, 0], x[:, 1])
        return ray + along[:, None] * rig.left.viewing_direction

    return left, right, rig, truth


@pytest.mark.parametrize("setting", ["fast", "quality"])
def test_pair_to_surface(benchmark, full_hd_pair, setting):
    left, right, rig, truth = full_hd_pair
    results = []

    def run():
        results.append(reconstruct(left.image, right.image, rig, setting=setting, u_landmarks=(left.u, right.u)))

    benchmark.pedantic(run, rounds=7, iterations=1, warmup_rounds=1)
    stages = {name: min(r.seconds[name] for r in results) for name in results[0].seconds}
    error = evaluation.surface_error_mm(
        results[-1].surface, truth, np.arange(10, 1910, 20), np.arange(10, 1070, 20), camera=rig.left
    )
    benchmark.extra_info |= stages | {"total": sum(stages.values()), "surface_rms_um": evaluation.rms_um(error)}
    print(f"\n{setting}: {benchmark.extra_info}")
