"""Seconds of triangulation against OpenCV: `python3 -m lib bench`, or pytest on this folder."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lib.simulator.rig import reference_rig
from notebooks.studies.simulated_rows import simulate_correspondences

POINTS = 100_000


@pytest.fixture(scope="module")
def matches():
    return simulate_correspondences(POINTS, rng=np.random.default_rng(0))


def test_affine_triangulation(benchmark, matches):
    found = benchmark(lambda: matches.true_rig.triangulate(matches.u_left, matches.u_right))
    assert found.x_mm.shape == (POINTS, 3)


def test_opencv_triangulation(benchmark, matches):
    P = [camera.projection_matrix for camera in (matches.true_rig.left, matches.true_rig.right)]
    left, right = matches.u_left.T.copy(), matches.u_right.T.copy()
    x = benchmark(lambda: cv2.triangulatePoints(*P, left, right))
    ours = matches.true_rig.triangulate(matches.u_left, matches.u_right).x_mm
    np.testing.assert_allclose((x[:3] / x[3]).T, ours, atol=0.1)


def test_near_affine_triangulation(benchmark, matches):
    rig = reference_rig(inverse_distance_per_mm=1 / 200)
    u = rig.project(matches.true_x_mm)
    found = benchmark.pedantic(rig.triangulate, args=u, rounds=3)
    np.testing.assert_allclose(found.x_mm, matches.true_x_mm, atol=1e-9)
