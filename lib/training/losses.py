"""Losses: l2 of heatmaps, likelihood of offsets."""

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


def offset_loss(outputs: Sequence[Tensor], batch: Batch) -> Tensor:
    """Negative log likelihood of an `OffsetNetwork`'s errors under Laplace distributions with the scales that it predicts.

    A closeup has one visible landmark; without one, or without its label, it does not count.  The absolute error is smoothed
    within 0.1 px.  Gross errors weigh little under it; divided by the scale, a sharp image weighs more than a blurred one.
    """
    (found,) = outputs
    own = (batch.visibility == 2) & batch.u.isfinite().all(-1)
    there = own.any(1).float()
    true = torch.where(own[..., None], batch.u.float(), 0.0).sum(1) - (batch.images.shape[-1] - 1) / 2
    distance = ((found[:, :2].float() - true).square() + 0.01).sqrt()
    log_scale = found[:, 2:].float()
    return ((log_scale + distance * (-log_scale).exp()).sum(1) * there).sum() / there.sum().clamp_min(1)
