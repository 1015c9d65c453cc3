"""The robot's log: interpolation, dropped samples, and gaps that a program filled."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from lib import paths
from lib.recordings import Kinematics, Recording
from tests.recordings.test_recordings import tool


def test_dropped_samples_do_not_spread():
    x = tool(4)
    x[2, 1] = np.nan
    kinematics = Kinematics(np.array([0.0, 1.0, 2.0, 3.0]), x)
    at = kinematics.at([0.0, 0.5, 1.0, 1.5, 3.0, 3.1, -0.1])
    np.testing.assert_allclose(at[1], (x[0] + x[1]) / 2)
    np.testing.assert_array_equal(at[2], x[1])  # exactly on a sample beside the dropped one
    assert np.isnan(at[3, 1]).all()
    assert np.isfinite(at[3, [0, 2]]).all()
    np.testing.assert_array_equal(at[4], x[3])
    assert np.isnan(at[5:]).all()
    np.testing.assert_array_equal(Kinematics(np.array([1.0]), x[:1]).at([1.0, 2.0])[0], x[0])


def test_short_drops_of_a_fast_log_are_interpolated_and_long_ones_are_not():
    time_s = np.arange(0, 2, 0.002)
    x = time_s[:, None, None] * np.ones((3, 3))
    dropped = x.copy()
    dropped[[0, 100, 101, 400], 1] = np.nan
    dropped[500:700] = np.nan
    kinematics, at_s = Kinematics(time_s, dropped), np.array([0.001, 0.1999, 0.2, 0.2011, 0.801, 1.2, 1.5])
    found = kinematics.at(at_s)
    assert np.isnan(found[0, 1]).all() and np.isfinite(found[0, [0, 2]]).all() and np.isnan(found[5]).all()
    np.testing.assert_allclose(found[[1, 2, 3, 4, 6]], at_s[[1, 2, 3, 4, 6], None, None] * np.ones((3, 3)), atol=1e-12)
    slow_s = np.arange(0, 10, 0.05)
    slow = Kinematics(slow_s, np.where(np.arange(200) % 4 == 2, np.nan, slow_s)[:, None, None] * np.ones((3, 3)))
    assert np.isfinite(slow.at(np.arange(0, 9.9, 0.013))).all()  # every gap lasts 0.1 s
    for one, t in zip(found, at_s, strict=True):  # a single time reads a part of the log
        np.testing.assert_array_equal(kinematics.at([t])[0], one)


def test_a_frame_asks_for_a_part_of_a_long_log():
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.choice([0.01, 0.02, 0.7], 3000, p=[0.6, 0.39, 0.01]))
    x_mm = rng.normal(size=(3000, 3, 3))
    x_mm[rng.random(3000) < 0.05] = np.nan
    log, asked = Kinematics(time_s, x_mm), np.append(rng.uniform(-1, time_s[-1] + 1, 400), [*time_s[::500], np.nan])
    np.testing.assert_array_equal(log.at(asked), np.concatenate([log.at([t]) for t in asked]))
    assert 0.05 < np.isnan(log.at(asked)).mean() < 0.5


GAPS_S = ((2.0, 2.31), (3.5, 4.1), (6.0, 6.13))


def log(noise_mm: float = 0.005, hz: float = 100.0, seed: int = 0, digits: int = 6) -> Kinematics:
    """A tool of 4 mm in smooth motion for 10 s, and a robot's noise."""
    rng, time_s = np.random.default_rng(seed), np.arange(0, 10, 1 / hz)
    phase = rng.uniform(0, 6, 3)
    path = 3 * np.sin(time_s[:, None] * [0.9, 1.3, 2.1] + phase)
    shared = path + rng.normal(0, noise_mm, path.shape)  # the landmarks of a rigid tool share the robot's errors
    return Kinematics(time_s, np.round(shared[:, None] + tool(1), digits))


def with_filled_gaps(log: Kinematics, curve: str, digits: int = 6) -> tuple[Kinematics, np.ndarray]:
    """The log and (m,) bool: samples that a straight line or a cubic spline through the measured ones replaces."""
    lost = np.any([(log.time_s > first) & (log.time_s < end) for first, end in GAPS_S], axis=0)
    known_s, known_mm = log.time_s[~lost], log.x_mm[~lost]
    x = log.x_mm.copy()
    if curve == "straight":
        each = [np.interp(log.time_s[lost], known_s, one) for one in known_mm.reshape(-1, 9).T]
        x[lost] = np.stack(each, axis=1).reshape(-1, 3, 3)
    else:
        x[lost] = CubicSpline(known_s, known_mm)(log.time_s[lost])
    return Kinematics(log.time_s, x.round(digits)), lost


@pytest.mark.parametrize("curve", ["straight", "spline"])
@pytest.mark.parametrize(("noise_mm", "hz", "digits"), [(0.005, 100, 6), (0.0005, 250, 6), (0.01, 50, 4), (0.02, 100, 3)])
def test_gaps_that_a_program_filled_are_gaps(noise_mm, hz, digits, curve):
    for seed in range(5):
        filled, lost = with_filled_gaps(log(noise_mm, hz, seed, digits), curve, digits)
        found = filled.without_filled()
        assert found.filled[lost].all() and (found.filled & ~lost).sum() <= 1  # one beside a gap may lie on the curve
        np.testing.assert_array_equal(found.x_mm[~found.filled], filled.x_mm[~found.filled])
        assert np.isnan(found.at([2.15, 3.8])).all() and np.isfinite(found.at([1.5, 2.5, 5.0])).all()


def test_a_log_as_it_was_measured_has_no_filled_gap():
    """Rests, quiet holds, empty cells, another noise, and robots without noise, which may move on straight lines."""
    usual = log()
    held, still = usual.x_mm.copy(), usual.x_mm.copy()
    held[300:500] = held[300]
    still[300:500] = still[300] + np.random.default_rng(1).normal(0, 1e-4, (200, 1, 3))
    knots = np.interp(usual.time_s, np.arange(11), np.random.default_rng(2).integers(-8, 8, 11) / 4)
    line = knots[:, None, None] * np.array([1.0, 0.5, 2.0]) + tool(1)
    empty = np.where((usual.time_s % 1 < 0.3)[:, None, None], np.nan, usual.x_mm)
    noisy = [log(noise_mm, hz, seed).x_mm for noise_mm in (0.0, 1e-4, 0.02) for hz in (20, 100, 500) for seed in range(5)]
    for x in (held, still, line, line.round(2), empty, usual.x_mm.round(2), usual.x_mm[:40], *noisy):
        found = Kinematics(np.arange(len(x)) / 100, x).without_filled()
        assert not found.filled.any()
        np.testing.assert_array_equal(found.x_mm, x)


def test_a_recording_doubts_gaps_that_a_program_filled():
    filled, _ = with_filled_gaps(log(), "straight")
    shipped = Recording.open(paths.SHIPPED_RECORDING)
    (doubt,) = (one for one in replace(shipped, kinematics=filled.without_filled()).doubts if one.name == "filled")
    assert "For 1 s, first at 2.01 s, the log is smooth to the last digit" in doubt.text and not doubt.is_of_time
    assert not [one for one in replace(shipped, kinematics=filled).doubts if one.name == "filled"]
    assert not shipped.kinematics.filled.any()
