"""Free DeepMatching of two images, on the CPU or on CUDA: no calibration, whole positions (see `lib.matching.pyramid`).

Of the atomic patches only the pooled maps are stored.  Their full maps are four times as large, and are computed again
where the paths arrive at them.
"""

from collections.abc import Iterator

import numpy as np
import torch

from lib.matching.descriptors import CHANNELS, patch_quality, pixel_descriptors
from lib.matching.pyramid import PATCH, POWER, n_levels, path_scores, peak_ratio, pool, unit_patches, unpool
from lib.matching.result import SIGMA_LEFT_PX, Matches

#: Bytes of the full maps of atomic patches that are held at once.
CHUNK_BYTES = 32 << 20


def predicted_bytes(shape_left: tuple[int, int], shape_right: tuple[int, int], *, downscale: int = 1) -> int:
    """Peak memory in bytes of free DeepMatching of two images (h, w)."""
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
    """(h + 1, w + 1, 16 C) unit descriptors of the windows around every cell corner, zero outside the grid."""
    padded = torch.nn.functional.pad(grid, (0, 0, *[PATCH // 2] * 4))
    windows = padded.unfold(0, PATCH, 1).unfold(1, PATCH, 1).permute(0, 1, 3, 4, 2).flatten(2)
    return windows.div_(windows.norm(dim=2, keepdim=True).clamp_min(1e-12))


def correlation_maps(patches: torch.Tensor, windows: torch.Tensor) -> torch.Tensor:
    """Cosines (ry, rx, n_y, n_x) of atomic patches (ry, rx, 16 C) and windows (n_y, n_x, 16 C).

    At the border only the part of the patch that falls inside the image counts.
    """
    n_y, n_x, depth = windows.shape
    maps = torch.matmul(patches.reshape(-1, depth), windows.reshape(-1, depth).T)
    maps = maps.reshape(*patches.shape[:2], n_y, n_x)
    energy = patches.reshape(*patches.shape[:2], PATCH, PATCH, -1).square().sum(dim=4)
    cells = [torch.arange(n)[:, None] + torch.arange(PATCH) - PATCH // 2 for n in (n_y, n_x)]
    rows, columns = (((0 <= cell) & (cell < len(cell) - 1)).to(maps) for cell in cells)
    for y in (0, 1, n_y - 2, n_y - 1):
        maps[:, :, y] /= torch.einsum("ijrc,r,xc->ijx", energy, rows[y], columns).sqrt().clamp_min(1e-6)
    for x in (0, 1, n_x - 2, n_x - 1):
        maps[:, :, 2:-2, x] /= torch.einsum("ijrc,c->ij", energy, columns[x]).sqrt().clamp_min(1e-6)[..., None]
    return maps


def _match_grids(left: torch.Tensor, right: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, np.ndarray, torch.Tensor]:
    """Best corner (gy, gx, 2) (x, y) of each patch of two descriptor grids, its score and peak ratio (gy, gx), and
    whether no other patch fits the same place of the right grid better (gy, gx).
    """
    patches, windows = unit_patches(left), unit_windows(right)
    (gy, gx), (n_y, n_x) = patches.shape[:2], windows.shape[:2]

    def chunks() -> Iterator[tuple[slice, torch.Tensor]]:
        step = max(1, CHUNK_BYTES // (gx * n_y * n_x * 4))
        for first in range(0, gy, step):
            part = slice(first, first + step)
            yield part, correlation_maps(patches[part], windows)

    pooled = patches.new_empty(gy, gx, (n_y + 1) // 2, (n_x + 1) // 2)
    for part, maps in chunks():
        pooled[part] = pool(maps)[1]
    # The power is monotone, so it may follow the maximum, which is a quarter of the work.
    score = path_scores(pooled.pow_(POWER), n_levels(gy, gx), shifted=True)
    best, place = score.new_empty(gy, gx), torch.empty(gy, gx, dtype=torch.long, device=score.device)
    ratio, strongest = np.empty((gy, gx)), score.new_full((n_y, n_x), -torch.inf)
    for part, maps in chunks():
        along_x, small = pool(maps)
        best[part], peak = score[part].flatten(2).max(dim=2)
        row, column = torch.div(peak, small.shape[3], rounding_mode="floor"), peak % small.shape[3]
        full = unpool(maps, along_x, small, score[part])
        place[part] = full.flatten(2).argmax(dim=2)
        strongest = torch.maximum(strongest, full.amax(dim=(0, 1)))
        ratio[part] = peak_ratio(small.flatten(0, 1), row.flatten(), column.flatten()).reshape(peak.shape)
    x, y = place % n_x, torch.div(place, n_x, rounding_mode="floor")
    bins = torch.nn.functional.max_pool2d(strongest[None], PATCH, ceil_mode=True)[0]
    own = bins[torch.div(y, PATCH, rounding_mode="floor"), torch.div(x, PATCH, rounding_mode="floor")]
    return torch.stack([x, y], dim=2), best, ratio, best >= own


def match_free(
    images: tuple[np.ndarray, np.ndarray], masks: tuple[np.ndarray | None, np.ndarray | None], downscale: int | None, *,
    budget_bytes: int, reciprocal: bool, device: str,
) -> Matches:  # fmt: skip
    """DeepMatching without any calibration; arguments as in `lib.matching.match`, images (h, w) uint8 grey."""
    shapes = images[0].shape, images[1].shape
    largest = int(np.log2(min(shapes[0] + shapes[1]) / (2 * PATCH)))
    if downscale is not None and not 0 <= downscale <= largest:
        raise ValueError(f"downscale: expected 0 to {largest} for images of these sizes, got {downscale}.")
    choices = range(1, largest + 1) if downscale is None else [downscale]
    fitting = [d for d in choices if predicted_bytes(*shapes, downscale=d) <= budget_bytes]
    if not fitting:
        need = predicted_bytes(*shapes, downscale=max(choices))
        raise ValueError(
            f"budget_bytes: DeepMatching with downscale {max(choices)} needs {need / 2**30:.2f} GiB, the budget is "
            f"{budget_bytes / 2**30:.2f}. Raise the budget or downscale, or match with a rig (method 'band')."
        )
    stride = 1 << fitting[0]
    left, right = (
        pixel_descriptors(image, fitting[0], valid=None if mask is None else ~mask)
        for image, mask in zip(images, masks, strict=True)
    )
    corner, best, ratio, passed = _match_grids(*(torch.from_numpy(grid).to(device) for grid in (left, right)))
    corner, best, passed = (array.cpu().numpy() for array in (corner, best.double(), passed))
    target = np.clip(corner, 0, np.array(right.shape[1::-1]) - 1)
    kept = np.isfinite(best) & patch_quality(left) & (right[target[..., 1], target[..., 0], CHANNELS - 1] > 0)
    kept &= passed | (not reciprocal)
    y, x = np.nonzero(kept)
    # A corner c of the grid lies at c * stride - 1/2 px where pixel centres are integers.
    u_left = (np.column_stack([x, y]) * PATCH + PATCH // 2) * float(stride) - 0.5
    u_right = corner[kept] * float(stride) - 0.5
    # Positions are multiples of the stride: a uniform error, beside what the descriptor itself cannot tell.
    variance = stride**2 / 12 + 0.25 * stride**2 / 4
    covariance = np.tile(np.diag([SIGMA_LEFT_PX**2] * 2 + [variance] * 2), (len(u_left), 1, 1))
    score = np.clip(best[kept] / (n_levels(*best.shape) + 1), 0, 1)
    return Matches(
        u_left, u_right, score, covariance, peak_ratio=ratio[kept], reciprocal=passed[kept], method="deepmatching"
    )
