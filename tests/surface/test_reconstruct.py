"""Stereo pair to surface, and the figures of the notebook, on a small rendered eye and on real photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import matplotlib
import matplotlib.pyplot
import numpy as np
import pytest

from lib import paths
from lib.calibration import calibrate
from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.recordings import Recording
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.render import render_pair
from lib.simulator.rig import Microscope
from lib.surface import BSplineSurface, SplineGrid, epipolar_inliers, reconstruct, surface_mesh
from lib.surface.bspline import sign_inflation
from lib.surface.reconstruct import in_company
from lib.workbench import results
from notebooks import real_data
from notebooks.studies import surface_evaluation as evaluation
from notebooks.studies.simulated_rows import simulate_correspondences

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
        return evaluation.surface_on_rays(self.rig.left, self.eye.height, u)


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
    wrong = replace(matches, u_right=off)
    kept = epipolar_inliers(scene.rig, wrong)
    assert not kept[::4].any() and kept[1::4].mean() > 0.8
    assert not len(epipolar_inliers(scene.rig, matches.keep(np.zeros(len(matches), dtype=bool))))


def test_epipolar_filter_allows_for_lines_that_a_wrong_calibration_turns_and_bends(scene, result):
    """Else it would keep the matches of one stripe of the image, and wrong ones beside it."""
    matches, (width, height) = result.matches, (640, 360)
    x, y = (matches.u_left / (width, height) - 0.5).T
    off = (3 * x - 4 * y + 2 * x * y + y**2)[:, None] * scene.rig.epipolar_normal[2:]
    wrong = np.arange(len(matches)) % 5 == 0
    off[wrong] += 5 * scene.rig.epipolar_normal[2:]
    off /= np.sum(scene.rig.epipolar_normal[2:] ** 2)  # now px of distance from the lines
    kept = epipolar_inliers(scene.rig, replace(matches, u_right=matches.u_right + off))
    assert kept[~wrong].mean() > 0.9 and kept[wrong].mean() < 0.02


def test_a_match_that_no_point_explains_is_dropped_alone(scene, result):
    """Barrel distortion, if it is estimated too strong, images nothing at the corners: their distance is NaN."""
    barrel = NearAffineCamera(scene.rig.left.matrix, 0.0, (320, 180), radial_per_px2=-2e-6)
    rig = StereoRig(barrel, scene.rig.right)
    u = np.array([[320.0, 180.0], [330.0, 190.0], [0.0, 0.0], [310.0, 170.0]])
    matches = replace(result.matches.keep(np.arange(4)), u_left=u, u_right=scene.rig.right.project(scene.truth(u)))
    assert np.isnan(rig.epipolar_distance(matches.u_left, matches.u_right)).tolist() == [False, False, True, False]
    assert epipolar_inliers(rig, matches).tolist() == [True, True, False, True]


def test_errors_that_neighbours_share_inflate_the_covariance(scene, result):
    """The surface follows them, so only the distances from the epipolar lines show them."""
    rng, grid = np.random.default_rng(0), SplineGrid((0, 0, 100, 100), (13, 13))
    u = rng.uniform(0, 100, (4000, 2))
    alone, shared = rng.normal(size=(4000, 1)), rng.normal(size=(5, 5))[tuple((u // 20).astype(int).T)][:, None]
    assert sign_inflation(grid, u, alone, 2) < 1.3
    assert sign_inflation(grid, u, alone + shared, 2) > 20
    fit = result.surface.fit
    twice = replace(result.surface, fit=replace(fit, inflation=4 * max(fit.agreement[0].max(), fit.inflation)))
    ratio = twice.covariance([[320, 180]]) / result.surface.covariance([[320, 180]])
    assert 1 <= fit.inflation < 8 and (np.diag(ratio[0]) > 3.9).all()


def test_points_without_neighbours_are_dropped():
    x, y = (side.ravel() for side in np.mgrid[:12, :15] * 0.1)
    points = np.column_stack([x, y, 0.3 * x])
    points[[40, 100, 101], 2] += 3.0
    assert np.flatnonzero(~in_company(points)).tolist() == [40, 100, 101]
    assert in_company(points[:2]).all() and not len(in_company(points[:0]))


@pytest.mark.parametrize(("black", "blur_px"), [(0, 0), (16, 0), (0, 6)])
def test_the_black_surround_of_a_round_field_is_not_matched(scene, black, blur_px):
    """Its rim is at the same place in both images, also where it is blurred, or black is not 0."""
    field = np.zeros(scene.left.shape[:2], np.uint8)
    cv2.circle(field, (320, 180), 150, 255, -1)
    field = cv2.GaussianBlur(field, (0, 0), blur_px) if blur_px else field
    share = field[:, :, None] / 255
    rng = np.random.default_rng(0)
    pair = (black + share * image * (1 - black / 255) + rng.normal(0, 1, image.shape) for image in (scene.left, scene.right))
    pair = [np.clip(image, 0, 255).astype(np.uint8) for image in pair]
    found = reconstruct(*pair, scene.rig, setting="fast", u_landmarks=scene.u_tool, control=(14, 10))
    assert found.mask_left[field < 10].all() and found.mask_left[field > 250].mean() < 0.3
    error = evaluation.surface_error_mm(found.surface, scene.truth, *lattice())
    assert np.nanmax(np.abs(error[~found.mask_left[np.ix_(*lattice()[::-1])]])) < 0.5


def test_noise_is_refused(scene):
    rng = np.random.default_rng(0)
    for sd in (10, 40):
        pair = [np.clip(rng.normal(60, sd, (360, 640, 3)), 0, 255).astype(np.uint8) for _ in range(2)]
        with pytest.raises(ValueError, match="left, right: 0 matches|rig: it does not fit"):
            reconstruct(*pair, scene.rig)


@pytest.mark.parametrize("side", ["left", "right"])
def test_an_overexposed_image_is_named(scene, side):
    images = {"left": scene.left, "right": scene.right, side: np.full_like(scene.left, 255)}
    with pytest.raises(ValueError, match=f"{side}: the whole image is saturated"):
        reconstruct(**images, rig=scene.rig)


def test_black_images_and_full_masks_are_refused(scene):
    black = np.zeros_like(scene.left)
    with pytest.raises(ValueError, match=r"left, right|u:|texture"):
        reconstruct(black, black, scene.rig)
    with pytest.raises(ValueError, match="mask_left"):
        reconstruct(scene.left, scene.right, scene.rig, mask_left=np.ones(black.shape[:2], dtype=bool))


def test_the_left_image_twice_is_refused():
    """Two identical images and a true rig: they cannot both be right, and the error says by how much."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    left = recording.frames[0].left
    with pytest.raises(ValueError, match=r"rig: it does not fit the images: .* epipolar lines is 17\.\d px"):
        reconstruct(left, left, recording.truth.rig)


def window(x: int, y: int, size: int) -> np.ndarray:
    """A mask (360, 640) of everything but a square."""
    mask = np.ones((360, 640), dtype=bool)
    mask[y : y + size, x : x + size] = False
    return mask


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"mask_left": window(300, 160, 40)}, "left, right: .* matches lie on their epipolar lines; 100 are needed"),
        ({"mask_left": np.ones((5, 5), dtype=bool)}, "mask_left: expected a bool array"),
        ({"mask_right": np.zeros((360, 640))}, "mask_right: expected a bool array"),
        ({"setting": "best"}, "setting"),
        ({"right": np.zeros((360, 640, 3), np.uint8)}, "left, right: 0 matches .* does the rig fit"),
        ({"rig": "off its lines"}, r"rig: it does not fit the images: .* px, .* px are allowed"),
    ],
)
def test_bad_input_is_named(scene, change, named):
    moved = AffineCamera(scene.rig.right.matrix + np.array([[0, 0, 0, 0], [0, 0, 0, 15.0]]))
    arguments = {"left": scene.left, "right": scene.right, "rig": scene.rig} | change
    if arguments["rig"] == "off its lines":
        arguments["rig"] = StereoRig(scene.rig.left, moved)
    with pytest.raises(ValueError, match=named):
        reconstruct(**arguments)


def test_a_calibration_is_brought_to_agree_with_the_matches(scene, result):
    seen = simulate_correspondences(75, rng=np.random.default_rng(4), rig=scene.rig, sigma_u_px=1.0)
    calibration = calibrate(seen.x_mm, [seen.u_left, seen.u_right])
    found = reconstruct(scene.left, scene.right, calibration, u_landmarks=scene.u_tool, control=(14, 10))
    assert list(found.seconds) == ["mask", "refine", "match", "triangulate", "surface"]
    exact = scene.rig.project(result.surface(result.matches.u_left))
    before, after = (np.abs(rig.epipolar_distance(*exact)).mean() for rig in (calibration.rig, found.rig))
    assert after < 0.5 * before
    assert result.rig is scene.rig


def test_refinement_is_a_named_option_and_nothing_else_depends_on_the_type(scene):
    seen = simulate_correspondences(75, rng=np.random.default_rng(4), rig=scene.rig, sigma_u_px=1.0)
    calibration = calibrate(seen.x_mm, [seen.u_left, seen.u_right])
    options = {"setting": "fast", "control": (10, 8), "smoothness": 1e4, "percentiles": (1, 99)}
    one = reconstruct(scene.left, scene.right, calibration, refine=False, **options)
    other = reconstruct(scene.left, scene.right, calibration.rig, **options)
    np.testing.assert_array_equal(one.surface.control_points_mm, other.surface.control_points_mm)
    assert one.surface.grid.domain == tuple(np.percentile(one.u, (1, 99), axis=0).ravel())
    with pytest.raises(ValueError, match="refine: needs the covariance"):
        reconstruct(scene.left, scene.right, calibration.rig, refine=True)
    with pytest.raises(ValueError, match="percentiles: expected"):
        reconstruct(scene.left, scene.right, calibration.rig, percentiles=(99, 1))


def test_after_an_error_the_last_stage_is_the_one_that_failed(scene):
    seconds = {"detect": 0.1, "mask": 9.0}
    with pytest.raises(ValueError):
        reconstruct(scene.left, np.zeros_like(scene.left), scene.rig, seconds=seconds)
    assert list(seconds) == ["detect", "mask", "match", "triangulate", "surface"] and seconds["mask"] < 9.0


def test_what_an_alignment_takes_out():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(20, 30, 3))
    turned = RigidTransform.from_rotation_vector((0.02, -0.01, 0.03), (0.1, 0.0, -0.2)).apply(truth.reshape(-1, 3))
    rms = evaluation.aligned_rms_um(turned.reshape(truth.shape) - truth, truth)
    assert rms["robot frame"] > 100 and rms["rigid"] < 1e-6 and rms["affine"] < 1e-6
    rms = evaluation.aligned_rms_um(0.01 * truth * (1, 2, 0), truth)
    assert rms["rigid"] > 1 and rms["affine"] < 1e-6
    noise = 0.005 * rng.normal(size=truth.shape)
    noise[0, 0] = np.nan
    rms = evaluation.aligned_rms_um(noise, truth)
    assert rms["affine"] == pytest.approx(rms["robot frame"], rel=0.05) == pytest.approx(5 * np.sqrt(3), rel=0.1)
    assert np.isnan(evaluation.aligned_rms_um(noise, truth, np.zeros((20, 30), dtype=bool))["rigid"])


def test_simulated_scenes_are_reconstructed_and_judged():
    import matplotlib.pyplot as plt

    from notebooks.figures import reconstruction as figures

    found = []
    for pair in (next(evaluation.eyes(shrink=4)), next(evaluation.objects(shrink=4))):
        one = evaluation.case(pair, control=(12, 8), smoothness=1e4)
        u = np.array([[100.0, 60.0], [400.0, 200.0]])
        assert np.abs(pair.rig.left.project(pair.truth(u)) - u).max() < 0.01
        assert np.nanmedian(np.linalg.norm(one.error_mm, axis=2)) < 0.1
        found.append(one)
    assert found[0].rms_um < 0.7 * found[0].sphere_rms_um and np.isnan(found[1].sphere_rms_um)
    wrong = evaluation.wrong_matches(found[0].found.matches, found[0].pair.truth, found[0].pair.rig)
    assert np.nanmean(wrong) < 0.1
    page = figures.cases(found)
    page.canvas.draw()
    plt.close(page)
    assert found[0].pair.name in figures.case_table(found, "Errors.").data


def test_error_measures():
    grid = SplineGrid((0, 0, 100, 80), (4, 4))
    plane = BSplineSurface(grid, np.dstack([grid.sites / 100, np.zeros((4, 4))]))
    shifted = lambda u: np.column_stack([u / 100, np.full(len(u), -0.003)])  # noqa: E731
    error = evaluation.surface_error_mm(plane, shifted, np.arange(0, 120, 10), np.arange(0, 90, 10))
    assert error.shape == (9, 12, 3) and np.isnan(error[0, 11]).all()
    assert evaluation.rms_um(error) == pytest.approx(3.0)
    assert np.isnan(evaluation.rms_um(error, np.zeros(error.shape[:2], dtype=bool)))


def test_recorded_studies_are_tabled():
    from notebooks.figures import reconstruction as figures

    names = ("surfaces", "calibrated_surfaces", "l1_solver", "reconstruction_speed", "matching")
    recorded = {name: results.read(name) for name in names}
    assert all(table.provenance["command"] for table in recorded.values())
    table = figures.recorded_speeds(recorded, "Speeds.").data
    timed = sum(bool(row["width_px"] and np.isfinite(row["all_median_px"])) for row in recorded["matching"].rows)
    assert table.count("<tr") == 1 + timed + sum(len(recorded[k]) for k in ("l1_solver", "reconstruction_speed"))
    empty = figures.recorded_errors({}, "Errors."), figures.recorded_speeds({}, "Speeds.")
    assert not any("<td" in page.data for page in empty)
    assert figures.recorded_errors(recorded, "Errors.").data.count("<tr") > 1


def test_every_figure_draws(scene, result):
    import matplotlib.pyplot as plt

    from notebooks.figures import reconstruction as figures

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
        figures.sparsification({"eye": {"score": (0.9, np.linspace(0, 0.1, 5))}}, np.linspace(0.2, 1, 5)),
    ]
    for page in pages:
        page.set_dpi(30)  # pixels take time, and nobody looks at them
        page.canvas.draw()
        labels = {axes.get_ylabel(): axes.yaxis.label.get_window_extent() for axes in page.axes if axes.get_ylabel()}
        cut_off = [text for text, box in labels.items() if box.y0 < 0 or box.y1 > page.bbox.height]
        assert not cut_off
        plt.close(page)
    from notebooks.figures import interactive

    mesh = surface_mesh(surface, step_px=40, image=scene.left)
    tool = rig.left.viewing_direction * np.array([[-3.0], [-1.0], [-1.0]]) + surface(np.array([[200.0, 100.0]]))
    view = figures.scene_view(mesh, rig, tool, surface.distance(tool, rig.left), 20.0)
    assert len(view.data[0].x) == len(mesh.vertices_mm) and len(view.data[0].i) == len(mesh.faces)
    assert {"shaft", "jaw to tip_1", "ray of the left camera"} <= {line.name for line in view.data}
    (axes,) = interactive.still(view).axes
    assert len(axes.collections[0].get_paths()) == len(mesh.faces) and len(axes.lines) == len(view.data) - 1
    plt.close("all")


def test_real_pairs_are_scored_beside_each_other():
    folder = real_data.folder("stereo_pairs")
    if folder is None:
        pytest.skip(real_data.missing_line("stereo_pairs"))
    import matplotlib.pyplot as plt

    from notebooks.figures import reconstruction as figures

    pair = evaluation.real_pair(folder / "cones")
    found = evaluation.compare_matchers(pair, {"band": {"method": "band"}, "SGBM": {"method": "sgbm"}})
    for matches, score, _ in found.values():
        assert 1000 < score.n <= len(matches)
        assert score.median_px < 0.3 and score.above_2 < 0.09
    errors = {name: (score.u_left, score.error_px) for name, (_, score, _) in found.items()}
    for page in (
        figures.disparity_errors(pair.left, pair.disparity_px, errors),
    ):
        page.canvas.draw()
        plt.close(page)
    assert "SGBM" in figures.score_table({"cones": found}, "Errors.").data


def test_real_pair_files_are_checked(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"left\.png"):
        evaluation.real_pair(tmp_path)


@pytest.mark.parametrize("noise", [0.0, 14.0])
def test_points_scatter_as_their_covariances_state_also_in_images_that_the_matcher_does_not_know(scene, noise):
    rng = np.random.default_rng(5)
    views = (cv2.GaussianBlur(image, (0, 0), 1.5) if noise else image for image in (scene.left, scene.right))
    left, right = (np.clip(image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8) for image in views)
    found = reconstruct(left, right, scene.rig, u_landmarks=scene.u_tool, control=(10, 7))
    view, rig = scene.rig.left.viewing_direction, scene.rig
    of_matches = rig.triangulate(found.matches.u_left, found.matches.u_right, found.matches.covariance_px2)
    sd = [np.sqrt(np.einsum("i,nij,j->n", view, one.covariance_mm2, view)) for one in (found.points, of_matches)]
    off = np.abs((found.points.x_mm - scene.truth(found.u)) @ view)
    stated, matches = (1.4826 * float(np.nanmedian(off / one)) for one in sd)
    assert 0.7 < stated < 1.5 and (not noise or matches > 1.1 * stated)
