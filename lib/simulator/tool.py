"""The tool in an image: where the camera sees it, what hides its landmarks, its metal and its shadow."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import Microscope
from lib.simulator.optics import blur, blur_by_depth, motion_kernel
from lib.simulator.raster import ToolRaster, rasterise
from lib.simulator.window import Window

__all__ = ["ToolInView", "compose", "shadow", "tool_in_view"]


@dataclass(frozen=True, eq=False)
class ToolInView:
    """The tool in the camera frame of a window (pixel = zoom * (x, y)), each point when its own row is exposed.

    Attributes:
        window, forceps: Which camera sees which tool.
        landmarks: (3, 3) mm.
        centres, radii, chains: The round cones as `Forceps.nodes` gives them.
        velocity: Mean velocity (2,) of the tips in the image plane, mm/s.
        raster: What the camera sees of the tool, or None where nothing is in view.
    """

    window: Window
    forceps: Forceps
    landmarks: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    chains: np.ndarray
    velocity: np.ndarray
    raster: ToolRaster | None

    @property
    def u(self) -> np.ndarray:
        """Landmarks (3, 2) px."""
        return self.landmarks[:, :2] * self.window.zoom

    @property
    def visibility(self) -> np.ndarray:
        """COCO visibility (3,) of the landmarks: 0 outside the window, 1 hidden by another part of the tool, 2 visible."""
        u = self.u
        inside = ((u > -0.5) & (u < np.array(self.window.size_px) - 0.5)).all(axis=1)
        found = np.where(inside, 2, 0)
        for k in np.flatnonzero(inside) if self.raster else ():
            if self._behind_another_part(k) or (k > 0 and self._behind_its_jaw(k)):
                found[k] = 1
        return found

    def _behind_another_part(self, k: int) -> bool:
        raster = self.raster
        column, row = np.floor((self.u[k] + 0.5 - raster.origin_px) * raster.factor).astype(int)
        if not (0 <= row < raster.part.shape[0] and 0 <= column < raster.part.shape[1]):
            return False
        own_mm = self.forceps.shaft_radius_mm if k == 0 else 0.0
        in_front = raster.depth_mm[row, column] < self.landmarks[k, 2] - own_mm - 0.06
        return bool(in_front and raster.part[row, column] not in ((0, 1) if k == 0 else (0, k + 1)))

    def _behind_its_jaw(self, k: int) -> bool:
        """Whether a blunt jaw that points steeply away hides its own tip: the tip then lies inside the jaw's outline."""
        factor, reach_px, side = 16, 0.25, 5
        u, jaw, zoom = self.u[k], self.chains == k, self.window.zoom
        corner = np.round(u) - 2
        shifted = self.centres[jaw] - np.append(corner / zoom, 0)
        one_chain = np.ones(jaw.sum(), int)
        raster = rasterise(shifted, self.radii[jaw], one_chain, zoom=zoom, size_px=(side, side), factor=factor)
        if raster is None:
            return False
        covered = np.zeros((side * factor, side * factor), bool)
        (x0, y0), (height, width) = raster.origin_px, raster.part.shape
        covered[y0 * factor : y0 * factor + height, x0 * factor : x0 * factor + width] = raster.part > 0
        sample = (np.arange(side * factor) + 0.5) / factor - 0.5
        near = np.add.outer((sample - (u - corner)[1]) ** 2, (sample - (u - corner)[0]) ** 2) < reach_px**2
        return bool(covered[near].all())


def tool_in_view(
    window: Window, forceps: Forceps, pose: Pose, later: tuple[Pose, float] | None, *, readout_s: float = 0.0, factor: int = 2
) -> ToolInView:  # fmt: skip
    """The tool as the window's camera sees it.

    Args:
        later: (pose, seconds later): the tool's motion during the read-out, or None for a tool at rest.
        readout_s: Time from the first to the last row of the whole image; the middle row is exposed at the time of
            `pose`.
        factor: Samples per pixel and axis of the tool's edges.
    """
    centres, radii, chains = forceps.nodes(pose)
    points = np.vstack([forceps.landmarks(pose), centres])
    speed = np.zeros_like(points)
    if later is not None:
        other = np.vstack([forceps.landmarks(later[0]), forceps.nodes(later[0])[0]])
        speed = (other - points) / later[1]
    seen, _ = window.seen(points)
    for _ in range(3):  # two steps reach 1e-3 px
        row = seen[:, 1] * window.zoom + window.origin_px[1]
        delay = readout_s * np.clip(row / max(window.field_px[1] - 1, 1) - 0.5, -1, 1)
        seen, shrink = window.seen(points + speed * delay[:, None])
    centres, radii = seen[3:], radii * shrink[3:]
    raster = rasterise(centres, radii, chains, zoom=window.zoom, size_px=window.size_px, factor=factor)
    velocity = speed[1:3].mean(axis=0) @ window.R[:2].T
    return ToolInView(window, forceps, seen[:3], centres, radii, chains, velocity, raster)


def shadow(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, forceps: Forceps, pose: Pose, slope: tuple[float, float]
) -> np.ndarray:
    """Share of the light that the tool leaves on surface points (x, y, z) mm, in the shape of x; `slope` is the light's."""
    centres, radii, chains = forceps.nodes(pose)
    scale, half = 20.0, 14.0
    flat = (centres[:, :2] + np.multiply(slope, centres[:, 2:]) + half) * scale
    mask = np.zeros((int(2 * half * scale),) * 2, np.uint8)
    for k in np.flatnonzero(chains[1:] == chains[:-1]):
        thickness = max(1, round((radii[k] + radii[k + 1]) * scale))
        ends = np.clip(np.round(flat[k : k + 2] * 16), -(2**20), 2**20).astype(int)
        cv2.line(mask, tuple(map(int, ends[0])), tuple(map(int, ends[1])), 255, thickness, cv2.LINE_AA, 4)
    near = cv2.GaussianBlur(mask, (0, 0), 2.2).astype(np.float32) / 255
    columns = ((x + slope[0] * z + half) * scale).astype(np.float32)
    rows = ((y + slope[1] * z + half) * scale).astype(np.float32)
    return 1 - 0.62 * cv2.remap(near, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def compose(linear: np.ndarray, tool_mask: np.ndarray, tool: ToolInView, microscope: Microscope, light: tuple) -> None:
    """Lay the tool, blurred by its depth and motion, over the scene: `linear` (h, w, 3) and `tool_mask` change in place.

    `light` is the direction of the lamp (x, y) in the microscope frame, per unit of height.
    """
    window, raster = tool.window, tool.raster
    lamp = np.array([*light, -1.0]) @ window.R.T
    glow = linear[::16, ::16].reshape(-1, 3).mean(axis=0)
    metal = _metal(raster, tool.forceps, lamp / np.linalg.norm(lamp), glow) * np.float32(1.15 * microscope.brightness)
    colour, alpha, depth = _at_image_resolution(raster, metal)
    shift = tool.velocity * window.zoom * microscope.exposure_s
    height, width = alpha.shape
    (x0, y0), margin = raster.origin_px, 12 + int(np.ceil(np.abs(shift).max()))
    tool_mask[y0 : y0 + height, x0 : x0 + width] = np.round(255 * alpha)
    layer = np.dstack([colour, alpha])
    # Beyond the image's border the tool goes on; elsewhere there is nothing beyond the layer.
    sides = [y0, linear.shape[0] - y0 - height, x0, linear.shape[1] - x0 - width]
    pad = [min(margin, side) for side in sides]
    layer = cv2.copyMakeBorder(layer, *pad, cv2.BORDER_CONSTANT, value=0)
    z = np.where(alpha > 0.01, depth, np.nan)  # depth along the axis is z of the microscope frame to a few um
    if np.isfinite(microscope.depth_of_field_mm):
        covered = cv2.blur((alpha > 0.01).astype(np.float32), (25, 25))
        spread = cv2.blur(np.nan_to_num(z) * (alpha > 0.01), (25, 25)) / np.maximum(covered, 1e-3)
        defocus_px = microscope.defocus_px(np.where(np.isfinite(z), z, spread))
        sigma = np.hypot(microscope.psf_px, window.zoom / 100.0 * defocus_px)
        sigma = cv2.copyMakeBorder(sigma.astype(np.float32), *pad, cv2.BORDER_REPLICATE)
        layer = blur_by_depth(layer, sigma)
    else:
        layer = blur(layer, microscope.psf_px)
    kernel = motion_kernel(shift)
    if kernel is not None:
        layer = cv2.filter2D(layer, -1, kernel)
    target = linear[y0 - pad[0] : y0 + height + pad[1], x0 - pad[2] : x0 + width + pad[3]]
    target *= 1 - layer[..., 3:]
    target += layer[..., :3]


def _metal(raster: ToolRaster, forceps: Forceps, lamp: np.ndarray, glow: np.ndarray) -> np.ndarray:
    """Linear colour (n, 3) of the raster's tool samples under the lamp (3,), with the retina's glow (3,) from below."""
    normal, tangent = raster.normal, raster.tangent
    facing = np.clip(-normal[:, 2], 0, 1)
    up = 2 * facing * facing - 1  # of the mirrored view ray: 1 looks back into the microscope, -1 at the retina
    half = lamp - np.array([0, 0, 1.0])
    half = (half / np.linalg.norm(half)).astype(np.float32)
    along = tangent @ half
    streak = np.sqrt(np.maximum(1 - along * along, 0)) ** 60 * np.clip(normal @ half, 0, 1) ** 6
    marks = np.random.default_rng([forceps.seed, 3]).standard_normal((256, 128)).astype(np.float32)
    marks = cv2.GaussianBlur(marks, (0, 0), sigmaX=5, sigmaY=0.8)
    marks /= marks.std()
    around = np.arctan2(normal[:, 0] * tangent[:, 1] - normal[:, 1] * tangent[:, 0], facing)
    rows = ((around / np.pi + 1) * 128).astype(int) % 256
    brush = 1 + forceps.brushed * marks[rows, (raster.along_mm * 6).astype(int) % 128]
    lit = 1 / (1 + np.exp(-(up - 0.55) / 0.14))
    body = forceps.brightness * (0.10 + 0.50 * lit + 0.22 * np.clip(up + 0.2, 0, 1))
    grey = (body + 1.1 * forceps.brightness * streak) * np.clip(brush, 0.2, 2)
    colour = grey[:, None] * np.array([1.0, 0.99, 0.97], np.float32)
    return (colour + 0.35 * np.clip(0.3 - up, 0, 1)[:, None] * glow).astype(np.float32)


def _at_image_resolution(raster: ToolRaster, metal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Premultiplied colour (h, w, 3), coverage (h, w) and mean depth (h, w) of the tool's samples."""
    rows, columns = raster.hit
    height, width = (side // raster.factor for side in raster.part.shape)
    pixel = (rows // raster.factor) * width + columns // raster.factor

    def total(weights: np.ndarray | None = None) -> np.ndarray:
        return np.bincount(pixel, weights, height * width).reshape(height, width).astype(np.float32)

    samples, count = raster.factor**2, total()
    colour = np.dstack([total(metal[:, channel]) for channel in range(3)]) / samples
    return colour, count / samples, total(raster.depth_mm[rows, columns]) / np.maximum(count, 1)
