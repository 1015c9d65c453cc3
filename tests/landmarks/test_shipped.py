"""The weights that ship, on the recording that ships."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lib import paths
from lib.landmarks import Landmarks
from lib.landmarks.contrast import levelled
from lib.landmarks.engines import default_engine
from lib.landmarks.metrics import errors_px, pck, tool_length_px

SHIPPED_WEIGHTS = paths.MODELS / "default.safetensors"


def test_the_file_is_small_and_says_where_it_comes_from(shipped):
    assert SHIPPED_WEIGHTS.stat().st_size < 16e6
    metadata = shipped.torch.metadata
    assert {"trained_on", "commit", "stages", "metrics"} <= set(metadata)
    assert json.dumps(metadata)


def test_it_finds_the_landmarks_and_tells_the_tips_apart(shipped):
    u, labels = shipped.by_default.u, np.where(shipped.in_view[..., None], shipped.u, np.nan)
    assert pck(u, labels, 0.1, length_px=tool_length_px(shipped.u)) >= 80
    separated = np.linalg.norm(labels[:, 1] - labels[:, 2], axis=1) > 20
    error, swapped = errors_px(u, labels), errors_px(u[:, [0, 2, 1]], labels)
    assert separated.sum() > 10
    assert not (swapped[separated, 1:] < error[separated, 1:]).any()


def test_the_default_engine_agrees_with_torch(shipped):
    """The whole chain as it ships, in the precision that OpenVINO chooses here."""
    fast, slow = shipped.by_default, shipped.by_torch
    assert np.nanmedian(np.linalg.norm(fast.u - slow.u, axis=2)) < 0.1
    length = tool_length_px(shipped.u)
    assert abs(pck(fast.u, shipped.u, 0.05, length_px=length) - pck(slow.u, shipped.u, 0.05, length_px=length)) <= 0.5
    assert shipped.default.engine == default_engine()


def test_tracking_agrees_with_whole_frames(shipped):
    whole = shipped.by_default[:2]
    moved = Landmarks(whole.u + 4.0, whole.covariance, whole.confidence)
    tracked = shipped.default.track(shipped.images[:2], moved)
    both = (whole.confidence > 0.5) & (tracked.confidence > 0.5)
    assert both.any()
    assert np.median(np.linalg.norm(tracked.u - whole.u, axis=2)[both]) < 0.5


def test_a_tool_is_found_where_it_is_expected_and_nowhere_else(shipped):
    whole, length = shipped.by_default[:2], tool_length_px(shipped.u[:2])
    expected = whole.u + [[[9.0, -6.0]]]
    found = shipped.default.near(shipped.images[:2], expected)
    both = (whole.confidence > 0.5) & (found.confidence > 0.5)
    assert both.mean() > 0.6 and (np.linalg.norm(found.u - whole.u, axis=2)[both] < 0.03 * length.mean()).all()
    elsewhere = expected + 1.5 * length.mean()
    assert (shipped.default.near(shipped.images[:2], elsewhere).confidence < 0.5).all()
    # The cameras may have moved: what lies just too far away is missing, and not drawn to where it is expected.
    beside = whole.u + 0.13 * length.mean() * np.array([0.8, 0.6])
    drawn = np.linalg.norm(shipped.default.near(shipped.images[:2], beside).u - whole.u, axis=2)
    assert not (drawn[whole.confidence > 0.5] > 0.05 * length.mean()).any()
    expected[0, 0] = np.nan  # no window without a base
    assert np.isnan(shipped.default.near(shipped.images[:2], expected).u[0]).all()


def test_near_an_expected_place_the_surer_of_image_and_difference_from_the_ground_counts(shipped):
    image, expected = shipped.images[0], shipped.by_default.u[:1] + 5.0
    pattern = np.random.default_rng(0).integers(60, 190, (68, 120, 3), dtype=np.uint8)
    pattern = cv2.resize(pattern, image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    dull = cv2.addWeighted(image, 0.4, cv2.medianBlur(image, 255), -0.4, 0.0, dtype=cv2.CV_16S)
    dull = cv2.add(pattern, dull, dtype=cv2.CV_8U)[None]  # a dull tool on a strong pattern
    bare, both = shipped.default.near(dull, expected), shipped.default.near(dull, expected, ground=lambda: pattern[None])
    assert bare.confidence.mean() < 0.5 < both.confidence.mean()
    assert np.linalg.norm(both.u - shipped.by_default.u[:1], axis=2).max() < 0.02 * tool_length_px(shipped.u[:1]).mean()
    same = shipped.default.near(image[None], expected, ground=lambda: image[None])  # a ground that contains the tool
    assert np.array_equal(same.u, shipped.default.near(image[None], expected).u)


def test_an_empty_field_has_no_landmarks_and_disturbs_no_other(shipped):
    ground = np.random.default_rng(0).integers(90, 140, (27, 48, 3), dtype=np.uint8)
    both = np.stack([shipped.images[0], cv2.resize(ground, shipped.images.shape[2:0:-1])])
    found = shipped.default(both)
    assert (found.confidence[1] < 0.5).all()
    np.testing.assert_allclose(found.u[0], shipped.by_default.u[0], atol=1e-3)  # one was searched, and the other was not
    assert shipped.default.searched(both, shipped.default.coarse(both)).confidence[1].max() < 0.4


def test_an_image_in_doubt_is_seen_again_with_more_contrast(shipped, monkeypatch):
    clear, looks = shipped.images[:1], []
    dull = np.clip(np.round((clear - clear.mean()) * 0.05 + 110), 0, 255).astype(np.uint8)
    once = type(shipped.default)._once
    alone = once(shipped.default, dull)
    monkeypatch.setattr(type(shipped.default), "_once", lambda *a, **how: looks.append(len(a[1])) or once(*a, **how))
    found = shipped.default(np.concatenate([clear, dull]))
    assert looks[0] == 2 and set(looks[1:]) == {1}  # the clear image is seen once
    error = np.linalg.norm(found.u - shipped.u[:1], axis=2) / tool_length_px(shipped.u[:1])
    assert (error < 0.05).all() and (found.confidence > 0.5).all()
    assert alone.confidence.mean() < 0.5


def test_a_tool_that_the_first_stage_overlooks_is_found_by_sweeping(shipped, monkeypatch):
    def blind(self, images):
        return Landmarks.none(len(images))

    monkeypatch.setattr(type(shipped.default), "coarse", blind)
    monkeypatch.setattr(type(shipped.default), "proposed", lambda self, image, *others: (*others, *others, np.zeros(1)))
    found = shipped.default(shipped.images[:2])
    error = np.linalg.norm(found.u - shipped.u[:2], axis=2) / tool_length_px(shipped.u[:2])[:, None]
    assert (error < 0.05).all() and (found.confidence > 0.3).all() and (found.confidence <= 0.5).all()


def test_a_tool_that_is_part_of_the_ground_is_not_found_but_the_other_one_is(shipped):
    both, bare = (np.concatenate([image, shipped.images[8]], axis=1) for image in (shipped.images[0], shipped.ground[0]))
    found = shipped.default(levelled(both, bare)[None])
    assert (np.linalg.norm(found.u[0] - shipped.u[0], axis=1) < 0.05 * tool_length_px(shipped.u[:1])).all()
    assert (found.confidence > 0.5).all()
    assert not (shipped.default(levelled(both, both)[None]).confidence > 0.5).any()
    with pytest.raises(ValueError, match="ground: expected .* as the image"):
        levelled(both, shipped.ground[0])


@pytest.mark.parametrize("light", [0.75, 1.25])
def test_a_black_surround_does_not_hide_the_light_of_a_frame(shipped, light):
    """A round field: more than half of the pixels are black whatever the light."""
    y, x = np.indices(shipped.ground.shape[1:3]) - np.reshape(shipped.ground.shape[1:3], (2, 1, 1)) / 2
    inside = (np.hypot(x, y) < 500)[..., None]
    ground, image = (np.where(inside, one[0], 0).astype(np.uint8) for one in (shipped.ground, shipped.images))
    lit = np.clip(np.where(inside, light * image.astype(float), 0), 0, 255).astype(np.uint8)
    as_usual, changed = levelled(image, ground).astype(float), levelled(lit, ground).astype(float)
    r = [one[inside[..., 0]].ravel() for one in (as_usual, changed)]
    assert np.corrcoef(*r)[0, 1] > 0.95 and abs(r[0].mean() * light - r[1].mean()) < 10


def test_where_there_is_doubt_what_differs_from_the_ground_decides(shipped):
    """Without colour some frames leave doubt, and something else is taken for the tool.  The ground is asked for in doubt."""
    images, ground = (
        np.repeat(part.mean(axis=-1, keepdims=True).astype(np.uint8), 3, axis=-1)
        for part in (shipped.images[-6:-2], np.tile(shipped.ground, (2, 1, 1, 1)))
    )
    asked: list[int] = []
    found = shipped.default(images, batch=2, ground=lambda: asked.append(1) or ground)
    error = np.linalg.norm(found.u - shipped.u[-6:-2], axis=2) / tool_length_px(shipped.u[-6:-2])[:, None]
    assert (error[:, 1:] < 0.05).all() and (found.confidence.mean(1) > 0.4).all() and asked
    alone = Landmarks.join([shipped.default._once(images[i : i + 2]) for i in (0, 2)])  # the batches that were seen before
    assert (np.linalg.norm(alone.u - shipped.u[-6:-2], axis=2) > tool_length_px(shipped.u[-6:-2])[:, None]).any()
    assert shipped.default(shipped.images[:1], ground=pytest.fail).confidence.min() > 0.5


def test_without_a_second_stage_nothing_is_searched(shipped):
    alone, rough = replace(shipped.torch, tool_network=None, closeup_network=None), Landmarks.none(1)
    assert alone.searched(shipped.images[:1], rough) is rough
    lost = shipped.torch.searched(np.zeros((1, 90, 160, 3), np.uint8), rough)
    assert np.isnan(lost.u).all() and (lost.confidence < 0.1).all()
