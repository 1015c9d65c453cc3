"""The tool in an image: its depth and normals, the visibility of its landmarks, and its metal.

A round cone is the convex hull of two balls.  In orthographic view its front along a ray is the minimum over s of the convex
f(s) = z(s) - sqrt(Q(s)), Q(s) = r(s)^2 - |w - s c|^2.  It has a closed form, so no mesh is needed.  The shaft ends flat.
"""

from typing import NamedTuple

import cv2
import numpy as np

from lib.recordings.annotations import inside
from lib.simulator.forceps import MAX_TIP_RADIUS_MM, Forceps, Instrument, Nodes, Pose
from lib.simulator.rig import Microscope
from lib.simulator.window import Window, blur_by_depth, motion_blur


class ToolRaster(NamedTuple):
    """The visible surface of the tool, on a grid `factor` times finer than the image, over a box of it.

    Attributes:
        origin_px: (x, y), the image pixel with the raster's first sample.
        factor: Samples per pixel and axis; sample k of pixel i is at i + (k + 0.5) / factor - 0.5.
        depth_mm, part: (h, w) depth along the view, infinity without tool; and 0 none, 1 shaft, 2 jaw 1, 3 jaw 2.
        hit: (rows, columns), (n,) each, of the samples with tool, to which the following belong.
        normal, tangent, along_mm: Normal and direction of the part (n, 3) in the camera frame; position (n,) along the part.
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
    """Rasterise round cones, given as `Nodes` in the camera frame, for an image (w, h) whose pixel is `zoom` * (x, y) mm.

    Consecutive nodes of a chain are joined; chain 0 ends flat.  Returns None if nothing is in view.
    """
    pixel, reach = centres[:, :2] * zoom, radii * zoom + 1.5
    joined = np.flatnonzero(chains[1:] == chains[:-1])
    low, high = np.floor(pixel - reach[:, None]), np.ceil(pixel + reach[:, None]) + 1
    low = np.maximum(np.minimum(low[joined], low[joined + 1]), 0).astype(int)
    high = np.minimum(np.maximum(high[joined], high[joined + 1]), size_px).astype(int)
    if not (seen := (high > low).all(axis=1)).any():
        return None
    joined, low, high = joined[seen], low[seen], high[seen]
    x0, y0 = low.min(axis=0)
    x1, y1 = high.max(axis=0)
    shape = ((y1 - y0) * factor, (x1 - x0) * factor)
    depth, index = np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int16)
    parameter = np.zeros(shape, np.float32)
    for k, (lx, ly), (hx, hy) in zip(joined, low, high, strict=True):
        a, b = centres[k], centres[k + 1]
        r, dr = radii[k], radii[k + 1] - radii[k]
        c, dz = b[:2] - a[:2], b[2] - a[2]
        A = dr * dr - c @ c
        if A > -1e-9:  # one ball hides the other
            continue
        # Coordinates relative to the node are small, so single precision is exact to nanometres.
        wx = (((np.arange((hx - lx) * factor) + 0.5) / factor - 0.5 + lx) / zoom - a[0]).astype(np.float32)
        wy = (((np.arange((hy - ly) * factor) + 0.5) / factor - 0.5 + ly) / zoom - a[1]).astype(np.float32)
        A, gain = np.float32(A), np.float32(dz / np.sqrt(dz * dz - A))
        B = np.add.outer((r * dr + wy * c[1]).astype(np.float32), (wx * c[0]).astype(np.float32))
        C = np.subtract.outer((r * r - wy * wy).astype(np.float32), wx * wx)
        s = (gain * np.sqrt(np.maximum(B * B - A * C, 0)) - B) / A
        past = (s > 1) & (chains[k] == 0 and (k + 2 >= len(chains) or chains[k + 2] != 0))  # a flat end
        np.clip(s, 0, 1, out=s)
        Q = (A * s + 2 * B) * s + C
        z = np.float32(a[2]) + s * np.float32(dz) - np.sqrt(np.maximum(Q, 0))
        view = np.s_[(ly - y0) * factor : (hy - y0) * factor, (lx - x0) * factor : (hx - x0) * factor]
        closer = (Q > 0) & (z < depth[view]) & ~past
        for whole, own in ((depth, z), (parameter, s), (index, np.int16(k))):
            np.copyto(whole[view], own, where=closer)
    rows, columns = np.nonzero(index >= 0)
    k, s = index[rows, columns], parameter[rows, columns][:, None]
    span = centres[1:] - centres[:-1]
    length = np.linalg.norm(span, axis=1)
    x, y = (((sample + 0.5) * np.float32(1.0 / factor) - 0.5 + first) / zoom for sample, first in ((columns, x0), (rows, y0)))
    out = (np.column_stack([x, y, depth[rows, columns]]) - centres[k] - s * span[k]).astype(np.float32)
    normal = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    tangent = (span / np.maximum(length, 1e-9)[:, None]).astype(np.float32)[k]
    along = (np.concatenate([[0], np.cumsum(length)])[k] + s[:, 0] * length[k]).astype(np.float32)
    part = np.zeros(shape, np.uint8)
    part[rows, columns] = chains[k] + 1
    return ToolRaster((int(x0), int(y0)), factor, depth, part, (rows, columns), normal, tangent, along)


class ToolInView(NamedTuple):
    """The tool in a window, with each point at the time when its own row is exposed.

    Attributes:
        u, visibility: Landmarks (3, 2) px, and (3,) COCO: 0 outside the window, 1 hidden by the tool itself, 2 visible.
        velocity: (2,) mm/s, mean of the tips in the image plane.
        raster: None if nothing is in view.
    """

    u: np.ndarray
    visibility: np.ndarray
    velocity: np.ndarray
    raster: ToolRaster | None


def tool_in_view(
    window: Window, forceps: Forceps | Instrument, pose: Pose, later: tuple[Pose, float] | None, *,
    readout_s: float = 0.0, factor: int = 2,
) -> ToolInView:  # fmt: skip
    """Project and rasterise the tool in a window; `pose` is that when the middle row of the whole image is exposed.

    `later`, (pose, seconds later), gives its motion while the rows of the whole image are read out, within `readout_s`.
    """
    centres, radii, chains = forceps.nodes(pose)
    points = np.vstack([forceps.landmarks(pose), centres])
    speed = np.zeros_like(points)
    if later is not None:
        speed = (np.vstack([forceps.landmarks(later[0]), forceps.nodes(later[0])[0]]) - points) / later[1]
    seen, _ = window.seen(points)
    for _ in range(3):  # two steps reach 1e-3 px
        row = seen[:, 1] * window.zoom + window.origin_px[1]
        delay = readout_s * np.clip(row / max(window.field_px[1] - 1, 1) - 0.5, -1, 1)
        seen, shrink = window.seen(points + speed * delay[:, None])
    landmarks, nodes = seen[:3], (seen[3:], radii * shrink[3:], chains)
    raster = rasterise(*nodes, zoom=window.zoom, size_px=window.size_px, factor=factor)
    u = landmarks[:, :2] * window.zoom
    visibility = np.where(inside(u, window.size_px), 2, 0)
    # A blunt jaw's tip lies inside its own outline unless the jaw is parallel to the image, so only pointed jaws are tested.
    pointed = forceps.tip_radius_mm <= MAX_TIP_RADIUS_MM
    for k in np.flatnonzero(visibility) if raster else ():
        hidden = _behind_another_part(raster, k, u[k], landmarks[k, 2] - (forceps.shaft_radius_mm if k == 0 else 0.0))
        if hidden or (k > 0 and pointed and _behind_its_jaw(nodes, k, u[k], window.zoom)):
            visibility[k] = 1
    return ToolInView(u, visibility, speed[1:3].mean(axis=0) @ window.R[:2].T, raster)


def _behind_another_part(raster: ToolRaster, k: int, u: np.ndarray, front_mm: float) -> bool:
    """True if another part lies in front of landmark k at pixel u, whose own part begins at depth `front_mm`."""
    column, row = np.floor((u + 0.5 - raster.origin_px) * raster.factor).astype(int)
    if not (0 <= row < raster.part.shape[0] and 0 <= column < raster.part.shape[1]):
        return False
    return raster.depth_mm[row, column] < front_mm - 0.06 and raster.part[row, column] not in (0, k + 1)


def _behind_its_jaw(nodes: Nodes, k: int, u: np.ndarray, zoom: float) -> bool:
    """True if a jaw that points steeply away hides its own tip: the tip then lies inside the jaw's outline."""
    factor, reach_px, side = 16, 0.25, 5
    corner = np.round(u) - 2
    centres, radii, chains = (part[nodes[2] == k] for part in nodes)
    raster = rasterise(centres - np.append(corner / zoom, 0), radii, chains, zoom=zoom, size_px=(side, side), factor=factor)
    covered = np.zeros((side * factor, side * factor), bool)
    if raster is not None:
        covered[tuple(raster.hit + factor * np.array(raster.origin_px[::-1])[:, None])] = True
    sample = (np.arange(side * factor) + 0.5) / factor - 0.5
    near = np.add.outer((sample - (u - corner)[1]) ** 2, (sample - (u - corner)[0]) ** 2) < reach_px**2
    return covered[near].all()


def compose(
    linear: np.ndarray, tool_mask: np.ndarray, tool: ToolInView, forceps: Forceps | Instrument, window: Window,
    microscope: Microscope, light: tuple[float, float], scene_z_mm: float,
) -> None:  # fmt: skip
    """Draw the tool, blurred by its depth and motion, over the scene; changes `linear` (h, w, 3) and `tool_mask` in place.

    `light` is the lamp's direction (x, y) per unit of height, in the microscope frame; `scene_z_mm` the scene's mean z.
    """
    raster = tool.raster
    lamp = np.array([*light, -1.0]) @ window.R.T
    lamp /= np.linalg.norm(lamp)
    power = 1.15 * microscope.brightness * microscope.lighting.tool
    if isinstance(forceps, Instrument):
        clearance = max(scene_z_mm - float(raster.depth_mm[raster.hit].mean()), 0.3)
        metal = _finished(raster, forceps, lamp, linear / max(power, 0.02), window.zoom * clearance) * np.float32(power)
    else:
        metal = _metal(raster, forceps, lamp, linear[::16, ::16].reshape(-1, 3).mean(axis=0)) * np.float32(power)
    colour, alpha, depth = _at_image_resolution(raster, metal)
    shift = tool.velocity * window.zoom * microscope.exposure_s
    height, width = alpha.shape
    (x0, y0), margin = raster.origin_px, 12 + int(np.ceil(np.abs(shift).max()))
    tool_mask[y0 : y0 + height, x0 : x0 + width] = np.round(255 * alpha)
    layer = np.dstack([colour, alpha])
    # At the image's border the tool continues outside, so there is no margin; elsewhere nothing lies outside the layer.
    pad = np.minimum(margin, [y0, linear.shape[0] - y0 - height, x0, linear.shape[1] - x0 - width]).tolist()
    layer = cv2.copyMakeBorder(layer, *pad, cv2.BORDER_CONSTANT, value=0)
    # The depth along the view equals z of the microscope frame to a few um.  Around the tool, use that of the tool near by.
    covered = alpha > 0.01
    spread = cv2.blur(np.where(covered, depth, 0), (25, 25)) / np.maximum(cv2.blur(np.float32(covered), (25, 25)), 1e-3)
    sigma = microscope.blur_px(np.where(covered, depth, spread), window.zoom)
    sigma = cv2.copyMakeBorder(sigma.astype(np.float32), *pad, cv2.BORDER_REPLICATE)
    layer = motion_blur(blur_by_depth(layer, sigma), shift)
    target = linear[y0 - pad[0] : y0 + height + pad[1], x0 - pad[2] : x0 + width + pad[3]]
    target *= 1 - layer[..., 3:]
    target += layer[..., :3]


def _brush_marks(seed: int, n: int, sigma: float) -> np.ndarray:
    """Marks (n, 128) of unit variance: columns run along a part, rows around it."""
    marks = np.random.default_rng([seed, 3]).standard_normal((n, 128)).astype(np.float32)
    marks = cv2.GaussianBlur(marks, (0, 0), sigmaX=sigma, sigmaY=0.8)
    return marks / marks.std()


def _metal(raster: ToolRaster, forceps: Forceps, lamp: np.ndarray, glow: np.ndarray) -> np.ndarray:
    """Linear colour (n, 3) of the raster's tool samples under the lamp (3,), with the retina's glow (3,) from below."""
    normal, tangent = raster.normal, raster.tangent
    facing = np.clip(-normal[:, 2], 0, 1)
    up = 2 * facing * facing - 1  # of the reflected view ray: 1 towards the microscope, -1 towards the retina
    half = lamp - [0, 0, 1.0]
    half = (half / np.linalg.norm(half)).astype(np.float32)
    along = tangent @ half
    streak = np.sqrt(np.maximum(1 - along * along, 0)) ** 60 * np.clip(normal @ half, 0, 1) ** 6
    around = np.arctan2(normal[:, 0] * tangent[:, 1] - normal[:, 1] * tangent[:, 0], facing)
    rows = ((around / np.pi + 1) * 128).astype(int) % 256
    brush = 1 + forceps.brushed * _brush_marks(forceps.seed, 256, 5)[rows, (raster.along_mm * 6).astype(int) % 128]
    lit = 1 / (1 + np.exp(-(up - 0.55) / 0.14))
    body = forceps.brightness * (0.10 + 0.50 * lit + 0.22 * np.clip(up + 0.2, 0, 1))
    grey = (body + 1.1 * forceps.brightness * streak) * np.clip(brush, 0.2, 2)
    colour = grey[:, None] * np.array([1.0, 0.99, 0.97], np.float32)
    return (colour + 0.35 * np.clip(0.3 - up, 0, 1)[:, None] * glow).astype(np.float32)


def _at_image_resolution(raster: ToolRaster, metal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average the tool's samples to premultiplied colour (h, w, 3), coverage (h, w) and mean depth (h, w) of the pixels."""
    rows, columns = raster.hit
    height, width = (side // raster.factor for side in raster.part.shape)
    pixel = (rows // raster.factor) * width + columns // raster.factor

    def total(weights: np.ndarray | None = None) -> np.ndarray:
        return np.bincount(pixel, weights, height * width).reshape(height, width).astype(np.float32)

    samples, count = raster.factor**2, total()
    colour = np.dstack([total(channel) for channel in metal.T]) / samples
    return colour, count / samples, total(raster.depth_mm[rows, columns]) / np.maximum(count, 1)


def _finished(raster: ToolRaster, tool: Instrument, lamp: np.ndarray, scene: np.ndarray, clearance_px: float) -> np.ndarray:
    """As `_metal`, for any finish, which mirrors the `scene` (h, w, 3) that lies `clearance_px` below the tool."""
    normal, tangent = raster.normal, raster.tangent
    chain = raster.part[raster.hit].astype(int) - 1
    finishes = [f for one in (tool, *(other for other, _ in tool.others)) for f in (one.finishes[0], *[one.finishes[1]] * 2)]
    names = ("matt", "mirror", "shine", "sharpness", "brushed", "colour")
    values = (np.array([getattr(finish, name) for finish in finishes], np.float32)[chain] for name in names)
    matt, mirror, shine, sharpness, brushed, colour = values
    lamp = lamp.astype(np.float32)
    half = (lamp - [0, 0, 1]).astype(np.float32)
    half /= np.linalg.norm(half)
    to_half, along = np.clip(normal @ half, 0, 1), tangent @ half
    streak = np.maximum(1 - along * along, 0) ** sharpness * to_half**4
    # The reflected view ray (0, 0, 1) meets the scene if it goes down, and the room and the lamp if it goes up.
    up = 2 * normal[:, 2] ** 2 - 1
    shift = -2 * normal[:, 2:] * normal[:, :2] * (clearance_px / np.maximum(-up, 0.15))[:, None]
    sky = 0.08 + 0.75 / (1 + np.exp(-(up - 0.6) / 0.12))
    small = cv2.GaussianBlur(cv2.resize(scene, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), (0, 0), 1.5)
    at = [(sample + 0.5) / raster.factor + first for sample, first in zip(raster.hit[::-1], raster.origin_px, strict=True)]
    column, row = (np.clip((at[i] + shift[:, i]) / 4, 0, small.shape[1 - i] - 1).astype(int) for i in (0, 1))
    below, down = small[row, column], np.clip(0.5 - 2.5 * up, 0, 1)[:, None]
    around = (normal[:, 0] * tangent[:, 1] - normal[:, 1] * tangent[:, 0]) * 31 + 32
    marks = _brush_marks(tool.seed, 64, 4)[around.astype(int) % 64, (raster.along_mm * 6).astype(int) % 128]
    brush = np.clip(1 + brushed * marks, 0.2, 2)
    even = (matt * brush)[:, None] * ((0.12 + 0.9 * np.clip(normal @ lamp, 0, 1))[:, None]
                                      + 0.3 * np.clip(0.4 - up, 0, 1.4)[:, None] * below)  # fmt: skip
    mirrored = (mirror * brush)[:, None] * (down * below + (1 - down) * sky[:, None])
    return colour * (even + mirrored) + (shine * (0.4 * to_half**sharpness + 0.8 * streak))[:, None]
