"""DeepMatching in torch: free semi-dense matching of two images of any size, on the CPU or on CUDA.

Source: Revaud, Weinzaepfel, Harchaoui, Schmid, DeepMatching: Hierarchical Deformable Dense Matching (IJCV 2016).

1. Atomic 4 x 4 cell patches of the left descriptor grid are correlated with every window of the right one.
2. Bottom-up: the response map of a patch twice as large is the mean of its four children's maps, each max-pooled
   (so that a child may move by a cell), halved and shifted to its corner; then raised to 1.4.
3. Top-down: from every cell of every top map the best children are followed down, responses added up.  Each map
   cell keeps its best path only, which is a max-sum dynamic programme, so it runs on whole maps at once.
4. A match is kept if it is the best of its left patch and of its right bin.

Parents live on a dense lattice whose step is the atomic patch, so every level has about as many maps as the first.
Of the bottom level only the pooled maps are stored: a path enters a 3 x 3 neighbourhood at its maximum.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from lib.matching.descriptors import CHANNELS

__all__ = [
    "PATCH",
    "POWER",
    "GridMatches",
    "Pyramid",
    "atomic_response",
    "bottom_up",
    "match_grids",
    "n_levels",
    "plan_tiles",
    "predicted_bytes",
    "top_down",
]

PATCH = 4
POWER = 1.4
BORDER_POWER = 0.9
#: Bytes of the bottom level's unpooled maps that are held at once.
CHUNK_BYTES = 96 << 20


@dataclass(frozen=True)
class GridMatches:
    """Matches in cells of the descriptor grids: patch centres in corner coordinates (cell i spans [i, i + 1]).

    Beside the (n,) score: the response of the atomic patch over the best one elsewhere, and whether no other patch fits
    the same place better.
    """

    left: np.ndarray
    right: np.ndarray
    score: np.ndarray
    peak_ratio: np.ndarray
    reciprocal: np.ndarray


@dataclass(frozen=True)
class Pyramid:
    """Response maps of all patches.

    Attributes
    ----------
    pooled:
        Per level, (gy, gx, h, w): 3 x 3 maxima at every second cell, level 0 after the power.
    offset:
        (gy, gx, h, w) int8, where in its 3 x 3 neighbourhood the bottom maximum lies: 3 dy + dx.
    responses:
        Levels 1 to top, (gy + 1, gx + 1, h, w).
    """

    pooled: list[torch.Tensor]
    offset: torch.Tensor
    responses: list[torch.Tensor]


def n_levels(gy: int, gx: int) -> int:
    """Levels above the atomic patches: patches double while they fit the longer side and all their children exist."""
    levels = 0
    while 2 ** (levels + 1) <= max(gy, gx) and 2 ** max(levels - 1, 0) <= min(gy, gx) / 2:
        levels += 1
    return levels


def _half(n: int) -> int:
    return (n + 1) // 2


def predicted_bytes(grid_left: tuple[int, int], grid_right: tuple[int, int]) -> int:
    """Peak memory (bytes, float32) of `match_grids` for descriptor grids of these (rows, columns) in one piece."""
    gy, gx = grid_left[0] // PATCH, grid_left[1] // PATCH
    n_y, n_x = grid_right[0] + 1, grid_right[1] + 1
    windows = n_y * n_x * PATCH * PATCH * CHANNELS * 4
    chunk = max(min(CHUNK_BYTES, gy * gx * n_y * n_x * 4), gx * n_y * n_x * 4) * 3
    n_y, n_x = _half(n_y), _half(n_x)
    total = gy * gx * n_y * n_x * 5
    lattice = (gy + 1) * (gx + 1) * 4
    # Going down, the bottom scores (as many as pooled responses) stand beside everything else.
    scores = gy * gx * n_y * n_x * 4 + lattice * n_y * n_x
    for _ in range(n_levels(gy, gx)):
        total += lattice * n_y * n_x
        n_y, n_x = _half(n_y), _half(n_x)
        total += lattice * n_y * n_x
    return total + max(scores, windows + chunk)


def plan_tiles(grid_left: tuple[int, int], grid_right: tuple[int, int], budget_bytes: int) -> list[tuple[slice, slice]]:
    """Cut the left grid into equal tiles, each matched with the whole right grid, that fit the budget.

    Returns
    -------
    list of (rows, columns)
        One entry where all fits in one piece.

    Raises
    ------
    ValueError
        If not even tiles of 16 x 16 patches fit; the message says what is needed.
    """
    gy, gx = grid_left[0] // PATCH, grid_left[1] // PATCH
    size_y, size_x = gy, gx
    while (need := predicted_bytes((size_y * PATCH, size_x * PATCH), grid_right)) > budget_bytes:
        if max(size_y, size_x) <= 16:
            raise ValueError(
                f"budget_bytes: DeepMatching needs {predicted_bytes(grid_left, grid_right) / 2**30:.1f} GiB in one "
                f"piece and {need / 2**30:.2f} GiB in its smallest tiles; the budget is {budget_bytes / 2**30:.2f}. "
                "Raise downscale, or match with a rig (method 'band')."
            )
        if size_y >= size_x:
            size_y = -(-size_y // 2)
        else:
            size_x = -(-size_x // 2)
    return [
        (slice(y * PATCH, min(y + size_y, gy) * PATCH), slice(x * PATCH, min(x + size_x, gx) * PATCH))
        for y in range(0, gy, size_y)
        for x in range(0, gx, size_x)
    ]


def _patches(left: torch.Tensor) -> torch.Tensor:
    """(gy, gx, 16 C) unit descriptors of the atomic patches."""
    gy, gx, channels = left.shape[0] // PATCH, left.shape[1] // PATCH, left.shape[2]
    left = left[: gy * PATCH, : gx * PATCH].reshape(gy, PATCH, gx, PATCH, channels)
    patches = left.permute(0, 2, 1, 3, 4).reshape(gy, gx, -1)
    return patches / patches.norm(dim=2, keepdim=True).clamp_min(1e-12)


def _windows(right: torch.Tensor) -> torch.Tensor:
    """(h + 1, w + 1, 16 C) unit descriptors of the windows around every cell corner, zero outside the grid."""
    height, width, channels = right.shape
    pad = PATCH // 2
    padded = right.new_zeros(height + PATCH, width + PATCH, channels)
    padded[pad : pad + height, pad : pad + width] = right
    windows = right.new_empty(height + 1, width + 1, PATCH, PATCH, channels)
    for r in range(PATCH):
        for c in range(PATCH):
            windows[:, :, r, c] = padded[r : r + height + 1, c : c + width + 1]
    windows = windows.reshape(height + 1, width + 1, -1)
    norm = windows.norm(dim=2, keepdim=True)
    return windows.div_(norm.clamp_min(1e-12))


def _border_ranges(n: int) -> Iterator[tuple[int, slice]]:
    """Positions 0, 1, n - 2, n - 1 whose windows leave the grid of n - 1 cells, and the patch cells still seen."""
    yield from ((0, slice(2, 4)), (1, slice(1, 4)), (n - 2, slice(0, 3)), (n - 1, slice(0, 2)))


def _rescale_borders(maps: torch.Tensor, patches: torch.Tensor) -> None:
    """Divide responses at the border by the norm of the part of the patch that falls inside the image."""
    energy = patches.reshape(*patches.shape[:2], PATCH, PATCH, -1).square().sum(dim=4)
    n_y, n_x = maps.shape[2:]
    borders_y, borders_x = list(_border_ranges(n_y)), list(_border_ranges(n_x))
    for y, rows in borders_y:
        maps[:, :, y, 2:-2] /= energy[:, :, rows].sum(dim=(2, 3)).sqrt().clamp_min(1e-6)[:, :, None]
    for x, columns in borders_x:
        maps[:, :, 2:-2, x] /= energy[:, :, :, columns].sum(dim=(2, 3)).sqrt().clamp_min(1e-6)[:, :, None]
    for y, rows in borders_y:
        for x, columns in borders_x:
            maps[:, :, y, x] /= energy[:, :, rows, columns].sum(dim=(2, 3)).sqrt().clamp_min(1e-6)


def _pool_axis(maps: torch.Tensor, axis: int) -> torch.Tensor:
    """Maximum over [-1, 1] around every second cell of one axis."""
    out = maps[..., ::2].clone() if axis == 3 else maps[:, :, ::2].clone()
    odd = maps[..., 1::2] if axis == 3 else maps[:, :, 1::2]
    m = odd.shape[axis]
    torch.maximum(out.narrow(axis, 0, m), odd, out=out.narrow(axis, 0, m))
    m = min(m, out.shape[axis] - 1)
    torch.maximum(out.narrow(axis, 1, m), odd.narrow(axis, 0, m), out=out.narrow(axis, 1, m))
    return out


def _pool(maps: torch.Tensor) -> torch.Tensor:
    return _pool_axis(_pool_axis(maps, 3), 2)


def _pool_with_offset(maps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`_pool`, and where each maximum lies (3 dy + dx, the centre first among equals)."""
    along_x = _pool_axis(maps, 3)
    n_x = along_x.shape[3]
    odd = maps[..., 1::2]
    offset_x = torch.zeros(along_x.shape, dtype=torch.int8, device=maps.device)
    m = odd.shape[3]
    offset_x[..., :m] += along_x[..., :m] == odd
    m = min(m, n_x - 1)
    offset_x[..., 1 : m + 1] -= (along_x[..., 1 : m + 1] == odd[..., :m]).to(torch.int8)
    offset_x *= along_x != maps[..., ::2]

    pooled = _pool_axis(along_x, 2)
    odd, odd_offset = along_x[:, :, 1::2], offset_x[:, :, 1::2]
    offset = offset_x[:, :, ::2].clone()
    away = pooled != along_x[:, :, ::2]
    m = odd.shape[2]
    here = away[:, :, :m] & (pooled[:, :, :m] == odd)
    offset[:, :, :m] = torch.where(here, odd_offset + 3, offset[:, :, :m])
    m = min(m, pooled.shape[2] - 1)
    here = away[:, :, 1 : m + 1] & (pooled[:, :, 1 : m + 1] == odd[:, :, :m])
    offset[:, :, 1 : m + 1] = torch.where(here, odd_offset[:, :, :m] - 3, offset[:, :, 1 : m + 1])
    return pooled, offset


def _axis_factor(n_lattice: int, off: int, n_map: int, level: int, like: torch.Tensor) -> torch.Tensor:
    """(n_lattice, n_map) factor of one axis that turns the sum over valid children into the response.

    sum / n_exist * (n_exist / n_valid)^0.9: children beyond the lattice do not exist, shifts beyond the map are
    not valid, and both counts are products over the two axes.
    """
    i, p = np.arange(n_lattice)[:, None], np.arange(n_map)[None]
    if level == 1:
        exists = np.stack([i - 1 >= 0, i < n_lattice - 1])
    else:
        exists = np.stack([i - off >= 0, i + off < n_lattice])
    valid = exists & np.stack([p - 1 >= 0, p + 1 < n_map])
    n_exist, n_valid = exists.sum(axis=0), valid.sum(axis=0)
    factor = np.maximum(n_exist, 1) ** (BORDER_POWER - 1) * np.maximum(n_valid, 1) ** -BORDER_POWER * (n_valid > 0)
    return torch.as_tensor(factor, dtype=like.dtype, device=like.device)


def _lattice_slices(n_child: int, n_parent: int, level: int) -> Iterator[tuple[int, slice, slice]]:
    """(side, parents, children) of one lattice axis, side -1 for the child before its parent."""
    if level == 1:
        yield -1, slice(1, n_parent), slice(0, n_child)
        yield +1, slice(0, n_child), slice(0, n_child)
    else:
        off = 2 ** (level - 2)
        yield -1, slice(off, n_parent), slice(0, n_child - off)
        yield +1, slice(0, n_parent - off), slice(off, n_child)


def _map_slices(side: int, n: int) -> tuple[slice, slice]:
    """(parent cells p, child cells p + side) of one map axis."""
    return (slice(1, n), slice(0, n - 1)) if side < 0 else (slice(0, n - 1), slice(1, n))


def _aggregate(pooled: torch.Tensor, level: int) -> torch.Tensor:
    """Responses of the patches of one level from the pooled maps of their children."""
    gy, gx, n_y, n_x = pooled.shape
    py, px = (gy + 1, gx + 1) if level == 1 else (gy, gx)
    out = pooled.new_zeros(py, px, n_y, n_x)
    for side_y, parent_y, child_y in _lattice_slices(gy, py, level):
        to_y, from_y = _map_slices(side_y, n_y)
        for side_x, parent_x, child_x in _lattice_slices(gx, px, level):
            to_x, from_x = _map_slices(side_x, n_x)
            out[parent_y, parent_x, to_y, to_x] += pooled[child_y, child_x, from_y, from_x]
    off = 2 ** max(level - 2, 0)
    out *= _axis_factor(py, off, n_y, level, out)[:, None, :, None]
    out *= _axis_factor(px, off, n_x, level, out)[None, :, None, :]
    return out.pow_(POWER)


def _descend(score: torch.Tensor, shape: torch.Size, level: int) -> torch.Tensor:
    """Best score that arrives at every pooled cell of the children (`shape`) from their four parents."""
    gy, gx, n_y, n_x = shape
    py, px = score.shape[:2]
    out = score.new_full(shape, -torch.inf)
    for side_y, parent_y, child_y in _lattice_slices(gy, py, level):
        to_y, from_y = _map_slices(side_y, n_y)
        for side_x, parent_x, child_x in _lattice_slices(gx, px, level):
            to_x, from_x = _map_slices(side_x, n_x)
            there = out[child_y, child_x, from_y, from_x]
            torch.maximum(there, score[parent_y, parent_x, to_y, to_x], out=there)
    return out


def _unpool(response: torch.Tensor, pooled: torch.Tensor, score: torch.Tensor) -> torch.Tensor:
    """Give each pooled cell's score to the cell that was its maximum; unreached cells get -inf."""
    out = torch.full_like(response, -torch.inf)
    for y in (-1, 0, 1):
        for x in (-1, 0, 1):
            skip_y, skip_x = int(y < 0), int(x < 0)
            target = (slice(None), slice(None), slice(y + 2 * skip_y, None, 2), slice(x + 2 * skip_x, None, 2))
            n_y = min(response[target].shape[2], pooled.shape[2] - skip_y)
            n_x = min(response[target].shape[3], pooled.shape[3] - skip_x)
            if n_y <= 0 or n_x <= 0:
                continue
            source = (slice(None), slice(None), slice(skip_y, skip_y + n_y), slice(skip_x, skip_x + n_x))
            there = out[target][:, :, :n_y, :n_x]
            chosen = response[target][:, :, :n_y, :n_x] == pooled[source]
            torch.maximum(there, torch.where(chosen, score[source], -torch.inf), out=there)
    return out


def _correlation_maps(patches: torch.Tensor, windows: torch.Tensor) -> torch.Tensor:
    """(rows, gx, n_y, n_x) responses of some rows of atomic patches at every window."""
    n_y, n_x, depth = windows.shape
    maps = torch.matmul(patches.reshape(-1, depth), windows.reshape(-1, depth).T)
    maps = maps.reshape(*patches.shape[:2], n_y, n_x)
    _rescale_borders(maps, patches)
    return maps


def atomic_response(left: torch.Tensor, right: torch.Tensor, y: int, x: int) -> torch.Tensor:
    """(h + 1, w + 1) response of one atomic patch [y, x] at every window, after the power."""
    return _correlation_maps(_patches(left)[y : y + 1, x : x + 1], _windows(right))[0, 0] ** POWER


def bottom_up(left: torch.Tensor, right: torch.Tensor, *, levels: int | None = None) -> Pyramid:
    """The correlation pyramid of two descriptor grids (h, w, C)."""
    patches, windows = _patches(left), _windows(right)
    gy, gx = patches.shape[:2]
    n_y, n_x = windows.shape[:2]
    pooled = patches.new_empty(gy, gx, _half(n_y), _half(n_x))
    offset = torch.empty(pooled.shape, dtype=torch.int8, device=pooled.device)
    rows = max(1, CHUNK_BYTES // (gx * n_y * n_x * 4))
    for start in range(0, gy, rows):
        chosen = slice(start, start + rows)
        pooled[chosen], offset[chosen] = _pool_with_offset(_correlation_maps(patches[chosen], windows))
    del windows
    pooled.pow_(POWER)
    pools, responses = [pooled], []
    top = n_levels(gy, gx) if levels is None else levels
    for level in range(1, top + 1):
        responses.append(_aggregate(pools[-1], level))
        if level < top:
            pools.append(_pool(responses[-1]))
    return Pyramid(pools, offset, responses)


def top_down(pyramid: Pyramid) -> torch.Tensor:
    """Scores (gy, gx, h, w) of the best path to every pooled cell of the atomic patches; -inf where none leads."""
    if not pyramid.responses:
        return pyramid.pooled[0]
    score = pyramid.responses[-1]
    for level in range(len(pyramid.responses), 0, -1):
        pooled = pyramid.pooled[level - 1]
        score = _descend(score, pooled.shape, level).add_(pooled)
        if level > 1:
            score = _unpool(pyramid.responses[level - 2], pooled, score)
    return score


def _best(pyramid: Pyramid, score: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Per patch its best score and peak ratio (gy, gx) and right corner (gy, gx, 2) (x, y); per right bin its best score."""
    gy, gx, n_y, n_x = score.shape
    best, flat = score.reshape(gy, gx, -1).max(dim=2)
    offset = pyramid.offset.reshape(gy, gx, -1).gather(2, flat[:, :, None])[:, :, 0].long()
    dy = torch.div(offset + 4, 3, rounding_mode="floor") - 1
    corner = torch.stack([2 * (flat % n_x) + offset - 3 * dy, 2 * (flat // n_x) + dy], dim=2)

    # A pooled cell at 2 k falls into bin k // 2, unless its maximum lies one cell before an even k.
    bins = score.new_full((n_y // 2 + 2, n_x // 2 + 2), -torch.inf)
    step = max(1, CHUNK_BYTES // (gx * n_y * n_x * 8))
    for start in range(0, gy, step):
        part, where = score[start : start + step], pyramid.offset[start : start + step]
        row = torch.div(where + 4, 3, rounding_mode="floor") - 1
        before_y, before_x = row < 0, where - 3 * row < 0
        before_y[:, :, 1::2] = False
        before_x[..., 1::2] = False
        for back_y in (False, True):
            for back_x in (False, True):
                chosen = (before_y == back_y) & (before_x == back_x)
                strongest = torch.where(chosen, part, -torch.inf).amax(dim=(0, 1))
                for r in (0, 1):
                    for c in (0, 1):
                        if (back_y and r) or (back_x and c):
                            continue
                        some = strongest[r::2, c::2]
                        # Bins are stored from -1, so that one cell before the first has a place.
                        y, x = 1 - int(back_y), 1 - int(back_x)
                        there = bins[y : y + some.shape[0], x : x + some.shape[1]]
                        torch.maximum(there, some, out=there)
    return best, _peak_ratio(pyramid.pooled[0], flat), corner, bins


def _peak_ratio(pooled: torch.Tensor, flat: torch.Tensor) -> torch.Tensor:
    """Response (gy, gx) around the pooled cells `flat` over the largest one elsewhere, before the power.

    The cells around the peak are blotted out in place and put back, so that no second copy of the maps is needed.
    """
    gy, gx, n_y, n_x = pooled.shape
    y, x = torch.div(flat, n_x, rounding_mode="floor"), flat % n_x
    step = torch.arange(-1, 2, device=pooled.device)
    rows = (y[..., None, None] + step[:, None]).clamp(0, n_y - 1)
    columns = (x[..., None, None] + step).clamp(0, n_x - 1)
    around = (rows * n_x + columns).reshape(gy, gx, 9)
    maps = pooled.view(gy, gx, n_y * n_x)
    saved = maps.gather(2, around)
    maps.scatter_(2, around, 0.0)
    rival = maps.amax(dim=2)
    maps.scatter_(2, around, saved)
    return (saved.amax(dim=2) / rival) ** (1 / POWER)


def match_grids(
    left: torch.Tensor,
    right: torch.Tensor,
    tiles: list[tuple[slice, slice]] | None = None,
    *,
    reciprocal: bool = True,
) -> GridMatches:
    """Reciprocal matches of two descriptor grids.

    Parameters
    ----------
    left, right:
        (h, w, C) descriptors, on one device; sizes may differ.
    tiles:
        Parts of the left grid from `plan_tiles`, None = one piece.  Every tile has its own pyramid, as high as the
        first tile's, so that scores compare.
    reciprocal:
        False keeps the matches that fail the reciprocal check too.
    """
    gy, gx = left.shape[0] // PATCH, left.shape[1] // PATCH
    tiles = tiles or [(slice(0, gy * PATCH), slice(0, gx * PATCH))]
    levels = n_levels(*(side // PATCH for side in left[tiles[0]].shape[:2]))
    best, ratio = left.new_full((2, gy, gx), -torch.inf)
    corner = torch.zeros((gy, gx, 2), dtype=torch.long, device=left.device)
    bins = None
    for rows, columns in tiles:
        part = left[rows, columns]
        height, width = part.shape[0] // PATCH, part.shape[1] // PATCH
        pyramid = bottom_up(part, right, levels=min(levels, n_levels(height, width)))
        score = top_down(pyramid)
        target = (slice(rows.start // PATCH, rows.stop // PATCH), slice(columns.start // PATCH, columns.stop // PATCH))
        best[target], ratio[target], corner[target], tile_bins = _best(pyramid, score)
        bins = tile_bins if bins is None else torch.maximum(bins, tile_bins)
        del pyramid, score
    x, y = corner.unbind(dim=2)
    own = bins[torch.div(y, PATCH, rounding_mode="floor") + 1, torch.div(x, PATCH, rounding_mode="floor") + 1]
    passed = best >= own
    kept = torch.isfinite(best) & passed if reciprocal else torch.isfinite(best)
    grid_y, grid_x = torch.nonzero(kept, as_tuple=True)
    centre = torch.stack([grid_x, grid_y], dim=1) * PATCH + PATCH // 2
    return GridMatches(
        centre.cpu().numpy().astype(np.float64),
        corner[kept].cpu().numpy().astype(np.float64),
        (best[kept] / (levels + 1)).cpu().numpy().astype(np.float64),
        ratio[kept].cpu().numpy().astype(np.float64),
        passed[kept].cpu().numpy(),
    )
