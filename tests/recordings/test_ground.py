"""What the cameras see behind the tool."""

from types import SimpleNamespace

import numpy as np
import pytest

from lib.recordings import Ground, GrowingGround, Recording
from tests.adapt.world import World

GROUND = np.random.default_rng(0).integers(40, 200, (2, 30, 40, 3), dtype=np.uint8)


def frames(places):
    """A dark square of 8 px stands at the places (n, 2) px, in the right image 3 px further right."""
    made = []
    for x, y in places:
        both = GROUND.copy()
        for side, shift in enumerate((0, 3)):
            both[side, y : y + 8, x + shift : x + shift + 8] = 0
        made.append(SimpleNamespace(left=both[0], right=both[1]))
    return made


def test_a_tool_that_moves_is_no_part_of_it():
    places = np.column_stack([np.arange(0, 27, 3), np.tile([0, 11, 22], 3)])
    x_mm = np.repeat(np.column_stack([places, np.zeros(9)])[:, None], 3, axis=1)
    np.testing.assert_array_equal(Ground.of_frames(frames(places), x_mm, "one")(), GROUND)


def test_a_long_rest_does_not_put_the_tool_into_it():
    """In 60 of 66 frames the tool rests; those between which it moves farthest decide."""
    places = np.array([*[[0, 0]] * 60, [9, 0], [18, 0], [27, 0], [0, 12], [12, 12], [24, 12]])
    x_mm = np.repeat(np.column_stack([places, np.zeros(66)])[:, None], 3, axis=1).astype(float)
    np.testing.assert_array_equal(Ground.of_frames(frames(places), x_mm, "one")(), GROUND)
    x_mm[:] = np.nan  # without the robot it does
    assert (Ground.of_frames(frames(places), x_mm, "one")() != GROUND).any()


def test_a_change_of_the_light_does_not_put_the_tool_into_it():
    """Halfway the light grows: a median of four dim and five bright frames is dim where a bright one shows the tool."""
    places = np.column_stack([np.arange(0, 27, 3), np.tile([0, 11, 22], 3)])
    x_mm = np.repeat(np.column_stack([places, np.zeros(9)])[:, None], 3, axis=1)
    shown = frames(places)
    for frame in shown[4:]:
        frame.left, frame.right = (np.rint(1.25 * side).astype(np.uint8) for side in (frame.left, frame.right))
    growing = GrowingGround()
    for frame, x in zip(shown, x_mm, strict=True):
        growing.take(np.stack([frame.left, frame.right]), x)
    for ground in (Ground.of_frames(shown, x_mm, "one"), growing.ground):
        assert np.abs(ground().astype(int) - GROUND).max() <= 2


def test_a_tool_that_hardly_moves_has_no_ground():
    """It rests at two places: in the median of such frames it is seen where the other frames do not show it."""
    rng, places = np.random.default_rng(0), np.array([[0, 0]] * 10 + [[20, 10]] * 8)
    tool_mm = np.array([[0.0, 0, 0], [8, 1, 0], [8, -1, 0]])
    x_mm = np.column_stack([places, np.zeros(18)])[:, None] + tool_mm
    x_mm = x_mm + rng.normal(0, 0.01, x_mm.shape)
    assert Ground.of_frames(frames(places), x_mm, "one") is None
    growing = GrowingGround()
    for frame, x in zip(frames(places), x_mm, strict=True):
        growing.take(np.stack([frame.left, frame.right]), x)
    assert growing.ground is None
    assert Ground.of_frames(frames(places[:2]), np.full((2, 3, 3), np.nan), "one") is None  # of two frames


def test_it_grows_with_the_frames_and_a_rest_at_their_end_does_not_put_the_tool_into_it():
    growing, places = GrowingGround(), [*np.column_stack([np.arange(0, 27, 3), np.tile([0, 11, 22], 3)]), *[[24, 22]] * 30]
    for k, (frame, place) in enumerate(zip(frames(places), places, strict=True)):
        images, x_mm = np.stack([frame.left, frame.right]), np.tile([*place, 0.0], (3, 1))
        growing.take(images, x_mm * np.nan)  # where the robot is silent, nobody knows what a frame shows
        assert (growing.ground is None) == (k < 5)
        growing.take(images, x_mm)
        images[:] = 0  # the memory holds the next frame later
    np.testing.assert_array_equal(growing.ground(), GROUND)


def test_nothing_is_decoded_before_it_is_asked_for_and_nothing_twice():
    read = []
    ground = Ground(lambda: read.append(1) or GROUND, "one")
    mirrored = ground.changed(lambda images: images[:, :, ::-1])
    assert not read and mirrored.key == ground.key
    np.testing.assert_array_equal(mirrored(), ground()[:, :, ::-1])
    mirrored(), ground()
    assert len(read) == 1


@pytest.mark.filterwarnings("ignore")
def test_recordings_have_one_each(tmp_path):
    one, other = (World(n=n).record(tmp_path / str(n)) for n in (8, 12))
    assert one.ground().shape == (2, *one.frames[0].left.shape)
    assert one.ground is one.ground and len({one.ground.key, other.ground.key}) == 2
    assert Recording.open(one.folder).ground.key == one.ground.key
    image = next((one.folder / "left").iterdir())
    image.write_bytes(image.read_bytes())
    assert Recording.open(one.folder).ground.key != one.ground.key  # detections by the old ground are not read again
