"""The one interface of all matchers: accuracy on a known affine pair, masks, bad input."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.matching import RECTIFIED, Matches, glint_mask, match
from lib.matching.band import MAX_PIXELS
from lib.simulator.rig import reference_rig
from notebooks.studies.matching_evaluation import detection_auc


def shifted(image: np.ndarray, pixels: int) -> np.ndarray:
    """The right image of a fronto-parallel plane: x_right = x_left - pixels."""
    return np.roll(image, -pixels, axis=1)


@pytest.mark.parametrize(
    ("method", "median_px", "above_2"),
    [(None, 0.15, 0.02), ("band", 0.15, 0.02), ("sgbm", 0.35, 0.03), ("dis", 0.35, 0.06)],
)
def test_matchers_find_the_surface_of_an_affine_pair(affine_pair, method, median_px, above_2):
    matches = match(affine_pair.left, affine_pair.right, method=method, rig=affine_pair.rig)
    along, off = affine_pair.errors_px(matches)
    lattice = 80 * 45
    assert len(matches) > 0.8 * lattice
    assert np.median(np.abs(along)) < median_px
    assert np.mean(np.abs(along) > 2) < above_2
    assert np.median(np.abs(off)) < 0.5
    assert matches.covariance_px2.shape == (len(matches), 4, 4)
    assert (np.linalg.eigvalsh(matches.covariance_px2) > 0).all()
    assert ((matches.score >= 0) & (matches.score <= 1)).all()
    assert matches.epipolar_px < 0.5


def test_band_is_unbiased_and_its_covariance_is_calibrated(affine_pair):
    matches = match(affine_pair.left, affine_pair.right, rig=affine_pair.rig)
    error = matches.u_right - affine_pair.rig.right.project(affine_pair.surface(matches.u_left))
    along, _ = affine_pair.errors_px(matches)
    assert abs(np.median(along)) < 0.02
    whitened = np.linalg.solve(np.linalg.cholesky(matches.covariance_px2[:, 2:, 2:]), error[:, :, None])[:, :, 0]
    robust = np.median(np.abs(whitened), axis=0) / 0.6745
    assert ((robust > 0.7) & (robust < 1.4)).all()
    # And it tells the good from the bad: the surer half is clearly better.
    sure = matches.score > np.median(matches.score)
    assert np.median(np.abs(along[sure])) < 0.8 * np.median(np.abs(along[~sure]))


def test_fast_setting_shrinks_large_images(affine_pair):
    large = [np.kron(image, np.ones((3, 3), np.uint8)) for image in (affine_pair.left, affine_pair.right)]
    scaled = StereoRig(
        *(
            AffineCamera(np.column_stack([3 * camera.linear, 3 * camera.offset_px + 1]))
            for camera in (affine_pair.rig.left, affine_pair.rig.right)
        )
    )
    matches = match(*large, rig=scaled, setting="fast")
    along = matches.u_right - scaled.right.project(affine_pair.surface((matches.u_left - 1) / 3))
    assert np.median(np.abs(along)) < 0.6
    assert len(matches) > 0.65 * 400_000 / 8**2


@pytest.mark.parametrize("method", ["band", "sgbm", "dis"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_eyes_of_unlike_gain_and_stray_light_match(affine_pair, method, side):
    images = {"left": affine_pair.left, "right": affine_pair.right}
    alike = match(**images, method=method, rig=affine_pair.rig)
    images[side] = (0.4 * images[side] + 90).astype(np.uint8)
    found = match(**images, method=method, rig=affine_pair.rig)
    errors_px = [np.abs(affine_pair.errors_px(one)[0]) for one in (alike, found)]
    assert len(found) > 0.95 * len(alike)
    assert np.median(errors_px[1]) < 1.3 * np.median(errors_px[0])
    assert (errors_px[1] > 2).mean() < (errors_px[0] > 2).mean() + 0.01


def test_noisy_images_are_searched_on_a_coarser_canvas(affine_pair):
    """There more patches match, and better."""
    rng = np.random.default_rng(0)
    large = [np.kron(image, np.ones((2, 2))) for image in (affine_pair.left, affine_pair.right)]
    noisy = [(image + rng.normal(0, 60, image.shape)).clip(0, 255).astype(np.uint8) for image in large]
    cameras = affine_pair.rig.left, affine_pair.rig.right
    rig = StereoRig(*(AffineCamera(np.column_stack([2 * one.linear, 2 * one.offset_px + 0.5])) for one in cameras))
    errors_px = {}
    for name, canvases in (("all", (3_000_000, 400_000)), ("fine", (3_000_000,))):
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(MAX_PIXELS, "quality", canvases)
            found = match(*noisy, rig=rig)
        half = replace(found, u_left=(found.u_left - 0.5) / 2, u_right=(found.u_right - 0.5) / 2)
        errors_px[name] = np.abs(affine_pair.errors_px(half)[0])
    assert len(errors_px["all"]) > 2 * len(errors_px["fine"])
    assert (errors_px["all"] > 2).mean() < 0.5 * (errors_px["fine"] > 2).mean()


def test_depth_range_limits_the_search(affine_pair):
    rig = affine_pair.rig
    depth = affine_pair.surface(match(affine_pair.left, affine_pair.right, rig=rig).u_left) @ rig.left.viewing_direction
    whole = (depth.min() - 0.1, depth.max() + 0.1)
    found = match(affine_pair.left, affine_pair.right, rig=rig, depth_range_mm=whole)
    along, _ = affine_pair.errors_px(found)
    assert np.median(np.abs(along)) < 0.15
    wrong = match(affine_pair.left, affine_pair.right, rig=rig, depth_range_mm=(depth.max() + 1, depth.max() + 2))
    along, _ = affine_pair.errors_px(wrong)
    assert len(wrong) < 0.2 * len(found) and np.mean(np.abs(along) < 2) < 0.05
    with pytest.raises(ValueError, match="depth_range_mm: nothing from 500 to 600 mm"):
        match(affine_pair.left, affine_pair.right, rig=rig, depth_range_mm=(500, 600))
    with pytest.raises(ValueError, match=r"budget_bytes: \d+ displacements"):
        match(affine_pair.left, affine_pair.right, rig=rig, depth_range_mm=(-1e3, 1e3), budget_bytes=1 << 24)


def test_works_in_any_robot_frame_and_on_rgb(affine_pair):
    robot = RigidTransform.from_rotation_vector((0.4, 2.6, -0.3), (12.0, -7.0, 35.0))
    rig = reference_rig(robot_from_microscope=robot, image_size_px=(640, 360))
    colour = [np.repeat(image[:, :, None], 3, axis=2) for image in (affine_pair.left, affine_pair.right)]
    matches = match(*colour, rig=rig)
    assert len(matches) > 0.8 * 80 * 45
    assert np.median(np.abs(affine_pair.errors_px(matches)[0])) < 0.15


@pytest.mark.parametrize("method", ["band", "deepmatching", "sgbm", "dis"])
def test_masks_mean_ignore(textured, method):
    mask = np.zeros(textured.shape, bool)
    mask[40:90, 50:110] = True
    free = match(textured, textured, method=method, rig=RECTIFIED)
    matches = match(textured, textured, method=method, rig=RECTIFIED, mask_left=mask, mask_right=mask)
    assert 0.6 * len(free) < len(matches) < len(free)
    for u in (matches.u_left, matches.u_right):
        x, y = np.rint(u).astype(int).T
        assert not ((x >= 56) & (x < 104) & (y >= 46) & (y < 84)).any()


@pytest.mark.parametrize("method", ["band", "deepmatching"])
def test_no_patch_that_matches_is_partly_masked(method):
    """Equal masks would match each other, whatever lies beside them."""
    rng = np.random.default_rng(2)
    left, right = (rng.integers(0, 255, (128, 160), dtype=np.uint8) for _ in range(2))  # they show nothing in common
    mask = np.zeros(left.shape, bool)
    mask[45:82, 53:106] = True
    where = {"depth_range_mm": (-20, 20), "max_epipolar_px": np.inf, "rig": RECTIFIED} if method == "band" else {}
    found = match(left, right, method=method, mask_left=mask, mask_right=mask, min_score=0, **where)
    beside = cv2.dilate(mask.view(np.uint8), np.ones((7, 7))).astype(bool)  # patches have 8 x 8 px
    x, y = np.rint(found.u_left).astype(int).T
    assert len(found) and not beside[y, x].any()


def test_glints_do_harm_without_a_mask_and_little_with_one(affine_pair):
    left, right = affine_pair.left.copy(), affine_pair.right.copy()
    rng = np.random.default_rng(1)
    for image in (left, right):
        for x, y in rng.uniform((40, 40), (600, 320), (12, 2)).astype(int):
            image[y - 7 : y + 7, x - 9 : x + 9] = 255
    plain = match(left, right, rig=affine_pair.rig)
    masked = match(left, right, rig=affine_pair.rig, mask_left=glint_mask(left), mask_right=glint_mask(right))
    bad = [np.mean(np.abs(affine_pair.errors_px(m)[0]) > 1) for m in (plain, masked)]
    assert bad[1] < 0.7 * bad[0]


def test_a_callable_is_a_matcher(textured):
    def block_matcher(left, right, range_px):
        assert left.dtype == np.uint8 and left.shape == right.shape
        assert range_px[0] <= 12 <= range_px[1]
        return np.full(left.shape, 12.0), np.full(left.shape, 0.7)

    matches = match(textured, shifted(textured, 12), method=block_matcher, rig=RECTIFIED)
    assert np.allclose(matches.u_left - matches.u_right, (12, 0))
    assert np.allclose(matches.score, 0.7)
    assert matches.method == "block_matcher"
    assert matches.reciprocal.all()  # it tells no way back
    assert np.median(matches.peak_ratio) > 1.03

    def checking(left, right, range_px):
        passed = np.ones(left.shape, bool)
        passed[:64] = False
        return *block_matcher(left, right, range_px), passed

    lower = match(textured, shifted(textured, 12), method=checking, rig=RECTIFIED)
    assert (lower.u_left[:, 1] > 63).all() and 0 < len(lower) < len(matches)
    every = match(textured, shifted(textured, 12), method=checking, rig=RECTIFIED, reciprocal=False)
    assert len(every) == len(matches) and np.array_equal(every.reciprocal, every.u_left[:, 1] > 63)
    with pytest.raises(ValueError, match=r"method: .* shape"):
        match(textured, textured, method=lambda left, right, range_px: (left[:5], left), rig=RECTIFIED)
    with pytest.raises(ValueError, match=r"must return \(disparity, confidence\) or .*; got 1 of the shapes \(\d+, \d+\)\.$"):
        match(textured, textured, method=lambda left, right, range_px: left, rig=RECTIFIED)


@pytest.mark.parametrize("method", ["band", "deepmatching", "sgbm", "dis"])
def test_a_repeated_pattern_has_a_peak_ratio_of_one(textured, method):
    """Tiles repeat every 32 px: a match 32 px off fits as well, and only the peak ratio can tell."""
    repeated = np.tile(textured[:, :32], (1, 5))
    options = {"method": method, "rig": RECTIFIED, "min_score": 0}
    unique = match(textured, shifted(textured, 4), **options)
    ambiguous = match(repeated, shifted(repeated, 4), depth_range_mm=(-60, 60), **options)
    assert len(unique) > 100 and len(ambiguous) > 50
    assert np.median(unique.peak_ratio) > 1.03
    assert np.median(ambiguous.peak_ratio) == pytest.approx(1.0, abs=0.012)
    assert np.mean(ambiguous.peak_ratio < 1.02) > 0.8 and np.mean(unique.peak_ratio < 1.02) < 0.3


@pytest.mark.parametrize("method", ["band", "deepmatching", "sgbm", "dis"])
def test_hidden_surfaces_have_no_way_back(method):
    """A near strip hides what lies left of it from the right camera: matches there fail the reciprocal check."""
    rng = np.random.default_rng(8)
    wall, strip = (cv2.GaussianBlur(rng.standard_normal((192, 256)).astype(np.float32), (0, 0), 1.5) for _ in range(2))
    wall, strip = (np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8) for noise in (wall, strip))
    left, right = wall.copy(), shifted(wall, 8)
    left[:, 128:192], right[:, 88:152] = strip[:, :64], strip[:, :64]  # disparity 40
    options = {"method": method, "rig": RECTIFIED, "min_score": 0, "depth_range_mm": (0, 60)}
    every = match(left, right, reciprocal=False, **options)
    hidden = (every.u_left[:, 0] > 100) & (every.u_left[:, 0] < 124)
    seen = (every.u_left[:, 0] > 196) | ((every.u_left[:, 0] > 20) & (every.u_left[:, 0] < 84))
    assert hidden.sum() > 10
    assert every.reciprocal[hidden].mean() < 0.5 < 0.75 < every.reciprocal[seen].mean()
    only = match(left, right, **options)
    assert only.reciprocal.all() and len(only) <= every.reciprocal.sum() + 2
    assert detection_auc(every.reciprocal[hidden | seen], hidden[hidden | seen]) > 0.7


@pytest.mark.parametrize("method", ["band", "deepmatching", "sgbm", "dis"])
def test_identical_images_do_not_move(textured, method):
    matches = match(textured, textured, method=method, rig=RECTIFIED)
    assert len(matches) > 0.6 * 20 * 16
    assert np.median(np.abs(matches.u_left - matches.u_right)) < 1e-6


@pytest.mark.parametrize("method", ["band", "deepmatching", "sgbm", "dis"])
@pytest.mark.parametrize("value", [0, 255])
def test_no_texture_gives_no_match(method, value):
    flat = np.full((120, 160), value, np.uint8)
    matches = match(flat, flat, method=method, rig=RECTIFIED)
    assert isinstance(matches, Matches) and len(matches) == 0
    assert np.isnan(matches.epipolar_px)


@pytest.mark.parametrize("method", ["band", "deepmatching", "sgbm", "dis"])
def test_sizes_may_differ(textured, method):
    matches = match(textured, shifted(textured, 8)[:104, :130], method=method, rig=RECTIFIED)
    assert len(matches) > 100
    assert np.median(np.abs(matches.u_left - matches.u_right - (8, 0))) < 0.1
    assert (matches.u_right[:, 0] < 130).all() and (matches.u_right[:, 1] < 104).all()


@pytest.mark.parametrize("method", ["band", "sgbm", "dis"])
@pytest.mark.parametrize(("first", "last"), [(0, 400), (100, 300), (200, 400)])
def test_a_rectified_pair_of_different_sizes_matches_at_its_true_shift(method, first, last):
    """The left image shows a part of what the right one shows: any part, so that the middles of the images differ."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (96, 620)), (0, 0), 2)
    scene = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    left, right = scene[:, 20 + first : 20 + last], scene[:, 10:610]
    for pair, shift_px in (((left, right), first + 10), ((right, left), -first - 10)):
        matches = match(*pair, method=method, rig=RECTIFIED)
        assert len(matches) > 150
        assert abs(np.median(matches.u_right[:, 0] - matches.u_left[:, 0]) - shift_px) < 0.1


@pytest.mark.parametrize("method", ["band", "sgbm", "dis", lambda left, _, range_px: (0.0 * left, 0.0 * left + 1)])
def test_images_that_do_not_belong_together_give_no_match(textured, method):
    """Nothing fits a blank image, but a dense matcher returns a disparity everywhere, with confidence."""
    blank = np.clip(np.random.default_rng(0).normal(60, 2, textured.shape), 0, 255).astype(np.uint8)
    assert not len(match(textured, blank, method=method, rig=RECTIFIED))


def test_a_texture_that_repeats_along_the_lines_is_ambiguous(textured):
    rng, options = np.random.default_rng(0), {"rig": RECTIFIED, "depth_range_mm": (-50, 50), "max_epipolar_px": np.inf}
    for period_px, share in ((40, (0.9, 1)), (160, (0, 0.1))):
        repeated = np.tile(textured[:, :period_px], 160 // period_px)
        pair = [np.clip(np.roll(repeated, shift, axis=1) + rng.normal(0, 2, repeated.shape), 0, 255) for shift in (0, 6)]
        found = match(*(image.astype(np.uint8) for image in pair), **options)
        assert share[0] <= found.ambiguous <= share[1]
        assert (len(found) > 100) == (period_px == 160)
    dark = [np.concatenate([image, rng.normal(30, 4, (3 * len(image), image.shape[1]))]).astype(np.uint8) for image in pair]
    assert match(*dark, **options).ambiguous < 0.1, "noise fits anywhere, but imprecisely"


def test_epipolar_lines_of_near_cameras_are_followed():
    """At 25 mm they deviate from the canvas's rows by up to 10 px, most of all in the corners."""
    geometry = {"image_size_px": (640, 360), "pixels_per_mm": (34, 34), "inverse_distance_per_mm": 1 / 25}
    rig = reference_rig(robot_from_microscope=RigidTransform.identity(), **geometry)
    texture = cv2.GaussianBlur(np.random.default_rng(3).standard_normal((900, 1200)).astype(np.float32), (0, 0), 2)
    texture = np.clip(128 + 40 * texture / texture.std(), 0, 255).astype(np.uint8)
    pixel_from_plane = [np.delete(camera.projection_matrix, 2, axis=1) for camera in (rig.left, rig.right)]  # z = 0
    plane_from_texture = np.array([[0.03, 0, -18], [0, 0.03, -13.5], [0, 0, 1]])
    images = [cv2.warpPerspective(texture, H @ plane_from_texture, (640, 360)) for H in pixel_from_plane]
    found = match(*images, rig=rig)
    error_mm = np.abs(rig.triangulate(found.u_left, found.u_right).x_mm[:, 2])
    corner = (np.abs(found.u_left - (320, 180)) > (240, 120)).all(axis=1)
    assert corner.sum() > 150 and np.percentile(error_mm[corner], 90) < 0.1


def test_matches_where_distorted_optics_image_nothing_do_not_hide_the_others_distance(textured):
    barrel = NearAffineCamera(RECTIFIED.left.matrix, 0.0, (80, 64), radial_per_px2=-3e-5)  # nothing beyond 70 px
    options = {"rig": StereoRig(barrel, RECTIFIED.right), "depth_range_mm": (0, 20), "max_epipolar_px": np.inf}
    matches = match(textured, shifted(textured, 12), **options)
    distance = options["rig"].epipolar_distance(matches.u_left, matches.u_right)
    assert 0 < np.isnan(distance).mean() < 0.5 and matches.epipolar_px == np.nanmedian(np.abs(distance))


def turned(rig: StereoRig) -> StereoRig:
    """The rig with its right camera rolled by 8 degrees about the image centre: right in the middle only."""
    c, s, centre = np.cos(0.14), np.sin(0.14), (np.array([640, 360]) - 1) / 2
    R = np.array([[c, -s], [s, c]])
    return StereoRig(
        rig.left, AffineCamera(np.column_stack([R @ rig.right.linear, R @ (rig.right.offset_px - centre) + centre]))
    )


def test_a_rig_that_does_not_fit_is_reported(affine_pair):
    rig = affine_pair.rig
    moved = AffineCamera(rig.right.matrix + np.array([[0, 0, 0, 0], [0, 0, 0, 15.0]]))
    with pytest.raises(ValueError, match=r"rig: it does not fit the images: .* epipolar lines is 1[45]\.\d px"):
        match(affine_pair.left, affine_pair.right, rig=StereoRig(rig.left, moved))
    for method in ("band", "sgbm", "dis"):
        with pytest.raises(ValueError, match="rig: it does not fit"):
            match(affine_pair.left, affine_pair.right, rig=turned(rig), method=method)
    # A small misfit is followed and told.
    nudged = AffineCamera(rig.right.matrix + np.array([[0, 0, 0, 0], [0, 0, 0, 4.0]]))
    matches = match(affine_pair.left, affine_pair.right, rig=StereoRig(rig.left, nudged))
    along, _ = affine_pair.errors_px(matches)
    assert np.median(np.abs(along)) < 0.2
    assert matches.epipolar_px == pytest.approx(4 / np.sqrt(2), abs=0.3)


def test_a_rig_without_parallax_is_refused(affine_pair):
    with pytest.raises(ValueError, match="rig: both cameras look along the same direction"):
        match(affine_pair.left, affine_pair.right, rig=StereoRig(affine_pair.rig.left, affine_pair.rig.left))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"left": np.zeros((100, 100), np.float32)}, "left: expected a uint8 image"),
        ({"right": np.zeros((100, 100, 4), np.uint8)}, "right: expected .h, w, 3. RGB"),
        ({"left": np.zeros((8, 100), np.uint8)}, "left: .* too small"),
        ({"mask_left": np.ones((128, 160), bool)}, "mask_left: everything is masked"),
        ({"mask_right": np.ones((10, 10), bool)}, "mask_right: expected a bool array"),
        ({"mask_left": np.zeros((128, 160))}, "mask_left: expected a bool array"),
        ({"method": "orb"}, "method: expected"),
        ({"method": "band"}, "rig: method 'band' needs"),
        ({"setting": "best"}, "setting: expected one of"),
        ({"depth_range_mm": (3, 1)}, "depth_range_mm: expected .near, far."),
        ({"depth_range_mm": (0, np.nan)}, "depth_range_mm: expected .near, far."),
        ({"method": "deepmatching", "downscale": 9}, "downscale: expected 0 to"),
        ({"method": "deepmatching", "downscale": 0.5}, "downscale: expected 0 to"),
        ({"method": "deepmatching", "device": "foo"}, "device: 'foo' cannot be used"),
        ({"min_score": np.nan}, "min_score: expected a number"),
        ({"max_epipolar_px": np.nan}, "max_epipolar_px: expected a number"),
        ({"method": "deepmatching", "downscale": 1, "budget_bytes": 1000}, "budget_bytes: .* needs .* GiB"),
    ],
)
def test_bad_input_is_named(textured, change, message):
    arguments = {"left": textured, "right": textured} | change
    with pytest.raises(ValueError, match=message):
        match(**arguments)
