"""Exact orthographic rasterisation of round cones: the tool's depth, normals and parts.

A round cone is the convex hull of two balls.  Along a ray its front is min over s of
f(s) = z(s) - sqrt(Q(s)), where Q(s) = r(s)^2 - |w - s c|^2 is quadratic and f convex, so the minimum is a
closed form and no mesh is needed.  The shaft is a cylinder that ends flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["ToolRaster", "rasterise"]


@dataclass(frozen=True)
class ToolRaster:
    """What a camera sees of the tool, on a grid `factor` times finer than the image, over a box of it.

    Attributes
    ----------
    origin_px:
        (x, y), the image pixel whose first sample is the raster's first.
    factor:
        Samples per pixel and axis; sample k of pixel i is at i + (k + 0.5) / factor - 0.5.
    depth_mm:
        (h, w) float32 along the viewing direction, infinity where there is no tool.
    normal:
        (h, w, 3) float32 in the camera frame (z away from the camera).
    tangent:
        (h, w, 3) float32, direction along the part.
    part:
        (h, w) uint8: 0 none, 1 shaft, 2 jaw 1, 3 jaw 2.
    along_mm:
        (h, w) float32, position along the part, for brush marks.
    """

    origin_px: tuple[int, int]
    factor: int
    depth_mm: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    part: np.ndarray
    along_mm: np.ndarray


def rasterise(
    centres: np.ndarray,
    radii: np.ndarray,
    chains: np.ndarray,
    *,
    zoom: float,
    size_px: tuple[int, int],
    factor: int = 2,
) -> ToolRaster | None:
    """Rasterise chains of round cones; None where nothing is in view.

    Parameters
    ----------
    centres:
        (n, 3) camera frame: x, y so that pixel = zoom * (x, y), and depth.
    radii, chains:
        (n,) mm, and the chain each node belongs to; consecutive nodes of a chain are joined.  Chain 0 ends flat.
    zoom:
        px per mm.
    size_px:
        (w, h) of the image.
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
    step = 1.0 / factor
    for k, (lx, ly), (hx, hy) in zip(joined, low, high, strict=True):
        a, b = centres[k], centres[k + 1]
        r, dr = radii[k], radii[k + 1] - radii[k]
        c, dz = b[:2] - a[:2], b[2] - a[2]
        wx = ((np.arange((hx - lx) * factor) + 0.5) * step - 0.5 + lx) / zoom - a[0]
        wy = ((np.arange((hy - ly) * factor) + 0.5) * step - 0.5 + ly) / zoom - a[1]
        A = dr * dr - c @ c
        if A > -1e-9:  # one ball hides the other
            continue
        B = (r * dr + wy * c[1])[:, None] + (wx * c[0])[None]
        C = (r * r - wy * wy)[:, None] - (wx * wx)[None]
        y = dz * np.sqrt(np.maximum(B * B - A * C, 0) / (dz * dz - A))
        s = (y - B) / A
        flat = chains[k] == 0 and (k + 2 >= len(chains) or chains[k + 2] != 0)
        inside = s <= 1 if flat else True
        s = np.clip(s, 0, 1)
        Q = A * s * s + 2 * B * s + C
        view = np.s_[(ly - y0) * factor : (hy - y0) * factor, (lx - x0) * factor : (hx - x0) * factor]
        z = np.where((Q > 0) & inside, a[2] + s * dz - np.sqrt(np.maximum(Q, 0)), np.inf)
        closer = z < depth[view]
        depth[view][closer] = z[closer]
        parameter[view][closer] = s[closer]
        index[view][closer] = k
    hit = index >= 0
    k, s = index[hit], parameter[hit].astype(np.float64)[:, None]
    span = centres[1:] - centres[:-1]
    rows, columns = np.nonzero(hit)
    surface = np.column_stack(
        [
            ((columns + 0.5) * step - 0.5 + x0) / zoom,
            ((rows + 0.5) * step - 0.5 + y0) / zoom,
            depth[hit],
        ]
    )
    normal = np.zeros((*shape, 3), np.float32)
    out = surface - (centres[k] + s * span[k])
    normal[hit] = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    tangent = np.zeros((*shape, 3), np.float32)
    length = np.linalg.norm(span, axis=1)
    tangent[hit] = (span / np.maximum(length, 1e-9)[:, None])[k]
    along = np.zeros(shape, np.float32)
    along[hit] = np.concatenate([[0], np.cumsum(length)])[k] + s[:, 0] * length[k]
    part = np.zeros(shape, np.uint8)
    part[hit] = chains[k] + 1
    return ToolRaster((int(x0), int(y0)), factor, depth, normal, tangent, part, along)
