"""The online system at 25 full-HD frames a second: frames lost, latency, surfaces a second, memory."""

from __future__ import annotations

import os
import resource
import time

import numpy as np
import pytest

from lib import paths
from lib.geometry import RigidTransform
from lib.landmarks import Detector
from lib.online import OnlinePipeline, Settings
from lib.online.feeds import Arrival, Live
from lib.recordings import Recording
from notebooks.studies.moved_cameras import pushed_images

FPS = 25.0
N = int(os.environ.get("ONLINE_FRAMES", "500"))


def gliding(n: int, n_pairs: int = 24, seed: int = 0):
    """Frames of a scene that glides to and fro by 2 px a frame with all that is in it, and the robot's report of it."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    frame, truth = recording.frames[8], recording.truth
    steps = 0.02 * np.arange(n_pairs)[:, None] * ROBOT_X
    pairs = [pushed_images(frame.left, frame.right, truth.rig, RigidTransform(np.eye(3), -step)) for step in steps]
    x = truth.rig.triangulate(truth.u_left[8], truth.u_right[8]).x_mm
    rng = np.random.default_rng(seed)
    there_and_back = np.abs((np.arange(n) + n_pairs - 1) % (2 * n_pairs - 2) - (n_pairs - 1))
    for i, k in enumerate(there_and_back):
        left, right = (image.copy() for image in pairs[k])
        for image in (left, right):  # no two frames of a camera are alike
            image[::4, ::4] ^= rng.integers(0, 2, image[::4, ::4].shape, dtype=np.uint8)
        yield Arrival(left, right, x + steps[k] + rng.normal(0, 0.005, (3, 3)), i / FPS)


ROBOT_X = np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize("feed", ["live, surfaces beside", "as fast as it goes, in turn"])
def test_rate(benchmark, feed):
    live, truth = feed.startswith("live"), Recording.open(paths.SHIPPED_RECORDING).truth
    n, detector = N if live else N // 5, Detector.load()
    latency, surfaces, states, dropped, memory = [], set(), set(), [0], []
    with OnlinePipeline(detector, rig=truth.rig, noise_px=0.6, settings=Settings(fps=FPS), beside=live) as pipeline:
        first = next(gliding(1, 2, seed=1))
        pipeline.step(first.left, first.right, first.kinematics, time_s=-1.0)  # warms up
        arrivals = Live(gliding(n)) if live else list(gliding(n))  # made before the clock starts

        def run():
            for arrival in arrivals:
                start = arrival.arrived_s if live else time.monotonic()
                result = pipeline.step(arrival.left, arrival.right, arrival.kinematics, time_s=arrival.time_s)
                latency.append(time.monotonic() - start)
                surfaces.add(result.reconstructed_at)
                states.add(result.state)
                dropped.append(result.dropped)
                memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)

        benchmark.pedantic(run, rounds=1)
        seconds = benchmark.stats.stats.mean if benchmark.stats else n / FPS
        benchmark.extra_info |= {
            "frames": len(latency), "lost": arrivals.lost if live else 0, "states": sorted(states),
            "latency_ms_median": round(1e3 * float(np.median(latency)), 1),
            "latency_ms_p99": round(1e3 * float(np.quantile(latency, 0.99)), 1),
            "frames_per_s": round(len(latency) / seconds, 2), "surfaces_per_s": round(len(surfaces) / seconds, 2),
            "surfaces_dropped": dropped[-1],
            "memory_mb": [round(memory[len(memory) // 5]), round(memory[-1])],
        }  # fmt: skip
    print(f"\n{feed}: {benchmark.extra_info}")
    assert states == {"tracking"}
