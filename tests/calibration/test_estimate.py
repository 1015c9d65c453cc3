"""Estimators: exact recovery, the minimum itself, noise levels, outliers, covariances, clear errors."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from lib.calibration import (
    CompetingCamerasError,
    affine_minimum,
    calibrate,
    calibrate_as_shown,
    dlt,
    paper_variances,
)
from lib.calibration.affine import estimate_noise
from lib.calibration.checks import check_spread, extents, eyes_exchanged
from lib.calibration.offsets import rows_axes
from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.camera_models import compare_models
from tests.calibration.rigs import data, near_rig

SIZE = (1920, 1080)


def contaminated(n, share, seed, columns=slice(0, 2)):
    c = data(n, seed)
    rng = np.random.default_rng(seed + 1000)
    bad = rng.random(n) < share
    u = np.hstack([c.u_left, c.u_right])
    u[bad, columns] = rng.uniform(0, 1900, (bad.sum(), 2))
    return c, [u[:, :2], u[:, 2:]], bad


@pytest.mark.parametrize(
    "model", ["affine", "zero_skew", "square", "near_affine", "affine+distances", "square+distance+radial"]
)
@pytest.mark.parametrize("weighting", ["likelihood", "paper"])
def test_exact_correspondences_give_exact_cameras(model, weighting):
    c = data(60, sigma_u_px=0, sigma_x_mm=0)
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model=model, weighting=weighting)
    for camera, true in zip(found.cameras, (c.true_rig.left, c.true_rig.right), strict=True):
        np.testing.assert_allclose(camera.matrix, true.matrix, rtol=1e-9, atol=1e-9)
    assert found.inliers.all()


def test_four_points_suffice():
    c = data(4, sigma_u_px=0, sigma_x_mm=0)
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model="affine")
    np.testing.assert_allclose(found.rig.left.matrix, c.true_rig.left.matrix, atol=1e-8)
    np.testing.assert_allclose(dlt(c.x_mm, c.u_left).matrix, c.true_rig.left.matrix, atol=1e-8)


def test_exact_perspective_pair_is_recovered():
    rig, c = near_rig(150.0, radial=3e-9), data(80, 4)
    found = calibrate(c.true_x_mm, rig.project(c.true_x_mm), model="zero_skew+distances+radial", image_size_px=SIZE)
    for a, b in zip(found.rig.project(c.true_x_mm), rig.project(c.true_x_mm), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)
    depth = (c.true_x_mm.mean(axis=0) - ROBOT_FROM_MICROSCOPE.t) @ rig.left.viewing_direction
    assert 1 / found.cameras[0].inverse_distance_per_mm == pytest.approx(150 + depth, rel=1e-5)
    assert found.cameras[1].radial_per_px2 == pytest.approx(3e-9, rel=1e-4)


@pytest.mark.parametrize("weighting", ["likelihood", "paper"])
def test_affine_minimum_is_that_of_a_bundle_adjuster_over_all_unknowns(weighting):
    """Eq. (3) as printed, over cameras, points and (paper) corrected pixels, by a general solver."""
    sigma_u, sigma_x, n = 1.5, 0.02, 10
    c = data(n, 2, sigma_x_mm=sigma_x, half_size_mm=(4, 3, 1))
    y = np.hstack([c.u_left, c.u_right])
    mean = c.x_mm.mean(axis=0)

    def residuals(z):  # unknowns scaled to about one: A in 100 px/mm, offsets in px, points in their noise
        A, t, x = 100 * z[:12].reshape(4, 3), z[12:16], c.x_mm - mean + sigma_x * z[16 : 16 + 3 * n].reshape(n, 3)
        if weighting == "likelihood":
            parts = [(x @ A.T + t - y) / sigma_u, z[16 : 16 + 3 * n]]
        else:
            corrected = y + z[16 + 3 * n :].reshape(n, 4)
            parts = [corrected - x @ A.T - t, (corrected - y) * sigma_u**-0.5, (x - c.x_mm + mean) * sigma_x**-0.5]
        return np.concatenate([p.ravel() for p in parts])

    unknowns = 16 + 3 * n + (4 * n if weighting == "paper" else 0)
    start = np.concatenate([c.true_rig.linear.ravel() / 100, y.mean(axis=0), np.zeros(unknowns - 16)])
    general = least_squares(residuals, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    found = calibrate(
        c.x_mm, [c.u_left, c.u_right], model="affine", weighting=weighting, sigma_u_px=sigma_u, sigma_x_mm=sigma_x,
        ransac_px=np.inf, checks=False,
    )  # fmt: skip
    assert found.cost <= general.cost * (1 + 1e-9)
    assert found.cost == pytest.approx(general.cost, rel=1e-8)
    np.testing.assert_allclose(found.rig.linear, 100 * general.x[:12].reshape(4, 3), rtol=1e-3, atol=0.01)


def test_one_covariance_and_the_same_for_each_row_give_the_same_answer():
    c = data(80, 3)
    known = {"sigma_u_px": 1.5, "sigma_x_mm": 0.01, "ransac_px": np.inf}
    for model in ("affine", "zero_skew", "square", "common_zoom"):
        one = calibrate(c.x_mm, [c.u_left, c.u_right], model=model, **known)
        each = np.broadcast_to(2.25 * np.eye(4), (80, 4, 4))
        full = calibrate(c.x_mm, [c.u_left, c.u_right], model=model, covariance_px2=each, **known)
        assert one.cost == pytest.approx(full.cost, rel=1e-10)
        np.testing.assert_allclose(one.rig.linear, full.rig.linear, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(one.covariance, full.covariance, rtol=1e-3, atol=1e-4 * one.covariance.max())


def test_constraints_hold_and_cost_grows_with_them():
    c = data(100, 5)
    costs = []
    for model in ("affine", "zero_skew", "square", "common_zoom"):
        found = calibrate(c.x_mm, [c.u_left, c.u_right], model=model, sigma_u_px=1.5, sigma_x_mm=0.01, ransac_px=np.inf)
        costs.append(found.cost)
        K = np.stack([camera.resect().K for camera in found.cameras])
        if model != "affine":
            np.testing.assert_allclose(K[:, 0, 1], 0, atol=1e-9)
        if model in ("square", "common_zoom"):
            np.testing.assert_allclose(K[:, 0, 0], K[:, 1, 1])
    np.testing.assert_allclose(K[0], K[1], atol=1e-9)
    assert costs == sorted(costs)


def test_minimum_is_stationary_and_below_least_squares():
    c = data(60, 6, sigma_x_mm=0.05, half_size_mm=(4, 3, 0.3))
    y = np.hstack([c.u_left, c.u_right])
    best = affine_minimum(c.x_mm, y, 2.25, 0.0025)

    def energy(matrix):
        r = y - c.x_mm @ matrix[:, :3].T - matrix[:, 3]
        S = 2.25 * np.eye(4) + 0.0025 * matrix[:, :3] @ matrix[:, :3].T
        return 0.5 * np.einsum("ni,ij,nj->", r, np.linalg.inv(S), r)

    assert energy(best.matrix) == pytest.approx(best.cost, rel=1e-9)
    assert best.cost < energy(affine_minimum(c.x_mm, y, 1.0, 0.0).matrix)
    rng = np.random.default_rng(0)
    for _ in range(50):
        assert energy(best.matrix + rng.normal(size=(4, 4)) * 1e-3) > best.cost


def test_noise_levels_are_found():
    found = np.array(
        [
            (k.sigma_u_px, k.sigma_x_mm)
            for seed in range(20)
            for c in [data(300, seed)]
            for k in [calibrate(c.x_mm, [c.u_left, c.u_right])]
        ]
    )
    assert found[:, 0].mean() == pytest.approx(1.5, rel=0.03)
    assert found[:, 1].mean() == pytest.approx(0.010, rel=0.04)


def test_noise_levels_are_found_where_one_is_negligible():
    for sigma_u, sigma_x in ((0.001, 0.01), (0.01, 0.01), (3.0, 1e-5)):
        c = data(300, 3, sigma_u_px=sigma_u, sigma_x_mm=sigma_x)
        A = c.true_rig.linear
        r = np.hstack([c.u_left, c.u_right]) - np.hstack(c.true_rig.project(c.x_mm))
        r[:, 0] += 1e-3 * np.abs(np.random.default_rng(0).normal(size=300))  # not quite Gaussian, as real residuals are
        found_u, found_x = estimate_noise(r, A, 16)
        assert found_u == pytest.approx(sigma_u, rel=0.15)
        assert found_x == pytest.approx(sigma_x, rel=0.15) if sigma_x > 1e-4 else found_x < 0.01


def test_one_camera_attributes_all_noise_to_its_pixels_or_keeps_what_is_given():
    c = data(400, 1)
    alone = calibrate(c.x_mm, [c.u_left], model="affine")
    assert alone.rig is None and alone.sigma_x_mm == 0
    assert alone.sigma_u_px == pytest.approx(np.hypot(1.5, 1.0), rel=0.06)
    assert calibrate(c.x_mm, [c.u_left], sigma_x_mm=0.01).sigma_u_px == pytest.approx(1.5, rel=0.1)
    assert calibrate(c.x_mm, [c.u_left], sigma_u_px=1.5).sigma_x_mm == pytest.approx(0.01, rel=0.25)
    r = np.random.default_rng(0).normal(size=(5, 4))
    assert estimate_noise(r, np.ones((4, 3)), 16, sigma_u_px=2.0, sigma_x_mm=0.1) == (2.0, 0.1)


def test_paper_weighting_depends_on_the_unit_of_length_and_likelihood_does_not():
    c = data(200, 2, half_size_mm=(4, 3, 0.2))
    options = {"sigma_u_px": 1.5, "model": "affine", "ransac_px": np.inf, "checks": False}
    cm = {
        w: calibrate(c.x_mm / 10, [c.u_left, c.u_right], weighting=w, sigma_x_mm=0.001, **options)
        for w in ("paper", "likelihood")
    }
    mm = {
        w: calibrate(c.x_mm, [c.u_left, c.u_right], weighting=w, sigma_x_mm=0.01, **options)
        for w in ("paper", "likelihood")
    }
    np.testing.assert_allclose(cm["likelihood"].rig.linear / 10, mm["likelihood"].rig.linear, rtol=1e-6)
    assert np.abs(cm["paper"].rig.linear / 10 - mm["paper"].rig.linear).max() > 0.5
    assert paper_variances(1.5, 0.01) == (2.5, 0.01)


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("known", [{}, {"sigma_u_px": 1.5, "sigma_x_mm": 0.01}, {"ransac_px": 10.0}])
def test_gross_outliers_are_found(share, known):
    for seed in range(4):
        c, u, bad = contaminated(200, share, seed)
        found = calibrate(c.x_mm, u, seed=seed, **known)
        left, right = found.view_inliers.T
        assert not (left & bad & (np.abs(found.residuals_px[:, :2]).max(axis=1) > 15)).any()
        assert (left & ~bad).sum() >= 0.98 * (~bad).sum() and right.sum() >= 0.98 * len(bad)
        clean = calibrate(c.x_mm[~bad], [u[0][~bad], u[1][~bad]], ransac_px=np.inf)
        grid = c.true_x_mm
        for a, b in zip(found.rig.project(grid), clean.rig.project(grid), strict=True):
            assert np.abs(a - b).max() < 1.5


def test_outliers_in_both_detectors_at_once():
    c, (u_left, u_right), bad = contaminated(400, 0.4, 9)
    rng = np.random.default_rng(99)
    bad_right = rng.random(400) < 0.4
    u_right = u_right.copy()
    u_right[bad_right] = rng.uniform(0, 1900, (bad_right.sum(), 2))
    found = calibrate(c.x_mm, [u_left, u_right])
    # A landmark that is lost in one view counts in the other.
    for kept, wrong in zip(found.view_inliers.T, (bad, bad_right), strict=True):
        assert (kept & ~wrong).sum() >= 0.97 * (~wrong).sum() and (kept & wrong).sum() <= 2
    assert found.sigma_u_px == pytest.approx(1.5, rel=0.15)


def test_gaussian_data_keep_every_row():
    kept = [calibrate(c.x_mm, [c.u_left, c.u_right]).view_inliers.all() for seed in range(25) for c in [data(100, seed)]]
    assert sum(kept) >= 24


def test_perspective_is_not_mistaken_for_outliers():
    rig, c = near_rig(120.0), data(200, 7)
    rng = np.random.default_rng(0)
    u = [p + rng.normal(0, 0.5, p.shape) for p in rig.project(c.true_x_mm)]
    found = calibrate(c.true_x_mm, u, model="near_affine", image_size_px=SIZE)
    assert found.inliers.all()
    assert found.sigma_u_px == pytest.approx(0.5, rel=0.1)


def test_detector_covariances_weigh_their_points():
    rng = np.random.default_rng(0)
    errors = {"with": [], "without": []}
    for seed in range(15):
        c = data(100, seed, sigma_u_px=0)
        sd = rng.uniform(0.3, 6, (2, 100))
        u = [p + s[:, None] * rng.normal(size=p.shape) for p, s in zip((c.u_left, c.u_right), sd, strict=True)]
        covariance = sd.T[:, :, None, None] ** 2 * np.eye(2)
        for name, given in (("with", covariance), ("without", None)):
            found = calibrate(c.x_mm, u, covariance_px2=given, ransac_px=np.inf)
            errors[name].append(found.rig.left.project(c.true_x_mm) - c.true_rig.left.project(c.true_x_mm))
            if given is not None:
                assert found.sigma_x_mm == pytest.approx(0.01, rel=0.35)
    assert np.std(errors["with"]) < 0.75 * np.std(errors["without"])


def test_correspondences_bring_their_covariances_and_gaps():
    c, rng = data(80, 2), np.random.default_rng(2)
    covariance = rng.uniform(0.5, 3, (80, 2, 1, 1)) * np.eye(2)
    u = [c.u_left, c.u_right]
    rows = Correspondences.of_points(c.x_mm, *u, covariance_px2=covariance)
    each = calibrate(c.x_mm, u, covariance_px2=covariance)
    for name in ("cost", "sigma_x_mm", "detector_scale", "view_inliers", "residuals_px"):
        np.testing.assert_array_equal(getattr(calibrate(rows), name), getattr(each, name))
    plain = calibrate(c.x_mm, u, sigma_u_px=1.5)
    assert calibrate(rows, sigma_u_px=1.5).cost == plain.cost
    unknown = covariance.copy()
    unknown[3] = np.nan
    assert calibrate(Correspondences.of_points(c.x_mm, *u, covariance_px2=unknown)).covariance_px2 is None
    missing = u[0].copy()
    missing[[3, 50]] = np.nan
    unknown[3, 1] = covariance[3, 1]  # what is not seen needs no covariance
    found = calibrate(Correspondences.of_points(c.x_mm, missing, u[1], covariance_px2=unknown))
    assert found.covariance_px2.shape == (80, 4, 4) and found.inliers.all()
    assert found.view_inliers.sum(axis=0).tolist() == [78, 80]
    assert found.chi_square[1] == 4 * 80 - 2 * 2 - 14 and np.isfinite(found.press_rms_px)


def test_covariance_covers_the_truth():
    """Mahalanobis distances of the error, in the model's own (nonsingular) number of dimensions."""
    distances = {m: [] for m in ("affine", "zero_skew", "square+distance")}
    rng = np.random.default_rng(0)
    base = reference_rig()
    for seed in range(50):
        c = data(60, seed)
        for model, values in distances.items():
            rig = near_rig() if "distance" in model else base
            u = [p + rng.normal(0, 1.5, p.shape) for p in rig.project(c.true_x_mm)]
            found = calibrate(c.x_mm, u, model=model, ransac_px=np.inf, image_size_px=SIZE)
            # Judged by what counts: the projections of four points that no plane holds.
            corners = c.true_x_mm[:5]
            error = np.hstack(
                [a - b for a, b in zip(found.rig.project(corners), rig.project(corners), strict=True)]
            ).ravel()
            J = found.derivatives(corners)[1]
            J = J.reshape(-1, J.shape[2])
            covariance = J @ found.parameter_covariance @ J.T
            rank = len(found.parameter_names)
            w, V = np.linalg.eigh(covariance)
            values.append(((V[:, -rank:].T @ error) ** 2 / w[-rank:]).sum() / rank)
    for model, values in distances.items():
        assert np.mean(values) == pytest.approx(1, abs=0.15), model


def test_affine_covariance_is_the_cramer_rao_bound():
    c = data(500, 1)
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model="affine", sigma_u_px=1.5, sigma_x_mm=0.01, ransac_px=np.inf)
    A = c.true_rig.linear
    H = np.column_stack([c.true_x_mm, np.ones(500)])
    bound = np.kron(1.5**2 * np.eye(4) + 1e-4 * A @ A.T, np.linalg.inv(H.T @ H))
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(bound), rtol=0.02)


def test_estimates_scatter_as_the_bound_and_their_own_covariances_say():
    """Variance over the Cramer-Rao bound, Mahalanobis distances and the size of nested tests, over simulated data sets."""
    rng, rig, x = np.random.default_rng(0), reference_rig(pixels_per_mm=(100.0, 100.0)), data(100, 0).true_x_mm
    H = np.column_stack([x, np.ones(100)])
    bound = np.kron(1.5**2 * np.eye(4) + 1e-4 * rig.linear @ rig.linear.T, np.linalg.inv(H.T @ H))
    truth = np.concatenate([rig.left.matrix.ravel(), rig.right.matrix.ravel()])
    errors, claimed, rejected, runs = [], [], [], 160
    for run in range(runs):
        noisy = x + rng.normal(0, 0.01, x.shape)
        u = [p + rng.normal(0, 1.5, p.shape) for p in rig.project(x)]
        found = calibrate(noisy, u, model="affine", ransac_px=np.inf)
        errors.append(np.concatenate([camera.matrix.ravel() for camera in found.cameras]) - truth)
        claimed.append(errors[-1] @ np.linalg.solve(found.covariance, errors[-1]))
        if run < 60:
            models = ("common_zoom", "square", "zero_skew", "affine")
            rungs = compare_models(noisy, u, models=models, sigma_u_px=1.5, sigma_x_mm=0.01, ransac_px=np.inf).rungs
            rejected += [rung.p_value < 0.05 for rung in rungs if rung.against]
    ratio = np.mean(np.square(errors), axis=0) / np.diag(bound)
    assert ratio.mean() == pytest.approx(1, abs=0.1)  # four standard deviations
    np.testing.assert_allclose(ratio, 1, atol=0.4)
    assert np.mean(claimed) / 16 == pytest.approx(1, abs=0.1)
    assert np.mean(np.array(claimed) < chdtri(16, 0.05)) == pytest.approx(0.95, abs=0.05)
    assert np.mean(rejected) == pytest.approx(0.05, abs=0.045)


@pytest.mark.parametrize("n", [6, 7, 8, 9, 10, 12, 15, 20, 24])
def test_few_clean_rows_are_never_refused_nor_dropped(n):
    for seed in range(12):
        c = data(n, 1000 * n + seed)
        assert calibrate(c.x_mm, [c.u_left, c.u_right], seed=seed).view_inliers.all()


def test_few_clean_rows_are_not_taken_for_a_plane():
    rng, thinnest = np.random.default_rng(0), np.inf
    for _ in range(2000):
        x = rng.uniform(-1, 1, (6, 3)) * rng.uniform([2, 1, 0.2], [8, 4.5, 2.0]) + rng.normal(0, 0.01, (6, 3))
        check_spread(x, 0.01)
        thinnest = min(thinnest, extents(x)[2])
    assert thinnest < 0.02  # what the noise of the robot leaves of many rows


@pytest.mark.parametrize("n", [25, 100, 1000])
def test_a_plane_and_the_noise_of_the_robot_are_refused_where_rows_are_many(n):
    rng = np.random.default_rng(n)
    plane = rng.uniform(-4, 4, (n, 3)) * [1, 1, 0]
    with pytest.raises(ValueError, match="coplanar"):
        check_spread(plane + rng.normal(0, 0.01, (n, 3)), 0.01)
    check_spread(plane + rng.normal(0, 0.03, (n, 3)), 0.01)


@pytest.mark.parametrize(("n", "wrong"), [(8, 1), (10, 2), (16, 4), (24, 6)])
def test_gross_outliers_among_few_rows_are_found(n, wrong):
    missed = 0
    for seed in range(12):
        c = data(n, seed)
        u_left = c.u_left.copy()
        u_left[:wrong] += np.random.default_rng(seed).choice([-1, 1], (wrong, 2)) * [400, 300]
        views = calibrate(c.x_mm, [u_left, c.u_right], seed=seed).view_inliers
        assert views[wrong:].all() and views[:, 1].all()
        missed += views[:wrong, 0].any()
    assert missed <= 1


def test_one_gross_row_does_not_look_like_another_unit():
    x, u = good()
    u[0][5] = [1e6, -1e6]
    x[7] += 5000
    np.testing.assert_array_equal(np.argwhere(~calibrate(x, u).view_inliers), [[5, 0], [7, 0], [7, 1]])


def test_paper_weighting_reports_the_sandwich():
    c = data(200, 3, half_size_mm=(4, 3, 0.3))
    errors, claims = [], []
    rng = np.random.default_rng(0)
    for _ in range(80):
        x = c.true_x_mm + rng.normal(0, 0.01, (200, 3))
        u = [p + rng.normal(0, 1.5, p.shape) for p in c.true_rig.project(c.true_x_mm)]
        found = calibrate(
            x, u, model="zero_skew", weighting="paper", sigma_u_px=1.5, sigma_x_mm=0.01, ransac_px=np.inf, checks=False
        )
        errors.append(np.concatenate([camera.matrix.ravel() for camera in found.cameras]))
        claims.append(np.diag(found.covariance))
    ratio = np.var(errors, axis=0) / np.mean(claims, axis=0)
    assert ratio.mean() == pytest.approx(1, abs=0.25)


# ---- bad input -------------------------------------------------------------------------------------------------------


def good():
    c = data(60, 11)
    return c.x_mm.copy(), [c.u_left.copy(), c.u_right.copy()]


def flat(x, u):
    rig, y = reference_rig(), ROBOT_FROM_MICROSCOPE.inverse().apply(x)
    y[:, 2] = 0.3
    x = ROBOT_FROM_MICROSCOPE.apply(y)
    return x + np.random.default_rng(0).normal(0, 0.005, x.shape), list(rig.project(x))


def line(x, u):
    x = x.mean(axis=0) + np.outer(np.linspace(-4, 4, len(x)), [0.6, 0.8, 0])
    return x, list(reference_rig().project(x))


def nan_rows(x, u):
    x[3] = np.nan
    return x, u


def nan_pixels(x, u):
    u[1][[4, 9]] = np.nan
    return x, u


def noise_only(x, u):
    rng = np.random.default_rng(0)
    return x, [rng.uniform(0, 1000, p.shape) for p in u]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (flat, "coplanar"),
        (line, "collinear"),
        (lambda x, u: (x * 0 + x[:1], u), "repeat|hardly move"),
        (lambda x, u: (x[:3], [p[:3] for p in u]), "at least 4"),
        (lambda x, u: (x[:0], [p[:0] for p in u]), "at least 4"),
        (lambda x, u: (x / 1000, u), "metres"),
        (lambda x, u: (x * 1000, u), "micrometres"),
        (lambda x, u: (x, u[::-1]), "swapped"),
        (nan_rows, "x_mm: 1 of 60 rows"),
        (nan_pixels, "u_right: 2 of 60 rows"),
        (noise_only, "outliers|agree"),
        (lambda x, u: (np.vstack([x, x[:5]]), [np.vstack([p, p[:5]]) for p in u]), "5 of 65 rows repeat"),
        (lambda x, u: (x, [u[0], u[1][:-1]]), "u_right: 59 points"),
        (lambda x, u: (x, [u[0], u[1], u[1]]), "3 arrays"),
        (lambda x, u: (x[:, :2], u), "x_mm"),
        (lambda x, u: (x, [u[0] * 0 + 5, u[1]]), "u_left: the detections stand still"),
        (lambda x, u: (x, [u[0], u[1] * [1, 0]]), "u_right: the detections .* on one line"),
        (lambda x, u: (x, [u[0], u[0]]), "the same pixels as u_left"),
    ],
)
def test_bad_data_are_refused_with_the_reason(spoil, message):
    x, u = spoil(*good())
    with pytest.raises(ValueError, match=message):
        calibrate(x, u)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "perspective"}, "unknown model 'perspective'"),
        ({"model": "affine+distance+distances"}, "unknown model"),
        ({"weighting": "bayes"}, "weighting"),
        ({"sigma_u_px": -1.0}, "sigma_u_px"),
        ({"sigma_u_px": 0.0}, "sigma_u_px"),
        ({"sigma_x_mm": np.nan}, "sigma_x_mm"),
        ({"sigma_x_mm": np.inf}, "sigma_x_mm: must be finite"),
        ({"ransac_px": -3.0}, "ransac_px"),
        ({"covariance_px2": np.eye(3)}, "covariance_px2"),
        ({"covariance_px2": -np.eye(4)}, "positive definite"),
        ({"covariance_px2": np.tile(np.eye(4), (60, 1, 1)), "weighting": "paper"}, "one sigma_u"),
        ({"ransac_px": 1e-3}, "rows agree"),
    ],
)
def test_bad_options_are_named(options, message):
    x, u = good()
    with pytest.raises(ValueError, match=message):
        calibrate(x, u, **options)


def test_rows_before_columns_are_noticed():
    x, u = good()
    with pytest.raises(ValueError, match="not \\(row, column\\)"):
        calibrate(x, [p[:, ::-1] for p in u], image_size_px=SIZE)


def test_checks_can_be_waived():
    x, u = good()
    swapped = calibrate(x, u[::-1], checks=False)
    np.testing.assert_allclose(swapped.rig.left.matrix, calibrate(x, u).rig.right.matrix, rtol=1e-6)


def test_swapped_eyes_of_a_head_whose_images_are_both_turned_are_refused():
    for roll_rad, swapped in ((0.4, True), (0.7, False)):
        rig = reference_rig(image_rotation_rad=(roll_rad, roll_rad))
        assert eyes_exchanged(StereoRig(rig.right, rig.left).linear, 0.001) == swapped
        assert not eyes_exchanged(rig.linear, 0.001)


def test_a_mirrored_axis_that_looks_like_swapped_eyes_is_named_beside_them():
    x, u = good()
    with pytest.raises(ValueError, match="swapped.*one axis of x_mm"):
        calibrate(x * [1, -1, 1], u)


def test_one_very_uncertain_row_does_not_hide_swapped_cameras():
    x, u = good()
    covariance_px2 = np.tile(np.eye(4), (len(x), 1, 1))
    covariance_px2[5] *= 1e6
    with pytest.raises(ValueError, match="swapped"):
        calibrate(x, u[::-1], covariance_px2=covariance_px2)
    assert calibrate(x, u, covariance_px2=covariance_px2).sigma_u_px < 3


def test_a_head_whose_geometry_leaves_doubt_is_not_called_swapped():
    x, (u_left, u_right) = good()
    calibrate(x, [u_right, np.column_stack([1919 - u_left[:, 0], u_left[:, 1]])])  # one channel mirrored
    calibrate(x, [u_right, u_left[:, ::-1] * [1, -1] + [0, 1919]])  # one image turned by 90 degrees


def test_dlt_refuses_what_it_cannot_solve():
    x, u = good()
    with pytest.raises(ValueError, match="not finite"):
        dlt(nan_rows(*good())[0], u[0])
    with pytest.raises(ValueError, match="coplanar"):
        dlt(np.column_stack([x[:, :2], np.zeros(60)]), u[0])
    with pytest.raises(ValueError, match="59 points, x_mm has 60"):
        dlt(x, u[0][:-1])


def at_two_depths(rng, *, distance_mm=np.inf, zoom=1.0, offset_mm=0.0, noise_px=0.4, n=40):
    """A tool at one depth in the first half of the frames, and 5 mm deeper in the second half, in which the images zoom."""
    late = np.arange(n) >= n // 2
    base = rng.uniform([-4, -2.5, -0.3], [3, 2.5, 0.3], (n, 3)) + np.where(late, 5, 0)[:, None] * [0, 0, 1]
    turn = Rotation.from_euler("zyx", rng.normal(0, [0.3, 0.15, 0.3], (n, 3))).as_matrix()
    half = rng.uniform(0.4, 0.8, n)
    tool = np.stack([np.zeros((n, 3)), *(np.column_stack([np.full(n, 3.0), s * half, 0 * half]) for s in (-1, 1))], axis=1)
    x = ROBOT_FROM_MICROSCOPE.apply((base[:, None] + np.einsum("nij,nkj->nki", turn, tool)).reshape(-1, 3))
    u, centre = reference_rig(inverse_distance_per_mm=1 / distance_mm).project(x), (np.array(SIZE) - 1) / 2
    zooms = np.where(np.repeat(late, 3), zoom, 1.0)[:, None]
    u = [centre + zooms * (v - centre) + rng.normal(0, noise_px, v.shape) for v in u]
    data = Correspondences.of_points(x, *u, frame=np.repeat(np.arange(n), 3), landmark=np.tile(np.arange(3), n))
    offset = offset_mm * np.array([[1, 0.5, -0.5], [-1, 0.5, 0.5], [0.5, -1, 0.7]])
    return replace(data, x_mm=x + np.einsum("nij,nj->ni", np.nan_to_num(rows_axes(data)), offset[data.landmark]))


@pytest.mark.parametrize("offset_mm", [0.0, 0.15])
def test_two_depths_before_a_near_microscope_are_no_two_cameras(offset_mm):
    """Affine cameras for both halves differ by 8 % in scale, and offsets of the landmarks make them differ, too."""
    data = at_two_depths(np.random.default_rng(0), distance_mm=60, offset_mm=offset_mm)
    found = calibrate_as_shown(data)
    assert found.model == "near_affine" and found.view_inliers.all() and found.reprojection_rms_px < 0.7
    assert found.inverse_distance_per_mm[0] == pytest.approx(1 / 62.5, rel=0.02)  # from the middle of the positions
    with pytest.raises(CompetingCamerasError, match="two consensuses compete"):
        calibrate(data)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_zoom_before_the_tool_moves_to_another_depth_is_no_finite_distance(seed):
    with pytest.raises(CompetingCamerasError, match="two consensuses compete"):
        calibrate_as_shown(at_two_depths(np.random.default_rng(seed), zoom=0.95, noise_px=0.8, n=60), image_size_px=SIZE)


def test_cameras_have_a_finite_distance_only_where_the_detections_show_one():
    """Mirrored ones, and few rows, stay affine.  A warning names the mirrored ones."""
    rng = np.random.default_rng(3)
    x = ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-4, 4, (60, 3)))
    for distance_mm, rows in ((np.inf, 60), (-190, 60), (190, 4), (190, 60)):
        u = [v + rng.normal(0, 1, v.shape) for v in reference_rig(inverse_distance_per_mm=1 / distance_mm).project(x)]
        data = Correspondences.of_points(x, *u).subset(slice(rows))
        model = "near_affine" if (distance_mm, rows) == (190, 60) else "zero_skew"
        with pytest.warns(match="look mirrored.*flip both images") if distance_mm < 0 else nullcontext():
            assert calibrate_as_shown(data, ransac_px=np.inf).model == model
    square = calibrate_as_shown(data, models=("square", "square+distance"))
    value, sd = square.inverse_distance_per_mm
    assert square.model == "square+distance" and abs(value - 1 / 190) < 3 * sd
