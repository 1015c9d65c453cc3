"""How long images take to make, and where the time goes: python3 -m lib bench."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lib.simulator import Eye, Forceps, Microscope, Pose, render_pair
from lib.simulator.dataset import seconds_a_pair
from lib.simulator.population import sample

EYE, FORCEPS, POSE = Eye(seed=27), Forceps(), Pose((-1.0, 0.8, -1.0), -0.5, 0.35, 0.2, 0.9)
LATER = (replace(POSE, base_mm=(-0.995, 0.8, -1.0)), 1e-3)


def test_full_hd_stereo_pair_with_truth(benchmark):
    EYE.texture  # noqa: B018 - drawn once an eye

    def pair():
        left, right = render_pair(
            EYE, Microscope(), forceps=FORCEPS, pose=POSE, later=LATER, rng=np.random.default_rng(0), surface=True
        )
        for view in (left, right):
            cv2.imencode(".jpg", view.image)

    benchmark.pedantic(pair, rounds=3, warmup_rounds=1)


def test_pair_of_a_recording(benchmark):
    """CPU seconds of a pair with truth and files; 3 s are allowed for a pair on two cores."""
    benchmark.extra_info["cpu_s"] = benchmark.pedantic(seconds_a_pair, args=(1,), rounds=1)
    assert benchmark.extra_info["cpu_s"] < 3.0


@pytest.mark.parametrize("size", [{"crop_px": 512}, {"size_px": (640, 360)}], ids=["crop", "field"])
def test_training_image(benchmark, size):
    rng = np.random.default_rng(0)
    benchmark.pedantic(lambda: sample(rng, textures=range(10_000, 10_001), **size), rounds=10, warmup_rounds=1)


def test_texture_of_an_eye(benchmark):
    seeds = iter(range(500, 600))
    benchmark.pedantic(lambda: Eye(seed=next(seeds)).texture, rounds=2)
