"""Where the shaft ends: known tools drawn on moving grounds, and pictures that do not show it."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lib.adapt import teach
from lib.landmarks import shaft
from lib.landmarks.recorded import look
from lib.landmarks.shaft import AHEAD, Aside, ShaftEnd, shaft_axis, shaft_end
from lib.recordings import StereoFrame
from tests.adapt.world import StandIn, World

SIZE, FRAMES, LENGTH_PX = (360, 200), np.arange(12), 90.0


def tools(sine):
    """Landmarks (12, 2, 3, 2) px of a tool that wanders; `sine` of its angle to the image is a number or (12, 1, 1)."""
    rng = np.random.default_rng(0)
    base = rng.uniform((120, 70), (170, 120), (len(FRAMES), 2, 2))
    angle = rng.normal(0.3, 0.2, (len(FRAMES), 1, 1)) + np.radians([0, 18, -18])
    length = LENGTH_PX * np.sqrt(1 - sine**2) / np.cos(np.radians(18)) * np.array([0, 1, 1])
    return base[:, :, None] + length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def shown(u, sine):
    """The images (m, 2, 2, 3) px of the tool's axes; the second one lies in the image plane."""
    along = u[:, :, 1:].mean(axis=2) - u[:, :, 0]
    size = np.linalg.norm(along, axis=-1, keepdims=True)
    across = along[..., ::-1] * [-1, 1] / np.sqrt(1 - sine**2)
    return np.stack([along, across, LENGTH_PX * sine * along / size], axis=-1)


def pictured(u, sine, *, axis=AHEAD, radius_px=12.0, taper=0.0, bevel=0.15, shaft=True, jaws=True, highlight=0.0):
    """A recording of drawn tools on a ground that differs in every frame.

    The shafts end at the base; the edge of the end has a `bevel` of 45 degrees, a share of the radius.  A bright band along
    the shaft, `highlight` radii to either side of its axis, reaches to its end.
    """
    rng, pairs = np.random.default_rng(1), []
    for pair, axes in zip(u, shown(u, sine), strict=True):
        images = []
        for (base, *tips), axes_px in zip(pair, axes, strict=True):
            ground = cv2.GaussianBlur(rng.normal(0, 1, SIZE[::-1]), (0, 0), 4)
            large = np.repeat(np.repeat(150 + 20 * ground / ground.std(), 4, axis=0), 4, axis=1).astype(np.float32)
            shown_px = np.linalg.norm(axes_px @ axis)
            along, lean = axes_px @ axis / shown_px, np.sqrt(1 - min(2 * (shown_px / np.linalg.norm(axes_px)) ** 2, 1))
            across = np.array([-along[1], along[0]])
            turn = np.linspace(-np.pi / 2, np.pi / 2, 40)[:, None]
            circle = radius_px * (lean * np.cos(turn) * along + np.sin(turn) * across)
            bevelled = [(1 - bevel) * circle, circle - bevel * radius_px * np.sqrt(1 - lean**2) * along]
            end = cv2.convexHull(np.concatenate(bevelled).astype(np.float32))[:, 0]
            end = end[np.argsort(end @ across)]
            wide = taper * radius_px * across
            behind = [end[-1] - 12 * along + wide, end[-1] - 250 * along + wide]
            behind += [end[0] - 250 * along - wide, end[0] - 12 * along - wide]
            outline = base + np.concatenate([end, behind])
            for tip in tips if jaws else ():
                cv2.line(large, *(np.rint(4 * point + 1.5).astype(int) for point in (base, tip)), 90.0, 16)
            if shaft:
                cv2.fillPoly(large, [np.rint(4 * outline + 1.5).astype(np.int32)], 60.0)
                arc = base + circle[np.abs(np.sin(turn[:, 0])) <= highlight]
                if len(arc):
                    band = np.concatenate([arc, arc[::-1] - 250 * along])
                    cv2.fillPoly(large, [np.rint(4 * band + 1.5).astype(np.int32)], 250.0)
            small = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA) + rng.normal(0, 3, SIZE[::-1])
            images.append(np.repeat(small.clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1))
        pairs.append(StereoFrame(*images, 0.0))
    return SimpleNamespace(frames=pairs, image_size_px=SIZE)


@pytest.mark.parametrize("bevel", [0.0, 0.15, 0.3])
@pytest.mark.parametrize(
    ("sine", "share", "taper", "bevelled"), [(0.5, 0.1, 0.0, 0.028), (0.2, -0.06, 0.0, 0.02), (0.4, 0.05, 0.4, 0.035)]
)
def test_a_base_that_is_off_along_the_shaft_is_found_within_a_hundredth_of_the_tool(sine, share, taper, bevelled, bevel):
    """If the end is strongly bevelled, it is off by `bevelled` at most."""
    u = tools(sine)
    axis = u[:, :, 1:].mean(axis=2) - u[:, :, 0]
    labels = u.copy()
    labels[:, :, 0] += share * axis
    found = shaft_end(pictured(u, sine, taper=taper, bevel=bevel), FRAMES, labels[:, :, 0], shown(u, sine))
    length = np.linalg.norm(axis, axis=-1)
    off = (np.linalg.norm(found.u - u[:, :, 0], axis=-1) / length).max()
    assert off < (0.012 if bevel < 0.3 else bevelled)
    assert 0.01 < found.sd < 0.02 if taper == 0 else 0.02 < found.sd < 0.03  # where a neck ends is less sure
    assert found.pictures.shape == (2, 141, 161, 3) and found.outline.shape[::2] == (2, 2)
    middle = found.outline.mean(axis=1)[:, 1]
    assert np.abs(middle - 70).max() < 4  # the outline lies around the tool's axis, which is the row of the label


def test_a_highlight_that_is_clearer_than_the_sides_is_not_taken_for_the_shaft():
    """It ends at the same front, so its ellipse, which is smaller, would lie nearer to the tips."""
    u, sine = tools(0.5), 0.5
    axes = shown(u, sine)
    found = shaft_end(pictured(u, sine, highlight=0.6), FRAMES, u[:, :, 0] - 0.04 * axes[..., 0], axes)
    off = ((found.u - u[:, :, 0]) * axes[..., 0]).sum(axis=-1) / (axes[..., 0] ** 2).sum(axis=-1)
    assert np.abs(off).max() < 1.5 * found.sd
    radius_px = 12.0 / LENGTH_PX * 200 / np.sqrt(1 - sine**2)
    np.testing.assert_allclose(np.ptp(found.outline[..., 1], axis=1) / 2, radius_px, rtol=0.1)


@pytest.mark.parametrize(("share", "taper"), [(0.03, 0.0), (-0.02, 0.0), (0.02, 0.4)])
def test_a_base_that_is_off_across_the_shaft_is_found_midway_between_its_sides(share, taper):
    u, sine = tools(0.4), 0.4
    axes = shown(u, sine)
    found = shaft_end(pictured(u, sine, taper=taper), FRAMES, u[:, :, 0] + share * axes[..., 1], axes)
    assert abs(found.aside.moved + share) < 0.004 and 0.001 < found.aside.sd < 0.006
    assert np.allclose(found.aside.axis, [0, 1, 0], atol=0.02)
    assert np.allclose(found.aside.across, axes @ found.aside.axis)
    middle = found.outline.mean(axis=1)[:, 1] - 70
    np.testing.assert_allclose(middle, -share * 200 / np.sqrt(1 - sine**2), atol=1.0)


@pytest.mark.parametrize("degrees", [-4, 4])
def test_the_axis_is_measured_at_the_end_of_a_shaft_whose_direction_is_off(monkeypatch, degrees):
    u, angle = tools(0.4), np.radians(degrees)
    axes = shown(u, 0.4)
    recording = pictured(u, 0.4, axis=np.array([np.cos(angle), np.sin(angle), 0.0]))
    monkeypatch.setattr(shaft, "shaft_axis", lambda *_: AHEAD)
    found = shaft_end(recording, FRAMES, u[:, :, 0], axes)
    assert abs(found.aside.moved) < 0.004


@pytest.mark.parametrize(("sine", "radius_px", "share"), [(0.2, 8.0, 0.06), (0.5, 12.0, -0.08), (0.5, 4.0, -0.045)])
def test_an_axis_outside_the_searched_range_is_not_measured(sine, radius_px, share):
    """There one side and the ground beside it would be taken for two sides."""
    u = tools(sine)
    axes = shown(u, sine)
    found = shaft_end(pictured(u, sine, radius_px=radius_px), FRAMES, u[:, :, 0] + share * axes[..., 1], axes)
    assert found is None or found.aside is None


def test_an_axis_is_not_measured_if_a_side_is_unclear_or_the_roll_varies(monkeypatch):
    u = tools(0.4)
    recording, axes = pictured(u, 0.4), shown(u, 0.4)
    turn = np.linspace(0, 2 * np.pi, len(FRAMES), endpoint=False)
    rolled = axes.copy()  # steps across the tool point everywhere
    rolled[..., 1], rolled[..., 2] = (
        np.cos(turn + part)[:, None, None] * axes[..., 1] + np.sin(turn + part)[:, None, None] * axes[..., 2]
        for part in (0.0, np.pi / 2)
    )
    assert shaft_end(recording, FRAMES, u[:, :, 0], rolled).aside is None
    row = np.abs(np.arange(141) - 70)
    picture = np.repeat(np.where(row < 20, 60.0, 150.0)[None, :, None, None], 161, axis=2).repeat(3, axis=3)
    middle, sd = shaft._middle(picture, 20.0, 0, 45.0)
    assert middle == 0 and 0 < sd < 1.0
    assert np.isnan(shaft._middle(picture, 15.0, 0, 45.0)).all()  # the steps are those of another thing
    assert np.isnan(shaft._middle(np.roll(picture, 12, axis=1), 20.0, 0, 45.0)).all()
    monkeypatch.setattr(shaft, "_middle", lambda *_: (np.nan, np.nan))
    found = shaft_end(recording, FRAMES, u[:, :, 0], axes)
    assert found.aside is None and np.allclose(found.u, u[:, :, 0] + found.moved * found.along)


def test_a_shaft_that_does_not_point_to_the_tips_is_found_with_its_end(monkeypatch):
    """Jaws at an angle of 35 degrees: along the tips no shaft ends."""
    sine, axis = np.linspace(0.1, 0.6, len(FRAMES))[:, None, None], np.array([0.82, 0.5, 0.28])
    axis /= np.linalg.norm(axis)
    u = tools(sine)
    recording, axes = pictured(u, sine, axis=axis), shown(u, sine)
    base = u[:, :, 0] - 0.06 * axes @ axis
    found = shaft_axis(recording, FRAMES, base, axes)
    assert np.degrees(np.arccos(found @ axis)) < 3
    end = shaft_end(recording, FRAMES, base, axes)
    monkeypatch.setattr(shaft, "shaft_axis", lambda *_: AHEAD)
    straight = shaft_end(recording, FRAMES, base, axes)
    off = np.linalg.norm(end.u - u[:, :, 0], axis=-1) / np.linalg.norm(axes[..., 0], axis=-1)
    assert off.max() < 0.02 and np.allclose(end.u, base + end.moved * end.along + end.aside.moved * end.aside.across)
    assert straight is None or np.abs(straight.u - u[:, :, 0]).max() > 2 * np.abs(end.u - u[:, :, 0]).max()


@pytest.mark.parametrize("visible", [True, False])
def test_a_shaft_that_points_to_the_tips_or_is_not_shown_gives_their_direction(visible):
    u = tools(0.3)
    found = shaft_axis(pictured(u, 0.3, shaft=visible, jaws=visible), FRAMES, u[:, :, 0], shown(u, 0.3))
    across = np.einsum("mcik,k->mci", shown(u, 0.3), found)
    off = np.arctan2(*np.moveaxis(across, -1, 0)) - np.arctan2(*np.moveaxis(shown(u, 0.3)[..., 0], -1, 0))
    assert np.degrees(np.abs(off)).max() < 2.5 if visible else np.array_equal(found, AHEAD)


def test_frames_in_which_the_robot_is_silent_are_left_out():
    u = tools(0.5)
    recording, axes = pictured(u, 0.5), shown(u, 0.5)
    base = u[:, :, 0] + 0.1 * axes[..., 0]
    alone, again = shaft_end(recording, FRAMES, base, axes), np.append(FRAMES, [3, 8])
    silent = np.concatenate([axes, np.full((2, 2, 2, 3), np.nan)])  # without a report the axes are unknown
    found = shaft_end(recording, again, base[again], silent)
    assert found.moved == alone.moved and np.array_equal(found.u[: len(FRAMES)], alone.u)
    assert np.array_equal(shaft_axis(recording, again, base[again], silent), shaft_axis(recording, FRAMES, base, axes))


@pytest.mark.parametrize("left_out", ["tool", "shaft", "edges", "frames"])
def test_pictures_that_show_no_end_of_a_shaft_give_none(left_out):
    u, frames = tools(0.4), FRAMES[: 8 if left_out == "frames" else None]
    recording = pictured(u, 0.4, shaft=left_out in ("edges", "frames"), jaws=left_out != "tool")
    if left_out == "edges":
        blank = np.full((*SIZE[::-1], 3), 90, np.uint8)
        recording.frames = [StereoFrame(blank, blank, 0.0) for _ in FRAMES]
    assert shaft_end(recording, frames, u[frames, :, 0], shown(u[frames], 0.4)) is None


def test_a_shaft_that_ends_outside_the_pictures_or_is_thick_and_steep_gives_none(monkeypatch):
    u = tools(0.4)
    far = u[:, :, 0] - 0.4 * (u[:, :, 1:].mean(axis=2) - u[:, :, 0])
    outside = pictured(u, 0.4, jaws=False), FRAMES, far, shown(u, 0.4)
    steep = pictured(tools(0.75), 0.75, radius_px=18.0), FRAMES, tools(0.75)[:, :, 0], shown(tools(0.75), 0.75)
    assert shaft_end(*outside) is None and shaft_end(*steep) is None
    monkeypatch.setattr(shaft, "_CLEAR", -10.0)
    monkeypatch.setattr(shaft, "_LONGEST", 1.0)
    assert shaft_end(*outside) is not None and shaft_end(*steep) is not None


def taught(tmp_path):
    """A teacher by a detector that knows the tool, and the numbers of the frames."""
    world = World()
    frames = np.arange(world.n)
    recording = world.record(tmp_path / "lab")
    return teach(recording, look(recording, StandIn(world.u, noise_px=0.7), frames)), frames


def test_the_base_moves_by_as_much_as_the_label_is_unsure_but_not_to_another_edge(tmp_path):
    teacher, frames = taught(tmp_path)
    teacher = replace(teacher, offset_covariance_mm2=np.tile(0.1**2 * np.eye(3), (3, 1, 1)))
    u = teacher.labels(frames)[0]
    axis = u[:, :, 1:].mean(axis=2) - u[:, :, 0]

    def moved(share, sd):
        end = ShaftEnd(frames, u[:, :, 0] + share * axis, AHEAD, axis, share, sd, np.empty(0), np.empty(0))
        found = teacher.with_base(end)
        off = found.labels(frames)[0] - u
        assert np.nanmax(np.abs(off[:, :, 1:])) < 1e-9  # the tips stay
        return np.nanmedian((off[:, :, 0] * axis).sum(axis=-1) / (axis**2).sum(axis=-1)), found

    share, surer = moved(0.02, 0.002)
    assert 0.9 * 0.02 < share < 0.02
    assert surer.offset_covariance_mm2[0, 0, 0] < 0.1 * teacher.offset_covariance_mm2[0, 0, 0]
    less, confirmed = moved(0.02, 0.015)
    assert 0.5 * share < less < 0.9 * share
    assert confirmed.offset_covariance_mm2[0, 0, 0] < teacher.offset_covariance_mm2[0, 0, 0]
    shares = [moved(size, 0.01)[0] / size for size in (-0.03, -0.01, 0.005, 0.02)]
    np.testing.assert_allclose(shares, shares[0], rtol=1e-6)
    assert moved(0.5, 0.002)[1] is teacher and teacher.with_base(None) is teacher


def test_the_base_moves_across_the_shaft_too_unless_the_end_is_another_edge(tmp_path):
    teacher, frames = taught(tmp_path)
    teacher = replace(teacher, offset_covariance_mm2=np.tile(0.1**2 * np.eye(3), (3, 1, 1)))
    base, axes = teacher.labels(frames)[0][:, :, 0], teacher.axes_px(frames)
    aside = Aside(np.array([0.0, 1.0, 0.0]), axes[..., 1], 0.02, 0.002)

    def moved(along_share, aside_share, aside):
        end = base + along_share * axes[..., 0] + aside_share * axes[..., 1]
        return teacher.with_base(ShaftEnd(frames, end, AHEAD, axes[..., 0], along_share, 0.002, None, None, aside))

    found, along = moved(0.01, 0.02, aside), moved(0.01, 0.02, None)
    shift_mm = found.offset_mm[0] - along.offset_mm[0]
    x_mm = teacher.recording.landmarks_mm()
    length_mm = np.nanmedian(np.linalg.norm(x_mm[:, 1:].mean(axis=1) - x_mm[:, 0], axis=1))
    assert np.allclose(shift_mm[[0, 2]], 0) and 0.9 < shift_mm[1] / (0.02 * length_mm) < 1
    assert found.offset_covariance_mm2[0, 1, 1] < 0.1 * along.offset_covariance_mm2[0, 1, 1]
    assert moved(0.5, 0.02, aside) is teacher
    assert np.array_equal(moved(0.01, 0.5, aside).offset_mm, moved(0.01, 0.5, None).offset_mm)


def test_a_correction_along_an_angled_shaft_moves_the_base_there_and_makes_it_surer(tmp_path):
    teacher, frames = taught(tmp_path)
    own = np.diag([0.2, 0.1, 0.05]) ** 2
    teacher = replace(teacher, offset_covariance_mm2=np.tile(own, (3, 1, 1)))
    axis = np.array([0.8, 0.0, 0.6])
    along = teacher.axes_px(frames) @ axis
    end = ShaftEnd(frames, teacher.labels(frames)[0][:, :, 0] + 0.03 * along, axis, along, 0.03, 0.002, None, None)
    found = teacher.with_base(end)
    shift_mm = found.offset_mm[0] - teacher.offset_mm[0]
    assert np.allclose(shift_mm, np.linalg.norm(shift_mm) * axis) and np.linalg.norm(shift_mm) > 0
    surer = found.offset_covariance_mm2[0]
    assert np.linalg.eigvalsh(surer).min() > 0 and axis @ surer @ axis < 0.1 * axis @ own @ axis
    assert np.linalg.eigvalsh(own - surer).min() > -1e-12 and np.isclose(surer[1, 1], own[1, 1])
    exact = replace(teacher, offset_covariance_mm2=np.zeros((3, 3, 3))).with_base(end)
    assert not exact.offset_covariance_mm2.any()
