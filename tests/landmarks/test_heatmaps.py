import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lib.geometry import image_from_cell
from lib.landmarks.heatmaps import decode, render, sigma_cells


def points(n, seed=0, low=20, high=108):
    return torch.rand(n, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * (high - low) + low


def test_peak_of_one_at_the_half_pixel_position():
    """Cell (7, 5) of stride 4 is centred on pixel 4 c + 1.5, as lib.geometry says."""
    centre = torch.tensor(image_from_cell([7, 5], 4))
    heatmap = render(centre.expand(1, 1, 2), (64, 64), 4)[0, 0]
    assert heatmap[5, 7] == 1.0
    assert heatmap.argmax() == 5 * 16 + 7


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_sigma_is_in_input_pixels_whatever_the_stride(stride):
    u = torch.tensor([[[60.0, 60.0]]], dtype=torch.float64)
    heatmap = render(u, (128, 128), stride)[0, 0]
    x = torch.arange(heatmap.shape[1]) * stride + (stride - 1) / 2
    variance = ((x - 60.0) ** 2 * heatmap.sum(0)).sum() / heatmap.sum()
    assert variance == pytest.approx(25.0, rel=1e-3)


def test_missing_landmarks_have_empty_heatmaps():
    u = torch.tensor([[[10.0, 10.0], [torch.nan, torch.nan], [30.0, 40.0]]])
    heatmaps = render(u, (64, 64), 4)
    assert heatmaps[0, 1].abs().max() == 0
    assert torch.isfinite(heatmaps).all()


@settings(max_examples=25, deadline=None)
@given(st.floats(12, 50), st.floats(12, 50), st.floats(0.05, 1.2), st.floats(-0.3, 0.3), st.floats(3.5, 8))
def test_gauss_newton_finds_height_offset_and_width(x, y, height, offset, sigma):
    u = torch.tensor([[[x, y]]], dtype=torch.float64)
    peaks = decode(height * render(u, (64, 64), 4, sigma) + offset, 4)
    assert (peaks.u - u).abs().max() < 0.02
    assert peaks.width.item() == pytest.approx(sigma / 5, rel=0.05)


def test_gauss_newton_covariance_is_that_of_its_errors():
    u = points(300)
    heatmaps = render(u, (128, 128), 4)
    noisy = heatmaps + 0.02 * torch.randn(heatmaps.shape, generator=torch.Generator().manual_seed(1)).double()
    peaks = decode(noisy, 4)
    d = peaks.u - u
    squared = torch.einsum("nki,nkij,nkj->nk", d, torch.linalg.inv(peaks.covariance), d)
    assert 1.7 < squared.mean() < 2.6  # 2, a little more for a variance from 16 degrees of freedom


def test_equation_1_needs_the_sum_of_p():
    """The paper's Eq. (1) divides by the area of the disc, not by the sum of p; then it is no mean."""
    heatmap = render(torch.tensor([[[48.2, 47.7]]], dtype=torch.float64), (96, 96), 1)
    normalised = decode(heatmap, 1, method="paper").u[0, 0].numpy()
    assert np.allclose(normalised, (48.19, 47.72), atol=0.01)
    y, x = np.mgrid[:96, :96]
    disc = (x - 48) ** 2 + (y - 48) ** 2 <= 15**2
    printed = [(v * heatmap[0, 0].numpy())[disc].sum() / disc.sum() for v in (x, y)]
    assert np.allclose(printed, (10.56, 10.45), atol=0.01)


def test_the_encoders_stride_still_has_a_peak():
    assert sigma_cells(64) == 0.6
    assert render(torch.tensor([[[100.0, 100.0]]]), (256, 256), 64).max() > 0.4


def test_errors_name_the_argument():
    with pytest.raises(ValueError, match=r"method: 'soft'.*paper"):
        decode(torch.zeros(1, 3, 8, 8), 4, method="soft")
    with pytest.raises(ValueError, match="heatmaps: expected"):
        decode(torch.zeros(3, 8, 8), 4)
    with pytest.raises(ValueError, match="heatmaps: not finite"):
        decode(torch.full((1, 3, 8, 8), torch.nan), 4)
