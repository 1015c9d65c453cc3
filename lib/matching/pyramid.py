"""The pyramid of DeepMatching on responses (gy, gx, rows, columns) of a lattice of patches.

Source: Revaud, Weinzaepfel, Harchaoui, Schmid, DeepMatching: Hierarchical Deformable Dense Matching (IJCV 2016).

1. The atomic patches of 4 x 4 cells are correlated with the right image.
2. Bottom-up: the response of a patch twice as large is the mean of its four children's responses, each max-pooled
   (so that a child may move by a cell) and halved; then raised to the power 1.4.
3. Top-down: from every cell of every top map the best children are followed down and their responses added up.  Each
   cell keeps its best path only.  This is a max-sum dynamic programme, so it runs on whole maps at once.
4. A match is kept if it is the best of its left patch and of its place in the right image.

Parents live on a dense lattice whose step is the atomic patch, so every level has about as many maps as the first.  The
last two axes are either places in the right image (`shifted`: a child lies one pooled cell away from its parent) or
displacements, in which a child stays where its parent is.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch.nn.functional import max_pool1d

PATCH = 4
POWER = 1.4
BORDER_POWER = 0.9


def unit_patches(grid: torch.Tensor) -> torch.Tensor:
    """(gy, gx, 16 C) unit descriptors of the atomic patches of a grid (h, w, C)."""
    gy, gx = grid.shape[0] // PATCH, grid.shape[1] // PATCH
    cells = grid[: gy * PATCH, : gx * PATCH].reshape(gy, PATCH, gx, PATCH, -1)
    patches = cells.permute(0, 2, 1, 3, 4).reshape(gy, gx, -1)
    return patches / patches.norm(dim=2, keepdim=True).clamp_min(1e-12)


def n_levels(gy: int, gx: int) -> int:
    """Levels above the atomic patches: patches double while they fit the longer side and all their children exist."""
    levels = 0
    while 2 ** (levels + 1) <= max(gy, gx) and 2 ** max(levels - 1, 0) <= min(gy, gx) / 2:
        levels += 1
    return levels


def pool(maps: torch.Tensor, start: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Maxima over three columns at every second one; and of these over three rows at rows start, start + 2, ..."""
    along_x = max_pool1d(maps.flatten(0, 2), 3, stride=2, padding=1).reshape(*maps.shape[:3], -1)
    out = along_x[:, :, start::2].clone()
    for first, beside in ((1 - start, along_x[:, :, 1 - start :: 2]), (0, along_x[:, :, start + 1 :: 2])):
        there = out[:, :, first : first + beside.shape[2]]
        torch.maximum(there, beside[:, :, : there.shape[2]], out=there)
    return along_x, out


def unpool(
    maps: torch.Tensor, along_x: torch.Tensor, pooled: torch.Tensor, score: torch.Tensor, start: int = 0
) -> torch.Tensor:
    """Give the score of each pooled cell to the cell that was its maximum in `pool`; cells that none reaches get -inf."""
    return _unpool_axis(maps, along_x, _unpool_axis(along_x, pooled, score, 2, start), 3, 0)


def _unpool_axis(maps: torch.Tensor, pooled: torch.Tensor, score: torch.Tensor, axis: int, start: int) -> torch.Tensor:
    out = torch.full_like(maps, -torch.inf)
    cells, given, pooled, score = (x.movedim(axis, 0) for x in (maps, out, pooled, score))
    for first in (start - 1, start, start + 1):
        skip = int(first < 0)  # nothing lies before the first cell
        here, there = (x[first + 2 * skip :: 2] for x in (cells, given))
        n = min(len(here), len(pooled) - skip)
        if n > 0:
            chosen = here[:n] == pooled[skip : skip + n]
            torch.maximum(there[:n], torch.where(chosen, score[skip : skip + n], -torch.inf), out=there[:n])
    return out


def _by_axis(maps: torch.Tensor, axis: int) -> torch.Tensor:
    """The same responses with the lattice and the map along one axis first."""
    return maps.movedim((axis, axis + 2), (0, 1))


def _sides(level: int, n: int, n_map: int, shifted: bool) -> Iterator[tuple[tuple, tuple]]:
    """Indices (lattice, map) of parents and children, for the child before and the child behind, of n children."""
    wider = int(level == 1)  # there is a parent beyond the last child
    off = 1 if level == 1 else 2 ** (level - 2)
    near, far = slice(0, n_map - shifted), slice(int(shifted), n_map)
    yield (slice(off, n + wider), far), (slice(0, n + wider - off), near)
    yield (slice(0, n + wider - off), near), (slice(off - wider, n), far)


def gather(pooled: torch.Tensor, axis: int, level: int, *, shifted: bool) -> torch.Tensor:
    """Responses of the parents of a level along one lattice axis: the mean of the children that exist.

    Children beyond the lattice do not exist; of those that do, some have a place beyond the map (not valid).  The sum
    over the valid ones is divided by n_exist^0.1 n_valid^0.9, as in the published implementation.
    """
    shape = list(pooled.shape)
    shape[axis] += level == 1
    out = pooled.new_zeros(shape)
    total, single = _by_axis(out, axis), _by_axis(pooled, axis)
    exist, valid = torch.zeros(len(total), 1), torch.zeros(total.shape[:2])
    for parents, children in _sides(level, *single.shape[:2], shifted):
        total[parents] += single[children]
        exist[parents[0]] += 1
        valid[parents] += 1
    factor = exist.clamp_min(1) ** (BORDER_POWER - 1) * valid.clamp_min(1) ** -BORDER_POWER * (valid > 0)
    total *= factor.to(out)[..., None, None]
    return out


def _scatter(score: torch.Tensor, axis: int, level: int, n: int, *, shifted: bool) -> torch.Tensor:
    """Best score of the two parents for n children along one lattice axis: the reverse of `gather`."""
    shape = list(score.shape)
    shape[axis] = n
    out = score.new_full(shape, -torch.inf)
    best, paths = _by_axis(out, axis), _by_axis(score, axis)
    for parents, children in _sides(level, *best.shape[:2], shifted):
        torch.maximum(best[children], paths[parents], out=best[children])
    return out


def path_scores(pooled: torch.Tensor, levels: int, *, shifted: bool, level: int = 1) -> torch.Tensor:
    """Score of the best path through the pyramid to every pooled cell of the patches below a level; -inf where none leads.

    Args:
        pooled: Responses after the power, pooled; of the atomic patches at the first level.
        levels: Of the pyramid, at most.
    """
    if level > levels:
        return pooled
    score = gather(gather(pooled, 0, level, shifted=shifted), 1, level, shifted=shifted).pow_(POWER)
    if level < levels and score.shape[2:].numel() > 1:
        # Of displacements the epipolar line itself, the middle row, is always one that is sampled.
        start = 0 if shifted else (score.shape[2] // 2) % 2
        along_x, smaller = pool(score, start)
        above = path_scores(smaller, levels, shifted=shifted, level=level + 1)
        score = unpool(score, along_x, smaller, above, start)
    for axis in (0, 1):
        score = _scatter(score, axis, level, pooled.shape[axis], shifted=shifted)
    return score.add_(pooled)


def peak_ratio(maps: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> np.ndarray:
    """Response around each match over the largest one elsewhere in its map.

    The peak ratio of Hu and Mordohai (PAMI 2012), for responses, which are large where a place fits.

    Args:
        maps: (m, rows, columns) responses, 0 where nothing is seen; overwritten.
        row, column: (m,) int, where the match lies; the cells next to it count as the match.

    Returns:
        np.ndarray: (m,); infinite where nothing else responds, NaN where there is no place for a rival.
    """
    step = torch.arange(-1, 2, device=maps.device)
    rows = (row[:, None, None] + step[:, None]).clamp(0, maps.shape[1] - 1)
    columns = (column[:, None, None] + step).clamp(0, maps.shape[2] - 1)
    around = (rows * maps.shape[2] + columns).flatten(1)
    flat = maps.flatten(1)
    response = flat.gather(1, around).amax(dim=1)
    rival = flat.scatter_(1, around, -1.0).amax(dim=1)
    return torch.where(rival >= 0, response / rival.clamp_min(0), torch.nan).cpu().numpy().astype(np.float64)
