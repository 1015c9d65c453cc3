"""DeepMatching on a volume of displacements along the epipolar line (see `lib.matching.pyramid`).

A volume holds (gy, gx, 2 v + 1, n) responses: lattice of patches, rows off the epipolar line, displacements along it.
In displacement coordinates the shifts between a patch and its children vanish, so both passes are slices only.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch

from lib.matching.pyramid import PATCH, POWER, n_levels, path_scores, pool, unit_patches, unpool

#: Lattice rows that are worked on at once: they stay in the cache.
ROWS = 8


@dataclass(frozen=True)
class VolumeMatches:
    """Matches on the lattice, in cells of the pooled descriptor grid."""

    patch: np.ndarray  # (n, 2) int, (gx, gy) of the 4 x 4 cell patch
    cell: np.ndarray  # (n, 2) int, (dx, dy) displacement in whole cells
    displacement: np.ndarray  # (n, 2), the same at the vertex of a parabola through the response and its neighbours
    peaked: np.ndarray  # (n,) bool, whether the response has an interior peak along x
    reciprocal: np.ndarray  # (n,) bool, whether no other patch fits the same place of the right image better

    def keep(self, chosen: np.ndarray) -> Self:
        """The matches of a mask (n,) or of indices."""
        return VolumeMatches(*(getattr(self, field.name)[chosen] for field in fields(self)))


def predicted_bytes(gy: int, gx: int, n: int, v: int) -> int:
    """Peak memory (float32) of `correlation_volume` and `match_volume`: the volume, and its pooled copies."""
    return int(4 * gy * gx * (2 * v + 1) * n * 2.7)


def correlation_volume(left: torch.Tensor, right: torch.Tensor, v: int) -> torch.Tensor:
    """Cosine of every 4 x 4 patch of the left grid with its displaced windows in the right one.

    Args:
        left: (4 gy, 4 gx, C) descriptors, contiguous.
        right: (4 gy + 2 v, 4 gx + n - 1, C): the left grid with v more rows on either side, and the reach of n
            displacements.

    Returns:
        torch.Tensor: (gy, gx, 2 v + 1, n).
    """
    height, width, channels = left.shape
    gy, gx, n = height // PATCH, width // PATCH, right.shape[1] - width + 1
    depth = PATCH * PATCH * channels
    patches = unit_patches(left)
    n_x, n_y = right.shape[1] - PATCH + 1, right.shape[0] - PATCH + 1
    energy = right.square().sum(dim=2)
    energy = sum(energy[:, c : c + n_x] for c in range(PATCH))
    energy = sum(energy[r : r + n_y] for r in range(PATCH))
    inverse_norm = torch.where(energy > 1e-12, energy.clamp_min(1e-12).rsqrt(), 0.0).contiguous()

    volume = right.new_empty(gy, gx, 2 * v + 1, n)
    block, row = max(4, min(gx, n // 2)), PATCH * channels
    column = (PATCH * ROWS + 2 * v) * row
    turned = right.transpose(0, 1)

    def correlate(top: int) -> None:
        """Fill one chunk of lattice rows, from windows laid out as (x, y, 4 cells of the row): any is then contiguous."""
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
                first = (PATCH * top + j) * n_x + PATCH * start
                scale = inverse_norm.as_strided((k, b, n), (PATCH * n_x, PATCH, 1), first)
                torch.mul(skewed, scale, out=volume[top : top + k, start : start + b, j])

    with ThreadPoolExecutor(2) as executor:
        list(executor.map(correlate, range(0, gy, ROWS)))
    return volume


def match_volume(volume: torch.Tensor, low: int, *, reciprocal: bool = True) -> VolumeMatches:
    """The best displacement of each patch: bottom-up, top-down, reciprocal check, sub-cell peak.

    `low` is the volume's first displacement along x, cells; without `reciprocal` that check drops nothing.
    """
    gy, gx, rows, n = volume.shape
    v = rows // 2
    along_x, pooled = pool(volume, v % 2)
    # The power is monotone, so it may follow the maximum, which is a quarter of the work.
    scores = path_scores(pooled**POWER, n_levels(gy, gx) if rows * n > 1 else 0, shifted=False)

    # The centre of a patch lies at cell 4 g + 2; its displaced copy falls into the bin (4 g + 2 + d) // 4, so
    # displacements in fours share a bin for every patch.
    bin_x, bin_y = (low + np.arange(n) + 2) // PATCH, (np.arange(-v, v + 1) + 2) // PATCH
    in_x, in_y = ([np.flatnonzero(of == i) for i in range(of[0], of[-1] + 1)] for of in (bin_x, bin_y))
    bins = volume.new_full((gy + len(in_y) - 1, gx + len(in_x) - 1), -torch.inf)
    best, flat = volume.new_empty(gy, gx), torch.empty(gy, gx, dtype=torch.long)

    def search(top: int) -> list[list[torch.Tensor]]:
        """Best displacements of a chunk of lattice rows; its strongest scores per bin, (chunk, gx) for each (y, x)."""
        part = slice(top, min(top + ROWS, gy))
        score = unpool(volume[part], along_x[part], pooled[part], scores[part], v % 2)
        torch.max(score.flatten(2), dim=2, out=(best[part], flat[part]))
        return [[score[:, :, y[0] : y[-1] + 1, x[0] : x[-1] + 1].amax(dim=(2, 3)) for x in in_x] for y in in_y]

    tops = range(0, gy, ROWS)
    with ThreadPoolExecutor(2) as executor:
        for top, strongest in zip(tops, executor.map(search, tops), strict=True):
            for y, row in enumerate(strongest):
                for x, chunk in enumerate(row):
                    there = bins[top + y : top + y + len(chunk), x : x + gx]
                    torch.maximum(there, chunk, out=there)
    y, x = torch.meshgrid(torch.arange(gy), torch.arange(gx), indexing="ij")
    j, k = flat // n, flat % n
    own_y, own_x = (torch.from_numpy(of - of[0])[at] + grid for of, at, grid in ((bin_y, j, y), (bin_x, k, x)))
    passed = best >= bins[own_y, own_x]
    kept = torch.isfinite(best) & (passed | (not reciprocal))

    place = y[kept], x[kept], j[kept], k[kept]
    vertex_x, peaked = _parabola(volume, place, 3)
    vertex_y, _ = _parabola(volume, place, 2)
    cell = torch.stack([place[3] + low, place[2] - v], dim=1)
    return VolumeMatches(
        patch=torch.stack([place[1], place[0]], dim=1).numpy(), cell=cell.numpy(),
        displacement=(cell + torch.stack([vertex_x, vertex_y], dim=1).double()).numpy(),
        peaked=peaked.numpy(), reciprocal=passed[kept].numpy(),
    )  # fmt: skip


def _parabola(volume: torch.Tensor, place: tuple[torch.Tensor, ...], axis: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertex (in [-0.5, 0.5]) of the response around its peak along one axis, 0 where it has no interior peak; has it?"""
    n, index = volume.shape[axis], place[axis]
    before, centre, after = (
        volume[tuple((index + step).clamp(0, n - 1) if k == axis else i for k, i in enumerate(place))] for step in (-1, 0, 1)
    )
    curvature = 2 * centre - before - after
    peaked = (index > 0) & (index < n - 1) & (centre >= before) & (centre >= after) & (curvature > 1e-9)
    return torch.where(peaked, 0.5 * (after - before) / curvature.clamp_min(1e-9), 0.0), peaked
