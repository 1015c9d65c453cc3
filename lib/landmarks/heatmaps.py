"""Heatmaps: Gaussian targets from float coordinates, and five decoders behind one function.

Cells and pixels obey the half-pixel rule of `lib.geometry`: cell c of a heatmap of stride s is centred on pixel
s * c + (s - 1) / 2.  Sigma is in pixels of the network's input whatever the stride.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["DECODERS", "SIGMA_PX", "Peaks", "decode", "render", "sigma_cells"]

#: Standard deviation of the targets (paper Sec. V-B), px of the network's input.
SIGMA_PX = 5.0


def sigma_cells(stride: int, sigma_px: float = SIGMA_PX) -> float:
    """Sigma in cells, at least 0.6: a narrower Gaussian falls between the cells (the encoder's stride 64)."""
    return max(sigma_px / stride, 0.6)


def render(u: Tensor, image_size: tuple[int, int], stride: int, sigma_px: float = SIGMA_PX) -> Tensor:
    """Gaussians of peak 1 centred on float coordinates: the l2 targets (paper Sec. III).

    Takes points u (n, k, 2) px of an input of size (h, w), and returns heatmaps (n, k, ceil(h / stride), ceil(w / stride)).
    A point that is NaN gives an empty heatmap.

    >>> heatmaps = render(torch.tensor([[[5.5, 9.5]]]), (16, 32), 4)
    >>> heatmaps.shape, heatmaps[0, 0, 2, 1].item()
    (torch.Size([1, 1, 4, 8]), 1.0)
    """
    h, w = image_size
    rows = torch.arange(-(-h // stride), dtype=u.dtype, device=u.device)
    columns = torch.arange(-(-w // stride), dtype=u.dtype, device=u.device)
    cells = (u - (stride - 1) / 2) / stride
    scale = -0.5 / sigma_cells(stride, sigma_px) ** 2
    along_x = torch.exp(scale * (columns - cells[..., :1]) ** 2)
    along_y = torch.exp(scale * (rows - cells[..., 1:]) ** 2)
    return torch.nan_to_num(along_y[..., :, None] * along_x[..., None, :], nan=0.0)


def _pixels(u_cell: Tensor, stride: int) -> Tensor:
    """`lib.geometry.image_from_cell` for tensors."""
    return stride * u_cell + (stride - 1) / 2


@dataclass(frozen=True)
class Peaks:
    """The peak that a decoder finds in each heatmap.

    Attributes:
        u: (n, k, 2) px of the network's input.
        value: (n, k) height of the peak; that of the target is 1.
        width: (n, k) sigma of the peak over that of the target; 1 where the decoder does not fit it.
        covariance: (n, k, 2, 2) px^2, from the fit's residual; NaN where the decoder has none.
    """

    u: Tensor
    value: Tensor
    width: Tensor
    covariance: Tensor

    @classmethod
    def none(cls) -> Peaks:
        """No peaks, (0, 1)."""
        empty = torch.zeros((0, 1))
        return cls(torch.zeros((0, 1, 2)), empty, empty, torch.zeros((0, 1, 2, 2)))

    def double(self) -> Peaks:
        """The same in float64."""
        return Peaks(self.u.double(), self.value.double(), self.width.double(), self.covariance.double())


def _argmax(heatmaps: Tensor) -> tuple[Tensor, Tensor]:
    """Integer cell (n, k, 2) as x, y, and value (n, k) of the highest cell."""
    value, flat = heatmaps.flatten(-2).max(-1)
    w = heatmaps.shape[-1]
    return torch.stack([flat % w, torch.div(flat, w, rounding_mode="floor")], -1), value


def _patches(heatmaps: Tensor, centre: Tensor, radius: int) -> tuple[Tensor, Tensor, Tensor]:
    """Square neighbourhoods: values (n, k, p), offsets (p, 2) from `centre` in cells, inside (n, k, p) bool."""
    h, w = heatmaps.shape[-2:]
    side = torch.arange(-radius, radius + 1, device=heatmaps.device)
    dy, dx = torch.meshgrid(side, side, indexing="ij")
    offsets = torch.stack([dx, dy], -1).reshape(-1, 2)
    at = centre[..., None, :] + offsets
    inside = ((at >= 0) & (at < torch.tensor([w, h], device=heatmaps.device))).all(-1)
    flat = at[..., 1].clamp(0, h - 1) * w + at[..., 0].clamp(0, w - 1)
    return heatmaps.flatten(-2).gather(-1, flat), offsets.to(heatmaps.dtype), inside


def _plain(u_cells: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    nan = torch.full((*u_cells.shape, 2), torch.nan, dtype=u_cells.dtype, device=u_cells.device)
    return u_cells, value, torch.ones_like(value), nan


def _decode_argmax(heatmaps: Tensor, sigma: float) -> tuple[Tensor, ...]:
    cell, value = _argmax(heatmaps)
    return _plain(cell.to(heatmaps.dtype), value)


def _decode_disc(heatmaps: Tensor, sigma: float) -> tuple[Tensor, ...]:
    """The mean of Eq. (1) over its disc Delta, weighted by p."""
    cell, value = _argmax(heatmaps)
    p, offsets, inside = _patches(heatmaps, cell, int(3 * sigma))
    # A regressed activation can be negative, a probability cannot.
    weights = p.clamp_min(0) * inside * (offsets.square().sum(-1) <= (3 * sigma) ** 2)
    total = weights.sum(-1, keepdim=True)
    mean = (weights @ offsets) / total.clamp_min(torch.finfo(total.dtype).tiny)
    return _plain(cell.to(heatmaps.dtype) + mean, value)


def _decode_kornia(heatmaps: Tensor, sigma: float) -> tuple[Tensor, ...]:
    """kornia's spatial expectation over the square of 3 sigma around the peak."""
    from kornia.geometry.subpix import spatial_expectation2d  # imported late: decoding by default needs no kornia

    cell, value = _argmax(heatmaps)
    radius = int(3 * sigma)
    p, _, inside = _patches(heatmaps, cell, radius)
    p = p.clamp_min(0) * inside
    p = p / p.sum(-1, keepdim=True).clamp_min(torch.finfo(p.dtype).tiny)
    square = p.unflatten(-1, (2 * radius + 1, -1))
    return _plain(cell.to(heatmaps.dtype) + spatial_expectation2d(square, normalized_coordinates=False) - radius, value)


def _decode_dark(heatmaps: Tensor, sigma: float) -> tuple[Tensor, ...]:
    """Blur by sigma, then one Newton step on the logarithm (Zhang et al. 2020, DARK)."""
    k = heatmaps.shape[1]
    radius = max(1, round(3 * sigma))
    x = torch.arange(-radius, radius + 1, dtype=heatmaps.dtype, device=heatmaps.device)
    g = torch.exp(-0.5 * (x / sigma) ** 2)
    g = (g / g.sum()).expand(k, 1, 1, -1)
    blurred = F.conv2d(heatmaps, g, padding=(0, radius), groups=k)
    blurred = F.conv2d(blurred, g.transpose(-1, -2), padding=(radius, 0), groups=k)
    h, w = heatmaps.shape[-2:]
    (_, value), (cell, _) = _argmax(heatmaps), _argmax(blurred)
    inner = torch.stack([cell[..., 0].clamp(1, max(w - 2, 1)), cell[..., 1].clamp(1, max(h - 2, 1))], -1)
    p, _, _ = _patches(blurred, inner, 1)
    a, b, c, d, e, f, g2, h2, i = p.clamp_min(1e-10).log().unbind(-1)
    gx, gy = (f - d) / 2, (h2 - b) / 2
    gxx, gyy, gxy = f - 2 * e + d, h2 - 2 * e + b, (i - g2 - c + a) / 4
    determinant = gxx * gyy - gxy**2
    peak = (determinant > 1e-12) & (gxx < 0)
    safe = torch.where(peak, determinant, torch.ones_like(determinant))
    step = torch.stack([gxy * gy - gyy * gx, gxy * gx - gxx * gy], -1) / safe[..., None]
    step = torch.where(peak[..., None], step.clamp(-1.5, 1.5), torch.zeros_like(step))
    return _plain(inner.to(heatmaps.dtype) + step, value)


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """X (..., n, m) of matrix (..., n, n) X = right; matrix positive definite."""
    if not torch.onnx.is_in_onnx_export():
        return torch.linalg.solve(matrix, right)
    # ONNX has no solver: Gauss-Jordan, which needs no pivoting here.
    n, both = matrix.shape[-1], torch.cat([matrix, right], -1)
    for i in range(n):
        row = both[..., i : i + 1, :] / both[..., i : i + 1, i : i + 1]
        both = both - both[..., :, i : i + 1] * row
        both = torch.cat([both[..., :i, :], row, both[..., i + 1 :, :]], -2)
    return both[..., n:]


def _decode_gauss_newton(heatmaps: Tensor, sigma: float, iterations: int = 6) -> tuple[Tensor, ...]:
    """Least-squares fit of a exp(-|c - x|^2 / (2 (w sigma)^2)) + b in a disc, started from the paper's disc centroid.

    The five unknowns are x, y, width w, height a and offset b.  Steps are damped and limited.  A fit that leaves the disc
    or ends with a width below 0.4 or above 2.5 falls back to the centroid, with a wide covariance.
    """
    start, value, *_ = _decode_disc(heatmaps, sigma)
    h, w = heatmaps.shape[-2:]
    limit = torch.tensor([w - 1, h - 1], device=heatmaps.device)
    cell = torch.minimum(start.round().long().clamp_min(0), limit)
    reach = max(2.0 * sigma, 1.5)
    p, offsets, inside = _patches(heatmaps, cell, int(reach + 0.5))
    p = p.double()
    offsets = offsets.double()
    weight = (inside & (offsets.square().sum(-1) <= (reach + 0.25) ** 2)).double()
    theta = torch.stack(
        [*(start - cell).double().unbind(-1), torch.ones_like(value).double(), value.double(), torch.zeros_like(value)],
        -1,
    )

    def model(theta: Tensor) -> tuple[Tensor, Tensor]:
        x, y, width, a, b = (t[..., None] for t in theta.unbind(-1))
        dx, dy, s2 = offsets[:, 0] - x, offsets[:, 1] - y, (width * sigma) ** 2
        g = torch.exp(-0.5 * (dx**2 + dy**2) / s2)
        jacobian = torch.stack([a * g * dx / s2, a * g * dy / s2, a * g * (dx**2 + dy**2) / (s2 * width), g, g * 0 + 1])
        return (p - a * g - b) * weight, jacobian.movedim(0, -1) * weight[..., None]

    damping = 1e-6 * torch.eye(5, dtype=torch.float64, device=p.device)
    step_limit = torch.tensor([0.7 * sigma, 0.7 * sigma, 0.4, 1.0, 1.0], dtype=torch.float64, device=p.device)
    for _ in range(iterations):
        residual, jacobian = model(theta)
        normal = jacobian.transpose(-1, -2) @ jacobian + damping
        step = _solve(normal, jacobian.transpose(-1, -2) @ residual[..., None])[..., 0]
        theta = theta + torch.maximum(torch.minimum(step, step_limit), -step_limit)
        theta = torch.cat([theta[..., :2], theta[..., 2:3].clamp(0.3, 3.0), theta[..., 3:]], -1)
    residual, jacobian = model(theta)
    freedom = (weight.sum(-1) - 5).clamp_min(1)
    variance = residual.square().sum(-1) / freedom + 1e-8
    unit = torch.eye(5, dtype=torch.float64, device=p.device)[:, :2].expand(*jacobian.shape[:-2], 5, 2)
    covariance = variance[..., None, None] * _solve(jacobian.transpose(-1, -2) @ jacobian + damping, unit)[..., :2, :]
    near = (theta[..., :2].square().sum(-1) <= reach**2) & (theta[..., 2] > 0.4) & (theta[..., 2] < 2.5)
    good = near & (theta.abs() < torch.inf).all(-1) & (theta[..., 3] > 0)  # NaN is not below infinity
    u = torch.where(good[..., None], cell + theta[..., :2], start.double())
    fallback = sigma**2 * torch.eye(2, dtype=torch.float64, device=p.device)
    covariance = torch.where(good[..., None, None], covariance, fallback)
    width = torch.where(good, theta[..., 2], torch.full_like(theta[..., 2], 3.0))
    return u, value, width, covariance


_DECODERS: dict[str, Callable[[Tensor, float], tuple[Tensor, ...]]] = {
    "argmax": _decode_argmax,
    "paper": _decode_disc,
    "dark": _decode_dark,
    "kornia": _decode_kornia,
    "gauss_newton": _decode_gauss_newton,
}
#: Names `decode` knows.
DECODERS = tuple(_DECODERS)


def decode(heatmaps: Tensor, stride: int, *, method: str = "gauss_newton", sigma_px: float = SIGMA_PX) -> Peaks:
    """The peak of every heatmap (n, k, h, w) of `stride` input pixels per cell, in pixels of the network's input.

    The methods are ``"argmax"``: the highest cell; ``"paper"``: the centroid of the disc of 3 sigma around it, Eq. (1)
    divided by the sum of p (as printed it is divided by the disc's area, which is no mean); ``"dark"``: Zhang et al.
    2020; ``"kornia"``: the spatial expectation in a window; ``"gauss_newton"``: a Gaussian fit, with covariance.
    Raises `ValueError` for an unknown method and for heatmaps of another shape or not finite.

    >>> heatmaps = render(torch.tensor([[[20.3, 12.8]]], dtype=torch.float64), (64, 64), 4)
    >>> decode(heatmaps, 4).u.round(decimals=3).tolist()
    [[[20.3, 12.8]]]
    """
    if method not in _DECODERS:
        raise ValueError(f"method: {method!r} is no decoder; choose one of {', '.join(DECODERS)}.")
    if heatmaps.ndim != 4 or not heatmaps.numel():
        raise ValueError(f"heatmaps: expected a non-empty (n, k, h, w), got {tuple(heatmaps.shape)}.")
    heatmaps = heatmaps.float() if heatmaps.dtype != torch.float64 else heatmaps
    if not torch.onnx.is_in_onnx_export() and not torch.isfinite(heatmaps).all():
        raise ValueError("heatmaps: not finite; the network or its input is broken (look for NaN in the images).")
    u, value, width, covariance = _DECODERS[method](heatmaps, sigma_cells(stride, sigma_px))
    u_px = _pixels(u, stride)
    return Peaks(u_px.to(heatmaps.dtype), value, width.to(heatmaps.dtype), (covariance * stride**2).to(heatmaps.dtype))
