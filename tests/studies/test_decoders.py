"""The five decoders on heatmaps whose peaks are known."""

import pytest
import torch

from lib.landmarks import heatmaps as lib_heatmaps
from lib.landmarks.heatmaps import render
from notebooks.studies.decoders import DECODERS, positions

#: Largest error on exact Gaussians of stride 1 and 4, in pixels of the image.
TOLERANCE = {
    "argmax": (0.71, 2.83),
    "paper": (0.05, 0.2),
    "dark": (0.003, 0.003),
    "kornia": (0.05, 0.2),
    "gauss_newton": (1e-4, 1e-4),
}
decoders = pytest.mark.parametrize("method", DECODERS)


def points(n):
    return torch.rand(n, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 88 + 20


def test_those_of_lib_are_among_them():
    assert set(lib_heatmaps.DECODERS) < set(DECODERS)


@decoders
@pytest.mark.parametrize("stride", [1, 4])
def test_exact_gaussians(method, stride):
    u = points(10)
    found = positions(render(u, (128, 128), stride), stride, method)
    assert (found - u).norm(dim=-1).max() < TOLERANCE[method][stride > 1]


@decoders
@pytest.mark.parametrize("u", [(0.0, 0.0), (63.0, 31.0), (1.5, 62.0)])
def test_peaks_on_the_border(u, method):
    truth = torch.tensor([[u]], dtype=torch.float64)
    found = positions(render(truth, (64, 64), 4), 4, method)
    assert (found - truth).norm() < (0.05 if method == "gauss_newton" else 6)


@decoders
@pytest.mark.parametrize("shape", [(1, 3, 8, 8), (1, 3, 1, 1), (2, 1, 2, 3)])
def test_flat_and_tiny_heatmaps_decode_to_something_finite(shape, method):
    assert torch.isfinite(positions(torch.zeros(shape), 4, method)).all()


@decoders
def test_batches_decode_as_single_heatmaps_do(method):
    heatmaps = render(points(4), (128, 128), 4) + 0.01 * torch.rand(4, 3, 32, 32)
    together = positions(heatmaps, 4, method)
    single = torch.cat([positions(heatmaps[i : i + 1], 4, method) for i in range(4)])
    assert torch.allclose(together, single, atol=1e-9)
