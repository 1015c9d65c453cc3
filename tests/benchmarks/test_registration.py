"""How long registration takes: one alarm must be answered between two frames (40 ms)."""

from __future__ import annotations

import numpy as np
import pytest

from lib.registration import DriftMonitor, identify_motion, register, register_images
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.moved_cameras import random_motion, tool_frames

RIG = reference_rig()


def data(n_frames: int):
    rng = np.random.default_rng(0)
    moved = RIG.moved(random_motion(rng, centre_mm=ROBOT_FROM_MICROSCOPE.t))
    frames = tool_frames(n_frames, rng=rng, rig=moved)
    return frames.x_mm, frames.u_left, frames.u_right


@pytest.mark.parametrize("n_frames", [3, 30, 300])
@pytest.mark.parametrize("loss", ["norm", "squared"])
def test_register(benchmark, n_frames, loss):
    x, u_left, u_right = data(n_frames)
    source = RIG.triangulate(u_left, u_right).x_mm
    benchmark(register, source, x, loss=loss)


@pytest.mark.parametrize("n_frames", [3, 30, 300])
@pytest.mark.parametrize("loss", ["squared", "robust"])
def test_register_images(benchmark, n_frames, loss):
    benchmark(register_images, RIG, *data(n_frames), covariance_px2=2.25, loss=loss)


def test_identify_motion(benchmark):
    benchmark(identify_motion, RIG, *data(10), covariance_px2=2.25)


def test_drift_monitor(benchmark):
    monitor = DriftMonitor(RIG, covariance_px2=2.25)
    benchmark(monitor.update, *(values[:3] for values in data(1)))
