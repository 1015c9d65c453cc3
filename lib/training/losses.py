"""Losses: l2 of heatmaps, distance of their peaks, likelihood of offsets."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from lib.landmarks.heatmaps import SIGMA_PX, render, sigma_cells
from lib.training.augmentation import Batch


def heatmap_loss(outputs: Sequence[Tensor], batch: Batch, stride: int, sigma_px: float = SIGMA_PX) -> Tensor:
    """Squared distance of every stack's heatmaps from the Gaussians, scaled so that empty heatmaps cost 1.

    It is the sum over cells divided by pi sigma^2 (the sum of a squared Gaussian of peak 1), the mean over the landmarks
    that count, and the mean over stacks (intermediate supervision).

    >>> batch = Batch(torch.zeros(1, 3, 96, 96), torch.full((1, 3, 2), 47.5), torch.full((1, 3), 2))
    >>> round(heatmap_loss([torch.zeros(1, 3, 24, 24)], batch, stride=4).item(), 2)
    1.0
    """
    target = render(batch.u.float(), tuple(batch.images.shape[-2:]), stride, sigma_px) * batch.peak[..., None, None]
    scale = math.pi * sigma_cells(stride, sigma_px) ** 2 * batch.weight.sum().clamp_min(1)
    losses = [((output.float() - target).square().sum((-2, -1)) * batch.weight).sum() / scale for output in outputs]
    return torch.stack(losses).mean()


def position_loss(outputs: Sequence[Tensor], batch: Batch, stride: int, sigma_px: float = SIGMA_PX) -> Tensor:
    """Mean distance in px (smoothed within 0.2 px) of every stack's peaks from the visible landmarks.

    The l2 loss of heatmaps is nearly flat within the last pixel: a displacement d costs (d / sigma)^2 / 2 of an empty
    heatmap.  A peak's position is twice the centroid of its product with the target's Gaussian, relative to the landmark:
    exact for a Gaussian of the same width (the product's centre lies halfway), smooth, and independent of what lies far
    away.  Landmarks within 2 sigma of the border, where the sums are cut, and those with less than a quarter of a peak do
    not count.
    """
    size = tuple(batch.images.shape[-2:])
    u = batch.u.float()
    inside = ((u > 2 * sigma_px) & (u < u.new_tensor(size[::-1]) - 1 - 2 * sigma_px)).all(-1)  # NaN is not inside
    weight = (inside & (batch.visibility == 2)).float()
    target = render(u, size, stride, sigma_px)
    rows, columns = (stride * torch.arange(n, device=u.device) + (stride - 1) / 2 for n in target.shape[-2:])
    least = 0.25 * math.pi * sigma_cells(stride, sigma_px) ** 2
    losses = []
    for output in outputs:
        product = output.float() * target
        total = product.sum((-2, -1))
        sums = torch.stack([product.sum(-2) @ columns, product.sum(-1) @ rows], -1)
        moved = sums - total[..., None] * torch.nan_to_num(u)
        there = weight * (total > least)
        distance = ((2 * moved / total.clamp_min(least)[..., None]).square().sum(-1) + 0.04).sqrt() - 0.2
        losses.append((distance * there).sum() / weight.sum().clamp_min(1))
    return torch.stack(losses).mean()


def offset_loss(outputs: Sequence[Tensor], batch: Batch) -> Tensor:
    """Negative log likelihood of an `OffsetNetwork`'s errors under Laplace distributions with the scales that it predicts.

    A closeup has one visible landmark; without one, or without its label, it does not count.  The absolute error is
    smoothed within 0.1 px.
    Gross errors weigh little under it; divided by the scale, a sharp image weighs more than a blurred one.
    """
    (found,) = outputs
    centre = (batch.images.shape[-1] - 1) / 2
    own = (batch.visibility == 2) & batch.u.isfinite().all(-1)
    there = own.any(1).float()
    true = torch.where(own[..., None], batch.u.float(), 0.0).sum(1) - centre
    distance = ((found[:, :2].float() - true).square() + 0.01).sqrt()
    log_scale = found[:, 2:].float()
    return ((log_scale + distance * (-log_scale).exp()).sum(1) * there).sum() / there.sum().clamp_min(1)
