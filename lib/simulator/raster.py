"""Exact orthographic rasterisation of round cones: the tool's depth, normals and parts.

A round cone is the convex hull of two balls.  Along a ray its front is the minimum over s of f(s) = z(s) - sqrt(Q(s)) with
Q(s) = r(s)^2 - |w - s c|^2.  Q is quadratic and f convex, so the minimum has a closed form and no mesh is needed.  The shaft
is a cylinder that ends flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["ToolRaster", "rasterise"]


@dataclass(frozen=True)
class ToolRaster:
    """What a camera sees of the tool, on a grid `factor` times finer than the image, over a box of it.

    Attributes:
        origin_px: (x, y), the image pixel whose first sample is the raster's first.
        factor: Samples per pixel and axis; sample k of pixel i is at i + (k + 0.5) / factor - 0.5.
        depth_mm: (h, w) float32 along the viewing direction, infinity where there is no tool.
        part: (h, w) uint8: 0 none, 1 shaft, 2 jaw 1, 3 jaw 2.
        hit: (rows, columns), (n,) each, of the samples with tool; the following are theirs.
        normal, tangent: (n, 3) float32 in the camera frame (z away from the camera); the tangent runs along the part.
        along_mm: (n,) float32, position along the part, for brush marks.
    """

    origin_px: tuple[int, int]
    factor: int
    depth_mm: np.ndarray
    part: np.ndarray
    hit: tuple[np.ndarray, np.ndarray]
    normal: np.ndarray
    tangent: np.ndarray
    along_mm: np.ndarray


def rasterise(
    centres: np.ndarray, radii: np.ndarray, chains: np.ndarray, *, zoom: float, size_px: tuple[int, int], factor: int = 2
) -> ToolRaster | None:
    """Rasterise chains of round cones; None where nothing is in view.

    Args:
        centres: (n, 3) camera frame: x, y so that pixel = zoom * (x, y), and depth.
        radii, chains: (n,) mm, and the chain each node belongs to; consecutive nodes of a chain are joined.  Chain 0
            ends flat.
        zoom: px per mm.
        size_px: (w, h) of the image.
    """
    width, height = size_px
    pixel, reach = centres[:, :2] * zoom, radii * zoom + 1.5
    joined = np.flatnonzero(chains[1:] == chains[:-1])
    low = np.minimum(pixel[joined] - reach[joined, None], pixel[joined + 1] - reach[joined + 1, None])
    high = np.maximum(pixel[joined] + reach[joined, None], pixel[joined + 1] + reach[joined + 1, None])
    low = np.maximum(np.floor(low), 0).astype(int)
    high = np.minimum(np.ceil(high) + 1, [width, height]).astype(int)
    seen = (high > low).all(axis=1)
    if not seen.any():
        return None
    joined, low, high = joined[seen], low[seen], high[seen]
    x0, y0 = low.min(axis=0)
    x1, y1 = high.max(axis=0)
    shape = ((y1 - y0) * factor, (x1 - x0) * factor)
    depth = np.full(shape, np.inf, np.float32)
    parameter = np.zeros(shape, np.float32)
    index = np.full(shape, -1, np.int16)
    step = np.float32(1.0 / factor)
    for k, (lx, ly), (hx, hy) in zip(joined, low, high, strict=True):
        a, b = centres[k], centres[k + 1]
        r, dr = radii[k], radii[k + 1] - radii[k]
        c, dz = b[:2] - a[:2], b[2] - a[2]
        A = dr * dr - c @ c
        if A > -1e-9:  # one ball hides the other
            continue
        # Relative to the node and small, so single precision is exact to nanometres.
        wx = (((np.arange((hx - lx) * factor) + 0.5) / factor - 0.5 + lx) / zoom - a[0]).astype(np.float32)
        wy = (((np.arange((hy - ly) * factor) + 0.5) / factor - 0.5 + ly) / zoom - a[1]).astype(np.float32)
        A, gain = np.float32(A), np.float32(dz / np.sqrt(dz * dz - A))
        B = np.add.outer((r * dr + wy * c[1]).astype(np.float32), (wx * c[0]).astype(np.float32))
        C = np.subtract.outer((r * r - wy * wy).astype(np.float32), wx * wx)
        s = np.sqrt(np.maximum(B * B - A * C, 0))
        s *= gain
        s -= B
        s /= A
        flat = chains[k] == 0 and (k + 2 >= len(chains) or chains[k + 2] != 0)
        past = flat & (s > 1)
        np.clip(s, 0, 1, out=s)
        Q = (A * s + 2 * B) * s + C
        z = np.float32(a[2]) + s * np.float32(dz) - np.sqrt(np.maximum(Q, 0))
        view = np.s_[(ly - y0) * factor : (hy - y0) * factor, (lx - x0) * factor : (hx - x0) * factor]
        closer = (Q > 0) & (z < depth[view]) & ~past
        np.copyto(depth[view], z, where=closer)
        np.copyto(parameter[view], s, where=closer)
        np.copyto(index[view], np.int16(k), where=closer)
    rows, columns = np.nonzero(index >= 0)
    k, s = index[rows, columns], parameter[rows, columns][:, None]
    span = centres[1:] - centres[:-1]
    length = np.linalg.norm(span, axis=1)
    x, y = ((columns + 0.5) * step - 0.5 + x0) / zoom, ((rows + 0.5) * step - 0.5 + y0) / zoom
    surface = np.column_stack([x, y, depth[rows, columns]])
    out = (surface - centres[k] - s * span[k]).astype(np.float32)
    normal = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    tangent = (span / np.maximum(length, 1e-9)[:, None]).astype(np.float32)[k]
    along = (np.concatenate([[0], np.cumsum(length)])[k] + s[:, 0] * length[k]).astype(np.float32)
    part = np.zeros(shape, np.uint8)
    part[rows, columns] = chains[k] + 1
    return ToolRaster((int(x0), int(y0)), factor, depth, part, (rows, columns), normal, tangent, along)
