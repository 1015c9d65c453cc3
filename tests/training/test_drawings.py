"""Drawn tools and bent jaws: their landmarks lie where the picture shows them, in the workbench's order."""

from dataclasses import replace

import numpy as np

from lib.training import sources
from lib.training.drawings import bent, drawn_ground, drawn_tool
from lib.training.samples import LabelledImage
from lib.training.sources import CloseupSource, FrameSource, ToolSource

GROUND = np.full((180, 320, 3), 120, np.uint8)


def test_landmarks_lie_on_the_drawing_and_tip_1_on_the_left_of_the_tool():
    painted, order = [], []
    for seed in range(40):
        image, u, visibility = drawn_tool(GROUND, np.random.default_rng(seed))
        changed = np.abs(image.astype(int) - GROUND).max(axis=2) > 6
        for column, row in np.round(u[visibility == 2]).astype(int).clip(0, (319, 179)):
            painted.append(changed[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3].any())
        one, two = u[1:] - u[0]
        order.append(one[0] * two[1] - one[1] * two[0])
        assert ((visibility == 2) == ((u > -0.5) & (u < (319.5, 179.5))).all(axis=1)).all()
        _, near, _ = drawn_tool(GROUND, np.random.default_rng(seed), length_px=200.0, around=seed % 3)
        assert np.abs(near[seed % 3] - (159.5, 89.5)).max() <= 8
        assert 50 < np.linalg.norm(near[1:] - near[0], axis=1).mean() < 300
    assert np.mean(painted) > 0.9  # some have the colour of the ground
    assert min(order) > -1e-6


def test_the_seed_decides_everything_and_a_ground_keeps_no_tool():
    first, again = (drawn_tool(GROUND, np.random.default_rng(3)) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    with_tool = GROUND.copy()
    with_tool[80:100, 100:220] = 0
    grounds = [drawn_ground(with_tool, np.random.default_rng(seed)).astype(float) for seed in range(40)]
    inside, around = (np.mean([ground[rows].mean() for ground in grounds]) for rows in (np.s_[85:95, 110:210], np.s_[60:80]))
    assert abs(inside - around) < 40  # of the 120 by which the tool was darker


def test_a_source_draws_tools_and_undrawn_frames_keep_their_labels():
    u = np.array([[100.0, 90], [150, 80], [150, 100]])
    images = [LabelledImage("a", GROUND, u, np.full(3, 2))]
    for kind in (FrameSource, ToolSource):
        plain = kind.of(images, weight=np.zeros((1, 3)))
        drawn = kind(plain.ends, plain.jpegs, plain.u, plain.visibility, weight=np.zeros((1, 3)), drawn=1.0)
        rng = np.random.default_rng(0)
        assert not any(np.isfinite(plain.draw(0, rng)[1]).all(axis=1).any() for _ in range(5))  # weight 0: no label counts
        assert any(np.isfinite(drawn.draw(0, rng)[1]).all() for _ in range(10))
    closeups = CloseupSource.of(images, still=True)
    (image, at, seen), k = replace(closeups, drawn=1.0).draw(1, np.random.default_rng(0)), closeups.landmark[1]
    assert image.std() > 5 and seen[k] == 2 and (np.abs(at[k] - 31.5) < 31.5).all()


def test_a_tool_with_one_labelled_tip_is_drawn_by_every_source():
    for tip in (1, 2):
        u = np.array([[100.0, 90], [150, 80], [150, 100]])
        u[tip] = np.nan
        images, rng = [LabelledImage("a", GROUND, u, np.full(3, 2))], np.random.default_rng(0)
        for source in (FrameSource.of(images), ToolSource.of(images), replace(CloseupSource.of(images), alone=1.0)):
            for index in range(len(source)):
                for image, at, seen in (source.draw(index, rng) for _ in range(30)):
                    assert image.dtype == np.uint8
                    assert np.isfinite(at[seen == 2]).all() or not isinstance(source, CloseupSource)


def test_some_windows_show_that_a_tool_askew_too_small_or_aside_is_none():
    u = np.array([[100.0, 90], [150, 80], [150, 100]])
    source, rng = ToolSource.of([LabelledImage("a", GROUND, u, np.full(3, 2))]), np.random.default_rng(0)
    draws = [source.draw(0, rng)[1:] for _ in range(300)]
    none = np.array([(visibility == 0).all() and np.isfinite(at).all() for at, visibility in draws])
    assert 0.1 < none.mean() < 0.3  # 0.3 * 0.7, and what else leaves the window
    shown = np.stack([at for at, visibility in draws if (visibility > 0).all() and (abs(at - 63.5) < 64).all()])
    ahead = shown[:, 1:].mean(1) - shown[:, 0]
    assert (np.abs(np.arctan2(ahead[:, 1], ahead[:, 0])) < 0.75).all()


def test_what_a_first_stage_took_for_a_tool_is_an_example_of_one_or_of_none(monkeypatch):
    monkeypatch.setattr(sources, "_PROPOSED", 1.0)
    u, nothing = np.array([[100.0, 90], [150, 80], [150, 100]]), np.full((1, 3, 2), np.nan)
    source = ToolSource.of([LabelledImage("a", GROUND, u, np.full(3, 2))], still=True)
    source, rng = replace(source, u=source.u.astype(float)), np.random.default_rng(0)
    draws = {}
    for name, tool in {"it": u, "turned": u[::-1] + 0.0, "far": u + 90, "none": nothing[0]}.items():
        own = replace(source, proposals=np.stack([tool[None] if name != "none" else nothing]))
        draws[name] = [own.draw(0, rng)[1:] for _ in range(20)]
    for _, visibility in draws["it"] + draws["none"]:
        assert (visibility == 2).all()
    for at, visibility in draws["turned"] + draws["far"]:
        assert not visibility.any() and (at == -128).all()


def test_the_landmarks_of_bent_jaws_move_with_the_image_and_tip_1_stays_on_the_left():
    rows, columns = np.mgrid[:240, :320]
    base, tips, turned, seen = np.array([100.0, 120]), np.array([[200.0, 90], [200, 150]]), 0, []
    for seed in range(30):
        rng, u = np.random.default_rng(seed), np.vstack([base, tips + np.random.default_rng(seed).uniform(-20, 20, (2, 2))])
        spots = [np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 4.0) for x, y in u]
        image = (200 * np.stack(spots, axis=2)).astype(np.uint8)
        out, moved, visibility = bent(image, u, np.array([2, 1, 2]), rng)
        swapped = visibility[1] == 2
        for channel, (x, y) in zip(np.moveaxis(out, 2, 0), np.round(moved[[0, 2, 1]] if swapped else moved), strict=True):
            seen.append(channel[int(y), int(x)] > 0.6 * channel.max())
        assert np.linalg.norm(moved[0] - base) < 5
        assert np.linalg.det(moved[1:] - moved[0]) > 0
        np.testing.assert_array_equal(out[:, :20], image[:, :20])  # what is far stays as it is
        turned += np.linalg.norm(moved - u, axis=1).max() > 8
    assert turned > 20 and np.mean(seen) > 0.97  # a few land where the image is squeezed
