"""What the pipeline itself costs a frame, its components being instant."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lib.online.pipeline import OnlinePipeline, Settings
from lib.simulator.rig import reference_rig
from notebooks.studies.registration_experiment import tool_frames


def test_step(benchmark):
    rig = reference_rig()
    frames = tool_frames(10_000, rng=np.random.default_rng(0))
    pair = iter(zip(frames.x_mm, frames.u_left, frames.u_right, strict=True))
    image = np.zeros((1080, 1920, 3), np.uint8)
    seen = {}

    def detect(images):
        return SimpleNamespace(u=seen["u"], confidence=np.ones((2, 3)))

    pipeline = OnlinePipeline(detect, rig=rig, settings=Settings(surface_every=10**9))

    def step():
        x, u_left, u_right = next(pair)
        seen["u"] = np.stack([u_left, u_right])
        return pipeline.step(image, image, x)

    assert not benchmark(step).failures
