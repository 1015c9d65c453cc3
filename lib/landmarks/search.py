"""Peaks of heatmaps: several of them, those near a known place, and the tools that they may belong to."""

import numpy as np
import torch

from lib.landmarks.heatmaps import SIGMA_PX, disc_mean, distances2, sigma_cells
from lib.landmarks.metrics import tool_length_px

#: Number of peaks taken from each heatmap.
PEAKS = 4
#: Two tools count as one if the mean distance between their landmarks is at most this share of the length.
_SAME = 0.25
#: Weight of the jaws' opening, relative to the tool's length, in a score; chosen on validation scenes.
_OPENING_WEIGHT = 0.25


def several_peaks(heatmaps: torch.Tensor, n: int, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the `n` highest peaks of heatmaps (m, k, h, w), 3 sigma apart: centroids (n m, k, 2) px and heights (n m, k)."""
    sigma, found = sigma_cells(stride, SIGMA_PX), []
    for _ in range(n):
        found.append(disc_mean(heatmaps, sigma))  # accurate enough: the next stage measures in a window
        heatmaps = heatmaps.masked_fill(distances2(heatmaps, found[-1][0]) < (3 * sigma) ** 2, -1.0)
    u, value = (torch.cat(part) for part in zip(*found, strict=True))
    return (stride * u + (stride - 1) / 2).numpy(), value.numpy()


def near_only(heatmaps: torch.Tensor, u: np.ndarray, reach: float, stride: int) -> torch.Tensor:
    """Set heatmaps (n, 3, h, w) to 0 where a cell is farther from the heatmap's landmark in u (n, 3, 2) px than `reach`.

    `reach` is a share of the tool's length.  The heatmap of a landmark that is NaN does not change.

    >>> near_only(torch.ones(1, 3, 1, 8), np.array([[[2.0, 0], [6, 0], [6, 0]]]), 0.25, 1)[0, 0].tolist()
    [[0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]]
    """
    cells = (u - (stride - 1) / 2) / stride
    reach2 = torch.from_numpy((reach * tool_length_px(cells)) ** 2)[:, None, None, None]
    return heatmaps.masked_fill(distances2(heatmaps, torch.from_numpy(cells)) > reach2, 0.0)


def best_tools(u: np.ndarray, height: np.ndarray, n: int) -> np.ndarray:
    """Combine peaks u (k, 3, 2) px of heights (k, 3) to the `n` likeliest tools, or fewer: (m, 3), each landmark's peak.

    A tool is likely if its peaks are high, if its jaws are about equally long and no farther apart than they are long, and if
    tip_1 lies on the left for a view along the tool.  Of similar tools only the likeliest is returned.

    >>> u = np.array([[[0, 0], [9, -2], [90, 2]], [[0, 1], [80, 9], [9, 2]]])
    >>> best_tools(u, np.array([[1.0, 1.0, 0.8], [0.2, 0.7, 0.5]]), 1)
    array([[0, 0, 1]])
    """
    which = np.indices((len(u),) * 3).reshape(3, -1).T
    tools, score = u[which, np.arange(3)], np.log(np.clip(height[which, np.arange(3)], 0.02, 1)).sum(1)
    base, one, two = (tools[:, k] for k in range(3))
    jaws = np.stack([np.linalg.norm(one - base, axis=1), np.linalg.norm(two - base, axis=1)]) + 1.0
    length, ahead = jaws.mean(0), (one + two) / 2 - base
    score -= 2 * np.abs(np.log(jaws[0] / jaws[1])) + 2 * np.clip(np.linalg.norm(one - two, axis=1) / length - 1, 0, None)
    score -= ahead[:, 0] * (one - two)[:, 1] > ahead[:, 1] * (one - two)[:, 0]
    chosen: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        apart = np.linalg.norm(tools[chosen] - tools[i], axis=2).mean(1) if chosen else np.ones(0)
        if (apart > _SAME * length[chosen]).all():
            chosen.append(int(i))
        if len(chosen) == n:
            break
    return which[chosen]


def likelihood(u: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Score tools u (n, 3, 2) px by their peaks' mean height (n,) and their opening, as a rod looks like shut jaws: (n,)."""
    opening = np.linalg.norm(u[:, 1] - u[:, 2], axis=1) / np.maximum(tool_length_px(u), 1.0)
    return height + _OPENING_WEIGHT * np.nan_to_num(opening)
