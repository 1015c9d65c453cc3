"""Affine rectification: shared rows and displacement linear in depth, for any rig."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lib.cameras import AffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.matching import RECTIFIED
from lib.matching.rectification import on_image, rectify, warp
from lib.simulator.rig import reference_rig


def canvas_from(image_from_canvas: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.linalg.solve(image_from_canvas[:, :2], (u - image_from_canvas[:, 2]).T).T


@settings(max_examples=40, deadline=None)
@given(
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
    rolls=st.tuples(*[st.floats(-3.1, 3.1)] * 2),
    zoom=st.tuples(*[st.floats(20, 200)] * 2),
    convergence=st.floats(0.02, 0.6),
    scale=st.sampled_from([1.0, 0.5, 0.3]),
)
def test_rows_are_shared_and_displacement_is_depth(rotation, rolls, zoom, convergence, scale):
    rig = reference_rig(
        pixels_per_mm=zoom,
        image_rotation_rad=rolls,
        convergence_rad=convergence,
        robot_from_microscope=RigidTransform.from_rotation_vector(rotation, (3, -40, 25)),
    )
    found = rectify(rig, (1080, 1920), (1080, 1920), scale=scale)
    x = np.random.default_rng(0).normal(0, 5, (30, 3))
    u_left, u_right = rig.project(x)
    left, right = canvas_from(found.left_from_canvas, u_left), canvas_from(found.right_from_canvas, u_right)
    depth = x @ rig.left.viewing_direction
    assert np.allclose(left[:, 1], right[:, 1], atol=1e-6)
    expected = (depth - found.reference_depth_mm) * found.displacement_px_per_mm
    assert np.allclose(right[:, 0] - left[:, 0], expected, atol=1e-6)
    assert np.allclose(on_image(found.left_from_canvas, left), u_left)
    assert np.allclose(on_image(found.right_from_canvas, right), u_right)
    assert np.allclose(found.depth_range_mm((expected.min(), expected.max())), (depth.min(), depth.max()))
    near_far = found.depth_range_mm((-10.0, 10.0))  # which both images show, whose centres lie together at 0
    assert np.allclose(found.search_range_px(near_far, (1080, 1920)), (-10, 10))
    # The canvas holds the whole left image and is upright as far as it can be.
    corners = canvas_from(found.left_from_canvas, np.array([[0, 0], [1919, 0], [0, 1079], [1919, 1079]], float))
    assert (corners > -1).all() and (corners < found.size_px).all()
    assert corners[1, 0] >= corners[0, 0] - 1e-9


def test_a_rectified_pair_is_left_alone():
    found = rectify(RECTIFIED, (50, 70), (50, 70))
    assert np.allclose(found.left_from_canvas, np.eye(2, 3)) and np.allclose(found.right_from_canvas, np.eye(2, 3))
    assert found.size_px == (70, 50)
    assert found.displacement_px_per_mm == -1
    points = RECTIFIED.triangulate([[40.0, 20.0]], [[28.0, 20.0]])
    assert np.allclose(points.x_mm, (40, 20, 12))


@pytest.mark.parametrize("sizes", [((50, 70), (50, 90)), ((50, 70), (40, 61)), ((31, 33), (50, 70))])
def test_a_rectified_pair_of_different_sizes_is_moved_by_whole_pixels(sizes):
    found = rectify(RECTIFIED, *sizes)
    moved = found.right_from_canvas - np.eye(2, 3)
    assert np.array_equal(moved, np.rint(moved)) and not moved[1].any()


@pytest.mark.parametrize("scale", [1.0, 0.44])
def test_the_canvas_does_not_depend_on_the_origin_of_the_robots_frame(scale):
    """The same cameras: a surface must not change by micrometres if the robot counts its millimetres from elsewhere."""
    rig, shape = reference_rig(), (1080, 1920)
    here = rectify(rig, shape, shape, scale=scale)
    for along_mm in (0.05, 0.13, 250.0):
        to = RigidTransform(np.eye(3), along_mm * rig.left.viewing_direction + (3.0, -2.0, 1.0))
        there = rectify(rig.moved(to), shape, shape, scale=scale)
        assert np.allclose(there.left_from_canvas, here.left_from_canvas)
        assert np.allclose(there.right_from_canvas, here.right_from_canvas)


def test_warping_shifts_masks_and_shrinks_without_moving():
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 255, (40, 60)).astype(np.float32)
    identity = np.eye(2, 3)
    out, valid = warp(image, identity, (70, 44), shift_px=(-5, -2))
    assert np.array_equal(out[2:42, 5:65], image)
    assert valid[2:42, 5:65].all() and valid.sum() == 2400
    mask = np.zeros(image.shape, bool)
    mask[10:20, 30:40] = True
    _, valid = warp(image, identity, (60, 40), mask=mask)
    assert np.array_equal(valid, ~mask)
    # A ramp stays the ramp: half-pixel shifts, turned or half-size canvases.
    x, y = np.meshgrid(np.arange(60, dtype=np.float32), np.arange(40, dtype=np.float32))
    for matrix in (
        np.array([[1, 0, 0.5], [0, 1, 0.25]]),
        np.array([[2, 0, 0.5], [0, 2, 0.5]]),
        np.array([[1.98, 0.1, 0.7], [-0.1, 1.98, 3.0]]),
    ):
        rows, columns = np.mgrid[5:12, 5:20]
        at = np.stack([columns, rows], axis=-1) @ matrix[:, :2].T + matrix[:, 2]
        for axis, ramp in enumerate((x, y)):
            out, valid = warp(ramp, matrix, (26, 16))
            assert np.abs(out[rows, columns] - at[..., axis])[valid[rows, columns]].max() < 0.05


def test_parallel_axes_are_refused():
    camera = AffineCamera([[1.0, 0, 0, 0], [0, 1, 0, 0]])
    with pytest.raises(ValueError, match="rig: both cameras look along the same direction"):
        rectify(StereoRig(camera, camera), (50, 50), (50, 50))
