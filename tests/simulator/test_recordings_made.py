"""Recordings, training images and bad parameters."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lib.geometry import RigidTransform
from lib.recordings import Recording
from lib.simulator import Design, Eye, Forceps, Microscope, Motion, Pose, render_pair, simulate
from lib.simulator import recording as recording_module
from lib.simulator.lighting import Lighting
from lib.simulator.population import RESERVED_JAW_MM, RESERVED_SEEDS, TEXTURE_SEEDS, random_forceps, sample
from notebooks.studies.realism import STATISTICS, image_statistics, landmark_window
from notebooks.studies.scenes import Checkerboard, Relief

SMALL = Microscope(pixels_per_mm=(17.0, 16.5), image_size_px=(320, 180), readout_s=0.0)
EYE = Eye(seed=5, texture_px=256)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated") / "made"
    design = Design(EYE, microscope=SMALL, duration_s=8.0, offset_s=0.03, dropout=0.2)
    return simulate(folder, design, seed=4, n_frames=5, progress=False)


def test_a_recording_agrees_with_its_truth(made):
    truth = made.truth
    u_left, u_right = truth.rig.project(truth.landmarks_mm.reshape(-1, 3))
    assert_allclose(truth.u_left.reshape(-1, 2), u_left, atol=1e-3)
    assert_allclose(truth.u_right.reshape(-1, 2), u_right, atol=1e-3)
    labelled = made.annotations.visibility_left == 2
    assert labelled.mean() > 0.5
    assert np.abs(made.annotations.u_left - truth.u_left)[labelled].max() < 5


def test_truth_says_which_landmarks_saturated_light_touches(tmp_path, monkeypatch):
    """Against the images on disk and the renderer's masks; a recording without these columns opens, too."""
    pairs, options = [], {"seed": 6, "n_frames": 6, "progress": False}
    render = recording_module.render_pair
    monkeypatch.setattr(recording_module, "render_pair", lambda *a, **k: pairs.append(render(*a, **k)) or pairs[-1])
    bright = replace(SMALL, brightness=1.6, jpeg_quality=None)
    design = Design(replace(EYE, gloss=2.0), microscope=bright, motion="surgeon", duration_s=4.0)
    recording = simulate(tmp_path / "bright", design, **options)
    truth = recording.truth
    for number, side in enumerate(("left", "right")):
        u, visibility, told = (getattr(truth, f"{name}_{side}") for name in ("u", "visibility", "in_glint"))
        assert told.dtype == bool and told.shape == (6, 3)
        for k, frame in enumerate(recording.frames):
            glints = pairs[k][number].glint_mask
            for landmark in range(3):
                x, y = np.round(u[k, landmark]).astype(int)
                if not visibility[k, landmark] or not (3 <= x < 317 and 3 <= y < 177):
                    continue
                near = np.s_[y - 3 : y + 4, x - 3 : x + 4]
                bright_channels = (getattr(frame, side)[near] >= 250).sum(axis=2)
                assert told[k, landmark] == ((bright_channels >= 2).any() or glints[near].any())
    assert 0 < np.mean([truth.in_glint_left, truth.in_glint_right]) < 1
    matt = replace(design, eye=replace(EYE, gloss=0.0), microscope=replace(SMALL, brightness=0.2))
    dim = simulate(tmp_path / "dim", matt, **(options | {"n_frames": 2}))
    assert not dim.truth.in_glint_left.any()
    table = dim.truth.folder / "landmarks.csv"
    table.write_text("\n".join(",".join(line.split(",")[:28]) for line in table.read_text().splitlines()) + "\n")
    assert Recording.open(dim.folder).truth.in_glint_left is None


def test_kinematics_have_noise_drop_outs_and_the_clock_offset(made):
    missing = np.isnan(made.kinematics.x_mm).all(axis=(1, 2)).mean()
    assert 0.1 < missing < 0.3
    at_frames = made.landmarks_mm()
    seen = np.isfinite(at_frames)
    assert seen.any()
    # Ten micrometres, and what interpolation across drop-outs adds.
    assert np.abs(at_frames - made.truth.landmarks_mm)[seen].max() < 0.25
    assert_allclose(made.kinematics.time_s[0] - made.offset_s, -0.05, atol=1e-6)


def test_surface_truth_is_seen_at_its_pixels(made):
    u = np.array([[100.0, 80.0], [200.3, 120.7], [160.0, 90.0]])
    assert_allclose(made.truth.rig.left.project(made.truth.surface(u)), u, atol=0.01)


def test_the_same_seed_gives_the_same_files(made, tmp_path):
    design = Design(EYE, microscope=SMALL, motion="surgeon", duration_s=2.0)
    folders = [
        simulate(tmp_path / folder, design, seed=seed, name="r", n_frames=1, progress=False).folder
        for folder, seed in (("a", 1), ("b", 1), ("c", 2))
    ]
    files = [{p.relative_to(f): p.read_bytes() for p in sorted(f.rglob("*.[jc]*")) if p.is_file()} for f in folders]
    assert files[0] == files[1]
    assert files[0] != files[2]


def test_sweep_covers_a_volume_and_never_touches_the_retina():
    forceps = Forceps()
    motion = Motion(forceps, EYE, kind="sweep", seed=1)
    x = np.array([forceps.landmarks(motion.pose(t)) for t in np.linspace(0, 30, 200)])
    assert (np.ptp(x[:, 1:].reshape(-1, 3), axis=0) > [10, 5, 1.5]).all()
    tips = x[:, 1:].reshape(-1, 3)
    assert (EYE.height(tips[:, 0], tips[:, 1]) - tips[:, 2] > 0.1).all()


def test_tremor_is_physiological():
    forceps = Forceps()
    still = Motion(forceps, EYE, kind="surgeon", seed=3, tremor_mm=0.0)
    shaky = Motion(forceps, EYE, kind="surgeon", seed=3, tremor_mm=0.15)
    time = np.arange(0, 4, 1 / 200)
    tremor = np.array([np.subtract(shaky.pose(t).base_mm, still.pose(t).base_mm) for t in time])
    assert 0.1 < np.ptp(tremor[:, 0]) < 0.2
    spectrum = np.abs(np.fft.rfft(tremor[:, 0] * np.hanning(len(time)))) ** 2
    frequency = np.fft.rfftfreq(len(time), 1 / 200)
    assert spectrum[(frequency > 7.5) & (frequency < 12.5)].sum() > 0.99 * spectrum.sum()


@pytest.mark.parametrize("size", [{"crop_px": 160}, {"size_px": (240, 135)}, {"size_px": (160, 120)}])
def test_training_images(size, monkeypatch):
    monkeypatch.setattr("lib.simulator.population._TEXTURE_PX", 256)
    options = size | {"textures": range(10_000, 10_001), "population": "near"}
    image, u, visibility = sample(np.random.default_rng(1), **options)
    again = sample(np.random.default_rng(1), **options)
    shape = (size["crop_px"],) * 2 if "crop_px" in size else size["size_px"][::-1]
    assert image.shape == (*shape, 3) and image.dtype == np.uint8 and image.std() > 5
    assert u.shape == (3, 2) and visibility.shape == (3,) and np.isfinite(u).all()
    inside = ((u > -0.5) & (u < np.array(shape[::-1]) - 0.5)).all(axis=1)
    assert_array_equal(visibility > 0, inside)
    assert_array_equal(image, again[0])


def test_training_windows_hold_the_landmark_asked_for(monkeypatch):
    monkeypatch.setattr("lib.simulator.population._TEXTURE_PX", 256)
    # Far from the field's border, beyond which no window reaches.
    monkeypatch.setattr("lib.simulator.population.random_pose", lambda *_: Pose(azimuth_rad=0.7))
    rng = np.random.default_rng(2)
    for around in (0, 1, 2):
        window = {"crop_px": 160, "around": around, "jitter": 0.0}
        _, u, _ = sample(rng, textures=range(10_000, 10_001), population="near", **window)
        assert np.abs(u[around] - 79.5).max() <= 0.5


def test_training_never_draws_what_test_recordings_show():
    rng = np.random.default_rng(0)
    lengths = np.array([random_forceps(rng).jaw_length_mm for _ in range(2000)])
    assert not ((lengths > RESERVED_JAW_MM[0]) & (lengths < RESERVED_JAW_MM[1])).any()
    assert lengths.min() >= 2 and lengths.max() <= 4
    assert not set(TEXTURE_SEEDS) & set(RESERVED_SEEDS)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Eye(radius_mm=-1), "radius_mm"),
        (lambda: Eye(depth_mm=20), "depth_mm"),
        (lambda: Forceps(shaft_radius_mm=-0.3), "shaft_radius_mm"),
        (lambda: Forceps(jaw_radius_mm=0.5), "jaw_radius_mm"),
        (lambda: Forceps(tip_radius_mm=0.05), "tip_radius_mm"),
        (lambda: Microscope(depth_of_field_mm=0), "depth_of_field_mm"),
        (lambda: Microscope(pixels_per_mm=(0, 100)), "pixels_per_mm"),
        (lambda: Microscope(full_well=0), "full_well"),
        (lambda: Microscope(jpeg_quality=101), "jpeg_quality"),
        (lambda: Microscope(inverse_distance_per_mm=0.2), "working distance"),
        (lambda: Microscope(focus_z_mm=np.nan), "focus_z_mm"),
        (lambda: Microscope(gain=((1.0, np.nan, 1.0), (1.0, 1.0, 1.0))), "gain"),
        (lambda: Lighting(haze=(0.0, np.nan, 0.0)), "haze"),
        (lambda: Pose(azimuth_rad=np.nan), "azimuth_rad"),
        (lambda: Pose(roll_rad=2.0), "roll_rad"),
        (lambda: Pose(pitch_rad=-0.1), "pitch_rad"),
        (lambda: Pose(base_mm=(0, 0, np.nan)), "base_mm"),
        (lambda: Relief("piano"), "screw"),
        (lambda: Checkerboard(square_mm=0), "square_mm"),
        (lambda: Checkerboard(RigidTransform.from_rotation_vector((1.5, 0, 0))), "edge"),
        (lambda: Motion(Forceps(), EYE, kind="waltz"), "sweep, surgeon, both"),
        (lambda: Motion(Forceps(), EYE, duration_s=0), "duration_s"),
        (lambda: render_pair(EYE, SMALL, forceps=Forceps(), pose=Pose((50.0, 0.0, 0.0))), "outside the field"),
        (lambda: simulate("x", n_frames=0), "n_frames"),
        (lambda: simulate("x", Design(EYE, duration_s=1.0), n_frames=27), "27 at 25 Hz last longer than the motion's 1 s"),
        (lambda: Design(dropout=1.0), "dropout"),
        (lambda: Design(click_px=-1.0), "click_px"),
        (lambda: Microscope(fps=0.0), "fps"),
        (lambda: sample(np.random.default_rng(0), crop_px=64, size_px=(64, 64)), "give one"),
        (lambda: image_statistics(np.zeros((8, 8, 3), np.uint8)), "image"),
    ],
)
def test_bad_parameters_are_named(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_missing_photograph_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no\.jpg"):
        render_pair(Eye(texture_path=tmp_path / "no.jpg"), SMALL)


def test_image_statistics_of_known_images():
    rng = np.random.default_rng(0)
    noise = np.repeat(rng.normal(128, 20, (96, 96, 1)).clip(0, 255).astype(np.uint8), 3, axis=2)
    statistics = image_statistics(noise)
    assert set(statistics) == set(STATISTICS)
    assert_allclose(statistics["luminance_mean"], 0.5, atol=0.01)
    assert_allclose(statistics["luminance_std"], 20 / 255, rtol=0.05)
    assert abs(statistics["spectrum_slope"]) < 0.5  # white
    assert abs(statistics["gradient_kurtosis"]) < 0.3  # Gaussian
    assert_allclose(statistics["red_over_green"], 1.0, atol=1e-6)
    window = landmark_window(noise, np.array([[0.0, 0.0], [np.nan, np.nan], [4.0, 2.0]]), 48)
    assert window.shape == (48, 48, 3)
