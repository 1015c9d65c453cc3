"""Interlaced or repeated images and rounded times are told from the wrong clock that they look like."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lib import paths
from lib.correspondences import of_recording
from lib.recordings import Frames, Recording
from lib.trust import Diagnosis, Hypothesis
from lib.trust.footage import blurred, turned_images, with_footage

CLOCK = Hypothesis("clock", "10 ms", "Set offset_s.", 10.0, 1.0, "ms", explained=0.8, gain=90.0)
STAMPS = replace(CLOCK, name="time_stamps", value=30.0)


@pytest.fixture(scope="module")
def recording():
    """The recording that ships, with its left images for both eyes, decoded once at their full size."""
    shipped = Recording.open(paths.SHIPPED_RECORDING)
    images = [shipped.frames[i].left for i in range(len(shipped))]
    return replace(shipped, frames=Frames(images.__getitem__, images.__getitem__, shipped.frames.time_s))


def named(recording, cause, edit=lambda images: images, time_s=None):
    images = edit([frame.left for frame in recording.frames])
    frames = Frames(images.__getitem__, images.__getitem__, recording.frames.time_s if time_s is None else time_s)
    data = of_recording(recording, recording.truth.u_left, recording.truth.u_right)
    return with_footage(Diagnosis((cause,)), replace(recording, frames=frames), data).best


def interlaced(images):
    rows = (np.arange(len(images[0])) % 2 == 0)[:, None, None]
    return [np.where(rows, image, np.roll(image, 4, axis=1)) for image in images]


def with_thin_lines(images):
    """Level lines of one row, as the rim of a tool or a thread."""
    lines = [image.copy() for image in noisy(images)]
    for line in lines:
        line[::9] //= 3
    return lines


def noisy(images):
    rng = np.random.default_rng(0)
    return [cv2.add(image, rng.integers(0, 6, image.shape, dtype=np.uint8)) for image in images]


def pulled_down(images):
    delivered = noisy(images)
    return [delivered[i * 5 // 6] for i in range(len(images))]


@pytest.mark.parametrize("cause", [CLOCK, replace(CLOCK, name="detector_unfit")])
def test_a_log_that_never_turns_the_tool_is_named(recording, cause):
    x_mm = recording.kinematics.x_mm
    still = replace(recording, kinematics=replace(recording.kinematics, x_mm=x_mm[:, :1] + x_mm[:1] - x_mm[:1, :1]))
    best = named(still, cause, noisy)
    assert best.name == "frozen_orientation" and "turns by" in best.text and best.gain == CLOCK.gain
    assert named(recording, cause, noisy).name == cause.name


@pytest.mark.parametrize(("code", "how"), [(0, "top to bottom"), (1, "left to right"), (-1, "by 180 degrees")])
def test_images_of_an_eye_that_are_turned_in_some_frames_are_named(recording, code, how):
    late, images = len(recording) - 5, [frame.left for frame in recording.frames]
    turned = [cv2.flip(image, code) for image in images]

    def found(right):
        frames = Frames(images.__getitem__, right.__getitem__, recording.frames.time_s)
        return turned_images(replace(recording, frames=frames), np.arange(len(recording)))

    one = found(images[:late] + turned[late:])
    assert one.is_named and one.images == (1,) and how in one.text
    assert f"5 of the right images, first in frame {late}, last in frame {late + 4}," in one.text
    assert found(images) is None and found(turned) is None  # all of them: other tests find that


def test_a_picture_that_looks_alike_when_turned_is_not_turned(recording):
    y, x = np.mgrid[-1:1:108j, -1:1:192j]
    rings = [np.uint8(127 + 100 * np.cos(30 * np.hypot(x, y)))[..., None].repeat(3, axis=2)] * len(recording)
    alike = replace(recording, frames=Frames(rings.__getitem__, rings.__getitem__, recording.frames.time_s))
    assert turned_images(alike, np.arange(len(recording))) is None


def test_detections_that_turn_in_one_image_only_accuse_no_log(recording):
    x_mm = recording.kinematics.x_mm
    still = replace(recording, kinematics=replace(recording.kinematics, x_mm=x_mm[:, :1] + x_mm[:1] - x_mm[:1, :1]))
    u_left, u_right = recording.truth.u_left, recording.truth.u_right
    unlike = of_recording(still, u_left, np.roll(u_right, 7, axis=0))
    still_too = of_recording(still, *(u[:, :1] + u[:1] - u[:1, :1] for u in (u_left, u_right)))
    for data in (unlike, still_too):
        assert with_footage(Diagnosis((replace(CLOCK, name="detector_unfit"),)), still, data).best.name == "detector_unfit"


@pytest.mark.parametrize(("edit", "name", "cure"), [
    (noisy, "clock", "Set offset_s."), (with_thin_lines, "clock", "Set offset_s."),
    (interlaced, "interlaced", "even rows"), (pulled_down, "frozen_video", "Drop images"),
])  # fmt: skip
def test_a_defect_of_the_images_is_named_in_place_of_the_clock(recording, edit, name, cure):
    best = named(recording, CLOCK, edit)
    assert best.name == name and cure in best.cure and best.gain == CLOCK.gain


def test_a_defect_of_the_images_is_not_named_where_times_fit(recording):
    slipped = replace(CLOCK, name="tool_slipped")
    assert named(recording, slipped, interlaced) is slipped


@pytest.mark.parametrize(("fps", "digits", "told"), [(8.0, 1, True), (8.0, 6, False), (10.0, 6, False)])
def test_rounded_times_are_named(recording, fps, digits, told):
    best = named(recording, STAMPS, time_s=np.round(np.arange(len(recording)) / fps, digits))
    assert best.name == "time_stamps" and ("rounded to 0.1 s" in best.text) == told


@pytest.mark.parametrize(("digits", "told"), [(1, True), (3, False)])
def test_rounded_positions_are_named(recording, digits, told):
    noise = replace(CLOCK, name="robot_noise", value=50.0, unit="um")
    log = replace(recording.kinematics, x_mm=np.round(recording.kinematics.x_mm, digits))
    best = named(replace(recording, kinematics=log), noise)
    assert best.name == "robot_noise" and ("rounded to 0.1 mm" in best.text) == told


def blurry(image):
    return cv2.GaussianBlur(image, (0, 0), 4)


def scaled_up(image):
    return cv2.resize(cv2.resize(image, None, fx=0.2, fy=0.2, interpolation=cv2.INTER_AREA), image.shape[1::-1])


def with_eyes(recording, **edits):
    """The recording that ships with its `left` or `right` images edited."""
    frames = Recording.open(paths.SHIPPED_RECORDING).frames

    def eye(side):
        return lambda i: edits[side](i, getattr(frames[i], side)) if side in edits else getattr(frames[i], side)

    return replace(recording, frames=Frames(eye("left"), eye("right"), frames.time_s))


def covered(image):
    """The image with two thirds of it behind something black."""
    image = image.copy()
    image[:, image.shape[1] // 3 :] = 0
    return image


def round_field(image):
    """The image in a round field of view on black."""
    height, width = image.shape[:2]
    return image * cv2.circle(np.zeros((height, width), np.uint8), (width // 2, height // 2), height // 2, 1, -1)[..., None]


@pytest.mark.parametrize("sharp", [False, True])
def test_in_a_round_field_only_what_is_lit_counts(recording, sharp):
    eyes = with_eyes(recording, left=lambda i, image: round_field(image),
                     right=lambda i, image: round_field(image if sharp else blurry(image)))  # fmt: skip
    found = blurred(eyes, np.arange(len(eyes)))
    assert not found if sharp else ("the right image" in found[0].text)


@pytest.mark.parametrize(("side", "edit", "first"), [
    ("right", blurry, 6), ("left", blurry, 0), ("right", scaled_up, 6), ("left", np.zeros_like, 6), ("right", covered, 0),
])  # fmt: skip
def test_an_eye_that_is_blurred_is_told(recording, side, edit, first):
    spoilt = with_eyes(recording, **{side: lambda i, image: edit(image) if i >= first else image})
    (doubt,) = blurred(spoilt, np.arange(len(spoilt)))
    assert doubt.name == "blurred" and f"the {side} image" in doubt.text and side in doubt.cure
    assert first <= int(doubt.text.partition("first in frame ")[2].partition(",")[0]) <= first + 2


@pytest.mark.parametrize("edit", [
    lambda i, image: image, lambda i, image: image // 2, lambda i, image: np.repeat(image[..., 1:2], 3, axis=2),
    lambda i, image: cv2.add(image, np.random.default_rng(i).integers(0, 10, image.shape, dtype=np.uint8)),
])  # fmt: skip
def test_eyes_that_differ_in_brightness_colour_or_noise_are_not_blurred(recording, edit):
    spoilt = with_eyes(recording, right=edit)
    assert not blurred(spoilt, np.arange(len(spoilt)))
