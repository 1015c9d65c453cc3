"""Masks of glints and tool."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lib import paths
from lib.matching import dark_mask, glint_mask, tool_mask
from lib.recordings import Recording


def test_glints_are_saturated_in_every_channel_and_grown():
    image = np.full((60, 80, 3), 120, np.uint8)
    image[20:24, 30:34] = 255
    image[40, 10] = (255, 200, 90)  # bright, but coloured
    mask = glint_mask(image, grow_px=3)
    assert mask.dtype == bool and mask.shape == (60, 80)
    assert mask[17:27, 31:33].all() and mask[22, 27:37].all()
    assert not mask[40, 10] and mask.sum() < 12 * 12
    assert glint_mask(image, grow_px=0).sum() == 16
    with pytest.raises(ValueError, match="image: expected a uint8"):
        glint_mask(image.astype(float))
    assert np.array_equal(glint_mask(image[..., 0], grow_px=0)[20:24, 30:34], np.ones((4, 4), bool))
    with pytest.raises(ValueError, match="image: expected a uint8"):
        glint_mask(image / 255.0)


def textured_image(mean: float, sd: float) -> np.ndarray:
    """(360, 480, 3) uint8, with noise of 0.5."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.standard_normal((360, 480, 1)).astype(np.float32), (0, 0), 3)[..., None]
    image = mean + sd * texture / texture.std() + rng.normal(0, 0.5, (360, 480, 3))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("gain", [1.0, 0.1])
def test_the_surround_is_dark_and_a_dim_picture_is_not(gain):
    image = textured_image(130 * gain, 25 * gain)
    assert not dark_mask(image).any() and not dark_mask(image[..., 0]).any()
    image[300:310, 400:410] = 255  # a glint
    image[:60, :80] = textured_image(0, 0)[:60, :80]
    mask = dark_mask(image)
    assert mask[:60, :80].all() and not mask[70:].any() and not mask[:, 90:].any()
    large = cv2.resize(image, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
    assert np.mean(dark_mask(large)[1::3, 1::3] != mask) < 0.01
    assert not dark_mask(textured_image(4, 1)).any() and not dark_mask(np.zeros((20, 30, 3), np.uint8)).any()


@pytest.mark.parametrize(("radius_px", "stray"), [(120, 0.0), (120, 0.2), (270, 0.0), (270, 0.2)])
def test_the_blurred_rim_of_a_surround_is_masked(radius_px, stray):
    """Of a field that is a disc, or that leaves only the corners dark; stray light brightens the surround."""
    field = cv2.circle(np.zeros((360, 480), np.uint8), (240, 180), radius_px, 255, -1)
    field = cv2.GaussianBlur(field, (0, 0), 6)
    level = field[:, :, None] / 255
    noise = np.random.default_rng(0).normal(0, 0.7, (360, 480, 1))
    mask = dark_mask((textured_image(130, 25) * level + 130 * stray * (1 - level) + noise).clip(0, 255).astype(np.uint8))
    assert mask[field < 90].mean() > 0.96 and mask[field > 250].mean() < 0.01


@pytest.mark.parametrize("sd", [6.0, 1.5])
def test_what_is_dark_and_textured_is_not_masked(sd):
    """A shadow, or what a lamp hardly reaches, beside a bright part."""
    image = textured_image(130, 25)
    image[:, :240] = textured_image(15, sd)[:, :240]
    assert dark_mask(image).mean() < 0.05


@pytest.mark.parametrize("rest", [0.08, 0.12])
def test_the_retina_beside_a_lit_disc_is_not_masked(rest):
    image = Recording.open(paths.SHIPPED_RECORDING).frames[0].left
    y, x = np.indices(image.shape[:2]) - np.reshape(image.shape[:2], (2, 1, 1)) / 2
    lit = rest + (1.5 - rest) / (1 + np.exp((np.hypot(x, y) - 350) / 15))
    assert dark_mask(np.clip(image * lit[..., None], 0, 240).astype(np.uint8)).mean() < 0.02


def test_tool_covers_jaws_and_shaft():
    u = np.array([[100.0, 60.0], [140.0, 50.0], [140.0, 70.0]])
    mask = tool_mask((120, 200), u, width_px=6)
    for x, y in [(100, 60), (120, 55), (120, 65), (138, 50), (60, 60), (5, 60)]:
        assert mask[y, x], (x, y)
    for x, y in [(160, 60), (135, 60), (100, 80), (60, 75)]:
        assert not mask[y, x], (x, y)
    assert mask.sum() < tool_mask((120, 200), u).sum()


def test_missing_landmarks_leave_out_what_is_unknown():
    u = np.array([[100.0, 60.0], [140.0, 50.0], [np.nan, np.nan]])
    mask = tool_mask((120, 200), u, width_px=6)
    assert mask[55, 120] and not mask[68, 135]
    assert not tool_mask((120, 200), np.full((3, 2), np.nan)).any()
    u = np.array([[np.nan, np.nan], [140.0, 50.0], [140.0, 70.0]])
    assert not tool_mask((120, 200), u).any()
    with pytest.raises(ValueError, match=r"u_landmarks: expected \(3, 2\)"):
        tool_mask((120, 200), np.zeros((2, 2)))
