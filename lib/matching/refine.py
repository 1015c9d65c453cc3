"""Sub-cell displacement along the epipolar line, on the descriptors: one symmetric Gauss-Newton step.

Raw intensity would be biased where the two optical paths differ in gain and blur (by 0.4 px on retinal images); the
descriptors are squashed gradients, and each patch is scaled to the other's norm.  With f the left and g the right
patch and w the mean of their gradients along x (efficient second-order minimisation: Malis, ICRA 2004), the step is
w.(f - g) / w.w.  It is exact to second order and has no bias at zero, unlike the vertex of a parabola through
three correlations, which stays as the starting point for `VolumeMatches`.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lib.matching.volume import PATCH

__all__ = ["refine"]

CHUNK = 2048
#: Reach of the derivative filter (8 (g1 - g-1) - (g2 - g-2)) / 12.
REACH = 2
#: Along an edge nothing tells where it is; this draws the step off the line to zero there.
RIDGE = 0.05


def _cut(grid: np.ndarray, x: np.ndarray, y: np.ndarray, margin: int) -> np.ndarray:
    """(n, s + 2, s + 4, C) windows of a grid (h, w, C) whose patches start at (x, y), with their margins."""
    side = PATCH + 2 * margin
    rows, columns = y - margin - 1, x - margin - REACH
    height, width, channels = grid.shape
    view = np.lib.stride_tricks.sliding_window_view(
        grid.reshape(height, width * channels), (side + 2, (side + 2 * REACH) * channels)
    )
    return view[rows, columns * channels].reshape(len(x), side + 2, side + 2 * REACH, channels)


def _derivatives(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Along x, to fourth order, and along y, (n, s, s, C)."""
    middle = windows[:, 1:-1]
    near, far = middle[:, :, 3:-1] - middle[:, :, 1:-3], middle[:, :, 4:] - middle[:, :, :-4]
    across = windows[:, 2:, REACH:-REACH] - windows[:, :-2, REACH:-REACH]
    return near * np.float32(8 / 12) - far * np.float32(1 / 12), across * np.float32(1 / 2)


def refine(
    left: np.ndarray, right: np.ndarray, start_left: np.ndarray, start_right: np.ndarray, *, margin: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Refine matches of whole cells.

    Args:
        left, right: (h, w, C) float32 descriptor grids.
        start_left, start_right: (n, 2) int, (x, y) cells where the matching 4 x 4 patches start.
        margin: Cells added to the patch on every side: steadier on smooth surfaces, worse at depth edges.

    Returns:
        (step, sigma): (n, 2) cells to add to the right (x, y), at most 1 either way: x on the line, and y as a step
            that may leave the line finds it.  And their standard deviations (n, 2) if the descriptors' residuals were
            independent: the shape of the uncertainty, not yet its scale.
    """
    pad = margin + REACH
    left, right = (np.pad(grid, ((margin + 1, margin + 1), (pad, pad), (0, 0))) for grid in (left, right))
    step, sigma = np.empty((2, len(start_left), 2))

    def one(first: int) -> None:
        part = slice(first, first + CHUNK)
        f, g = (
            _cut(grid, start[part, 0] + pad, start[part, 1] + margin + 1, margin)
            for grid, start in ((left, start_left), (right, start_right))
        )
        slopes = [[a.reshape(len(f), -1) for a in _derivatives(windows)] for windows in (f, g)]
        f, g = (np.ascontiguousarray(a[:, 1:-1, REACH:-REACH]).reshape(len(a), -1) for a in (f, g))
        energy = np.einsum("ij,ij->i", g, g)
        scale = np.sqrt(np.einsum("ij,ij->i", f, f) / np.maximum(energy, 1e-12))[:, None]
        w, across = ((mine + other * scale) * np.float32(0.5) for mine, other in zip(*slopes, strict=True))
        f -= g * scale
        information = np.maximum(np.einsum("ij,ij->i", w, w), 1e-12)
        projection = np.einsum("ij,ij->i", w, f)
        residual = np.maximum(np.einsum("ij,ij->i", f, f) - projection**2 / information, 0)

        cross = np.einsum("ij,ij->i", w, across)
        free = np.einsum("ij,ij->i", across, across) * (1 + RIDGE) - cross**2 / information
        rest = np.einsum("ij,ij->i", across, f) - cross / information * projection
        step[part] = np.clip(np.column_stack([projection / information, rest / np.maximum(free, 1e-12)]), -1, 1)
        variance = residual / (f.shape[1] - 1)
        sigma[part] = np.sqrt(np.column_stack([variance / information, variance / np.maximum(free, 1e-12)]))

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, range(0, len(step), CHUNK)))
    return step, sigma
