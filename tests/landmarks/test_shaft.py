"""Where the shaft ends: known tools drawn on moving grounds, and pictures that do not show it."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lib.adapt import teach
from lib.adapt.looking import look
from lib.landmarks.shaft import ShaftEnd, shaft_end, tilt
from lib.recordings import StereoFrame
from tests.adapt.world import StandIn, World

SIZE, FRAMES, LENGTH_PX = (360, 200), np.arange(12), 90.0


def tools(sine):
    """Landmarks (12, 2, 3, 2) px of a tool that wanders and turns."""
    rng = np.random.default_rng(0)
    base = rng.uniform((120, 70), (170, 120), (len(FRAMES), 2, 2))
    angle = rng.normal(0.3, 0.2, (len(FRAMES), 1, 1)) + np.radians([0, 18, -18])
    length = LENGTH_PX * np.sqrt(1 - sine**2) / np.cos(np.radians(18)) * np.array([0, 1, 1])
    return base[:, :, None] + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def pictured(u, sine, *, radius_px=12.0, taper=0.0, shaft=True, jaws=True):
    """A recording of drawn tools, whose shafts end at the base, on a ground that differs in every frame."""
    rng, pairs = np.random.default_rng(1), []
    for pair in u:
        images = []
        for base, *tips in pair:
            ground = cv2.GaussianBlur(rng.normal(0, 1, SIZE[::-1]), (0, 0), 4)
            large = np.repeat(np.repeat(150 + 20 * ground / ground.std(), 4, axis=0), 4, axis=1).astype(np.float32)
            axis = np.mean(tips, axis=0) - base
            along = axis / np.linalg.norm(axis)
            across = np.array([-along[1], along[0]])
            turn = np.linspace(-np.pi / 2, np.pi / 2, 40)[:, None]
            end = radius_px * (sine * np.cos(turn) * along + np.sin(turn) * across)
            wide = taper * radius_px * across
            behind = [end[-1] - 12 * along + wide, end[-1] - 250 * along + wide]
            behind += [end[0] - 250 * along - wide, end[0] - 12 * along - wide]
            outline = base + np.concatenate([end, behind])
            for tip in tips if jaws else ():
                cv2.line(large, *(np.rint(4 * point).astype(int) for point in (base, tip)), 90.0, 16)
            if shaft:
                cv2.fillPoly(large, [np.rint(4 * outline).astype(np.int32)], 60.0)
            small = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA) + rng.normal(0, 3, SIZE[::-1])
            images.append(np.repeat(small.clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1))
        pairs.append(StereoFrame(*images, 0.0))
    return SimpleNamespace(frames=pairs, image_size_px=SIZE)


@pytest.mark.parametrize(("sine", "share", "taper"), [(0.5, 0.1, 0.0), (0.2, -0.06, 0.0), (0.4, 0.05, 0.4)])
def test_a_base_that_is_off_along_the_shaft_is_found_within_a_hundredth_of_the_tool(sine, share, taper):
    u = tools(sine)
    axis = u[:, :, 1:].mean(axis=2) - u[:, :, 0]
    labels = u.copy()
    labels[:, :, 0] += share * axis
    found = shaft_end(pictured(u, sine, taper=taper), FRAMES, labels, np.full((len(FRAMES), 2), sine))
    length = np.linalg.norm(axis, axis=-1)
    assert (np.linalg.norm(found.u - u[:, :, 0], axis=-1) / length).max() < 0.012
    assert found.pictures.shape == (2, 141, 161, 3) and found.outline.shape[::2] == (2, 2)
    middle = found.outline.mean(axis=1)[:, 1]
    assert np.abs(middle - 70).max() < 4  # the outline lies around the tool's axis, which is the row of the label


def test_frames_in_which_the_robot_is_silent_are_left_out():
    u = tools(0.5)
    labels, recording, sine = u.copy(), pictured(u, 0.5), np.full((len(FRAMES), 2), 0.5)
    labels[:, :, 0] += 0.1 * (u[:, :, 1:].mean(axis=2) - u[:, :, 0])
    alone, again = shaft_end(recording, FRAMES, labels, sine), np.append(FRAMES, [3, 8])
    silent = np.concatenate([sine, np.full((2, 2), np.nan)])  # without a report the tilt is unknown
    found = shaft_end(recording, again, labels[again], silent)
    assert found.moved == alone.moved and np.array_equal(found.u[: len(FRAMES)], alone.u)


@pytest.mark.parametrize("left_out", ["tool", "shaft", "edges", "frames"])
def test_pictures_that_show_no_end_of_a_shaft_give_none(left_out):
    u, frames = tools(0.4), FRAMES[: 8 if left_out == "frames" else None]
    recording = pictured(u, 0.4, shaft=left_out in ("edges", "frames"), jaws=left_out != "tool")
    if left_out == "edges":
        blank = np.full((*SIZE[::-1], 3), 90, np.uint8)
        recording.frames = [StereoFrame(blank, blank, 0.0) for _ in FRAMES]
    assert shaft_end(recording, frames, u[frames], np.full((len(frames), 2), 0.4)) is None


def test_the_base_moves_by_as_much_as_the_label_is_unsure_but_not_to_another_edge(tmp_path):
    world = World()
    frames = np.arange(world.n)
    recording = world.record(tmp_path / "lab")
    teacher = teach(recording, look(recording, StandIn(world.u, noise_px=0.7), frames))
    teacher = replace(teacher, offset_covariance_mm2=np.tile(0.1**2 * np.eye(3), (3, 1, 1)))
    u = teacher.labels(frames)[0]
    axis = u[:, :, 1:].mean(axis=2) - u[:, :, 0]

    def moved(share, sd):
        end = ShaftEnd(frames, u[:, :, 0] + share * axis, share, sd, np.empty(0), np.empty(0))
        found = teacher.with_base(end)
        off = found.labels(frames)[0] - u
        assert np.nanmax(np.abs(off[:, :, 1:])) < 1e-9  # the tips stay
        return np.nanmedian((off[:, :, 0] * axis).sum(axis=-1) / (axis**2).sum(axis=-1)), found

    share, surer = moved(0.02, 0.002)
    assert 0.9 * 0.02 < share < 0.02
    assert surer.offset_covariance_mm2[0, 0, 0] < 0.1 * teacher.offset_covariance_mm2[0, 0, 0]
    assert moved(0.02, 0.015)[0] < 0.9 * share
    hardly, confirmed = moved(0.01, 0.015)  # as a detector that knows the tool explains just as well
    assert 0 < hardly < 0.5 * 0.01 and confirmed.offset_covariance_mm2[0, 0, 0] < teacher.offset_covariance_mm2[0, 0, 0]
    shares = [moved(size, 0.01)[0] / size for size in (0.005, 0.01, 0.02, 0.03)]
    assert (np.diff(shares) > 0).all() and np.diff(shares).max() < 0.35  # without a step
    assert moved(0.5, 0.002)[1] is teacher and teacher.with_base(None) is teacher


def test_the_angle_between_tool_and_image_is_that_of_the_projection(tmp_path):
    world = World()
    frames = np.arange(world.n)
    recording = world.record(tmp_path / "lab")
    teacher = teach(recording, look(recording, StandIn(world.u, noise_px=0.7), frames))
    x = recording.landmarks_mm()
    size_mm = np.linalg.norm(x[:, 1:].mean(axis=1) - x[:, 0], axis=1)
    size_px = np.linalg.norm(world.u[:, :, 1:].mean(axis=2) - world.u[:, :, 0], axis=-1)
    cosine = size_px / size_mm[:, None] / 25.0  # the rig has 25 pixels a millimetre
    known = np.isfinite(size_mm)
    sine = tilt(x, teacher.calibration.cameras)[known]
    assert np.abs(np.sqrt(1 - sine**2) - cosine[known]).max() < 0.05
    assert (sine > 0).mean() > 0.9  # the shaft enters from the side of the microscope
