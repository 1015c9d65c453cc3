"""Benchmarks of surfaces: the L1 solver, and a full-HD pair to its surface.

Run with ``python3 -m lib bench`` or pytest on this file.  The studies `l1_solver` and `reconstruction_speed` compare.
"""

from __future__ import annotations

import numpy as np
import pytest

from lib.surface import SplineGrid, reconstruct
from lib.surface.solver import L1Problem, interior_point
from notebooks.studies import surface_evaluation as evaluation


@pytest.mark.parametrize("n", [2000, 10000, 50000])
@pytest.mark.parametrize("control", [20, 40])
def test_solver(benchmark, control, n):
    u, x = evaluation.retina_points(n)
    grid = SplineGrid(evaluation.DOMAIN, (control, control))
    found = benchmark.pedantic(lambda: interior_point(L1Problem(grid, u), x, 5.0 * n, tolerance=5e-8), rounds=3)
    assert found.duality_gap.sum() <= 5e-8 * found.objective.sum()


@pytest.mark.parametrize("depth_only", [True, False])
@pytest.mark.parametrize("setting", ["fast", "quality"])
def test_pair_to_surface(benchmark, setting, depth_only):
    """One spline, the depth, and the paper's three: what each costs and gains."""
    left, right, rig, truth = evaluation.full_hd_pair()
    options = {"setting": setting, "u_landmarks": (left.u, right.u), "depth_only": depth_only}
    found = benchmark.pedantic(reconstruct, (left.image, right.image, rig), options, rounds=5, warmup_rounds=1)
    benchmark.extra_info |= found.seconds
    error = evaluation.surface_error_mm(found.surface, truth, np.arange(10, 1910, 20), np.arange(10, 1070, 20))
    assert evaluation.rms_um(error) <= {"fast": 25.0, "quality": 12.0}[setting]
