import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lib.geometry import (
    RigidTransform,
    align_rotation,
    cell_from_image,
    finite_points,
    image_from_cell,
    pair_covariance,
    points,
)

vectors = arrays(np.float64, 3, elements=st.floats(-3, 3))
strides = st.tuples(st.floats(0.25, 8), st.floats(0.25, 8))


@given(vectors, vectors, vectors)
def test_inverse_undoes_apply(rotation_rad, t_mm, x_mm):
    robot_from_camera = RigidTransform.from_rotation_vector(rotation_rad, t_mm)
    np.testing.assert_allclose(robot_from_camera.inverse().apply(robot_from_camera.apply(x_mm)), x_mm, atol=1e-12)


@given(vectors, vectors, vectors)
def test_compose_applies_the_argument_first(first, second, x_mm):
    b_from_c = RigidTransform.from_rotation_vector(first, second)
    a_from_b = RigidTransform.from_rotation_vector(second, first)
    expected = a_from_b.apply(b_from_c.apply(x_mm))
    np.testing.assert_allclose(a_from_b.compose(b_from_c).apply(x_mm), expected, atol=1e-12)


def test_rotation_by_a_quarter_turn_about_z():
    quarter = RigidTransform.from_rotation_vector((0, 0, np.pi / 2), (1, 2, 3))
    np.testing.assert_allclose(quarter.apply([1, 0, 0]), [1, 3, 3], atol=1e-15)


@pytest.mark.parametrize("R", [np.eye(3) * 2, np.diag([1, 1, -1]), np.full((3, 3), np.nan), np.eye(2)])
def test_what_is_no_rotation_is_refused(R):
    with pytest.raises(ValueError, match="R"):
        RigidTransform(R, np.zeros(3))


def test_a_transform_cannot_be_changed_behind_its_back():
    transform = RigidTransform.identity()
    with pytest.raises(ValueError):
        transform.t[0] = 1.0


def test_the_first_cell_of_a_stride_4_grid_is_centred_on_pixel_one_and_a_half():
    np.testing.assert_array_equal(image_from_cell([[0, 0], [1, 2]], 4), [[1.5, 1.5], [5.5, 9.5]])


def test_cell_centres_are_the_means_of_the_pixels_they_cover():
    pixels = np.arange(12)
    np.testing.assert_array_equal(image_from_cell(np.arange(3), 4), pixels.reshape(3, 4).mean(axis=1))


@given(arrays(np.float64, (5, 2), elements=st.floats(-2000, 2000)), strides)
def test_cells_and_pixels_are_inverse_also_when_anisotropic(u_px, stride):
    np.testing.assert_allclose(image_from_cell(cell_from_image(u_px, stride), stride), u_px, atol=1e-9)


def test_one_point_becomes_a_row_and_nan_passes_only_where_allowed():
    assert points([1, 2, np.nan], 3, "x").shape == (1, 3)
    with pytest.raises(ValueError, match=r"x: 1 of 2 rows are not finite \(the first is row 1\)"):
        finite_points([[1, 2, 3], [1, 2, np.nan]], 3, "x")


@pytest.mark.parametrize("shape", [(3,), (4, 3), (2, 2, 2), (0,)])
def test_wrong_shapes_name_the_argument(shape):
    with pytest.raises(ValueError, match="u_left: expected"):
        points(np.zeros(shape), 2, "u_left")


def test_pair_covariance_takes_every_form():
    rng = np.random.default_rng(0)
    blocks = rng.uniform(1, 2, (5, 2, 1, 1)) * np.eye(2)
    expected = np.zeros((5, 4, 4))
    expected[:, :2, :2], expected[:, 2:, 2:] = blocks[:, 0], blocks[:, 1]
    for form in (expected, blocks):
        np.testing.assert_array_equal(pair_covariance(form, 5), expected)
    for form, diagonal in ((None, 1), (2.5, 2.5), (2.5 * np.eye(2), 2.5), (2.5 * np.eye(4), 2.5)):
        np.testing.assert_array_equal(pair_covariance(form, 5), diagonal * np.eye(4)[None])
    np.testing.assert_array_equal(pair_covariance(blocks[:, 0], 5, images=1), blocks[:, 0])
    unseen = expected.copy()
    unseen[2, :2] = np.nan
    assert np.isnan(pair_covariance(unseen, 5)[2]).any()


#: Each pair of coordinates alone could be so correlated, and the three together cannot.
INDEFINITE = np.eye(4) - 0.6 * (np.ones((4, 4)) - np.eye(4))


@pytest.mark.parametrize(
    "bad", [np.eye(3), np.ones((4, 4, 4)), -1.0, np.inf, np.diag([1.0, 1, 1, -1]), np.zeros((5, 4, 4)), INDEFINITE]
)
def test_pair_covariance_refuses_what_is_no_covariance(bad):
    with pytest.raises(ValueError, match="covariance_px2"):
        pair_covariance(bad, 5)


def test_align_rotation_finds_the_nearest_rotation_and_never_a_reflection():
    rng = np.random.default_rng(1)
    R = np.stack([RigidTransform.from_rotation_vector(v).R for v in rng.normal(size=(4, 3))])
    np.testing.assert_allclose(align_rotation(R * rng.uniform(1, 3, (4, 1, 1))), R, atol=1e-12)
    assert np.linalg.det(align_rotation(np.diag([1.0, 1.0, -0.5]))) == pytest.approx(1)
