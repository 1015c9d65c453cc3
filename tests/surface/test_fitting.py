"""fit_surface: accuracy on a known surface, smoothness, rejection, uncertainty, bad input."""

from __future__ import annotations

import numpy as np
import pytest

from lib.cameras import NearAffineCamera
from lib.surface import fit_surface
from lib.surface.solver import L1Problem
from notebooks.studies.sphere import fit_sphere


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_recovers_the_bowl_from_noisy_matches_with_outliers(bowl):
    surface = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain)
    noise = np.sqrt(np.trace(bowl.points.covariance_mm2[0]))
    assert rms(bowl.depth_error_mm(surface)) < noise / 2
    inside = np.isfinite(surface(bowl.u_left)).all(axis=1)
    gross = bowl.outlier & inside & (np.abs(surface(bowl.u_left) - bowl.points.x_mm).sum(axis=1) > 0.5)
    assert gross.sum() > 20 and not surface.fit.inliers[gross].any()
    assert surface.fit.inliers[~bowl.outlier & inside].mean() > 0.97
    assert not surface.fit.inliers[~inside].any()


def test_objective_is_equation_6_over_the_inliers(bowl):
    from notebooks.studies.l1_reference import cvxpy_reference  # cvxpy takes a second to import

    surface = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, smoothness=2e4, reject_mm=0.4)
    u, x = bowl.u_left[surface.fit.inliers], bowl.points.x_mm[surface.fit.inliers]
    coefficients = surface.grid.flatten(surface.control_points_mm)
    bending_energy = np.sum(coefficients * (surface.grid.bending @ coefficients))
    energy = np.abs(surface(u) - x).sum() + 2e4 * bending_energy
    assert surface.fit.objective == pytest.approx(energy, rel=1e-9)
    problem = L1Problem(surface.grid, u)
    reference, _ = cvxpy_reference(problem, x, 2e4)
    assert surface.fit.objective == pytest.approx(reference.objective.sum(), rel=1e-6)
    assert 0 <= surface.fit.duality_gap < 1e-6 * surface.fit.objective
    # The bound was applied to the first fit, over all points.
    first = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, smoothness=2e4, reject_mm=np.inf)
    norm = np.abs(first(bowl.u_left) - bowl.points.x_mm).sum(axis=1)
    np.testing.assert_array_equal(surface.fit.inliers, norm <= 0.4)


def test_order_and_units_of_the_points_do_not_matter(bowl):
    order = np.random.default_rng(5).permutation(len(bowl.u_left))
    one = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, control=(10, 8))
    other = fit_surface(bowl.u_left[order], bowl.points.x_mm[order], domain=bowl.domain, control=(10, 8))
    assert other.fit.smoothness == pytest.approx(one.fit.smoothness, rel=1e-6)
    np.testing.assert_array_equal(other.fit.inliers, one.fit.inliers[order])
    moved = fit_surface(
        bowl.u_left, bowl.points.x_mm + 1000, domain=bowl.domain, control=(10, 8), smoothness=one.fit.smoothness
    )
    np.testing.assert_allclose(moved(bowl.u_left) - 1000, one(bowl.u_left), atol=1e-4)


def test_held_out_smoothness_is_near_the_best_one(bowl_factory):
    for seed in range(2):
        bowl = bowl_factory(1500, seed=seed)
        chosen = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, camera=bowl.rig.left)
        errors = [
            rms(
                bowl.depth_error_mm(
                    fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, camera=bowl.rig.left, smoothness=mu)
                )
            )
            for mu in 10.0 ** np.arange(2, 8)
        ]
        assert rms(bowl.depth_error_mm(chosen)) < 1.3 * min(errors) < 0.5 * max(errors)
        candidates, error = chosen.fit.held_out.T
        assert len(candidates) >= 3 and (np.diff(candidates) > 0).all()
        assert candidates[error.argmin()] / 2 < chosen.fit.smoothness < candidates[error.argmin()] * 2


def test_robust_where_least_squares_is_not(bowl_factory):
    from notebooks.studies.l1_reference import least_squares

    bowl = bowl_factory(2000, outliers=0.25)
    surface = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain)
    squares = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, solver=least_squares, reject_mm=np.inf)
    assert rms(bowl.depth_error_mm(surface)) < 0.5 * rms(bowl.depth_error_mm(squares))


def test_least_squares_solves_its_normal_equations(bowl):
    from notebooks.studies.l1_reference import least_squares

    surface = fit_surface(
        bowl.u_left, bowl.points.x_mm, domain=bowl.domain, solver=least_squares, smoothness=3e3, reject_mm=np.inf
    )
    inside = surface.fit.inliers
    B, x = surface.grid.design(bowl.u_left[inside]), bowl.points.x_mm[inside]
    c = surface.grid.flatten(surface.control_points_mm)
    np.testing.assert_allclose(B.T @ (B @ c - x) + 3e3 * surface.grid.bending @ c, 0, atol=1e-6)


def test_depth_only_fit_is_exact_across_the_view(bowl):
    scalar = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, camera=bowl.rig.left)
    u = bowl.u_left[scalar.grid.inside(bowl.u_left)]
    np.testing.assert_allclose(bowl.rig.left.project(scalar(u)), u, atol=1e-8)
    vector = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain)
    assert rms(bowl.depth_error_mm(scalar)) < 1.2 * rms(bowl.depth_error_mm(vector))


def test_whitening_with_one_covariance_only_turns_the_axes(bowl):
    arguments = {"domain": bowl.domain, "control": (12, 10), "smoothness": 2e4, "reject_mm": np.inf}
    white = fit_surface(bowl.u_left, bowl.points.x_mm, covariance_mm2=bowl.points.covariance_mm2[0], **arguments)
    axes = white.fit.axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    turned = fit_surface(bowl.u_left, bowl.points.x_mm @ axes.T, **arguments)
    np.testing.assert_allclose(white(bowl.u_left) @ axes.T, turned(bowl.u_left), atol=1e-4)


def test_whitening_trusts_the_precise_points(bowl_factory):
    bowl = bowl_factory(2000, outliers=0.0)
    rng = np.random.default_rng(7)
    factor = np.where(rng.random(2000) < 0.5, 1.0, 10.0)
    x = bowl.points.x_mm + rng.normal(size=(2000, 1)) * 0.3 * (factor[:, None] > 1) * bowl.rig.left.viewing_direction
    covariance = bowl.points.covariance_mm2 * factor[:, None, None] ** 2
    arguments = {"domain": bowl.domain, "smoothness": 1e4, "reject_mm": np.inf}
    white = fit_surface(bowl.u_left, x, covariance_mm2=covariance, **arguments)
    plain = fit_surface(bowl.u_left, x, **arguments)
    assert rms(bowl.depth_error_mm(white)) < 0.8 * rms(bowl.depth_error_mm(plain))


@pytest.mark.parametrize("kind", ["plain", "depth"])
def test_uncertainty_tells_the_true_error(bowl_factory, kind):
    ratios = []
    for seed in range(4):
        bowl = bowl_factory(1500, seed=seed)
        camera = bowl.rig.left if kind == "depth" else None
        surface = fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, control=(14, 12), camera=camera)
        u = np.random.default_rng(seed).uniform(bowl.domain[:2], bowl.domain[2:], (200, 2))
        d = bowl.rig.left.viewing_direction
        covariance = surface.covariance(u)
        np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1))
        assert np.linalg.eigvalsh(covariance).min() > -1e-12
        sigma = np.sqrt(np.einsum("i,nij,j->n", d, covariance, d))
        ratios.append((surface(u) - bowl.truth(u)) @ d / sigma)
    assert 0.7 < rms(np.concatenate(ratios)) < 1.4


def test_uncertainty_grows_where_points_are_missing(bowl):
    hole = np.linalg.norm(bowl.u_left - (960, 540), axis=1) > 200
    surface = fit_surface(bowl.u_left[hole], bowl.points.x_mm[hole], domain=bowl.domain)
    centre, away = np.trace(surface.covariance([[960, 540], [500, 540]]), axis1=1, axis2=2)
    assert centre > 4 * away
    assert np.isnan(surface.covariance([[0.0, 0.0]])).all()


@pytest.mark.parametrize("slope", [(0.01, 0.02), (0.0, 0.0)])
def test_planes_and_exact_data_are_fine(slope):
    u = np.random.default_rng(0).uniform(0, 100, (200, 2))
    x = np.column_stack([u / 100, u @ slope])
    surface = fit_surface(u, x, domain=(0, 0, 100, 100), control=(8, 8))
    np.testing.assert_allclose(surface(u), x, atol=1e-6)


@pytest.mark.parametrize("smoothness", [None, 1.0, 1e18])
def test_a_plane_that_faces_the_camera_is_fitted_exactly(bowl, smoothness):
    """It has one depth, so nothing in the data tells how stiff the surface may be."""
    camera, u = bowl.rig.left, bowl.u_left
    plane = (u - camera.offset_px) @ np.linalg.pinv(camera.linear).T + 3 * camera.viewing_direction
    found = fit_surface(u, plane, domain=bowl.domain, control=(8, 8), camera=camera, smoothness=smoothness)
    inside = found.grid.inside(u)
    np.testing.assert_allclose(found(u[inside]), plane[inside], atol=1e-6)


def test_points_without_scatter_have_no_covariance():
    u = np.random.default_rng(0).uniform(0, 100, (200, 2))
    surface = fit_surface(u, np.column_stack([u / 100, 0 * u[:, 0]]), domain=(0, 0, 100, 100), control=(8, 8))
    with pytest.raises(ValueError, match="covariance: the surface passes through all its points"):
        surface.covariance(u)


def test_uncertainty_in_a_hole_fits_the_bending_around_it():
    """Dense matches on waves: the smoothness of least error alone promises a third of the error below a mask."""
    u = np.random.default_rng(0).uniform(0, (600, 400), (3000, 2))
    u = u[np.abs(u - (300, 200)).max(axis=1) > 90]
    hole = np.stack(np.meshgrid(np.linspace(240, 360, 9), np.linspace(140, 260, 9)), axis=-1).reshape(-1, 2)

    def waves(u: np.ndarray, noise_mm: float = 0.0) -> np.ndarray:
        z = 0.3 * np.sin(u[:, 0] / 35) * np.cos(u[:, 1] / 45)
        return np.column_stack([u / 100, z]) + np.random.default_rng(1).normal(0, noise_mm, (len(u), 3))

    surface = fit_surface(u, waves(u, 0.02), domain=(0, 0, 600, 400), control=(20, 16))
    error, sigma = (surface(hole) - waves(hole))[:, 2], np.sqrt(surface.covariance(hole)[:, 2, 2])
    assert rms(error) > 0.03 and rms(error / sigma) < 1.5
    assert np.median(np.sqrt(surface.covariance(u[:200])[:, 2, 2])) < 0.01  # where points are, they decide


def test_a_hole_without_smoothness_is_refused_or_its_uncertainty_is_stated(bowl_factory):
    """Without smoothness nothing holds the surface over a hole in the data: it may leave the truth by metres."""
    bowl = bowl_factory(2000)
    stated = 0
    for size_px in (150, 300):
        kept = np.abs(bowl.u_left - (900, 500)).max(axis=1) > size_px
        hole = np.stack(np.meshgrid(*np.linspace((900, 500), (900 + size_px, 500 + size_px), 8).T), axis=-1).reshape(-1, 2)
        for smoothness in (0.0, 1e-6):
            arguments = {"domain": bowl.domain, "smoothness": smoothness}
            try:
                surface = fit_surface(bowl.u_left[kept], bowl.points.x_mm[kept], **arguments)
                covariance = surface.covariance(hole)
            except ValueError as error:
                assert str(error).startswith("smoothness: too small")
                continue
            view = bowl.rig.left.viewing_direction
            sigma = np.sqrt(np.einsum("i,nij,j->n", view, covariance, view))
            assert (np.abs((surface(hole) - bowl.truth(hole)) @ view) < 5 * sigma).all()
            stated += 1
    assert stated >= 2


def test_a_near_affine_camera_is_refused(bowl):
    left = bowl.rig.left
    near = NearAffineCamera(left.matrix, 1 / 200, (960.0, 540.0))
    with pytest.raises(ValueError, match="camera: the rays of a near-affine camera"):
        fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, smoothness=1e4, camera=near)


def test_a_sphere_is_found_and_is_too_rigid_for_this_bowl(bowl):
    sphere = fit_sphere(bowl.points.x_mm)
    assert 10 < sphere.radius_mm < 14
    u = np.random.default_rng(0).uniform(bowl.domain[:2], bowl.domain[2:], (300, 2))
    error = (sphere.along_view(u, bowl.rig.left) - bowl.truth(u)) @ bowl.rig.left.viewing_direction
    assert rms(error) > 1.5 * rms(bowl.depth_error_mm(fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain)))


def test_sphere_on_exact_points_with_outliers():
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(400, 3))
    direction = direction[direction[:, 2] > 0.3]
    x = np.array([1.0, -2.0, 30.0]) + 12 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    x[:20] += rng.uniform(-3, 3, (20, 3))
    sphere = fit_sphere(x)
    np.testing.assert_allclose(sphere.centre_mm, [1, -2, 30], atol=1e-4)
    assert sphere.radius_mm == pytest.approx(12, abs=1e-4)
    assert not sphere.inliers[:20].all()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"u": np.full((2000, 2), np.nan)}, "u: .*not finite"),
        ({"u": np.zeros((1999, 2))}, "u, x_mm"),
        ({"u": np.zeros((2000, 3))}, "u: expected"),
        ({"x_mm": np.full((2000, 3), np.inf)}, "x_mm: .*not finite"),
        ({"domain": (5000, 5000, 6000, 6000)}, "u: 0 of 2000 points lie in the domain"),
        ({"smoothness": -1.0}, "smoothness"),
        ({"smoothness": np.nan}, "smoothness"),
        ({"reject_mm": 0.0}, "reject_mm"),
        ({"reject_mm": 1e-9}, "reject_mm: only"),
        ({"control": (100, 100)}, "u: .*control points"),
        ({"control": (3, 20)}, "control"),
        ({"covariance_mm2": np.zeros((3, 3))}, "covariance_mm2"),
        ({"covariance_mm2": np.eye(2)}, "covariance_mm2"),
        ({"u": np.column_stack([np.linspace(310, 1600, 2000), np.full(2000, 500.0)])}, "u: .*one line"),
    ],
)
def test_bad_input_is_named(bowl, change, named):
    arguments = {"u": bowl.u_left, "x_mm": bowl.points.x_mm, "domain": bowl.domain, "smoothness": 1e4} | change
    with pytest.raises(ValueError, match=named):
        fit_surface(arguments.pop("u"), arguments.pop("x_mm"), **arguments)


@pytest.mark.parametrize("x", [np.zeros((3, 3)), np.full((9, 3), np.nan), np.eye(3)[np.arange(9) % 3]])
def test_bad_spheres_are_named(x):
    with pytest.raises(ValueError, match="x_mm"):
        fit_sphere(x)


@pytest.mark.parametrize("crowded", [0, 28, 60])
def test_a_surface_through_few_points_is_fitted_however_flexible(crowded):
    rng = np.random.default_rng(0)
    u = np.concatenate([rng.uniform(0, 400, (125 - crowded, 2)), rng.uniform(100, 104, (crowded, 2))])
    x = np.column_stack([u / 100, rng.normal(0, 0.05, 125)])
    surface = fit_surface(u, x, domain=(0, 0, 400, 400), smoothness=1e-8)
    assert surface.fit.inliers.sum() >= 100
