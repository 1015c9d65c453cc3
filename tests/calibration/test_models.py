"""The ladder: Jacobians against finite differences, parsing, tests of nested models, choice by BIC."""

import numpy as np
import pytest

from lib.calibration.models import Model, State, fit, settle
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.camera_models import compare_models
from notebooks.studies.simulated_rows import simulate_correspondences
from tests.calibration.rigs import near_rig

NAMES = [
    base + options
    for base in ("affine", "zero_skew", "square", "common_zoom")
    for options in ("", "+distance", "+distances+radial")
]


def state(model, seed=0):
    """A state well away from zero in every parameter."""
    rng = np.random.default_rng(seed)
    rig = reference_rig()
    matrix = np.vstack([rig.left.matrix, rig.right.matrix])[: 2 * model.cameras]
    start = State.start(model, matrix, ROBOT_FROM_MICROSCOPE.t, np.tile([959.5, 539.5], (model.cameras, 1)))
    scale = np.full(model.selection.shape[1], 0.05)
    if model.base == "affine":
        scale[:6] = 3.0
    scale[-4:-2], scale[-2], scale[-1] = 20.0, 4e-3, 3e-9
    return start.moved(np.einsum("cip,ci->p", model.selection, scale * rng.normal(size=model.selection.shape[:2])))


@pytest.mark.parametrize("name", NAMES)
def test_jacobians_are_finite_differences(name):
    model = Model.parse(name, 2)
    at = state(model)
    x = at.reference + np.random.default_rng(1).uniform(-1, 1, (9, 3)) * [6, 4, 2]
    _, J_x, J = at.evaluate(x)
    for j, name_j in enumerate(model.parameter_names):
        step = 1e-11 if "radial" in name_j else 1e-6 if "1/distance" in name_j else 1e-5
        move = np.eye(J.shape[2])[j] * step
        numeric = (at.moved(move).evaluate(x)[0] - at.moved(-move).evaluate(x)[0]) / (2 * step)
        np.testing.assert_allclose(
            J[:, :, j], numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max() + 1e-4, err_msg=name_j
        )
    for j, e in enumerate(1e-5 * np.eye(3)):
        numeric = (at.evaluate(x + e)[0] - at.evaluate(x - e)[0]) / 2e-5
        np.testing.assert_allclose(J_x[:, :, j], numeric, rtol=1e-6, atol=1e-4)
    assert [part.shape for part in at.evaluate(x[:0])] == [(0, 4), (0, 4, 3), (0, *J.shape[1:])]  # no points are no error


@pytest.mark.parametrize("name", ["affine", "square+distances"])
def test_matrix_jacobian_is_a_finite_difference(name):
    model = Model.parse(name, 2)
    at = state(model)

    def entries(s):
        return np.concatenate([camera.matrix.ravel() for camera in s.cameras()])

    G = at.matrix_jacobian()
    for j in range(G.shape[1]):
        move = np.eye(G.shape[1])[j] * 1e-6
        numeric = (entries(at.moved(move)) - entries(at.moved(-move))) / 2e-6
        np.testing.assert_allclose(G[:, j], numeric, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "cameras", "count"),
    [
        ("affine", 2, 16), ("zero_skew", 2, 14), ("square", 2, 12), ("common_zoom", 2, 11), ("affine", 1, 8),
        ("near_affine", 2, 15), ("zero_skew+distances", 2, 16), ("square+distance+radial", 2, 15),
        ("affine+radial", 1, 9), ("near_affine+radial", 2, 17),
    ],
)  # fmt: skip
def test_parameters_are_counted(name, cameras, count):
    model = Model.parse(name, cameras)
    assert len(model.parameter_names) == count == model.selection.shape[2]
    assert np.linalg.matrix_rank(model.selection.reshape(-1, count)) == count


def test_state_and_camera_project_alike():
    model = Model.parse("zero_skew+distances+radial", 2)
    at = state(model)
    x = at.reference + np.random.default_rng(1).uniform(-3, 3, (9, 3))
    y = at.evaluate(x)[0]
    projected = np.hstack([camera.project(x) for camera in at.cameras()])
    np.testing.assert_allclose(y, projected, atol=1e-8)


@pytest.mark.parametrize("name", ["zero_skew", "near_affine", "affine+distance+radial"])
def test_minimum_is_stationary(name):
    c = simulate_correspondences(60, rng=np.random.default_rng(2))
    model = Model.parse(name, 2)
    matrix = np.vstack([c.true_rig.left.matrix, c.true_rig.right.matrix])
    start = State.start(model, matrix, c.x_mm.mean(axis=0), np.tile([959.5, 539.5], (2, 1)))
    y = np.hstack([c.u_left, c.u_right])
    data = (c.x_mm, y, 2.25 * np.eye(4)[None], 1e-4, np.ones((60, 2), dtype=bool))
    found = fit(start, *data)
    assert found.converged
    sd = np.sqrt(np.diag(np.linalg.inv(found.information)))
    for j, s in enumerate(sd):
        for sign in (-1, 1):
            moved = found.state.moved(np.eye(len(sd))[j] * sign * 0.01 * s)
            assert settle(moved, *data)[0] >= found.energy


def seen(rig, seed, n=200):
    c = simulate_correspondences(n, rng=np.random.default_rng(seed))
    rng = np.random.default_rng(seed + 500)
    return c.x_mm, [u + rng.normal(0, 1.5, u.shape) for u in rig.project(c.true_x_mm)]


def test_bic_chooses_affine_where_it_is_and_distance_where_it_is():
    models = ("square", "zero_skew", "affine", "square+distance", "zero_skew+distance")
    for seed in range(3):
        x, u = seen(reference_rig(), seed)
        assert "distance" not in compare_models(x, u, models=models).best.model
        x, u = seen(near_rig(200), seed)
        comparison = compare_models(x, u, models=models, image_size_px=(1920, 1080))
        assert "distance" in comparison.best.model
        value, sd = comparison.best.calibration.inverse_distance_per_mm
        assert abs(value - 1 / 200) < 5 * sd < 0.002
        assert comparison["square"].chi_square > comparison["square+distance"].chi_square + 50
    assert "<- chosen" in str(comparison)


def test_nested_tests_reject_what_is_not_true():
    for seed in range(4):
        x, u = seen(reference_rig(), seed, n=80)
        models = ("common_zoom", "square", "zero_skew", "affine")
        rungs = compare_models(x, u, models=models, sigma_u_px=1.5, sigma_x_mm=0.01)
        assert rungs["common_zoom"].p_value < 1e-6  # the reference rig zooms by 100 and 98
        assert rungs["square"].p_value > 1e-3 and np.isnan(rungs["affine"].p_value)


def test_a_single_camera_has_a_ladder_too():
    x, u = seen(near_rig(100), 1)
    comparison = compare_models(x, u[:1], sigma_x_mm=0.01, image_size_px=(1920, 1080))
    assert {r.model for r in comparison.rungs}.isdisjoint({"common_zoom", "zero_skew+distances"})
    assert "distance" in comparison.best.model
