"""DeepMatching: a pyramid of responses, along the epipolar line or over the whole image, on the CPU or on CUDA.

Source: Revaud, Weinzaepfel, Harchaoui, Schmid, DeepMatching: Hierarchical Deformable Dense Matching (IJCV 2016).

1. The atomic patches of 4 x 4 cells are correlated with the right image: responses (gy, gx, rows, columns).
2. Bottom-up: the response of a patch twice as large is the mean of its four children's responses, each max-pooled
   (so that a child may move by a cell) and halved; then raised to the power 1.4.
3. Top-down: from every cell of every top map the best children are followed down and their responses added up.  Each
   cell keeps only its best path.  This is a max-sum dynamic programme, so it runs on whole maps at once.
4. A match is kept if it is the best one of its left patch and of its position in the right image.

The patches of a level form a dense lattice whose step is the atomic patch, so every level has about as many maps as the
first.  The last two axes of the responses are either positions in the right image (`shifted`: a child is one pooled cell
away from its parent) or displacements, where child and parent have the same index, so that both passes use only slices.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, Self

import numpy as np
import torch
from torch.nn.functional import max_pool1d, max_pool2d, pad

from lib.matching.descriptors import CHANNELS, PATCH, patch_quality, pixel_descriptors
from lib.matching.result import SIGMA_LEFT_PX, Matches

POWER = 1.4
BORDER_POWER = 0.9
#: Number of lattice rows that are processed at once: they stay in the cache.
ROWS = 8
#: Memory for the full maps of atomic patches that are processed at once, bytes.
CHUNK_BYTES = 32 << 20


def unit_patches(grid: torch.Tensor) -> torch.Tensor:
    """(gy, gx, 16 C) unit descriptors of the atomic patches of a grid (h, w, C)."""
    gy, gx = grid.shape[0] // PATCH, grid.shape[1] // PATCH
    patches = grid[: gy * PATCH, : gx * PATCH].reshape(gy, PATCH, gx, PATCH, -1).permute(0, 2, 1, 3, 4).reshape(gy, gx, -1)
    return patches / patches.norm(dim=2, keepdim=True).clamp_min(1e-12)


def n_levels(gy: int, gx: int) -> int:
    """Number of levels above the atomic patches: sizes double while they fit the longer side and all children exist."""
    levels = 0
    while 2 ** (levels + 1) <= max(gy, gx) and 2 ** max(levels - 1, 0) <= min(gy, gx) / 2:
        levels += 1
    return levels


def pool(maps: torch.Tensor, start: int = 0) -> torch.Tensor:
    """Maxima over 3 x 3 cells, at every second column and at the rows start (0 or 1), start + 2, ..."""
    pooled, beside = maps[:, :, start : maps.shape[2] - start : 2].clone(), maps[:, :, 1 - start :: 2]
    for before, after in ((0, start), (1 - start, 0)):  # whole rows are much faster than max_pool2d
        rows = beside[:, :, after : after + pooled.shape[2] - before]
        torch.maximum(into := pooled[:, :, before : before + rows.shape[2]], rows, out=into)
    return max_pool1d(pooled.flatten(0, 2), 3, stride=2, padding=1).reshape(*pooled.shape[:3], -1)


def unpool(maps: torch.Tensor, score: torch.Tensor, start: int = 0) -> torch.Tensor:
    """Give the score of each pooled cell to the cell that was its maximum in `pool`; all other cells get -inf."""
    highest = max_pool2d(maps, 3, stride=2, padding=(1 - start, 1), return_indices=True)[1]
    out = torch.full_like(maps, -torch.inf).flatten(2)
    return out.scatter_reduce_(2, highest.flatten(2), score.flatten(2), "amax").view(maps.shape)


def _by_axis(maps: torch.Tensor, axis: int) -> torch.Tensor:
    """The responses with the lattice dimension and the map dimension of one axis first."""
    return maps.movedim((axis, axis + 2), (0, 1))


def _sides(level: int, n: int, n_map: int, shifted: bool) -> Iterator[tuple[tuple, tuple]]:
    """Indices (lattice, map) of parents and of their n children along an axis: first the child before, then the one after."""
    wider = int(level == 1)  # level 1 has one parent more than children
    off = 1 if level == 1 else 2 ** (level - 2)
    near, far = slice(0, n_map - shifted), slice(int(shifted), n_map)
    yield (slice(off, n + wider), far), (slice(0, n + wider - off), near)
    yield (slice(0, n + wider - off), near), (slice(off - wider, n), far)


def gather(pooled: torch.Tensor, axis: int, level: int, *, shifted: bool) -> torch.Tensor:
    """Responses of the parents of a level along one lattice axis: the mean of the children that exist.

    Children beyond the lattice do not exist.  An existing child is valid if its position is inside the map.  The sum over the
    valid ones is divided by n_exist^0.1 n_valid^0.9, as in the published implementation.
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
    """Score of the best path from the top to every pooled cell of the patches below `level`; -inf if there is no path.

    `pooled` are the pooled responses of these patches after the power; at level 1 these are the atomic patches.
    """
    if level > levels:
        return pooled
    score = gather(gather(pooled, 0, level, shifted=shifted), 1, level, shifted=shifted).pow_(POWER)
    if level < levels and score.shape[2:].numel() > 1:
        # With displacements, the sampled rows include the middle one, which is the epipolar line.
        start = 0 if shifted else (score.shape[2] // 2) % 2
        score = unpool(score, path_scores(pool(score, start), levels, shifted=shifted, level=level + 1), start)
    for axis in (0, 1):
        score = _scatter(score, axis, level, pooled.shape[axis], shifted=shifted)
    return score.add_(pooled)


def peak_ratio(maps: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> np.ndarray:
    """Response (m,) at each match divided by the largest one elsewhere in its map (Hu and Mordohai, PAMI 2012).

    The match is at `row`, `column` (m,) int and includes the cells next to it.  The ratio is infinite if the responses
    elsewhere are 0, NaN if there are no other cells.  The maps (m, rows, columns), 0 where masked, are overwritten.
    """
    step = torch.arange(-1, 2, device=maps.device)
    rows = (row[:, None, None] + step[:, None]).clamp(0, maps.shape[1] - 1)
    columns = (column[:, None, None] + step).clamp(0, maps.shape[2] - 1)
    around = (rows * maps.shape[2] + columns).flatten(1)
    flat = maps.flatten(1)
    response = flat.gather(1, around).amax(dim=1)
    rival = flat.scatter_(1, around, -1.0).amax(dim=1)
    return torch.where(rival >= 0, response / rival.clamp_min(0), torch.nan).cpu().numpy().astype(np.float64)


class VolumeMatches(NamedTuple):
    """Matches on the lattice, in cells of the pooled descriptor grid."""

    patch: np.ndarray  # (n, 2) int, (gx, gy) of the 4 x 4 cell patch
    cell: np.ndarray  # (n, 2) int, (dx, dy) displacement in whole cells
    displacement: np.ndarray  # (n, 2), sub-cell: at the vertex of a parabola through the response and its neighbours
    peaked: np.ndarray  # (n,) bool, True if the response has an interior peak along x
    reciprocal: np.ndarray  # (n,) bool, True if no other patch fits the same position in the right image better
    uniqueness: np.ndarray  # (n,) score of the displacement over the largest one more than 4 to 8 cells away along x

    def keep(self, chosen: np.ndarray) -> Self:
        """The matches of a mask (n,) or of indices."""
        return VolumeMatches(*(values[chosen] for values in self))


def correlation_volume(left: torch.Tensor, right: torch.Tensor, v: int) -> torch.Tensor:
    """Cosine similarities (gy, gx, 2 v + 1, n) of the 4 x 4 patches of the left grid and displaced windows of the right.

    The left grid (4 gy, 4 gx, C) is contiguous; the right one (4 gy + 2 v, 4 gx + n - 1, C) has v more rows on either side.
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

    def correlate(top: int) -> None:
        """Fill one chunk of lattice rows.  `strip` has the layout (x, y, 4 cells of the row), so windows are contiguous."""
        k = min(ROWS, gy - top)
        rows = slice(PATCH * top, PATCH * (top + k) + 2 * v)
        strip = right.new_empty(n_x, column // row, row)
        for c in range(PATCH):
            strip[:, : rows.stop - rows.start, c * channels : (c + 1) * channels] = right[rows, c : c + n_x].transpose(0, 1)
        for j in range(2 * v + 1):
            for start in range(0, gx, block):
                b = min(block, gx - start)
                windows = PATCH * (b - 1) + n
                view = strip.as_strided((k, windows, depth), (PATCH * row, column, 1), PATCH * start * column + j * row)
                product = torch.bmm(patches[top : top + k, start : start + b], view.transpose(1, 2))
                skewed = product.as_strided((k, b, n), (b * windows, windows + PATCH, 1))
                scale = inverse_norm.as_strided((k, b, n), (PATCH * n_x, PATCH, 1), (PATCH * top + j) * n_x + PATCH * start)
                torch.mul(skewed, scale, out=volume[top : top + k, start : start + b, j])

    with ThreadPoolExecutor(2) as executor:
        list(executor.map(correlate, range(0, gy, ROWS)))
    return volume


def match_volume(volume: torch.Tensor, low: int, *, reciprocal: bool = True) -> VolumeMatches:
    """The best displacement of each patch: bottom-up, top-down, reciprocal check, sub-cell peak.

    `low` is the volume's first displacement along x in cells; without `reciprocal`, failed checks are only marked.
    """
    gy, gx, rows, n = volume.shape
    v = rows // 2
    # The power is monotone, so it can be applied after pooling, with a quarter of the work.
    scores = path_scores(pool(volume, v % 2) ** POWER, n_levels(gy, gx) if rows * n > 1 else 0, shifted=False)

    # Bins of the right image, 4 cells wide: the displaced centre of patch g is in bin (4 g + 2 + d) // 4.
    bin_x, bin_y = (low + np.arange(n) + 2) // PATCH, (np.arange(-v, v + 1) + 2) // PATCH
    in_x, in_y = ([np.flatnonzero(index == i) for i in range(index[0], index[-1] + 1)] for index in (bin_x, bin_y))
    bins = volume.new_full((gy + len(in_y) - 1, gx + len(in_x) - 1), -torch.inf)
    best, rival, flat = *volume.new_empty(2, gy, gx), torch.empty(gy, gx, dtype=torch.long)
    own_x, x_of_bins = torch.from_numpy(bin_x - bin_x[0]), torch.arange(len(in_x))[:, None, None]

    def search(top: int) -> list[list[torch.Tensor]]:
        """Find the best displacements of a chunk of lattice rows; returns the largest scores (chunk, gx) for each bin."""
        part = slice(top, min(top + ROWS, gy))
        score = unpool(volume[part], scores[part], v % 2)
        torch.max(score.flatten(2), dim=2, out=(best[part], flat[part]))
        strongest = [[score[:, :, y[0] : y[-1] + 1, x[0] : x[-1] + 1].amax(dim=(2, 3)) for x in in_x] for y in in_y]
        near = (own_x[flat[part] % n] - x_of_bins).abs() <= 1  # the bin of the match and those next to it are no rivals
        rivals = torch.stack([torch.stack(row) for row in strongest]).amax(dim=0).masked_fill_(near, 0.0)
        torch.amax(rivals, dim=0, out=rival[part])
        return strongest

    tops = range(0, gy, ROWS)
    with ThreadPoolExecutor(2) as executor:
        for top, strongest in zip(tops, executor.map(search, tops), strict=True):
            for y, row in enumerate(strongest):
                for x, chunk in enumerate(row):
                    there = bins[top + y : top + y + len(chunk), x : x + gx]
                    torch.maximum(there, chunk, out=there)
    y, x = torch.meshgrid(torch.arange(gy), torch.arange(gx), indexing="ij")
    j, k = flat // n, flat % n
    own = (torch.from_numpy(bin_y - bin_y[0])[j] + y, own_x[k] + x)
    passed = best >= bins[own]
    kept = torch.isfinite(best) & (passed | (not reciprocal))

    place = y[kept], x[kept], j[kept], k[kept]
    vertex_x, peaked = _parabola(volume, place, 3)
    vertex_y, _ = _parabola(volume, place, 2)
    patch, cell = torch.stack([place[1], place[0]], dim=1), torch.stack([place[3] + low, place[2] - v], dim=1)
    displacement = cell + torch.stack([vertex_x, vertex_y], dim=1).double()
    uniqueness = (best / rival)[kept]
    return VolumeMatches(*(part.numpy() for part in (patch, cell, displacement, peaked, passed[kept], uniqueness)))


def _parabola(volume: torch.Tensor, place: tuple[torch.Tensor, ...], axis: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertex (-0.5 to 0.5, relative to the peak) of the response along one axis, or 0; and if there is an interior peak."""
    n, index = volume.shape[axis], place[axis]
    beside = ([(index + step).clamp(0, n - 1) if k == axis else i for k, i in enumerate(place)] for step in (-1, 0, 1))
    before, centre, after = (volume[tuple(at)] for at in beside)
    curvature = 2 * centre - before - after
    peaked = (index > 0) & (index < n - 1) & (centre >= before) & (centre >= after) & (curvature > 1e-9)
    return torch.where(peaked, 0.5 * (after - before) / curvature.clamp_min(1e-9), 0.0), peaked


def predicted_bytes(shape_left: tuple[int, int], shape_right: tuple[int, int], *, downscale: int = 1) -> int:
    """Predicted peak memory in bytes of free DeepMatching of two images (h, w)."""
    (gy, gx), (n_y, n_x) = ([n >> downscale for n in shape[:2]] for shape in (shape_left, shape_right))
    gy, gx, n_y, n_x = gy // PATCH, gx // PATCH, n_y + 1, n_x + 1
    windows = n_y * n_x * PATCH**2 * CHANNELS
    chunk = max(min(CHUNK_BYTES // 4, gy * gx * n_y * n_x), gx * n_y * n_x)
    n_y, n_x = (n_y + 1) // 2, (n_x + 1) // 2
    lattice, pooled = (gy + 1) * (gx + 1), gy * gx * n_y * n_x
    levels = 0
    for _ in range(n_levels(gy, gx)):
        levels += int(lattice * n_y * n_x * 1.75)  # the responses, their maxima along x, and along both axes
        n_y, n_x = (n_y + 1) // 2, (n_x + 1) // 2
    return 4 * (windows + pooled + max(levels + 2 * pooled, pooled + 5 * chunk))


def unit_windows(grid: torch.Tensor) -> torch.Tensor:
    """(h + 1, w + 1, 16 C) unit descriptors of the windows around every cell corner; cells outside the grid are zero."""
    windows = pad(grid, (0, 0, *[PATCH // 2] * 4)).unfold(0, PATCH, 1).unfold(1, PATCH, 1).permute(0, 1, 3, 4, 2).flatten(2)
    return windows.div_(windows.norm(dim=2, keepdim=True).clamp_min(1e-12))


def correlation_maps(patches: torch.Tensor, windows: torch.Tensor) -> torch.Tensor:
    """Cosine similarities (ry, rx, n_y, n_x) of atomic patches (ry, rx, 16 C) and windows (n_y, n_x, 16 C).

    At the border only the part of the patch that is inside the image is used.
    """
    n_y, n_x, _ = windows.shape
    maps = torch.tensordot(patches, windows, ([2], [2]))
    energy = patches.reshape(*patches.shape[:2], PATCH, PATCH, -1).square().sum(dim=4)
    cells = [torch.arange(n)[:, None] + torch.arange(PATCH) - PATCH // 2 for n in (n_y, n_x)]
    rows, columns = (((0 <= cell) & (cell < len(cell) - 1)).to(maps) for cell in cells)
    for y in (0, 1, n_y - 2, n_y - 1):
        maps[:, :, y] /= torch.einsum("ijrc,r,xc->ijx", energy, rows[y], columns).sqrt().clamp_min(1e-6)
    for x in (0, 1, n_x - 2, n_x - 1):
        maps[:, :, 2:-2, x] /= torch.einsum("ijrc,c->ij", energy, columns[x]).sqrt().clamp_min(1e-6)[..., None]
    return maps


def _match_grids(left: torch.Tensor, right: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, np.ndarray, torch.Tensor]:
    """For each patch (gy, gx): best corner (x, y), score, peak ratio, and True if no other patch fits there better."""
    patches, windows = unit_patches(left), unit_windows(right)
    (gy, gx), (n_y, n_x) = patches.shape[:2], windows.shape[:2]

    def chunks() -> Iterator[tuple[slice, torch.Tensor]]:
        step = max(1, CHUNK_BYTES // (gx * n_y * n_x * 4))
        for first in range(0, gy, step):
            part = slice(first, first + step)
            yield part, correlation_maps(patches[part], windows)

    pooled = patches.new_empty(gy, gx, (n_y + 1) // 2, (n_x + 1) // 2)
    for part, maps in chunks():
        pooled[part] = pool(maps)
    # The power is monotone, so it can be applied after pooling, with a quarter of the work.
    score = path_scores(pooled.pow_(POWER), n_levels(gy, gx), shifted=True)
    best, place = score.new_empty(gy, gx), torch.empty(gy, gx, dtype=torch.long, device=score.device)
    ratio, strongest = np.empty((gy, gx)), score.new_full((n_y * n_x,), -torch.inf)
    for part, maps in chunks():
        small, highest = max_pool2d(maps, 3, stride=2, padding=1, return_indices=True)
        best[part], peak = score[part].flatten(2).max(dim=2)
        row, column = torch.div(peak, small.shape[3], rounding_mode="floor"), peak % small.shape[3]
        place[part] = highest.flatten(2).gather(2, peak[:, :, None])[:, :, 0]
        strongest.scatter_reduce_(0, highest.flatten(), score[part].flatten(), "amax")
        ratio[part] = peak_ratio(small.flatten(0, 1), row.flatten(), column.flatten()).reshape(peak.shape)
    x, y = place % n_x, torch.div(place, n_x, rounding_mode="floor")
    bins = max_pool2d(strongest.view(1, n_y, n_x), PATCH, ceil_mode=True)[0]
    own = bins[torch.div(y, PATCH, rounding_mode="floor"), torch.div(x, PATCH, rounding_mode="floor")]
    return torch.stack([x, y], dim=2), best, ratio, best >= own


def match_free(
    images: tuple[np.ndarray, np.ndarray], masks: tuple[np.ndarray | None, np.ndarray | None], downscale: int | None, *,
    budget_bytes: int, reciprocal: bool, device: str,
) -> Matches:  # fmt: skip
    """DeepMatching without any calibration; arguments as in `lib.matching.match`, images (h, w) uint8 grey."""
    shapes = images[0].shape, images[1].shape
    largest = int(np.log2(min(shapes[0] + shapes[1]) / (2 * PATCH)))
    if downscale is not None and downscale not in range(largest + 1):
        raise ValueError(f"downscale: expected 0 to {largest} for images of these sizes, got {downscale}.")
    choices = range(1, largest + 1) if downscale is None else [int(downscale)]
    if not (fitting := [d for d in choices if predicted_bytes(*shapes, downscale=d) <= budget_bytes]):
        need = predicted_bytes(*shapes, downscale=max(choices))
        what = f"DeepMatching with downscale {max(choices)} needs {need / 2**30:.2f} GiB"
        cure = "Raise the budget or downscale, or match with a rig (method 'band')"
        raise ValueError(f"budget_bytes: {what}, the budget is {budget_bytes / 2**30:.2f}. {cure}.")
    stride = 1 << fitting[0]
    valid = [None if mask is None else ~mask for mask in masks]
    left, right = (pixel_descriptors(image, fitting[0], valid=seen) for image, seen in zip(images, valid, strict=True))
    try:
        grids = [torch.from_numpy(grid).to(device) for grid in (left, right)]
    except (RuntimeError, AssertionError) as error:  # unknown or absent device, or torch was built without it
        raise ValueError(f"device: {device!r} cannot be used: {error}") from None
    corner, best, ratio, passed = _match_grids(*grids)
    corner, best, passed = (array.cpu().numpy() for array in (corner, best.double(), passed))
    target = np.clip(corner, 0, np.array(right.shape[1::-1]) - 1)
    kept = np.isfinite(best) & patch_quality(left) & (right[target[..., 1], target[..., 0], CHANNELS - 1] > 0)
    kept &= passed | (not reciprocal)
    y, x = np.nonzero(kept)
    # Pixel centres are integers, so the corner c of the grid is at c * stride - 1/2 px.
    u_left = (np.column_stack([x, y]) * PATCH + PATCH // 2) * float(stride) - 0.5
    u_right = corner[kept] * float(stride) - 0.5
    # Positions are multiples of the stride, which gives a uniform error; the second term is the descriptor's own error.
    variance = stride**2 / 12 + 0.25 * stride**2 / 4
    covariance = np.tile(np.diag([SIGMA_LEFT_PX**2] * 2 + [variance] * 2), (len(u_left), 1, 1))
    score = np.clip(best[kept] / (n_levels(*best.shape) + 1), 0, 1)
    return Matches(u_left, u_right, score, covariance, peak_ratio=ratio[kept], reciprocal=passed[kept], method="deepmatching")
