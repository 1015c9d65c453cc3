"""What the pipeline itself costs a frame, its components being instant."""

from __future__ import annotations

import numpy as np

from lib.landmarks import Landmarks
from lib.online import OnlinePipeline, Settings
from lib.simulator.rig import reference_rig
from notebooks.studies.moved_cameras import tool_frames


def test_step(benchmark):
    rig = reference_rig()
    frames = tool_frames(10_000, rng=np.random.default_rng(0))
    pair = iter(zip(*(frames.grid(name) for name in ("x_mm", "u_left", "u_right")), strict=True))
    images = np.random.default_rng(1).integers(0, 255, (2, 1080, 1920, 3), dtype=np.uint8)
    seen = {}

    def detect(images):
        return Landmarks(seen["u"], np.tile(np.eye(2), (2, 3, 1, 1)), np.ones((2, 3)))

    pipeline = OnlinePipeline(detect, rig=rig, settings=Settings(surface_every=10**9))

    def step():
        x, u_left, u_right = next(pair)
        seen["u"] = np.stack([u_left, u_right])
        images[:, ::4, ::4] += 1  # no frame repeats the one before
        return pipeline.step(*images, x)

    assert not benchmark(step).failures
