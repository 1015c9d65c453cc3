"""Heatmaps: Gaussian targets for given positions, and the decoders that recover positions from heatmaps.

Cells and pixels obey the half-pixel rule of `lib.geometry`: cell c of a heatmap of stride s is centred on pixel
s * c + (s - 1) / 2.  Sigma is in pixels of the network's input for every stride.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor

#: Standard deviation of the targets (paper Sec. V-B), px of the network's input.
SIGMA_PX = 5.0
#: The methods of `decode`.  Three more are compared in notebook 02 (`notebooks/studies/decoders.py`).
DECODERS = ("paper", "gauss_newton")
#: A fit has converged if the steps of all parameters (positions in cells) are below this.
_CONVERGED = 1e-4


def sigma_cells(stride: int, sigma_px: float = SIGMA_PX) -> float:
    """Sigma in cells, at least 0.6: a narrower Gaussian would fall between the cells (at stride 64, of the encoder)."""
    return max(sigma_px / stride, 0.6)


def render(u: Tensor, image_size: tuple[int, int], stride: int, sigma_px: float = SIGMA_PX) -> Tensor:
    """Render Gaussians of height 1 at subpixel positions: the targets of the l2 loss (paper Sec. III).

    Takes points u (n, k, 2) px of an input of size (h, w), and returns heatmaps (n, k, ceil(h / stride), ceil(w / stride)).
    The heatmap of a NaN point is 0 everywhere.

    >>> heatmaps = render(torch.tensor([[[5.5, 9.5]]]), (16, 32), 4)
    >>> heatmaps.shape, heatmaps[0, 0, 2, 1].item()
    (torch.Size([1, 1, 4, 8]), 1.0)
    """
    rows, columns = (torch.arange(-(-side // stride), dtype=u.dtype, device=u.device) for side in image_size)
    cells = (u - (stride - 1) / 2) / stride
    scale = -0.5 / sigma_cells(stride, sigma_px) ** 2
    along_x = torch.exp(scale * (columns - cells[..., :1]) ** 2)
    along_y = torch.exp(scale * (rows - cells[..., 1:]) ** 2)
    return torch.nan_to_num(along_y[..., :, None] * along_x[..., None, :], nan=0.0)


class Peaks(NamedTuple):
    """The peak that a decoder finds in each heatmap.

    Attributes:
        u: (n, k, 2) px of the network's input.
        value: (n, k) height of the heatmap's highest cell; the target's peak has height 1.
        width: (n, k) sigma of the peak divided by that of the target; 1 if the decoder does not fit it.
        covariance: (n, k, 2, 2) px^2, from the residuals of the fit; NaN if the decoder gives none.
        rival: (n, k) largest value of the heatmap more than 3 sigma from the peak.
    """

    u: Tensor
    value: Tensor
    width: Tensor
    covariance: Tensor
    rival: Tensor

    def double(self) -> Self:
        """The same in float64."""
        return Peaks(*(part.double() for part in self))


def _patches(heatmaps: Tensor, centre: Tensor, radius: int) -> tuple[Tensor, Tensor, Tensor]:
    """Square neighbourhoods: values (n, k, p), offsets (p, 2) from `centre` in cells, mask (n, k, p) of cells inside."""
    h, w = heatmaps.shape[-2:]
    side = torch.arange(-radius, radius + 1, device=heatmaps.device)
    dy, dx = torch.meshgrid(side, side, indexing="ij")
    offsets = torch.stack([dx, dy], -1).reshape(-1, 2)
    at = centre[..., None, :] + offsets
    inside = ((at >= 0) & (at < torch.tensor([w, h], device=heatmaps.device))).all(-1)
    flat = at[..., 1].clamp(0, h - 1) * w + at[..., 0].clamp(0, w - 1)
    return heatmaps.flatten(-2).gather(-1, flat), offsets.to(heatmaps.dtype), inside


def disc_mean(heatmaps: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Position of the peak in cells, the mean over the disc Delta of Eq. (1) weighted by p, and the highest cell's value."""
    if not torch.onnx.is_in_onnx_export() and not torch.isfinite(heatmaps).all():
        raise ValueError("heatmaps: not finite; the network or its input is broken (look for NaN in the images).")
    value, flat = heatmaps.flatten(-2).max(-1)
    w = heatmaps.shape[-1]
    cell = torch.stack([flat % w, torch.div(flat, w, rounding_mode="floor")], -1)
    p, offsets, inside = _patches(heatmaps, cell, int(3 * sigma))
    # The network's outputs can be negative, probabilities cannot.
    weights = p.clamp_min(0) * inside * (offsets.square().sum(-1) <= (3 * sigma) ** 2)
    total = weights.sum(-1, keepdim=True)
    return cell.to(heatmaps.dtype) + (weights @ offsets) / total.clamp_min(torch.finfo(total.dtype).tiny), value


def distances2(heatmaps: Tensor, u: Tensor) -> Tensor:
    """Squared distances (n, k, h, w) of the cells of heatmaps from points u (n, k, 2), in cells."""
    rows, columns = (torch.arange(side, dtype=u.dtype, device=u.device) for side in heatmaps.shape[-2:])
    return (columns - u[..., None, :1]) ** 2 + (rows[:, None] - u[..., None, 1:]) ** 2


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve matrix (..., n, n) X = right for X (..., n, m); the matrix must be positive definite."""
    if not torch.onnx.is_in_onnx_export():
        return torch.linalg.solve(matrix, right)
    # ONNX has no solver, so eliminate (Gauss-Jordan); a positive definite matrix needs no pivoting.
    n, both = matrix.shape[-1], torch.cat([matrix, right], -1)
    for i in range(n):
        row = both[..., i : i + 1, :] / both[..., i : i + 1, i : i + 1]
        both = both - both[..., :, i : i + 1] * row
        both = torch.cat([both[..., :i, :], row, both[..., i + 1 :, :]], -2)
    return both[..., n:]


def _gauss_newton(heatmaps: Tensor, sigma: float, start: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a exp(-|c - x|^2 / (2 (w sigma)^2)) + b in a disc by least squares, started from the paper's disc centroid.

    The five unknowns are x, y, width w, height a and offset b.  Steps are damped and limited.  A fit that leaves the disc, or
    has a width below 0.4 or above 2.5, is replaced by the centroid with variance sigma^2.  Returns x and y, w, covariance.
    """
    h, w = heatmaps.shape[-2:]
    cell = torch.minimum(start.round().long().clamp_min(0), torch.tensor([w - 1, h - 1], device=heatmaps.device))
    reach = max(2.0 * sigma, 1.5)
    p, offsets, inside = (part.double() for part in _patches(heatmaps, cell, int(reach + 0.5)))
    weight = inside * (offsets.square().sum(-1) <= (reach + 0.25) ** 2)
    one = torch.ones_like(value).double()
    theta = torch.stack([*(start - cell).double().unbind(-1), one, value.double(), 0 * one], -1)

    def model(theta: Tensor) -> tuple[Tensor, Tensor]:
        width, a, b = theta[..., None, 2:].unbind(-1)
        apart = offsets - theta[..., None, :2]
        s2 = (width * sigma) ** 2
        q = apart.square().sum(-1) / s2
        g = torch.exp(-0.5 * q) * weight
        ag = a * g
        jacobian = [(ag / s2)[..., None] * apart, torch.stack([ag * q / width, g, weight.expand_as(g)], -1)]
        return (p - b) * weight - ag, torch.cat(jacobian, -1)

    eye = torch.eye(5, dtype=torch.float64, device=p.device)
    bounds = [[0.7 * sigma, 0.7 * sigma, 0.4, 1.0, 1.0], [torch.inf, torch.inf, 3.0, torch.inf, torch.inf]]
    step_limit, upper = torch.tensor(bounds, dtype=torch.float64, device=p.device)
    lower = torch.where(upper < torch.inf, 0.3, -torch.inf)
    converged = torch.zeros_like(one, dtype=torch.bool)  # by peak: no peak's result depends on the rest of the batch
    for _ in range(6):
        residual, jacobian = model(theta)
        transposed = jacobian.transpose(-1, -2)  # ONNX lacks .mT
        step = _solve(transposed @ jacobian + 1e-6 * eye, transposed @ residual[..., None])[..., 0]
        step = torch.maximum(torch.minimum(step, step_limit), -step_limit).masked_fill(converged[..., None], 0.0)
        theta = torch.maximum(torch.minimum(theta + step, upper), lower)
        converged = converged | (step.abs() < _CONVERGED).all(-1)
        if not torch.onnx.is_in_onnx_export() and converged.all():
            break
    residual, jacobian = model(theta)
    variance = residual.square().sum(-1) / (weight.sum(-1) - 5).clamp_min(1) + 1e-8
    normal = jacobian.transpose(-1, -2) @ jacobian + 1e-6 * eye
    covariance = variance[..., None, None] * _solve(normal, eye[:, :2].expand(*jacobian.shape[:-2], 5, 2))[..., :2, :]
    width = theta[..., 2]
    near = (theta[..., :2].square().sum(-1) <= reach**2) & (width > 0.4) & (width < 2.5)
    good = near & (theta.abs() < torch.inf).all(-1) & (theta[..., 3] > 0)  # NaN is not good
    u = torch.where(good[..., None], cell + theta[..., :2], start.double())
    covariance = torch.where(good[..., None, None], covariance, sigma**2 * eye[:2, :2])
    return u, torch.where(good, width, torch.full_like(width, 3.0)), covariance


def decode(heatmaps: Tensor, stride: int, *, method: str = "gauss_newton", sigma_px: float = SIGMA_PX) -> Peaks:
    """Find the peak of every heatmap (n, k, h, w) of `stride` input pixels per cell, in pixels of the network's input.

    Args:
        method: ``"paper"``: the weighted centroid of the disc of 3 sigma around the highest cell, Eq. (1) divided by the sum
            of p (the paper prints the disc's area, which gives no mean); ``"gauss_newton"``: a Gaussian fit, with covariance.

    Raises ValueError for an unknown method, and for heatmaps that have another shape or are not finite.

    >>> heatmaps = render(torch.tensor([[[20.3, 12.8]]], dtype=torch.float64), (64, 64), 4)
    >>> decode(heatmaps, 4).u.round(decimals=3).tolist()
    [[[20.3, 12.8]]]
    """
    if method not in DECODERS:
        raise ValueError(f"method: {method!r} is no decoder; choose one of {', '.join(DECODERS)}.")
    if heatmaps.ndim != 4 or not heatmaps.numel():
        raise ValueError(f"heatmaps: expected a non-empty (n, k, h, w), got {tuple(heatmaps.shape)}.")
    heatmaps = heatmaps.float() if heatmaps.dtype != torch.float64 else heatmaps
    sigma = sigma_cells(stride, sigma_px)
    u, value = disc_mean(heatmaps, sigma)
    width, covariance = torch.ones_like(value), torch.full_like(u[..., None, :].expand(*u.shape, 2), torch.nan)
    if method == "gauss_newton":
        u, width, covariance = _gauss_newton(heatmaps, sigma, u, value)
    far = distances2(heatmaps, u) > (3 * sigma) ** 2
    rival = torch.where(far, heatmaps, torch.zeros_like(heatmaps)).flatten(-2).amax(-1)
    u_px = stride * u + (stride - 1) / 2  # as `lib.geometry.image_from_cell`
    return Peaks(*(part.to(heatmaps.dtype) for part in (u_px, value, width, covariance * stride**2, rival)))
