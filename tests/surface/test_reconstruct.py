"""Stereo pair to surface, and the figures of the notebook, on a small rendered eye and on real photographs."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np
import pytest

from lib import paths
from lib.cameras import StereoRig
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import Microscope
from lib.simulator.render import render_pair
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE
from lib.surface import BSplineSurface, SplineGrid, epipolar_inliers, evaluation, reconstruct, surface_mesh

matplotlib.use("Agg")


@dataclass(frozen=True)
class Scene:
    """A rendered pair with its truth."""

    left: np.ndarray
    right: np.ndarray
    rig: StereoRig
    u_tool: tuple[np.ndarray, np.ndarray]
    eye: Eye

    def truth(self, u: np.ndarray) -> np.ndarray:
        camera, robot_to_microscope = self.rig.left, ROBOT_FROM_MICROSCOPE.inverse()
        ray = (u - camera.offset_px) @ np.linalg.pinv(camera.linear).T
        along = np.full(len(u), float(camera.viewing_direction @ ROBOT_FROM_MICROSCOPE.t))
        for _ in range(60):
            x = robot_to_microscope.apply(ray + along[:, None] * camera.viewing_direction)
            along -= x[:, 2] - self.eye.height(x[:, 0], x[:, 1])
        return ray + along[:, None] * camera.viewing_direction


@pytest.fixture(scope="module")
def scene() -> Scene:
    microscope = Microscope(image_size_px=(640, 360), pixels_per_mm=(34.0, 33.0))
    eye = Eye(seed=501, texture_px=768)
    pose = Pose(base_mm=(2.0, 1.0, -1.0))
    views = render_pair(eye, microscope, forceps=Forceps(), pose=pose, rng=np.random.default_rng(0))
    rig = microscope.rig()
    return Scene(views[0].image, views[1].image, rig, (views[0].u, views[1].u), eye)


@pytest.fixture(scope="module")
def result(scene):
    return reconstruct(scene.left, scene.right, scene.rig, u_landmarks=scene.u_tool, control=(14, 10))


def lattice() -> tuple[np.ndarray, np.ndarray]:
    return np.arange(20, 620, 20), np.arange(20, 340, 20)


def test_the_surface_lies_within_a_fraction_of_a_pixel_of_disparity(scene, result):
    one_pixel_um = 1e3 / (33.5 * np.tan(scene.rig.convergence_rad))
    error = evaluation.surface_error_mm(result.surface, scene.truth, *lattice())
    seen = ~result.mask_left[np.ix_(*lattice()[::-1])]
    assert evaluation.rms_um(error, seen) < one_pixel_um / 4
    assert list(result.seconds) == ["mask", "match", "triangulate", "surface"]
    assert len(result.points.x_mm) == len(result.matches) <= result.n_matches
    tool = np.rint(scene.u_tool[0][0]).astype(int)
    assert result.mask_left[tool[1], tool[0]]


def test_fast_setting_fits_the_depth_alone(scene):
    fast = reconstruct(scene.left, scene.right, scene.rig, setting="fast", u_landmarks=scene.u_tool, control=(10, 8))
    assert len(fast.surface.fit.axes) == 1
    error = evaluation.surface_error_mm(fast.surface, scene.truth, *lattice())
    assert evaluation.rms_um(error) < 150


def test_epipolar_filter_drops_what_is_off_the_line(scene, result):
    matches = result.matches
    off = matches.u_right.copy()
    off[::4] += 20 * scene.rig.epipolar_normal[2:] / np.linalg.norm(scene.rig.epipolar_normal[2:])
    wrong = type(matches)(matches.u_left, off, matches.score, matches.covariance_px2)
    kept = epipolar_inliers(scene.rig, wrong)
    assert not kept[::4].any() and kept[1::4].mean() > 0.8
    assert not len(epipolar_inliers(scene.rig, matches.keep(np.zeros(len(matches), dtype=bool))))


def test_black_images_and_full_masks_are_refused(scene):
    black = np.zeros_like(scene.left)
    with pytest.raises(ValueError, match=r"left, right|u:|texture"):
        reconstruct(black, black, scene.rig)
    with pytest.raises(ValueError, match="mask_left"):
        reconstruct(scene.left, scene.right, scene.rig, mask_left=np.ones(black.shape[:2], dtype=bool))


def test_error_measures():
    grid = SplineGrid((0, 0, 100, 80), (4, 4))
    plane = BSplineSurface(grid, np.dstack([grid.sites / 100, np.zeros((4, 4))]))
    shifted = lambda u: np.column_stack([u / 100, np.full(len(u), -0.003)])  # noqa: E731
    error = evaluation.surface_error_mm(plane, shifted, np.arange(0, 120, 10), np.arange(0, 90, 10))
    assert error.shape == (9, 12, 3) and np.isnan(error[0, 11]).all()
    assert evaluation.rms_um(error) == pytest.approx(3.0)
    assert np.isnan(evaluation.rms_um(error, np.zeros(error.shape[:2], dtype=bool)))


def test_every_figure_draws(scene, result):
    import matplotlib.pyplot as plt

    from lib.figures import reconstruction as figures

    surface, rig = result.surface, scene.rig
    error_um = 1e3 * evaluation.surface_error_mm(surface, scene.truth, *lattice())[..., 2]
    position = np.linspace(0, 10, 50)
    curves = {"truth": (np.cos(position), "truth"), "L1": (np.cos(position) + 0.1, "ours")}
    dots = (position, np.cos(position))
    pages = [
        figures.stereo_pair(scene.left, scene.right, scene.u_tool),
        figures.descriptor_channels(scene.left, np.random.default_rng(0).random((36, 64, 9))),
        figures.match_fields(scene.left, {"band": result.matches}),
        figures.epipolar_geometry(
            scene.left, scene.right, rig, np.array([[100.0, 50.0]]), np.arange(9.0), np.arange(9) < 7
        ),
        figures.point_errors({"a": np.array([0.01, np.nan, -0.02]), "b": np.ones(4) * 0.01}, {"a": 10.0, "b": 1.0}),
        figures.profiles(position, dots, curves, title="section"),
        figures.smoothness_sections(np.array([1.0, 2.0, 3.0]), [np.cos(position)] * 3, position, dots, curves),
        figures.held_out_curve(np.array([[1.0, 0.2], [10.0, 0.1]]), 3.0, np.array([1.0, 10.0]), np.array([5.0, 4.0])),
        figures.held_out_curve(np.array([[1.0, 0.2], [10.0, 0.1]]), 3.0),
        figures.error_maps({"one": error_um, "two": error_um}),
        figures.error_budget({"quality": 10.0, "sphere": 90.0}, highlight="quality", paper_um=25.479),
        figures.reconstruction(scene.left, surface, rig, mask=result.mask_left),
    ]
    for page in pages:
        page.canvas.draw()
        plt.close(page)
    mesh = surface_mesh(surface, step_px=40, image=scene.left)
    view = figures.mesh_view(mesh)
    assert len(view.data[0].x) == len(mesh.vertices_mm) and len(view.data[0].i) == len(mesh.faces)
    plt.close("all")


def test_real_pairs_are_scored_beside_each_other():
    folder = paths.real_data("stereo_pairs")
    if folder is None:
        pytest.skip(paths.missing_data_line("stereo_pairs"))
    import matplotlib.pyplot as plt

    from lib.figures import reconstruction as figures

    pair = evaluation.real_pair(folder / "cones")
    found = evaluation.compare_matchers(pair, {"band": {"method": "band"}, "SGBM": {"method": "sgbm"}})
    for matches, score, _ in found.values():
        assert 1000 < score.n <= len(matches)
        assert score.median_px < 0.3 and score.above_2 < 0.09
    errors = {name: (score.u_left, score.error_px) for name, (_, score, _) in found.items()}
    for page in (
        figures.disparity_errors(pair.left, pair.disparity_px, errors),
        figures.score_table({"cones": found}),
    ):
        page.canvas.draw()
        plt.close(page)


def test_real_pair_files_are_checked(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"left\.png"):
        evaluation.real_pair(tmp_path)
