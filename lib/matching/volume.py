"""Epipolar-band DeepMatching: the same pyramid on a volume of displacements along the epipolar line.

In displacement coordinates the shifts between a patch and its children vanish, so the bottom-up pass is a
max-pool, the mean of four lattice neighbours and a power, and the top-down pass a dense max-unpool: slices only.
A volume holds (gy, gx, 2 v + 1, D) responses: lattice of patches, rows off the epipolar line, displacements along it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
import torch

from lib.matching.deepmatching import PATCH, POWER, n_levels

__all__ = [
    "VolumeMatches",
    "correlation_volume",
    "match_volume",
    "predicted_bytes",
]

#: Lattice rows that are correlated at once.
ROWS = 8


@dataclass(frozen=True)
class VolumeMatches:
    """Reciprocal matches on the lattice, in cells of the pooled descriptor grid.

    Attributes
    ----------
    patch:
        (n, 2) int, (gx, gy) of the 4 x 4 cell patch.
    cell:
        (n, 2) int, (dx, dy) displacement in whole cells.
    displacement:
        (n, 2) float, the same with sub-cell precision.
    response:
        (n,) correlation of the two patches in [0, 1].
    curvature:
        (n, 2) minus the second difference of the response along x and y per cell^2; 0 where it has no interior peak.
    score:
        (n,) sum of the responses over the pyramid, divided by the number of levels.
    reciprocal:
        (n,) bool, whether no other patch fits the same place of the right image better.
    """

    patch: np.ndarray
    cell: np.ndarray
    displacement: np.ndarray
    response: np.ndarray
    curvature: np.ndarray
    score: np.ndarray
    reciprocal: np.ndarray

    def keep(self, chosen: np.ndarray) -> VolumeMatches:
        """The matches of a mask (n,) or of indices."""
        return VolumeMatches(*(getattr(self, field.name)[chosen] for field in fields(self)))


def predicted_bytes(gy: int, gx: int, n: int, v: int) -> int:
    """Peak memory (float32) of `correlation_volume` and `match_volume`: the volume, and its pooled copies."""
    return int(4 * gy * gx * (2 * v + 1) * n * 2.7)


def correlation_volume(left: torch.Tensor, right: torch.Tensor, low: int, n: int, v: int) -> torch.Tensor:
    """Cosine of every 4 x 4 patch of the left grid with its displaced windows in the right one.

    Parameters
    ----------
    left:
        (4 gy, 4 gx, C) descriptors, contiguous.
    right:
        (4 gy + 2 v, 4 gx + n - 1, C): its cell (0, 0) is the left grid's (-v, low).
    low, n, v:
        Displacements low .. low + n - 1 along x and -v .. v along y, cells.

    Returns
    -------
    torch.Tensor
        (gy, gx, 2 v + 1, n).
    """
    height, width, channels = left.shape
    gy, gx = height // PATCH, width // PATCH
    depth = PATCH * PATCH * channels
    patches = left.reshape(gy, PATCH, gx, PATCH, channels).permute(0, 2, 1, 3, 4).reshape(gy, gx, depth)
    patches = patches / patches.norm(dim=2, keepdim=True).clamp_min(1e-12)

    n_x, n_y = right.shape[1] - PATCH + 1, right.shape[0] - PATCH + 1
    energy = right.square().sum(dim=2)
    energy = sum(energy[:, c : c + n_x] for c in range(PATCH))
    energy = sum(energy[r : r + n_y] for r in range(PATCH))
    inverse_norm = torch.where(energy > 1e-12, energy.clamp_min(1e-12).rsqrt(), 0.0).contiguous()

    volume = right.new_empty(gy, gx, 2 * v + 1, n)
    block = max(4, min(gx, n // 2))
    row = PATCH * channels
    column = (PATCH * ROWS + 2 * v) * row
    turned = right.transpose(0, 1)

    def correlate(top: int) -> None:
        """One chunk of lattice rows, which stays in the cache.

        Windows are laid out as (x, y, 4 cells of the row): any window is then `depth` contiguous numbers, so that BLAS
        reads it in place.
        """
        k = min(ROWS, gy - top)
        rows = slice(PATCH * top, PATCH * (top + k) + 2 * v)
        strip = right.new_empty(n_x, column // row, row)
        for c in range(PATCH):
            strip[:, : rows.stop - rows.start, c * channels : (c + 1) * channels] = turned[c : c + n_x, rows]
        for j in range(2 * v + 1):
            for start in range(0, gx, block):
                b = min(block, gx - start)
                windows = PATCH * (b - 1) + n
                view = strip.as_strided((k, windows, depth), (PATCH * row, column, 1), PATCH * start * column + j * row)
                product = torch.bmm(patches[top : top + k, start : start + b], view.transpose(1, 2))
                skewed = product.as_strided((k, b, n), (b * windows, windows + PATCH, 1))
                scale = inverse_norm.as_strided(
                    (k, b, n), (PATCH * n_x, PATCH, 1), (PATCH * top + j) * n_x + PATCH * start
                )
                torch.mul(skewed, scale, out=volume[top : top + k, start : start + b, j])

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(correlate, range(0, gy, ROWS)))
    return volume


def _pooled_length(length: int, start: int) -> int:
    return (length - start + 1) // 2


def _pool_axis(volume: torch.Tensor, axis: int, start: int) -> torch.Tensor:
    """Maximum over [-1, 1] around the samples start, start + 2, ... of one axis."""
    length = volume.shape[axis]
    n = _pooled_length(length, start)

    def every_second(first: int) -> torch.Tensor:
        index = [slice(None)] * volume.ndim
        index[axis] = slice(first, None, 2)
        return volume[tuple(index)]

    out = every_second(start).clone(memory_format=torch.contiguous_format)
    before, after = every_second(1 - start), every_second(start + 1)
    skip = 1 - start  # without a start there is nothing before the first sample
    m = min(before.shape[axis], n - skip)
    torch.maximum(out.narrow(axis, skip, m), before.narrow(axis, 0, m), out=out.narrow(axis, skip, m))
    m = min(after.shape[axis], n)
    torch.maximum(out.narrow(axis, 0, m), after.narrow(axis, 0, m), out=out.narrow(axis, 0, m))
    return out


def _starts(shape: torch.Size) -> int:
    """Where the rows off the line start to be sampled, so that the line itself is always one of them."""
    return (shape[2] // 2) % 2


def _pool(volume: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Maximum over three displacements along x at every second one; and of these over three along y."""
    along_x = _pool_axis(volume, 3, 0)
    return along_x, _pool_axis(along_x, 2, _starts(volume.shape))


def _offset(level: int) -> int:
    return 2 ** (level - 2) if level >= 2 else 0


def _gather(pooled: torch.Tensor, axis: int, level: int) -> torch.Tensor:
    """Mean over the children that exist, along one lattice axis."""
    n = pooled.shape[axis]
    if level == 1:
        shape = list(pooled.shape)
        shape[axis] = n + 1
        out = pooled.new_empty(shape)
        out.narrow(axis, 0, 1).copy_(pooled.narrow(axis, 0, 1))
        out.narrow(axis, n, 1).copy_(pooled.narrow(axis, n - 1, 1))
        inner = out.narrow(axis, 1, n - 1)
        torch.add(pooled.narrow(axis, 0, n - 1), pooled.narrow(axis, 1, n - 1), out=inner)
        inner.mul_(0.5)
        return out
    off = _offset(level)
    out = torch.empty_like(pooled)
    out.narrow(axis, 0, off).copy_(pooled.narrow(axis, off, off))
    out.narrow(axis, n - off, off).copy_(pooled.narrow(axis, n - 2 * off, off))
    inner = out.narrow(axis, off, n - 2 * off)
    torch.add(pooled.narrow(axis, 0, n - 2 * off), pooled.narrow(axis, 2 * off, n - 2 * off), out=inner)
    inner.mul_(0.5)
    return out


def _scatter(score: torch.Tensor, axis: int, level: int) -> torch.Tensor:
    """Best score of the two parents, along one lattice axis: the reverse of `_gather`."""
    n = score.shape[axis]
    if level == 1:
        return torch.maximum(score.narrow(axis, 0, n - 1), score.narrow(axis, 1, n - 1))
    off = _offset(level)
    out = torch.empty_like(score)
    out.narrow(axis, 0, off).copy_(score.narrow(axis, off, off))
    out.narrow(axis, n - off, off).copy_(score.narrow(axis, n - 2 * off, off))
    inner = out.narrow(axis, off, n - 2 * off)
    torch.maximum(score.narrow(axis, 0, n - 2 * off), score.narrow(axis, 2 * off, n - 2 * off), out=inner)
    return out


def _unpool_axis(
    response: torch.Tensor, pooled: torch.Tensor, score: torch.Tensor, axis: int, start: int
) -> torch.Tensor:
    """Give each pooled sample's score to the displacement that was its maximum; unreached ones get -inf."""
    out = torch.full_like(response, -torch.inf)
    for first in (start - 1, start, start + 1):
        skip = int(first < 0)
        index = [slice(None)] * 4
        index[axis] = slice(first + 2 * skip, None, 2)
        there, here = out[tuple(index)], response[tuple(index)]
        n = min(here.shape[axis], pooled.shape[axis] - skip)
        if n > 0:
            there, here = there.narrow(axis, 0, n), here.narrow(axis, 0, n)
            chosen = here == pooled.narrow(axis, skip, n)
            torch.maximum(there, torch.where(chosen, score.narrow(axis, skip, n), -torch.inf), out=there)
    return out


def _unpool(response: torch.Tensor, along_x: torch.Tensor, pooled: torch.Tensor, score: torch.Tensor) -> torch.Tensor:
    score = _unpool_axis(along_x, pooled, score, 2, _starts(response.shape))
    return _unpool_axis(response, along_x, score, 3, 0)


def _parabola(volume: torch.Tensor, i: tuple[torch.Tensor, ...], axis: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertex (in [-0.5, 0.5]) and curvature of the response around its peak along one axis; 0, 0 at the ends."""
    n = volume.shape[axis]
    at = list(i)
    centre = volume[tuple(at)]
    at[axis] = (i[axis] - 1).clamp_min(0)
    before = volume[tuple(at)]
    at[axis] = (i[axis] + 1).clamp_max(n - 1)
    after = volume[tuple(at)]
    curvature = 2 * centre - before - after
    interior = (i[axis] > 0) & (i[axis] < n - 1) & (centre >= before) & (centre >= after) & (curvature > 1e-9)
    vertex = torch.where(interior, 0.5 * (after - before) / curvature.clamp_min(1e-9), 0.0)
    return vertex, torch.where(interior, curvature, 0.0)


def match_volume(volume: torch.Tensor, low: int, *, reciprocal: bool = True) -> VolumeMatches:
    """DeepMatching on a volume of correlations: bottom-up, top-down, reciprocal check, sub-cell peak.

    Parameters
    ----------
    volume:
        (gy, gx, 2 v + 1, n) from `correlation_volume`.
    low:
        Its first displacement along x, cells.
    reciprocal:
        False keeps the matches that fail the reciprocal check too.
    """
    gy, gx = volume.shape[:2]
    responses, pools, gains = [volume], [], []
    for level in range(1, n_levels(gy, gx) + 1):
        below = responses[-1]
        if below.shape[2] * below.shape[3] == 1:
            break
        along_x, pooled = _pool(below)
        pools.append((along_x, pooled))
        # The power is monotone, so at the bottom it may follow the maximum: a quarter of the work.
        gains.append(pooled**POWER if level == 1 else pooled)
        responses.append(_gather(_gather(gains[-1], 0, level), 1, level).pow_(POWER))

    score = responses.pop()
    for level in range(len(pools), 0, -1):
        score = _scatter(_scatter(score, 0, level), 1, level).add_(gains[level - 1])
        if level > 1:
            score = _unpool(responses[level - 1], *pools[level - 1], score)

    def bottom(rows: slice) -> torch.Tensor:
        """Scores of some lattice rows: at the bottom they are needed only once, so never all at a time."""
        return _unpool(volume[rows], *(pool[rows] for pool in pools[0]), score[rows]) if pools else score[rows]

    return _reciprocal(volume, bottom, low, len(pools) + 1, reciprocal)


def _reciprocal(
    volume: torch.Tensor, scores_of: Callable[[slice], torch.Tensor], low: int, levels: int, only: bool
) -> VolumeMatches:
    """Best displacement of each patch; `only` if it is also the best of its bin in the right grid."""
    gy, gx, rows, n = volume.shape
    v = rows // 2
    # The centre of a patch lies at cell 4 g + 2; its displaced copy falls into the bin (4 g + 2 + d) // 4, so
    # displacements in fours share a bin for every patch.
    bin_x, bin_y = (low + np.arange(n) + 2) // PATCH, (np.arange(-v, v + 1) + 2) // PATCH
    span_x, span_y = (int(bin_x[0]), int(bin_x[-1])), (int(bin_y[0]), int(bin_y[-1]))
    bins = volume.new_full((gy + span_y[1] - span_y[0], gx + span_x[1] - span_x[0]), -torch.inf)
    best, flat = volume.new_empty(gy, gx), torch.empty(gy, gx, dtype=torch.long, device=volume.device)
    bins_y, bins_x = (range(span[0], span[1] + 1) for span in (span_y, span_x))

    def search(top: int) -> list[list[torch.Tensor]]:
        """Best displacements of a chunk of lattice rows; its strongest scores per bin, (chunk, gx) for each (y, x)."""
        part = slice(top, min(top + ROWS, gy))
        score = scores_of(part)
        torch.max(score.reshape(*score.shape[:2], -1), dim=2, out=(best[part], flat[part]))
        in_y, in_x = ([np.flatnonzero(bin_ == i) for i in bins_] for bin_, bins_ in ((bin_y, bins_y), (bin_x, bins_x)))
        return [[score[:, :, y[0] : y[-1] + 1, x[0] : x[-1] + 1].amax(dim=(2, 3)) for x in in_x] for y in in_y]

    tops = range(0, gy, ROWS)
    with ThreadPoolExecutor(2) as pool:
        for top, strongest in zip(tops, pool.map(search, tops), strict=True):
            for y, row in enumerate(strongest):
                for x, chunk in enumerate(row):
                    there = bins[top + y : top + y + len(chunk), x : x + gx]
                    torch.maximum(there, chunk, out=there)
    j, k = flat // n, flat % n
    grid_y, grid_x = torch.meshgrid(
        torch.arange(gy, device=volume.device), torch.arange(gx, device=volume.device), indexing="ij"
    )
    own_y = grid_y + torch.div(j - v + 2, PATCH, rounding_mode="floor") - span_y[0]
    own_x = grid_x + torch.div(k + low + 2, PATCH, rounding_mode="floor") - span_x[0]
    reciprocal = best >= bins[own_y, own_x]
    kept = torch.isfinite(best) & reciprocal if only else torch.isfinite(best)

    y, x, j, k = grid_y[kept], grid_x[kept], j[kept], k[kept]
    vertex_x, curvature_x = _parabola(volume, (y, x, j, k), 3)
    vertex_y, curvature_y = _parabola(volume, (y, x, j, k), 2)
    cell = torch.stack([k + low, j - v], dim=1)
    return VolumeMatches(
        patch=torch.stack([x, y], dim=1).cpu().numpy(),
        cell=cell.cpu().numpy(),
        displacement=(cell + torch.stack([vertex_x, vertex_y], dim=1).double()).cpu().numpy(),
        response=volume[y, x, j, k].cpu().numpy(),
        curvature=torch.stack([curvature_x, curvature_y], dim=1).cpu().numpy(),
        score=(best[kept] / levels).cpu().numpy(),
        reciprocal=reciprocal[kept].cpu().numpy(),
    )
