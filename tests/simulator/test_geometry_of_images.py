"""Images against geometry that needs no faith in the renderer: masks, depths, warps, speeds."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lib.cameras import AffineCamera, NearAffineCamera
from lib.geometry import RigidTransform
from lib.simulator import Eye, Forceps, Microscope, Pose, render_pair
from lib.simulator.forceps import MAX_PITCH_RAD, MAX_ROLL_RAD
from lib.simulator.population import random_forceps, random_pose
from lib.simulator.render import render_view
from lib.simulator.texture import smooth_noise
from lib.simulator.tool import rasterise, tool_in_view
from lib.simulator.window import Window, surface_grid
from notebooks.figures.data import ray_cast_depth
from notebooks.figures.effects import PLAIN
from notebooks.studies.scenes import Checkerboard, Relief, checkerboard_poses

IDENTITY = RigidTransform.identity()
RIG = PLAIN.rig(IDENTITY)


class Plane:
    """z = z_mm + slope . (x, y), textured with noise: a scene with a known depth."""

    gloss, extent_mm = 0.0, 26.0
    texture = np.uint8(110 + 30 * smooth_noise(np.random.default_rng(0), 512, 40, 3, 0.8).clip(-2, 2))[..., None].repeat(3, 2)

    def __init__(self, z_mm: float = 0.0, slope: tuple[float, float] = (0.0, 0.0)) -> None:
        self.z_mm, self.slope = z_mm, slope

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.z_mm + self.slope[0] * x + self.slope[1] * y


class Sphere(Plane):
    """The far inside of a sphere of 11 mm, as an ideal eye cup."""

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return -10.0 + np.sqrt(11.0**2 - x**2 - y**2)


def window(camera: AffineCamera, u: np.ndarray, size: int) -> Window:
    return Window.around(camera, u, (size, size))


def tip_distances(rng: np.random.Generator, n: int, min_pitch_rad: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Distance (2 n,) px of each tip from the edge of its jaw on a grid of 1/16 px, and what the renderer says
    of its visibility; poses all over the range that `Pose` allows, from `min_pitch_rad`."""
    factor, size, distances, visibilities = 16, 16, [], []
    for i in range(n):
        forceps = random_forceps(rng)
        pose = replace(
            random_pose(rng, forceps),
            pitch_rad=rng.uniform(min_pitch_rad, MAX_PITCH_RAD),
            roll_rad=rng.uniform(-MAX_ROLL_RAD, MAX_ROLL_RAD),
            opening_mm=rng.uniform(0.0, 0.55) * forceps.jaw_length_mm,
        )
        centres, radii, chains = forceps.nodes(pose)
        whole = (RIG.left, RIG.right)[i % 2]
        for k in (1, 2):
            tip = forceps.landmarks(pose)[k]
            shown = window(whole, whole.project(tip)[0], size)
            view = tool_in_view(shown, forceps, pose, None, factor=3)
            R, zoom = shown.camera.resect().R, shown.camera.resect().K[0, 0]
            seen = np.column_stack([shown.camera.project(centres) / zoom, centres @ R[2]])
            raster = rasterise(seen, radii, chains, zoom=zoom, size_px=(size, size), factor=factor)
            own = (raster.part == k + 1).astype(np.uint8)
            edge = np.argwhere(own & ~cv2.erode(own, np.ones((3, 3), np.uint8)).astype(bool))
            edge_px = (edge[:, ::-1] + 0.5) / factor - 0.5 + raster.origin_px
            distances.append(np.linalg.norm(edge_px - view.u[k], axis=1).min(initial=np.inf))
            visibilities.append(view.visibility[k])
    return np.array(distances), np.array(visibilities)


def test_visible_tips_lie_on_the_boundary_of_the_rendered_tool():
    distance_px, visibility = tip_distances(np.random.default_rng(0), 90)
    assert (visibility == 2).mean() > 0.85
    assert distance_px[visibility == 2].max() <= 0.25


def test_a_tip_behind_its_own_blunt_jaw_counts_as_hidden():
    distance_px, visibility = tip_distances(np.random.default_rng(0), 40, 0.95)
    assert (visibility == 1).any() and (visibility == 2).any()
    assert distance_px[visibility == 2].max() <= 0.25
    # Hidden means that the outline is further than 0.25 px, less the diagonal of the grid here.
    assert distance_px[visibility == 1].min() > 0.25 - 1.5 / 16


def test_base_is_midway_between_the_edges_of_the_shaft():
    rng = np.random.default_rng(1)
    seen = 0
    for i in range(24):
        forceps = random_forceps(rng)
        pose = replace(
            random_pose(rng, forceps),
            pitch_rad=rng.uniform(0, MAX_PITCH_RAD), roll_rad=rng.uniform(-MAX_ROLL_RAD, MAX_ROLL_RAD)
        )
        whole = (RIG.left, RIG.right)[i % 2]
        shown = window(whole, whole.project(np.array(pose.base_mm))[0], 120)
        camera = shown.camera
        view = render_view(Plane(4.0), PLAIN, shown, forceps=forceps, pose=pose, factor=4)
        if view.visibility[0] != 2:
            continue
        seen += 1
        shaft = camera.linear @ pose.microscope_from_tool[:, 0]
        along = shaft / np.linalg.norm(shaft)
        across = np.array([-along[1], along[0]])
        # Coverage across the shaft, just behind the base and the roots of the jaws, which may bulge out beside it.
        offsets = np.arange(-48, 48, 0.05)
        behind_px = 4 + 120 * forceps.jaw_radius_mm
        points = view.u[0] - behind_px * along + offsets[:, None] * across
        profile = cv2.remap(view.tool_mask.astype(np.float32), *np.float32(points.T), cv2.INTER_LINEAR).ravel() / 255
        inside = offsets[profile > 0.5]
        assert abs(inside.min() + inside.max()) / 2 <= 0.25
        assert_allclose(np.ptp(inside), 2 * forceps.shaft_radius_mm * np.linalg.norm(camera.linear[0]), atol=0.5)
    assert seen > 20


@pytest.mark.parametrize("camera", [RIG.left, NearAffineCamera(RIG.right.matrix, 1 / 150, np.array([959.5, 539.5]))])
def test_depth_of_plane_and_sphere_is_right_to_a_micrometre(camera):
    """Against the closed-form intersection of each pixel's own ray."""
    size = (480, 320)
    shown = Window.around(camera, np.array([940, 460]), size).camera
    affine = getattr(shown, "affine", shown)
    plane, sphere = Plane(0.4, (0.1, -0.2)), Sphere()
    depths = [render_view(s, PLAIN, Window(shown, size), surface=True).surface_mm for s in (plane, sphere)]
    u = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1).reshape(-1, 2)[::371].astype(float)
    for surface, depth in zip((plane, sphere), depths, strict=True):
        z = depth[u[:, 1].astype(int), u[:, 0].astype(int)].astype(float)
        # The point on the surface that projects to u, by Newton on (x, y), from an independent projection.
        xy = np.zeros((len(u), 2))
        for _ in range(30):
            x = np.column_stack([xy, surface.height(*xy.T)])
            xy += (u - shown.project(x)) @ np.linalg.inv(affine.linear[:, :2]).T
        assert np.abs(shown.project(x) - u).max() < 1e-6
        assert np.abs(z - x[:, 2]).max() < 1e-3


def test_depth_agrees_with_an_independent_ray_caster():
    eye = Eye(seed=27, texture_px=64)
    shown = Window.around(RIG.left, np.array([700, 500]), (96, 64))
    u = np.stack(np.meshgrid(np.arange(0, 96, 5), np.arange(0, 64, 5)), axis=-1).reshape(-1, 2).astype(float)
    cast = ray_cast_depth(eye, shown, u)
    if cast is None:
        pytest.skip("Open3D cannot be imported")
    ours = render_view(eye, PLAIN, shown, surface=True).surface_mm[u[:, 1].astype(int), u[:, 0].astype(int)]
    assert np.abs(cast - ours).max() < 1e-3


def test_left_image_warped_by_the_true_surface_is_the_right_one():
    eye = Eye(seed=3, gloss=0.0, texture_px=1024)
    noisy = Microscope(
        depth_of_field_mm=float("inf"), psf_px=0.5, vignetting=0.0, jpeg_quality=None, full_well=4000.0,
        gain=PLAIN.gain, pixels_per_mm=(50.0, 50.0), image_size_px=(640, 400),
    )  # fmt: skip
    rig = noisy.rig(IDENTITY)
    clean = [render_view(eye, PLAIN_SMALL, Window(camera, (640, 400)), surface=True) for camera in (rig.left, rig.right)]
    rng = np.random.default_rng(0)
    right = render_view(eye, noisy, Window(rig.right, (640, 400)), side=1, rng=rng).image.astype(float)
    u = np.stack(np.meshgrid(np.arange(640.0), np.arange(400.0)), axis=-1)
    z = clean[1].surface_mm
    A = rig.right.linear
    xy = np.einsum("ij,hwj->hwi", np.linalg.inv(A[:, :2]), u - rig.right.offset_px - A[:, 2] * z[..., None])
    u_left = rig.left.project(np.dstack([xy, z]).reshape(-1, 3)).reshape(400, 640, 2).astype(np.float32)
    left = render_view(eye, replace_noise(noisy), Window(rig.left, (640, 400))).image.astype(np.float32)
    warped = cv2.remap(left, u_left[..., 0], u_left[..., 1], cv2.INTER_CUBIC)
    inside = np.s_[40:-40, 40:-40]
    # Noise predicted from the sensor model, carried through the gamma curve.
    linear = (clean_right(eye, noisy, rig) / 255.0) ** 2.2
    variance = linear / noisy.full_well + (noisy.read_noise / noisy.full_well) ** 2
    slope = 255 / 2.2 * np.maximum(linear, 1e-3) ** (1 / 2.2 - 1)
    predicted = np.sqrt(variance * slope**2 + 2 / 12)
    residual = (right - warped)[inside]
    unsaturated = (right[inside] < 250) & (right[inside] > 5)
    ratio = np.sqrt(np.mean(residual[unsaturated] ** 2) / np.mean(predicted[inside][unsaturated] ** 2))
    assert 0.9 < ratio <= 1.1
    # One pixel off, the test would notice.
    shifted = cv2.remap(left, u_left[..., 0] + 1, u_left[..., 1], cv2.INTER_CUBIC)
    assert np.mean((right - shifted)[inside][unsaturated] ** 2) > 1.3 * np.mean(residual[unsaturated] ** 2)


PLAIN_SMALL = Microscope(
    depth_of_field_mm=float("inf"), psf_px=0.5, vignetting=0.0, full_well=float("inf"), gain=PLAIN.gain,
    pixels_per_mm=(50.0, 50.0), image_size_px=(640, 400),
)  # fmt: skip


def replace_noise(microscope: Microscope) -> Microscope:
    return replace(microscope, full_well=float("inf"))


def clean_right(eye: Eye, microscope: Microscope, rig) -> np.ndarray:
    return render_view(eye, replace_noise(microscope), Window(rig.right, (640, 400)), side=1).image.astype(float)


def edge_position(mask: np.ndarray, row: int) -> float:
    """Column of the middle of the tool's coverage in a row, px."""
    weight = mask[row].astype(float)
    return float((weight * np.arange(len(weight))).sum() / weight.sum())


def test_rolling_shutter_moves_the_tool_by_what_its_speed_predicts():
    """A shaft along the rows' normal, moving sideways, leans; the landmarks say by how much each."""
    rolling = replace(PLAIN, readout_s=0.020)
    forceps = Forceps()
    pose = Pose((0.0, 0.0, -1.0), azimuth_rad=np.pi / 2, pitch_rad=0.2)
    speed = 30.0  # mm/s along x
    later = (replace(pose, base_mm=(speed * 1e-3, 0.0, -1.0)), 1e-3)
    camera = RIG.left
    centre = camera.project(np.array(pose.base_mm))[0]
    shown = Window.around(camera, centre, (300, 300), PLAIN.image_size_px)
    origin = shown.origin_px
    common = {"forceps": forceps, "pose": pose, "factor": 8}
    still = render_view(Plane(3.0), rolling, shown, **common)
    moving = render_view(Plane(3.0), rolling, shown, later=later, **common)
    for row in (10, 60, 110):
        delay = 0.020 * ((row + origin[1]) / 1079 - 0.5)
        predicted = speed * delay * camera.linear[0, 0]
        # The shaft itself is nearly vertical, so a row's shift is the tool's.
        assert_allclose(edge_position(moving.tool_mask, row) - edge_position(still.tool_mask, row), predicted, atol=0.1)
    delay = 0.020 * ((moving.u[:, 1] + origin[1]) / 1079 - 0.5)
    expected = still.u + (speed * delay)[:, None] * camera.linear[:, 0]
    assert_allclose(moving.u, expected, atol=0.02)


def test_defocus_grows_with_the_distance_from_focus_as_designed():
    """The width of a board's edge is the hypotenuse of what it is in focus and |z| / (depth of field / 2) px."""
    microscope = replace(PLAIN, depth_of_field_mm=2.0, psf_px=0.8)
    camera = RIG.left
    widths = []
    for z in (0.0, 1.0, 2.0, 4.0):
        board = Checkerboard(RigidTransform(np.eye(3), np.array([0.0, 0.0, z])), square_mm=1.0, columns=4, rows=4)
        shown = window(camera, camera.project(board.corners_mm[0])[0] + [0, 50], 90)
        image = render_view(board, microscope, shown).image[..., 1].astype(float)
        linear = (image / 255) ** 2.2
        profile = np.abs(np.diff(linear, axis=1))[25:66]
        columns = np.arange(89.0)
        rows = []
        for line in profile:
            middle = (line * columns).sum() / line.sum()
            rows.append(np.sqrt((line * (columns - middle) ** 2).sum() / line.sum()))
        widths.append(np.median(rows))
    assert (np.diff(widths) > 0).all()
    # What is wider than in focus, where the point spread and the texture's own softness remain.
    added = np.sqrt(np.square(widths[1:]) - widths[0] ** 2)
    assert_allclose(added, [1.0, 2.0, 4.0], rtol=0.05)


def test_checkerboard_corners_are_where_the_truth_says():
    rng = np.random.default_rng(2)
    small = Microscope(image_size_px=(640, 400), full_well=float("inf"))
    for pose in checkerboard_poses(2, rng, half_size_mm=(0.5, 0.3, 0.8)):
        board = Checkerboard(pose, columns=9, rows=7)
        for view, u in zip(render_pair(board, small), small.rig(IDENTITY).project(board.corners_mm), strict=True):
            u = u[((u > 12) & (u < np.array([640, 400]) - 12)).all(axis=1)]
            grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
            found = cv2.cornerSubPix(
                grey, np.ascontiguousarray(u[:, None], np.float32), (5, 5), (-1, -1), (3, 60, 1e-4)
            )[:, 0]
            assert np.sqrt(np.mean((found - u) ** 2)) < 0.1


def test_surface_grid_lies_on_the_surface_and_projects_to_its_pixels():
    for scene in (Eye(seed=8), Relief("leaf")):
        x_px, y_px, x_mm = surface_grid(scene, RIG.left, (1920, 1080), step_px=120)
        u = np.stack(np.meshgrid(x_px, y_px), axis=-1)
        assert_allclose(RIG.left.project(x_mm.reshape(-1, 3)).reshape(u.shape), u, atol=1e-6)
        assert_allclose(scene.height(x_mm[..., 0], x_mm[..., 1]), x_mm[..., 2], atol=1e-4)


def test_tip_1_is_left_of_the_shaft_in_both_images():
    rng = np.random.default_rng(5)
    for _ in range(200):
        forceps = random_forceps(rng)
        pose = replace(random_pose(rng, forceps), opening_mm=0.5)
        for camera in (RIG.left, RIG.right):
            base, tip_1, tip_2 = camera.project(forceps.landmarks(pose))
            ahead = (tip_1 + tip_2) / 2 - base
            left = np.array([ahead[1], -ahead[0]])  # y is down
            assert (tip_1 - tip_2) @ left > 0


def test_a_finite_working_distance_shows_the_tool_where_the_near_affine_camera_does():
    small = replace(PLAIN, image_size_px=(320, 200), inverse_distance_per_mm=1 / 150, pixels_per_mm=(25.0, 25.0))
    forceps, pose = Forceps(), Pose((-2.0, 1.0, -2.0), pitch_rad=0.4)
    rig = small.rig(IDENTITY)
    views = render_pair(Plane(2.0), small, forceps=forceps, pose=pose)
    for view, camera in zip(views, (rig.left, rig.right), strict=True):
        landmarks = forceps.landmarks(pose)
        assert_allclose(view.u, camera.project(landmarks), atol=1e-6)
        assert np.abs(view.u - AffineCamera(camera.matrix).project(landmarks)).max() > 0.5
        base = np.round(view.u[0]).astype(int)
        assert view.tool_mask[base[1], base[0]] == 255


def test_a_microscope_that_moved_sees_what_a_moved_scene_would_show():
    """Near-affine too: the plane in which the cameras touch their affine ones moves along."""
    near = replace(PLAIN, image_size_px=(160, 100), inverse_distance_per_mm=1 / 150, pixels_per_mm=(12.0, 12.0))
    after_from_before = RigidTransform.from_rotation_vector((0.03, 0.0, 0.02), (0.3, 0.1, 0.4))
    moved = near.rig(IDENTITY).moved(after_from_before.inverse())
    pose = Pose((-2.0, 1.0, -2.0), pitch_rad=0.4)
    shown = Window(moved.left, near.image_size_px)
    view = render_view(Plane(2.0), near, shown, forceps=Forceps(), pose=pose, factor=3)
    seen = near.rig(IDENTITY).left.project(after_from_before.apply(Forceps().landmarks(pose)))
    assert_allclose(view.u, seen, atol=1e-6)
    x_px, y_px, x_mm = surface_grid(Plane(2.0), moved.left, near.image_size_px, step_px=40)
    u = near.rig(IDENTITY).left.project(after_from_before.apply(x_mm.reshape(-1, 3)))
    assert_allclose(u, np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2), atol=1e-4)


def test_matt_plane_has_no_glints():
    small = Microscope(pixels_per_mm=(17.0, 16.5), image_size_px=(320, 180), readout_s=0.0)
    assert not render_pair(Plane(), small)[0].glint_mask.any()
    glossy, other = render_pair(Eye(seed=5, texture_px=256), small)
    assert glossy.glint_mask.any() and (glossy.glint_mask != other.glint_mask).any()


def test_ground_that_faces_the_lamp_is_brighter_and_the_shadow_falls_on_the_other_side():
    microscope = replace(PLAIN, light_slope=(0.9, 0.0))
    window = Window(microscope.rig(IDENTITY).left, microscope.image_size_px)
    towards, away = (render_view(Plane(1.0, (slope, 0.0)), microscope, window).image.mean() for slope in (0.4, -0.4))
    assert towards > 1.05 * away  # z grows with depth, so a positive slope faces +x
    tool = {"forceps": Forceps(), "pose": Pose((0.0, 0.0, -1.0), azimuth_rad=np.pi / 2, pitch_rad=0.0)}
    bare, shown = (render_view(Plane(1.0), microscope, window, **own) for own in ({}, tool))
    darker = np.where(shown.tool_mask, 0.0, (bare.image.astype(float) - shown.image).mean(axis=2).clip(0))
    shadow_x = (darker * np.arange(darker.shape[1])).sum() / darker.sum()
    assert shadow_x < shown.u[0, 0]
