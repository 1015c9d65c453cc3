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
from dataclasses import dataclass

import numpy as np
import torch

__all__ = ["PATCH", "POWER", "bottom_up", "gather", "n_levels", "peak_ratio", "pool", "top_down", "unit_patches", "unpool"]

PATCH = 4
POWER = 1.4
BORDER_POWER = 0.9


@dataclass(frozen=True)
class Pyramid:
    """Responses of the patches of all sizes."""

    pools: list[tuple[torch.Tensor | None, torch.Tensor]]  # maxima along x, and along both; of level 0 the latter
    responses: list[torch.Tensor]  # levels 1 to top
    shifted: bool  # whether the last two axes are places (else displacements)


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
    along_x = _pool_axis(maps, 3, 0)
    return along_x, _pool_axis(along_x, 2, start)


def _every_second(maps: torch.Tensor, axis: int, first: int) -> torch.Tensor:
    index = [slice(None)] * maps.ndim
    index[axis] = slice(first, None, 2)
    return maps[tuple(index)]


def _pool_axis(maps: torch.Tensor, axis: int, start: int) -> torch.Tensor:
    out = _every_second(maps, axis, start).clone(memory_format=torch.contiguous_format)
    for neighbour in (start - 1, start + 1):
        skip = int(neighbour < 0)  # nothing lies before the first sample
        beside = _every_second(maps, axis, neighbour + 2 * skip)
        n = min(beside.shape[axis], out.shape[axis] - skip)
        there = out.narrow(axis, skip, n)
        torch.maximum(there, beside.narrow(axis, 0, n), out=there)
    return out


def unpool(
    maps: torch.Tensor, along_x: torch.Tensor, pooled: torch.Tensor, score: torch.Tensor, start: int = 0
) -> torch.Tensor:
    """Give the score of each pooled cell to the cell that was its maximum in `pool`; cells that none reaches get -inf."""
    return _unpool_axis(maps, along_x, _unpool_axis(along_x, pooled, score, 2, start), 3, 0)


def _unpool_axis(maps: torch.Tensor, pooled: torch.Tensor, score: torch.Tensor, axis: int, start: int) -> torch.Tensor:
    out = torch.full_like(maps, -torch.inf)
    for first in (start - 1, start, start + 1):
        skip = int(first < 0)
        there, here = (_every_second(x, axis, first + 2 * skip) for x in (out, maps))
        n = min(here.shape[axis], pooled.shape[axis] - skip)
        if n > 0:
            there, here = there.narrow(axis, 0, n), here.narrow(axis, 0, n)
            chosen = here == pooled.narrow(axis, skip, n)
            torch.maximum(there, torch.where(chosen, score.narrow(axis, skip, n), -torch.inf), out=there)
    return out


def _sides(axis: int, level: int, n: int, n_map: int, shifted: bool) -> Iterator[tuple[tuple, tuple]]:
    """Indices of (parents, children) for the child before and the child behind along one axis of n children."""
    off = 1 if level == 1 else 2 ** (level - 2)
    shift = int(shifted)
    before = slice(off, n + (level == 1)), slice(0, n - off + (level == 1))
    behind = (slice(0, n), slice(0, n)) if level == 1 else (slice(0, n - off), slice(off, n))
    near, far = slice(0, n_map - shift), slice(shift, n_map)
    for (parents, children), (to, origin) in ((before, (far, near)), (behind, (near, far))):
        index = [[slice(None)] * 4 for _ in range(2)]
        index[0][axis], index[0][axis + 2] = parents, to
        index[1][axis], index[1][axis + 2] = children, origin
        yield tuple(index[0]), tuple(index[1])


def gather(pooled: torch.Tensor, axis: int, level: int, *, shifted: bool) -> torch.Tensor:
    """Responses of the parents of a level along one lattice axis: the mean of the children that exist.

    Children beyond the lattice do not exist; of those that do, some have a place beyond the map (not valid).  The sum
    over the valid ones is divided by n_exist^0.1 n_valid^0.9, as in the published implementation.
    """
    n, n_map = pooled.shape[axis], pooled.shape[axis + 2]
    shape = list(pooled.shape)
    shape[axis] = n + (level == 1)
    out = pooled.new_zeros(shape)
    exist, valid = (torch.zeros([s if k in (axis, axis + 2) else 1 for k, s in enumerate(shape)]) for _ in range(2))
    for parents, children in _sides(axis, level, n, n_map, shifted):
        out[parents] += pooled[children]
        valid[parents] += 1
        exist[tuple(s if k == axis else slice(None) for k, s in enumerate(parents))] += 1
    factor = exist.clamp_min(1) ** (BORDER_POWER - 1) * valid.clamp_min(1) ** -BORDER_POWER * (valid > 0)
    return out.mul_(factor.to(out))


def _scatter(score: torch.Tensor, axis: int, level: int, n: int, *, shifted: bool) -> torch.Tensor:
    """Best score of the two parents for n children along one lattice axis: the reverse of `gather`."""
    shape = list(score.shape)
    shape[axis] = n
    out = score.new_full(shape, -torch.inf)
    for parents, children in _sides(axis, level, n, score.shape[axis + 2], shifted):
        there = out[children]
        torch.maximum(there, score[parents], out=there)
    return out


def bottom_up(pooled: torch.Tensor, levels: int, *, shifted: bool) -> Pyramid:
    """The pyramid over the pooled responses of the atomic patches, after the power; `levels` at most."""
    pools, responses = [(None, pooled)], []
    for level in range(1, levels + 1):
        responses.append(gather(gather(pools[-1][1], 0, level, shifted=shifted), 1, level, shifted=shifted).pow_(POWER))
        if level == levels or responses[-1].shape[2:].numel() == 1:
            break
        pools.append(pool(responses[-1], _start(responses[-1], shifted)))
    return Pyramid(pools, responses, shifted)


def _start(maps: torch.Tensor, shifted: bool) -> int:
    """First row that is sampled: of displacements the epipolar line itself, the middle row, is always one of them."""
    return 0 if shifted else (maps.shape[2] // 2) % 2


def top_down(pyramid: Pyramid) -> torch.Tensor:
    """Score of the best path to every pooled cell of the atomic patches; -inf where none leads."""
    score = pyramid.responses[-1] if pyramid.responses else pyramid.pools[0][1]
    for level in range(len(pyramid.responses), 0, -1):
        along_x, pooled = pyramid.pools[level - 1]
        for axis in (0, 1):
            score = _scatter(score, axis, level, pooled.shape[axis], shifted=pyramid.shifted)
        score.add_(pooled)
        if level > 1:
            maps = pyramid.responses[level - 2]
            score = unpool(maps, along_x, pooled, score, _start(maps, pyramid.shifted))
    return score


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
