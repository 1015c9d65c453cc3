"""Three decoders that notebook 02 and the benchmark compare with those of `lib.landmarks.heatmaps`.

Each takes heatmaps (n, k, h, w) and sigma in cells, and returns positions (n, k, 2) in cells.
"""

from __future__ import annotations

import torch
from kornia.geometry.subpix import spatial_expectation2d
from torch import Tensor
from torch.nn import functional as F

from lib.landmarks.heatmaps import decode, sigma_cells


def _argmax(heatmaps: Tensor, sigma: float = 0.0) -> Tensor:
    """The highest cell."""
    flat, w = heatmaps.flatten(-2).argmax(-1), heatmaps.shape[-1]
    return torch.stack([flat % w, flat // w], -1).to(heatmaps.dtype)


def _square(heatmaps: Tensor, centre: Tensor, radius: int) -> Tensor:
    """The square (n, k, 2 radius + 1, 2 radius + 1) of cells around each `centre`; NaN beyond the border."""
    padded = F.pad(heatmaps, [radius] * 4, value=torch.nan)
    side = torch.arange(2 * radius + 1)
    n, k = (torch.arange(size) for size in heatmaps.shape[:2])
    x, y = centre.long()[..., None, None].unbind(2)
    return padded[n[:, None, None, None], k[:, None, None], y + side[:, None], x + side]


def _kornia(heatmaps: Tensor, sigma: float) -> Tensor:
    """kornia's spatial expectation over the square of 3 sigma around the highest cell."""
    cell, radius = _argmax(heatmaps), int(3 * sigma)
    p = _square(heatmaps, cell, radius).nan_to_num(0.0).clamp_min(0)
    p = p / p.sum((-2, -1), keepdim=True).clamp_min(torch.finfo(p.dtype).tiny)
    return cell + spatial_expectation2d(p, normalized_coordinates=False) - radius


def _dark(heatmaps: Tensor, sigma: float) -> Tensor:
    """Blur by sigma, then one Newton step on the logarithm (Zhang et al. 2020, DARK)."""
    k, (h, w) = heatmaps.shape[1], heatmaps.shape[-2:]
    radius = max(1, round(3 * sigma))
    x = torch.arange(-radius, radius + 1, dtype=heatmaps.dtype)
    g = torch.exp(-0.5 * (x / sigma) ** 2)
    g = (g / g.sum()).expand(k, 1, 1, -1)
    blurred = F.conv2d(heatmaps, g, padding=(0, radius), groups=k)
    blurred = F.conv2d(blurred, g.mT, padding=(radius, 0), groups=k)
    limit = torch.tensor([max(w - 2, 1), max(h - 2, 1)], dtype=heatmaps.dtype)
    inner = torch.minimum(_argmax(blurred).clamp_min(1), limit)
    p = _square(F.pad(blurred, (0, max(3 - w, 0), 0, max(3 - h, 0))), inner, 1)  # at least 3 x 3 cells
    a, b, c, d, e, f, g2, h2, i = p.flatten(-2).clamp_min(1e-10).log().unbind(-1)
    gx, gy = (f - d) / 2, (h2 - b) / 2
    gxx, gyy, gxy = f - 2 * e + d, h2 - 2 * e + b, (i - g2 - c + a) / 4
    determinant = gxx * gyy - gxy**2
    peak = ((determinant > 1e-12) & (gxx < 0))[..., None]
    step = torch.stack([gxy * gy - gyy * gx, gxy * gx - gxx * gy], -1) / torch.where(peak, determinant[..., None], 1.0)
    return inner + torch.where(peak, step.clamp(-1.5, 1.5), 0.0)


_OWN = {"argmax": _argmax, "dark": _dark, "kornia": _kornia}
#: All five decoders, in the order of the figure.
DECODERS = ("argmax", "paper", "dark", "kornia", "gauss_newton")


def positions(heatmaps: Tensor, stride: int, method: str) -> Tensor:
    """Positions (n, k, 2), in pixels of the network's input, by one of the `DECODERS`."""
    if method not in _OWN:
        return decode(heatmaps, stride, method=method).u
    u = _OWN[method](heatmaps, sigma_cells(stride))
    return stride * u + (stride - 1) / 2
