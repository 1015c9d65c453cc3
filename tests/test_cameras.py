"""Cameras and the stereo pair: known answers, properties, degenerate cases, files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from lib.cameras import AffineCamera, Camera, NearAffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig


@pytest.fixture
def rig():
    return reference_rig()


@pytest.fixture
def near(rig):
    centre, at = (959.5, 539.5), ROBOT_FROM_MICROSCOPE.t
    return StereoRig(
        NearAffineCamera(rig.left.matrix, 1 / 180, centre, at),
        NearAffineCamera(rig.right.matrix, 1 / 190, centre, at, radial_per_px2=2e-9),
    )


def workspace(n, seed=0):
    rng = np.random.default_rng(seed)
    return ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-1, 1, (n, 3)) * [8, 4.5, 1.5])


def homogeneous(u):
    return np.column_stack([u, np.ones(len(u))])


def near_affine_of(P, radial_per_px2=0.0):
    """The near-affine camera of a homogeneous P (3, 4), scaled as `projection_matrix` writes it."""
    depth = P[2, :3]
    centre = P[:2, :3] @ depth / (depth @ depth)
    M = P[:2] - np.outer(centre, P[2] - [0, 0, 0, 1])
    sign = np.sign(np.cross(M[0, :3], M[1, :3]) @ depth)
    reference = (1.0 - P[2, 3]) * depth / (depth @ depth)
    return NearAffineCamera(M, sign * np.linalg.norm(depth), centre, reference, radial_per_px2)


def test_affine_projection_is_the_matrix_product():
    camera = AffineCamera([[1, 2, 3, 4], [5, 6, 8, 7]])
    np.testing.assert_allclose(camera.project([[1, 1, 2], [0, 0, 0]]), [[13, 34], [4, 7]])
    assert isinstance(camera, Camera)


def test_nan_rows_stay_nan(rig):
    u = rig.left.project([[1, 2, 3], [np.nan, 0, 0]])
    assert np.isfinite(u[0]).all() and np.isnan(u[1]).all()


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.floats(0.5, 200),
    st.floats(0.5, 200),
    st.floats(-5, 5),
    st.booleans(),
)
def test_resection_recomposes_the_matrix(rotation, zoom_x, zoom_y, skew, mirrored):
    R = RigidTransform.from_rotation_vector(rotation).R
    M = np.column_stack([np.array([[zoom_x, skew], [0, zoom_y]]) @ R[:2], [10.0, -4.0]])
    found = AffineCamera(M).resect(mirrored=mirrored)
    again = found.K @ np.column_stack([found.R[:2], found.t])
    np.testing.assert_allclose(again, M, atol=1e-9 * np.abs(M).max())
    np.testing.assert_allclose(found.R @ found.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.R) == pytest.approx(1)
    if not mirrored:
        np.testing.assert_allclose(found.K, [[zoom_x, skew], [0, zoom_y]], atol=1e-9 * max(zoom_x, zoom_y, 5))


def test_triangulation_inverts_projection(rig, near):
    x = workspace(200)
    for pair in (rig, near):
        found = pair.triangulate(*pair.project(x))
        np.testing.assert_allclose(found.x_mm, x, atol=1e-9)
        np.testing.assert_allclose(found.epipolar_px, 0, atol=1e-8)


def test_near_affine_triangulation_with_one_affine_camera(rig, near):
    pair = StereoRig(rig.left, near.right)
    x = workspace(20)
    np.testing.assert_allclose(pair.triangulate(*pair.project(x)).x_mm, x, atol=1e-9)


@pytest.mark.parametrize("kind", ["affine", "near"])
@pytest.mark.parametrize("shape", ["number", "pair", "each"])
def test_triangulation_is_the_weighted_minimum_and_its_covariance_is_right(rig, near, kind, shape):
    pair = rig if kind == "affine" else near
    rng = np.random.default_rng(3)
    x = np.repeat(workspace(1), 4000, axis=0)
    L = np.diag([1.0, 2.0, 0.7, 1.5])
    L[1, 0] = 0.6
    S = L @ L.T if shape != "number" else 4.0 * np.eye(4)
    noise = rng.normal(size=(4000, 4)) @ np.linalg.cholesky(S).T
    u_left, u_right = (u + e for u, e in zip(pair.project(x), (noise[:, :2], noise[:, 2:]), strict=True))
    given_covariance = {"number": 4.0, "pair": S, "each": np.broadcast_to(S, (4000, 4, 4))}[shape]
    found = pair.triangulate(u_left, u_right, given_covariance)
    error = found.x_mm - x
    mahalanobis = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_mm2), error)
    assert mahalanobis.mean() == pytest.approx(3, rel=0.08)
    # Minimum: the gradient of the weighted reprojection error vanishes.
    r = np.hstack([u_left, u_right]) - np.hstack(pair.project(found.x_mm))
    gradient = np.einsum(
        "nij,nik,nk->nj", pair.jacobian(found.x_mm), np.broadcast_to(np.linalg.inv(S), (4000, 4, 4)), r
    )
    assert np.abs(gradient).max() < 1e-3 * 100


@pytest.mark.parametrize("each", [False, True])
def test_near_affine_triangulation_is_that_of_a_general_solver(near, each):
    rng = np.random.default_rng(5)
    x = workspace(23)
    u_left, u_right = (u + rng.normal(0, 3, u.shape) for u in near.project(x))
    u_left[11] = np.nan
    L = np.tril(rng.uniform(-0.4, 0.4, (23, 4, 4))) + 1.5 * np.eye(4)
    S = L @ L.transpose(0, 2, 1) if each else np.broadcast_to(L[0] @ L[0].T, (23, 4, 4))
    found = near.triangulate(u_left, u_right, S if each else S[0])

    def residuals(p, white, y):
        return white @ (np.hstack(near.project(p[None]))[0] - y)

    for i in np.delete(np.arange(23), 11):
        data = np.linalg.inv(np.linalg.cholesky(S[i])), np.hstack([u_left[i], u_right[i]])
        general = least_squares(residuals, x[i], args=data, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(found.x_mm[i], general.x, atol=1e-8)
        np.testing.assert_allclose(found.covariance_mm2[i] @ (general.jac.T @ general.jac), np.eye(3), atol=1e-5)
    assert np.isnan(found.x_mm[11]).all() and np.isnan(found.covariance_mm2[11]).all()


def test_match_of_a_point_behind_the_cameras_is_missing(near):
    x = workspace(3)
    u_left, u_right = near.project(x)
    # A point 400 mm towards the cameras, behind both, as the homogeneous projection sees it.
    behind = np.append(x[1] - 400 * near.left.viewing_direction, 1.0)
    for u, camera in ((u_left, near.left), (u_right, near.right)):
        h = camera.projection_matrix @ behind
        assert h[2] < 0
        u[1] = h[:2] / h[2]
    pair = StereoRig(near.left, NearAffineCamera(near.right.matrix, 1 / 190, (959.5, 539.5), ROBOT_FROM_MICROSCOPE.t))
    found = pair.triangulate(u_left, u_right)
    assert np.isnan(found.x_mm[1]).all() and np.isnan(found.epipolar_px[1])
    assert np.isfinite(found.x_mm[[0, 2]]).all()


def test_triangulation_keeps_missing_matches_missing(rig, near):
    x = workspace(5)
    for pair in (rig, near):
        u_left, u_right = (u.copy() for u in pair.project(x))
        u_right[2] = np.nan
        found = pair.triangulate(u_left, u_right)
        assert np.isnan(found.x_mm[2]).all() and np.isnan(found.epipolar_px[2]) and np.isnan(found.covariance_mm2[2]).all()
        assert np.isfinite(np.delete(found.covariance_mm2, 2, 0)).all()
        np.testing.assert_allclose(np.delete(found.x_mm, 2, 0), np.delete(x, 2, 0), atol=1e-9)


def test_fundamental_matrix_and_epipolar_distance(rig, near):
    x = workspace(50)
    for pair in (rig, StereoRig(near.left, NearAffineCamera(rig.right.matrix, 1 / 200, (900, 500), x[0]))):
        u_left, u_right = pair.project(x)
        values = np.einsum("ni,ij,nj->n", homogeneous(u_right), pair.fundamental, homogeneous(u_left))
        np.testing.assert_allclose(values, 0, atol=1e-8)
    rng = np.random.default_rng(0)
    u_left, u_right = (rng.uniform(0, 1000, (50, 2)) for _ in range(2))
    value = np.einsum("ni,ij,nj->n", homogeneous(u_right), rig.fundamental, homogeneous(u_left))
    np.testing.assert_allclose(value, rig.epipolar_distance(u_left, u_right), rtol=1e-9)


def test_epipolar_distance_of_unit_noise_has_unit_variance(rig, near):
    rng = np.random.default_rng(1)
    for pair in (rig, near):
        u = [p + rng.normal(size=p.shape) for p in pair.project(workspace(5000))]
        assert pair.epipolar_distance(*u).std() == pytest.approx(1, rel=0.05)


def test_a_match_of_infinite_covariance_is_nan_and_the_others_are_not(near):
    x = np.array([[0.5, -1.0, 0.2], [1.0, 2.0, -0.4], [-2.0, 0.3, 0.1]])
    covariance = np.stack([np.eye(4), np.diag([np.inf] * 4), np.eye(4)])
    found = near.triangulate(*near.project(x), covariance)
    assert np.isnan(found.x_mm[1]).all()
    np.testing.assert_allclose(found.x_mm[[0, 2]], x[[0, 2]], atol=1e-9)


def test_near_affine_is_affine_where_the_inverse_distance_is_zero(rig):
    camera = NearAffineCamera(rig.left.matrix, 0.0, (959.5, 539.5))
    x = workspace(10)
    np.testing.assert_allclose(camera.project(x), rig.left.project(x), atol=1e-9)
    np.testing.assert_array_equal(camera.matrix, rig.left.matrix)


def test_near_affine_is_a_pinhole():
    distance, focal = 150.0, 15000.0
    K = np.array([[focal, 0, 640], [0, focal, 480], [0, 0, 1.0]])
    P = K @ np.column_stack([np.eye(3), [0, 0, distance]])
    x = np.random.default_rng(0).uniform(-5, 5, (30, 3))
    h = x @ P[:, :3].T + P[:, 3]
    camera = near_affine_of(P / distance)
    assert camera.inverse_distance_per_mm == pytest.approx(1 / distance)
    np.testing.assert_allclose(camera.centre_px, [640, 480], atol=1e-9)
    np.testing.assert_allclose(camera.project(x), h[:, :2] / h[:, 2:], atol=1e-9)


def test_jacobians_are_finite_differences(rig, near):
    x, step = workspace(20), 1e-4
    for camera in (rig.left, near.left, near.right):
        numeric = np.stack(
            [(camera.project(x + e) - camera.project(x - e)) / (2 * step) for e in step * np.eye(3)], axis=2
        )
        np.testing.assert_allclose(camera.jacobian(x), numeric, atol=1e-4)


def test_radial_distortion_is_undone(near):
    u = np.random.default_rng(0).uniform(0, 1900, (50, 2))
    v = near.right.undistort(u) - near.right.centre_px
    again = near.right.centre_px + v * (1 + near.right.radial_per_px2 * (v**2).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(again, u, atol=1e-9)
    np.testing.assert_allclose(near.right.undistort(near.right.centre_px[None])[0], near.right.centre_px)


def test_a_pixel_beyond_the_fold_of_barrel_distortion_is_no_point(near):
    """The distorted radius is largest where 1 + 3 k r^2 = 0; no point is seen farther out."""
    barrel = replace(near.left, radial_per_px2=-1e-6)
    largest_px = (2 / 3) / np.sqrt(3e-6)
    u = barrel.centre_px + largest_px * np.array([[0.999, 0.0], [0.6, 0.8], [0.61, 0.81]])
    found = barrel.undistort(u)
    assert np.isfinite(found[0]).all() and np.isnan(found[2]).all()
    assert np.linalg.norm(found[0] - barrel.centre_px) < 1.5 * largest_px
    rig = StereoRig(barrel, near.right)
    seen = rig.triangulate(u, near.right.project(near.triangulate(u[:1], u[:1]).x_mm).repeat(3, axis=0))
    assert np.isnan(seen.x_mm[2]).all() and np.isnan(seen.covariance_mm2[2]).all() and np.isfinite(seen.x_mm[0]).all()


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-7])
def test_cameras_that_look_the_same_way_see_no_depth(rig, turn, tmp_path):
    """The inverse of the normal matrix has entries of either sign there, and says nothing."""
    linear = 1.01 * rig.left.linear + turn * 100 * rig.left.viewing_direction
    alike = StereoRig(rig.left, AffineCamera(np.column_stack([linear, [900, 500]])))
    found = alike.triangulate(*alike.project([[1.0, 2.0, 0.5]]))
    assert np.isnan(found.x_mm).all() and np.isnan(found.covariance_mm2).all() and abs(found.epipolar_px[0]) < 1e-6
    alike.save(tmp_path / "rig.json")
    with pytest.raises(ValueError, match=r"rig\.json: both cameras look along the same direction.*calibrate again"):
        StereoRig.load(tmp_path / "rig.json")


def test_a_hundredth_of_a_degree_sees_depth_as_poorly_as_it_says(rig):
    linear = rig.left.linear + 1e-4 * 100 * np.outer([1.0, 0.0], rig.left.viewing_direction)
    narrow = StereoRig(rig.left, AffineCamera(np.column_stack([linear, [900, 500]])))
    u = np.hstack(narrow.project([[1.0, 2.0, 0.5]])) + np.random.default_rng(0).normal(0, 1, (2000, 4))
    found = narrow.triangulate(u[:, :2], u[:, 2:])
    depth = found.x_mm @ rig.left.viewing_direction
    stated = rig.left.viewing_direction @ found.covariance_mm2[0] @ rig.left.viewing_direction
    assert depth.var() == pytest.approx(stated, rel=0.1) and np.sqrt(stated) > 50


def test_projection_matrix_round_trip(near):
    x = workspace(20)
    again = near_affine_of(near.right.projection_matrix, near.right.radial_per_px2)
    np.testing.assert_allclose(again.project(x), near.right.project(x), atol=1e-9)
    np.testing.assert_array_equal(AffineCamera(near.left.matrix).projection_matrix[2], [0, 0, 0, 1])


def test_files_round_trip(rig, near, tmp_path):
    x = workspace(20)
    for pair in (rig, near, StereoRig(rig.left, near.right)):
        pair.save(tmp_path / "rig.json")
        again = StereoRig.load(tmp_path / "rig.json")
        assert type(again.right) is type(pair.right)
        for a, b in zip(again.project(x), pair.project(x), strict=True):
            np.testing.assert_array_equal(a, b)
    assert [p.name for p in tmp_path.iterdir()] == ["rig.json"]


def test_bad_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing"):
        StereoRig.load(tmp_path / "nothing.json")
    bad = tmp_path / "bad.json"
    for text in ("{", "[]", "{}", json.dumps({"left": {"matrix": [[1, 2]]}, "right": {}})):
        bad.write_text(text)
        with pytest.raises(ValueError, match="bad.json"):
            StereoRig.load(bad)


@pytest.mark.parametrize("matrix", [np.eye(3), np.full((2, 4), np.nan), np.zeros((2, 4)), [[1, 2, 3, 0], [2, 4, 6, 1]]])
def test_no_camera_from_a_bad_matrix(matrix):
    with pytest.raises(ValueError, match="matrix"):
        AffineCamera(matrix)


def test_bad_arguments_are_named(rig):
    M = rig.left.matrix
    with pytest.raises(ValueError, match="centre_px"):
        NearAffineCamera(M, 0.01, (1, 2, 3))
    with pytest.raises(ValueError, match="inverse_distance_per_mm"):
        NearAffineCamera(M, np.nan, (1, 2))
    with pytest.raises(ValueError, match="reference_mm"):
        NearAffineCamera(M, 0.01, (1, 2), (np.inf, 0, 0))
    with pytest.raises(ValueError, match="behind"):
        NearAffineCamera(M, 0.01, (1, 2)).project(-1000 * AffineCamera(M).viewing_direction[None])
    with pytest.raises(ValueError, match="pairs"):
        rig.triangulate(np.zeros((3, 2)), np.zeros((4, 2)))
    with pytest.raises(ValueError, match="covariance_px2"):
        rig.triangulate(np.zeros((3, 2)), np.zeros((3, 2)), np.eye(3))
    with pytest.raises(ValueError, match="x: expected"):
        rig.left.project(np.zeros((3, 2)))
