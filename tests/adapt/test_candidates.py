"""The robot's motion chooses among several tools that an image may show."""

from __future__ import annotations

import numpy as np
import pytest

from lib.adapt import RefusalError, adapt, loop
from lib.adapt.candidates import choose, moving_with
from lib.landmarks.detector import Landmarks
from tests.adapt.test_adapt import bent
from tests.adapt.world import SIZE, StandIn, World


@pytest.fixture(scope="module")
def world():
    return World()


def candidates(world, right, rng, n=4):
    """Four tools of the right shape at random places of the left image; a share `right` of the images shows the true one."""
    other = world.u[:, 0][:, None] + rng.uniform(-1, 1, (world.n, n, 1, 2)) * SIZE
    true = np.where((rng.random(world.n) < right)[:, None, None], world.u[:, 0], np.nan)
    return np.concatenate([other, true[:, None]], axis=1)


@pytest.mark.parametrize("seed", range(6))
def test_a_third_of_the_images_with_the_right_candidate_suffices(world, seed):
    rng = np.random.default_rng(seed)
    u = candidates(world, 0.35, rng)
    there = np.isfinite(u[:, -1]).all(axis=(1, 2))
    best = moving_with(world.at(world.time_s), u + rng.normal(0, 2, u.shape), rng)
    assert (best[there] == u.shape[1] - 1).all() and (best[~there] >= 0).sum() <= 2


@pytest.mark.parametrize("seed", range(6))
def test_without_the_right_candidate_none_is_chosen(world, seed):
    rng = np.random.default_rng(seed)
    x_mm = world.at(world.time_s)
    assert (moving_with(x_mm, candidates(world, 0.0, rng), rng) < 0).all()
    assert (moving_with(np.full_like(x_mm, np.nan), candidates(world, 1.0, rng), rng) < 0).all()


class TakesOthers(StandIn):
    """Takes another object for the tool in most images, but the tool is among its candidates."""

    networks, closeup_network, tool_network, digest = {}, "some", "some", ""
    same_shaft = False

    def __call__(self, images):
        found = super().__call__(images)
        for j, image in enumerate(images):
            rng = np.random.default_rng([7, *image[0, 0]])
            if rng.random() < 0.97:
                base, *tips = found.u[j]
                near = base + rng.uniform(0.2, 0.45) * (np.mean(tips, axis=0) - base)
                found.u[j] += rng.uniform(-1, 1, 2) * SIZE
                found.u[j, 0] = near if self.same_shaft else found.u[j, 0]
        return found

    def coarse(self, images):
        return self(images)

    def proposed(self, image, *_):
        tool = StandIn.__call__(self, image[None]).u
        others = tool + np.random.default_rng([8, *image[0, 0]]).uniform(-200, 200, (3, 1, 2))
        u = np.concatenate([others, tool])
        return u, u, np.full(len(u), 0.6)

    def near(self, images, u, **_):
        found, known = StandIn.__call__(self, images), np.isfinite(u).all(axis=2)
        away = np.linalg.norm(found.u - u, axis=-1).mean(axis=1, keepdims=True) > 30
        return Landmarks(found.u, found.covariance, np.where(known & ~away, found.confidence, 0.0)).without_unsure()


@pytest.mark.parametrize(("robot", "same_shaft"), [("right", False), ("right", True), ("bent", False), ("rate", False)])
def test_a_detector_that_mostly_takes_other_objects_is_taught_by_a_robot_that_is_right(
    world, tmp_path, monkeypatch, robot, same_shaft
):
    chosen, _, offs, found = adapted(world, tmp_path, monkeypatch, robot, same_shaft)
    assert chosen and not found.improved  # `tune` never trains
    if robot == "right":
        assert "the robot's motion chose" in found.report["notes"][-1] and found.report["reason"] == "training starts"
    if offs:
        assert np.nanmedian(np.linalg.norm(offs, axis=-1)) < 1.5
    else:
        assert found.report["reason"].startswith(("detector:", "robot:"))


def test_frames_whose_images_show_different_instants_are_not_taught(world, tmp_path, monkeypatch):
    """The right camera delivered the images of five frames 1.5 s late; no candidate there lies where the robot's tool is."""
    late = World()
    late.u[8:13, 1] = late.u[11:16, 1]
    chosen, numbers, offs, found = adapted(late, tmp_path, monkeypatch, "right", False)
    assert chosen and found.report["reason"] == "training starts" and not {*range(8, 13)} & {*numbers}
    assert len(numbers) > 20 and np.nanmax(np.linalg.norm(offs, axis=-1)) < 6


def adapted(world, tmp_path, monkeypatch, robot, same_shaft):
    """What was chosen; the frames of the images to train on and their labels' errors (3, 2) px; the adaptation."""
    offs, numbers, chosen = [], [], []

    def choosing(*arguments, **how):
        chosen.append(choose(*arguments, **how))
        return chosen[-1]

    def tune(detector, images, *_, **__):
        for one in images:
            side, i = one.name.split()
            numbers.append(int(i))
            offs.append(one.u - world.u[int(i), int(side == "right")])
        raise RefusalError("training starts")

    monkeypatch.setattr(loop, "Detector", TakesOthers)
    monkeypatch.setattr(TakesOthers, "same_shaft", same_shaft)
    monkeypatch.setattr(loop, "choose", choosing)
    monkeypatch.setattr(loop, "simulated_like", lambda *_: [])
    how = {"right": {"clock_s": 0.04}, "bent": {"robot": bent}, "rate": {"rate": 1.15}}[robot]
    record = world.record(tmp_path / "lab", **how)
    found = adapt(record, TakesOthers(world.u, noise_px=0.7), folder=tmp_path / "out", progress=False, tune=tune)
    return chosen, numbers, offs, found
