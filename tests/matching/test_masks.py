"""Masks of glints and tool."""

from __future__ import annotations

import numpy as np
import pytest

from lib.matching import glint_mask, tool_mask


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
