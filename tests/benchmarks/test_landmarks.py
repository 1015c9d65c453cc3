"""The paper's timing table, a batch of left and right with decoding, and coarse to fine beside it: `python3 -m lib bench`.

Seconds per pair; the paper's Hz (Titan X) are in the benchmark's extra_info.
"""

import importlib.util

import numpy as np
import pytest
import torch

from lib import paths
from lib.landmarks import Detector
from lib.landmarks.engines import ENGINES
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.heatmaps import render
from lib.landmarks.network import HourglassConfig, StackedHourglass
from lib.recordings import Recording
from notebooks.studies.decoders import DECODERS, positions

PAPER_HZ = {(1080, 1920): 35, (480, 854): 77, (480, 640): 95, (256, 448): 140}


def pair(size):
    return np.random.default_rng(0).integers(0, 256, (2, *size, 3), dtype=np.uint8)


@pytest.mark.parametrize("size", PAPER_HZ, ids=lambda s: f"{s[0]}x{s[1]}")
def test_the_papers_configuration(benchmark, size):
    """Two stacks of 64 features over the whole frame."""
    benchmark.extra_info.update(paper_hz=PAPER_HZ[size], threads=torch.get_num_threads())
    sure = {"frame": ErrorModel(logit=(9.0, 0.0, 0.0, 0.0))}
    detector = Detector(StackedHourglass(HourglassConfig(64, 2)), method="paper", error_models=sure)
    benchmark.pedantic(detector, (pair(size),), rounds=3, warmup_rounds=1)


@pytest.mark.parametrize("engine", [pytest.param(e, marks=[pytest.mark.cuda] * (e == "cuda")) for e in ENGINES])
@pytest.mark.parametrize("mode", ["whole frame", "tracking"])
def test_coarse_to_fine(benchmark, request, mode, engine):
    """The shipped detector on a full-HD pair that shows the tool; one that shows none is searched, which takes longer."""
    if engine == "cuda":
        request.getfixturevalue("gpu")
    elif engine.startswith("openvino") and not importlib.util.find_spec("openvino"):
        pytest.skip("OpenVINO is not installed here")
    detector, frame = Detector.load(engine=engine), Recording.open(paths.SHIPPED_RECORDING).frames[0]
    images = np.stack([frame.left, frame.right])
    benchmark.extra_info.update(paper_hz=35, threads=torch.get_num_threads())
    if mode == "tracking":
        benchmark.pedantic(detector.track, (images, detector(images)), rounds=20, warmup_rounds=3)
    else:
        benchmark.pedantic(detector, (images,), rounds=20, warmup_rounds=3)


@pytest.mark.parametrize("method", DECODERS)
def test_decoders(benchmark, method):
    """Six heatmaps of a full-HD pair at stride 4."""
    u = torch.rand(2, 3, 2) * 900 + 60
    heatmaps = render(u, (1080, 1920), 4)
    benchmark.pedantic(positions, (heatmaps, 4, method), rounds=10, warmup_rounds=2)
