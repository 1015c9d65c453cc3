"""The families that training, validation and tests draw from, kept apart; what a camera and a light do to landmarks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lib.geometry import RigidTransform
from lib.simulator import Microscope, Pose, render_view, simulate
from lib.simulator.dataset import rung_design
from lib.simulator.eye import Ground
from lib.simulator.families import ASPECTS, FAR, SHIFTED, TOOLS, TRAINING, random_object
from lib.simulator.lighting import Lighting, Patch
from lib.simulator.population import POPULATIONS, random_setup, sample
from lib.simulator.video import Video
from lib.simulator.window import Window

SMALL = {"size_px": (160, 90)}
PLAIN = Microscope(depth_of_field_mm=float("inf"), full_well=float("inf"), readout_s=0.0, jpeg_quality=None)
CAMERA = PLAIN.rig(RigidTransform.identity()).left


@pytest.fixture(autouse=True)
def small_textures(monkeypatch):
    monkeypatch.setattr("lib.simulator.texture._SIDE_PX", 96)
    monkeypatch.setattr("lib.simulator.eye._FUNDUS_PX", 96)
    monkeypatch.setattr("lib.simulator.population._TEXTURE_PX", 96)


@pytest.mark.parametrize("population", [*POPULATIONS, *FAR])
def test_each_population_gives_images_and_the_same_ones_again(population):
    options = {"population": population, "textures": range(10_000, 10_002)}
    for size in (SMALL, {"crop_px": 64}):
        image, u, visibility = sample(np.random.default_rng(3), **size, **options)
        again = sample(np.random.default_rng(3), **size, **options)
        shape = (64, 64) if "crop_px" in size else (90, 160)
        assert image.shape == (*shape, 3) and image.dtype == np.uint8 and u.shape == (3, 2)
        assert_array_equal(image, again[0])
        inside = ((u > -0.5) & (u < np.array(shape[::-1]) - 0.5)).all(axis=1)
        assert_array_equal(visibility > 0, inside)
        assert np.isnan(u).all() if population == "empty" else np.isfinite(u).all()


def drawn(population: str, n: int, **options: object) -> list[dict[str, str]]:
    rng = np.random.default_rng(0)
    return [random_setup(rng, population, textures=range(10_000, 10_001), **options).families for _ in range(n)]


def test_training_validation_and_far_families_are_kept_apart():
    names = {aspect: [set(part[aspect]) for part in (TRAINING, SHIFTED)] for aspect in ASPECTS}
    assert not any(training & shifted for training, shifted in names.values())
    assert not {*FAR} & {name for parts in names.values() for part in parts for name in part}
    training = drawn("training", 60)
    assert all(families[aspect] in TRAINING[aspect] for families in training for aspect in ASPECTS)
    for families in drawn("validation", 20):
        assert any(families[aspect] in SHIFTED[aspect] for aspect in ASPECTS)
        assert not {*families.values()} & {*FAR}
    for family, replaced in FAR.items():
        for families in drawn(family, 3):
            assert {aspect for aspect in ASPECTS if families[aspect] == family} == {*replaced}


def test_a_family_can_be_left_out_and_wrong_names_are_told():
    left_out = ("looped_jaws", "pupil", "fundus", "clean", "grey")
    assert not {*left_out} & {name for families in drawn("validation", 60, without=left_out) for name in families.values()}
    for options, said in (
        ({"population": "everything"}, "population: one of training"),
        ({"without": ("angled_jaws",)}, "no such family in training: angled_jaws"),
        ({"without": tuple(TRAINING["light"])}, "no family of light"),
    ):
        with pytest.raises(ValueError, match=said):
            random_setup(np.random.default_rng(0), **({"textures": range(10_000, 10_001)} | options))


@pytest.mark.parametrize("family", sorted(TOOLS))
def test_landmarks_of_every_kind_of_tool_are_where_the_doc_says(family):
    """base on the shaft's axis where its silhouette still is; each tip on the silhouette, and the jaw's end."""
    rng = np.random.default_rng(1)
    for _ in range(2):
        tool = TOOLS[family](rng, 0.6)
        pose = Pose((-1.0, 0.0, -1.0), azimuth_rad=0.3, pitch_rad=0.0, roll_rad=0.0, opening_mm=0.6 * tool.jaw_length_mm)
        window = Window.around(CAMERA, CAMERA.project(np.array([[0.0, 0.0, -1.0]]))[0], (480, 480))
        view = render_view(Ground(kind="smooth", colours=((0.2,) * 3,) * 2), PLAIN, window, forceps=tool, pose=pose)
        solid = view.tool_mask > 127
        nearest_px = cv2.distanceTransform((~solid).astype(np.uint8), cv2.DIST_L2, 5)
        for k in range(3):
            column, row = np.round(view.u[k]).astype(int)
            assert nearest_px[row, column] <= 1.5, (family, k)
        for k, jaw in enumerate(tool.jaws, start=1):  # going on along the centre line leaves the jaw
            ahead = view.u[k] - window.camera.project(tool.landmarks(pose)[:1])[0]
            beyond = view.u[k] + ahead / np.linalg.norm(ahead) * (3 + 60 * jaw.radii[-1])
            if family not in ("hooked_jaws", "asymmetric_jaws"):
                assert not solid[tuple(np.round(beyond[::-1]).astype(int))], family
        # jaw 1 lies left of the direction from base to tips
        to_1, to_2 = view.u[1:] - view.u[0]
        assert to_1[0] * to_2[1] - to_1[1] * to_2[0] > 0


def test_objects_have_no_landmarks_and_stand_beside_a_tool():
    rng = np.random.default_rng(2)
    assert np.isnan(random_object(rng, 1.0).landmarks(Pose())).all()
    tool = replace(TOOLS["needle_jaws"](rng, 1.0), others=((random_object(rng, 1.0), Pose((1.0, 1.0, -2.0))),))
    centres, radii, chains = tool.nodes(Pose())
    assert len(centres) == len(radii) == len(chains) and set(chains) >= {0, 1, 2, 3}
    alone = replace(tool, others=())
    assert_array_equal(tool.landmarks(Pose()), alone.landmarks(Pose()))


def test_what_lies_before_a_landmark_hides_it():
    tool, pose = TOOLS["plain_jaws"](np.random.default_rng(3), 1.0), Pose((-1.0, 0.0, -1.0), opening_mm=1.5)
    base, tip, _ = tool.landmarks(pose)
    window = Window.around(CAMERA, CAMERA.project(base)[0], (600, 600))

    def seen(role: str, at: np.ndarray, radius: float) -> np.ndarray:
        patch = Patch(tuple(at - [0, 0, 0.1]), (radius, radius), (0.2, 0.2, 0.2), role)
        microscope = replace(PLAIN, lighting=Lighting(patches=(patch,)))
        scene = Ground(kind="smooth", colours=((0.2,) * 3, (0.4,) * 3))
        return render_view(scene, microscope, window, forceps=tool, pose=pose).visibility

    assert_array_equal(seen("cover", tip, 0.3), [2, 1, 2])
    assert_array_equal(seen("pupil", base, 0.5), [2, 1, 1])
    assert_array_equal(seen("glare", tip, 0.3), [2, 2, 2])  # behind the tool


@pytest.mark.parametrize(
    "settings",
    [
        {}, {"defocus_px": 2.5}, {"defocus_px": 14.0}, {"sharpening": 1.5}, {"resample": 1.7}, {"chroma": 4},
        {"mosaic": True}, {"field_shift_px": 2.0}, {"quality": 80}, {"fringe_px": 2.0},
        {"defocus_px": 2.0, "astigmatism": 2.0}, {"colours": ((0, 1, 0), (0, 0, 1), (1, 0, 0))},
        {"gamma": 1.4, "contrast": 0.8, "black": 0.1},
    ],
)  # fmt: skip
def test_a_camera_does_not_move_what_it_shows(settings):
    y, x = np.mgrid[:97, :129]
    at = np.array([63.3, 47.8])
    blob = 40 + 160 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 6.0**2))
    image = np.uint8(np.round(blob))[..., None].repeat(3, 2)
    shown = Video(**settings)(image, None)
    assert shown.shape == image.shape and shown.dtype == np.uint8
    if not settings:
        assert_array_equal(shown, image)
    value = shown.astype(float).mean(axis=2)
    weight = np.clip(value - np.median(value) - 12, 0, None)
    found = [(weight * axis).sum() / weight.sum() for axis in (x, y)]
    assert_allclose(found, at, atol=0.12)


@pytest.mark.parametrize("rung", ["near", "all_far", "validation"])
def test_rungs_have_stereo_recordings_with_truth(rung, tmp_path):
    design = rung_design(rung, 1, shrink=12)
    still = replace(design.microscope, readout_s=0.0)  # else the rows of a moving tool differ
    design = replace(design, microscope=still, duration_s=3.0, motion="sweep")
    recording = simulate(tmp_path / rung, design, seed=1, n_frames=2, progress=False)
    truth = recording.truth
    u_left, u_right = truth.rig.project(truth.landmarks_mm.reshape(-1, 3))
    assert_allclose(np.stack([truth.u_left, truth.u_right]).reshape(-1, 2), np.vstack([u_left, u_right]), atol=1e-3)
    assert np.isfinite(recording.kinematics.x_mm).any() and recording.frames[0].left.std() > 2
    assert repr(rung_design(rung, 1).microscope) != repr(rung_design(rung, 2).microscope)


def test_photographs_are_the_ground_of_some_scenes_and_change_no_others(tmp_path):
    photograph = tmp_path / "red.png"
    cv2.imwrite(str(photograph), np.full((40, 60, 3), (20, 30, 200), np.uint8))
    shown = []
    for seed in range(30):
        setup = random_setup(np.random.default_rng(seed), photographs=[photograph])
        plain = random_setup(np.random.default_rng(seed))
        shown.append(setup.scene.texture_path is not None)
        if shown[-1]:
            assert (setup.scene.texture == (200, 30, 20)).all()
        assert plain.scene.texture_path is None and plain.scene.seed == setup.scene.seed
    assert 4 <= sum(shown) <= 20
