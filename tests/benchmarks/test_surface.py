"""Benchmarks of surfaces: our solver beside CLARABEL, and a full-HD pair to its surface by stage.

Run with ``python3 -m lib bench`` or ``pytest -s tests/benchmarks/test_surface.py``; each prints what
``python3 -m notebooks.studies.surface_studies solver pair`` records.
"""

from __future__ import annotations

import pytest

from lib.surface import SplineGrid
from lib.surface.solver import L1Problem, interior_point
from notebooks.studies import surface_speed as speed


@pytest.mark.parametrize("n", speed.POINTS)
@pytest.mark.parametrize("control", speed.CONTROL)
def test_solver_beside_clarabel(benchmark, control, n):
    benchmark.extra_info |= speed.solver(control, n)
    print(f"\n{control} x {control}, n = {n}: {benchmark.extra_info}")
    u, x = speed.retina_points(n)
    grid = SplineGrid(speed.DOMAIN, (control, control))
    benchmark.pedantic(lambda: interior_point(L1Problem(grid, u), x, 5.0 * n, tolerance=speed.TOLERANCE), rounds=3)
    assert abs(benchmark.extra_info["relative_difference"]) < 1e-7


@pytest.mark.parametrize("depth_only", [True, False])
@pytest.mark.parametrize("setting", ["fast", "quality"])
def test_pair_to_surface(benchmark, setting, depth_only):
    """One spline, the depth, and the paper's three: what each costs and gains.

    The benchmark's own table times the whole measurement, eight pairs; a pair's seconds are in `extra_info`.
    """
    benchmark.extra_info |= benchmark.pedantic(speed.pair_to_surface, (setting,), {"depth_only": depth_only})
    print(f"\n{setting}, {'depth' if depth_only else 'three splines'}: {benchmark.extra_info}")
    assert benchmark.extra_info["surface_rms_um"] <= {"fast": 25.0, "quality": 12.0}[setting]
