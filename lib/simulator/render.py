"""Rendering: what one camera of the microscope sees of a scene and a tool, with the truth beside it.

Parallel rays (or nearly) meet the smooth height field after a few fixed-point steps on a coarse grid, which is
then interpolated to the image with fourth-order accuracy; the tool is rasterised exactly in its box only.
Everything is computed in linear light; the optics follow in the order of the real thing: defocus, motion blur,
vignetting, sensor noise, gamma, JPEG.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.simulator.eye import Scene
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import Microscope
from lib.simulator.raster import ToolRaster, rasterise
from lib.simulator.texture import GAMMA, smooth_noise

__all__ = ["View", "motion_kernel", "render_pair", "render_view", "surface_grid"]

_STEP_PX = 8  # of the coarse grid
_LINEAR = (np.arange(256, dtype=np.float32) / 255) ** GAMMA
_BUMP_MM, _BUMP_PX = 10.0, 1024
_FLAT = RigidTransform.identity()


@dataclass(frozen=True, eq=False)
class View:
    """One camera's image and its truth.

    Attributes
    ----------
    image:
        (h, w, 3) uint8 RGB.
    u:
        Landmarks base, tip_1, tip_2 (3, 2) px as imaged, rolling shutter included; NaN without a tool.
    visibility:
        (3,) COCO: 0 out of the image, 1 hidden by the tool, 2 visible.
    surface_mm:
        (h, w) float32, the scene's z in the microscope frame, or None if not asked for.
    tool_mask, glint_mask:
        (h, w) uint8: share of the pixel covered by the sharp tool, and whether a glint saturates it (0 or 255).
    """

    image: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    surface_mm: np.ndarray | None
    tool_mask: np.ndarray
    glint_mask: np.ndarray


@lru_cache(maxsize=8)
def _interpolation(size: int, step: int) -> np.ndarray:
    """(size, n) weights of the cubic through four neighbours on the coarse grid -step, 0, step, ..."""
    n = size // step + 4
    position = np.arange(size) / step + 1
    first = np.clip(np.floor(position).astype(int) - 1, 0, n - 4)
    t = position - first  # in 1..2
    weights = np.zeros((size, n))
    row = np.arange(size)
    for j in range(4):
        others = [k for k in range(4) if k != j]
        weights[row, first + j] = np.prod([(t - k) / (j - k) for k in others], axis=0)
    return weights.astype(np.float32)


class _Grid:
    """The coarse grid of an image and the way back to full resolution."""

    def __init__(self, size_px: tuple[int, int], step: int) -> None:
        width, height = size_px
        self.rows, self.columns = _interpolation(height, step), _interpolation(width, step)
        self.u = np.meshgrid(
            (np.arange(self.columns.shape[1]) - 1.0) * step, (np.arange(self.rows.shape[1]) - 1.0) * step
        )

    def full(self, values: np.ndarray) -> np.ndarray:
        """(h, w) float32 from values on the coarse grid; exact to 1e-6 of a value of order one."""
        offset = float(values.mean())
        return self.rows @ ((values - offset).astype(np.float32) @ self.columns.T) + np.float32(offset)


@lru_cache(maxsize=4)
def _bumps(seed: int) -> np.ndarray:
    """Slopes (n, n, 2) float32 of the wet film's ripples, over a square of `_BUMP_MM` that tiles by reflection."""
    rng = np.random.default_rng([seed, 5])
    return np.stack(
        [smooth_noise(rng, _BUMP_PX, 5, 2) + 0.2 * smooth_noise(rng, _BUMP_PX, 50) for _ in range(2)], axis=-1
    )


def _camera_frame(camera: AffineCamera | NearAffineCamera) -> tuple[np.ndarray, np.ndarray, float]:
    """R (3, 3), offset (2,) mm and zoom, so that pixel = zoom * (R[:2] @ x + offset) for square pixels."""
    affine = camera.affine if isinstance(camera, NearAffineCamera) else camera
    resection = affine.resect()
    zoom = float(resection.K[1, 1])
    if not np.allclose(resection.K, zoom * np.eye(2), atol=1e-6 * zoom):
        raise ValueError("camera: the renderer needs square pixels without skew.")
    return resection.R, resection.t, zoom


def _ray_points(camera: AffineCamera | NearAffineCamera, u: tuple, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x, y) mm where the rays of pixels u meet the plane z, all of one shape."""
    affine = camera.affine if isinstance(camera, NearAffineCamera) else camera
    (a, b, c), (d, e, f) = affine.linear
    right = (u[0] - affine.offset_px[0] - c * z, u[1] - affine.offset_px[1] - f * z)
    if isinstance(camera, NearAffineCamera):
        rho, axis, centre = camera.inverse_distance_per_mm, affine.viewing_direction, camera.centre_px
        du, dv = (u[0] - centre[0]) * rho, (u[1] - centre[1]) * rho
        right = (right[0] + du * axis[2] * z, right[1] + dv * axis[2] * z)
        a, b = a - du * axis[0], b - du * axis[1]
        d, e = d - dv * axis[0], e - dv * axis[1]
    determinant = a * e - b * d
    return (e * right[0] - b * right[1]) / determinant, (a * right[1] - d * right[0]) / determinant


def _intersect(scene: Scene, camera: AffineCamera | NearAffineCamera, u: tuple) -> tuple[np.ndarray, ...]:
    """(x, y, z) mm of the scene at pixels u.  Steep rays: a fixed point gains a factor of 30 a step on an eye."""
    z = np.zeros_like(u[0])
    for _ in range(40):
        x, y = _ray_points(camera, u, z)
        updated = scene.height(x, y)
        done = np.abs(updated - z).max() < 1e-6
        z = updated
        if done:
            break
    x, y = _ray_points(camera, u, z)
    return x, y, z


def _shadow(x: np.ndarray, y: np.ndarray, z: np.ndarray, nodes: tuple, slope: tuple[float, float]) -> np.ndarray:
    """Share of light (same shape as x) that the tool leaves on surface points."""
    centres, radii, chains = nodes
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


def _metal(raster: ToolRaster, forceps: Forceps, light: np.ndarray, glow: np.ndarray) -> np.ndarray:
    """Linear colour (n, 3) of the raster's tool samples under the lamp, with the retina's glow from below."""
    normal, tangent = raster.normal, raster.tangent
    facing = np.clip(-normal[:, 2], 0, 1)
    up = 2 * facing * facing - 1  # of the mirrored view ray: 1 looks back into the microscope, -1 at the retina
    half = light - np.array([0, 0, 1.0])
    half = (half / np.linalg.norm(half)).astype(np.float32)
    along = tangent @ half
    streak = np.sqrt(np.maximum(1 - along * along, 0)) ** 60 * np.clip(normal @ half, 0, 1) ** 6
    marks = np.random.default_rng([forceps.seed, 3]).standard_normal((256, 128)).astype(np.float32)
    marks = cv2.GaussianBlur(marks, (0, 0), sigmaX=5, sigmaY=0.8)
    marks /= marks.std()
    around = np.arctan2(normal[:, 0] * tangent[:, 1] - normal[:, 1] * tangent[:, 0], facing)
    rows = ((around / np.pi + 1) * 128).astype(int) % 256
    brush = 1 + forceps.brushed * marks[rows, (raster.along_mm * 6).astype(int) % 128]
    lamp = 1 / (1 + np.exp(-(up - 0.55) / 0.14))
    body = forceps.brightness * (0.10 + 0.50 * lamp + 0.22 * np.clip(up + 0.2, 0, 1))
    grey = (body + 1.1 * forceps.brightness * streak) * np.clip(brush, 0.2, 2)
    colour = grey[:, None] * np.array([1.0, 0.99, 0.97], np.float32)
    return (colour + 0.35 * np.clip(0.3 - up, 0, 1)[:, None] * glow).astype(np.float32)


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma) if sigma > 0.15 else image


def _blur_by_depth(image: np.ndarray, sigma: np.ndarray, grid: _Grid | None) -> np.ndarray:
    """Gaussian blur whose sigma (px, coarse grid or full) varies slowly: a blend in variance of three levels."""
    low, high = float(sigma.min()), float(sigma.max())
    if high - low < 0.15:
        return _blur(image, (low + high) / 2)
    levels = np.linspace(low, high, 3 if high - low > 0.8 else 2)
    stack = [_blur(image, level) for level in levels]
    result = stack[0]
    for k in range(1, len(levels)):
        share = (sigma**2 - levels[k - 1] ** 2) / (levels[k] ** 2 - levels[k - 1] ** 2)
        share = np.clip(grid.full(share) if grid else share, 0, 1).astype(np.float32)[..., None]
        result = result + share * (stack[k] - result)
    return result


def motion_kernel(shift_px: np.ndarray) -> np.ndarray | None:
    """A box along the movement during the exposure, centred, or None if it is too short to see."""
    length = float(np.hypot(*shift_px))
    if length < 0.3:
        return None
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1,) * 2, np.float32)
    for t in np.linspace(-0.5, 0.5, 4 * half + 1):
        x, y = t * shift_px + half
        i, j = int(np.floor(y)), int(np.floor(x))
        fy, fx = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
    return kernel / kernel.sum()


def _develop(
    linear: np.ndarray, microscope: Microscope, gain: np.ndarray, rng: np.random.Generator | None
) -> np.ndarray:
    """Sensor noise, gamma and 8 bits; `linear` (h, w, 3) float32 is overwritten."""
    linear *= gain.astype(np.float32)
    if rng is not None and np.isfinite(microscope.full_well):
        variance = np.clip(linear, 0, 1.2) * np.float32(1 / microscope.full_well)
        variance += np.float32((microscope.read_noise / microscope.full_well) ** 2)
        np.sqrt(variance, out=variance)
        variance *= rng.standard_normal(linear.shape, dtype=np.float32)
        linear += variance
    np.clip(linear, 0, 1, out=linear)
    cv2.pow(linear, 1 / GAMMA, linear)
    return cv2.convertScaleAbs(linear, alpha=255)


def render_view(
    scene: Scene,
    microscope: Microscope,
    camera: AffineCamera | NearAffineCamera,
    size_px: tuple[int, int],
    *,
    side: int = 0,
    forceps: Forceps | None = None,
    pose: Pose | None = None,
    later: tuple[Pose, float] | None = None,
    rng: np.random.Generator | None = None,
    factor: int = 2,
    surface: bool = False,
    field_px: tuple[int, int] | None = None,
    origin_px: tuple[float, float] = (0.0, 0.0),
) -> View:
    """What `camera` sees.

    Parameters
    ----------
    scene, microscope, camera:
        All in the microscope frame.
    size_px:
        (w, h) of the image.
    side:
        0 left, 1 right: which gains apply.
    forceps, pose:
        The tool at the time of the image, or None.
    later:
        (pose, seconds later): the tool's motion, for rolling shutter and motion blur.
    rng:
        Sensor noise; None renders without.
    factor:
        Samples per pixel and axis of the tool's edges.
    surface:
        Whether to return the depth of every pixel too.
    field_px, origin_px:
        Of the whole image and of this window's corner in it (vignetting, rolling shutter), for windows of an image.

    Returns
    -------
    View
    """
    width, height = size_px
    field_px = field_px or size_px
    R, offset, zoom = _camera_frame(camera)
    scale = zoom / 100.0  # blur is stated at 100 px per mm
    grid = _Grid(size_px, getattr(scene, "step_px", _STEP_PX))
    x, y, z = _intersect(scene, camera, grid.u)
    nodes = forceps.nodes(pose) if forceps is not None and pose is not None else None

    # The scene's light on the coarse grid: it is smooth.
    eps = 1e-3
    slope_x = (scene.height(x + eps, y) - scene.height(x - eps, y)) / (2 * eps)
    slope_y = (scene.height(x, y + eps) - scene.height(x, y - eps)) / (2 * eps)
    light_x, light_y = np.multiply(microscope.light_slope, 0.35)
    lambert = (1 - light_x * slope_x - light_y * slope_y) / np.sqrt(1 + slope_x**2 + slope_y**2)
    spot = np.exp(
        -((x - microscope.spot_mm[0]) ** 2 + (y - microscope.spot_mm[1]) ** 2) / (2 * microscope.spot_radius_mm**2)
    )
    light = microscope.brightness * 1.45 * np.clip(lambert, 0.05, None) * (0.25 + 0.75 * spot)
    if nodes is not None:
        light = light * _shadow(x, y, z, nodes, microscope.light_slope)
    to_texture = scene.texture.shape[0] / scene.extent_mm
    (a, b, c), (d, e, f) = getattr(scene, "texture_from_surface", np.eye(2, 3))
    map_x = grid.full((a * x + b * y + c + scene.extent_mm / 2) * to_texture - 0.5)
    map_y = grid.full((d * x + e * y + f + scene.extent_mm / 2) * to_texture - 0.5)
    albedo = cv2.remap(scene.texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    linear = cv2.LUT(albedo, _LINEAR)
    linear *= grid.full(light)[..., None]
    glint_mask = np.zeros((height, width), np.uint8)
    if scene.gloss > 0:
        # A film mirrors the lamp where its normal halves light and view.
        view_x, view_y = -R[2, 0] / R[2, 2], -R[2, 1] / R[2, 2]
        want_x, want_y = (light_x + view_x) / 2, (light_y + view_y) / 2
        film_x, film_y = grid.full(-0.6 * slope_x + want_x), grid.full(-0.6 * slope_y + want_y)
        to_bump = np.float32(_BUMP_PX / _BUMP_MM / to_texture)
        bump = cv2.remap(
            _bumps(getattr(scene, "seed", 0)), map_x * to_bump, map_y * to_bump, cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )  # fmt: skip
        bump *= np.float32(0.13)
        film_x += bump[..., 0]
        film_y += bump[..., 1]
        mirror = film_x * film_x + film_y * film_y
        # A narrow core that saturates in a broad sheen.
        sheen = cv2.exp(mirror * np.float32(-1 / (2 * 0.09**2)))
        mirror = cv2.exp(mirror * np.float32(-1 / (2 * 0.011**2)))
        mirror *= np.float32(2.2)
        mirror += np.float32(0.10) * sheen
        mirror *= grid.full(scene.gloss * light)
        glint_mask[mirror > 0.55] = 255
        linear += mirror[..., None]
    sigma = np.hypot(microscope.psf_px, scale * microscope.defocus_px(z))
    linear = _blur_by_depth(linear, sigma, grid)

    u, visibility = np.full((3, 2), np.nan), np.zeros(3, int)
    tool_mask = np.zeros((height, width), np.uint8)
    if nodes is not None:
        landmarks, (centres, radii, chains), tip_velocity = _to_camera(
            forceps, pose, later, nodes, camera, microscope, R, offset, zoom, field_px, origin_px
        )
        u = landmarks[:, :2] * zoom
        raster = rasterise(centres, radii, chains, zoom=zoom, size_px=size_px, factor=factor)
        inside = ((u > -0.5) & (u < np.array(size_px) - 0.5)).all(axis=1)
        visibility = np.where(inside, 2, 0)
        if raster is not None:
            lamp = np.array([light_x, light_y, -1.0]) @ R.T
            glow = linear[::16, ::16].reshape(-1, 3).mean(axis=0)
            shift = tip_velocity * zoom * microscope.exposure_s
            colour, alpha, depth = _tool_layer(raster, forceps, lamp, glow, microscope)
            _compose(linear, tool_mask, raster, colour, alpha, depth, microscope, scale, R, shift)
            visibility = _visibility(raster, landmarks, u, inside, forceps)
            for k in np.flatnonzero(visibility == 2):
                if k > 0 and _behind_its_jaw(u[k], centres, radii, chains == k, zoom):
                    visibility[k] = 1
    centre = (np.array(field_px) - 1) / 2 - origin_px
    radius2 = ((grid.u[0] - centre[0]) ** 2 + (grid.u[1] - centre[1]) ** 2) / (np.hypot(*field_px) / 2) ** 2
    linear *= grid.full(1 - microscope.vignetting * radius2)[..., None]
    image = _develop(linear, microscope, np.array(microscope.gain[side]), rng)
    glint_mask[tool_mask > 0] = 0
    return View(image, u, visibility, grid.full(z) if surface else None, tool_mask, glint_mask)


def _to_camera(forceps, pose, later, nodes, camera, microscope, R, offset, zoom, field_px, origin_px):
    """Landmarks (3, 3), nodes and the tips' mean velocity in the camera frame, each when its own row is exposed."""
    centres, radii, chains = nodes
    points = np.vstack([forceps.landmarks(pose), centres])
    speed = np.zeros_like(points)
    if later is not None:
        other = np.vstack([forceps.landmarks(later[0]), forceps.nodes(later[0])[0]])
        speed = (other - points) / later[1]

    def project(p: np.ndarray) -> np.ndarray:
        return np.column_stack([p @ R[:2].T + offset, p @ R[2]])

    def perspective(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not isinstance(camera, NearAffineCamera):
            return seen, np.ones(len(seen))
        shrink = 1 / (1 + camera.inverse_distance_per_mm * seen[:, 2])
        centre = camera.centre_px / zoom
        return np.column_stack([centre + (seen[:, :2] - centre) * shrink[:, None], seen[:, 2]]), shrink

    seen, _ = perspective(project(points))
    # Rows are exposed around the frame's time: the middle row exactly then.  Two steps reach 1e-3 px.
    for _ in range(3):
        row = seen[:, 1] * zoom + origin_px[1]
        delay = microscope.readout_s * (row / max(field_px[1] - 1, 1) - 0.5)
        delay = np.clip(delay, -microscope.readout_s, microscope.readout_s)
        seen, shrink = perspective(project(points + speed * delay[:, None]))
    return seen[:3], (seen[3:], radii * shrink[3:], chains), (speed[1:3].mean(axis=0) @ R[:2].T)


def _tool_layer(raster, forceps, lamp, glow, microscope):
    """Premultiplied colour (h, w, 3), coverage (h, w) and mean depth (h, w) of the tool at image resolution."""
    rows, columns = raster.hit
    height, width = (side // raster.factor for side in raster.part.shape)
    pixel = (rows // raster.factor) * width + columns // raster.factor
    metal = _metal(raster, forceps, lamp / np.linalg.norm(lamp), glow) * np.float32(1.15 * microscope.brightness)

    def total(weights: np.ndarray | None = None) -> np.ndarray:
        return np.bincount(pixel, weights, height * width).reshape(height, width).astype(np.float32)

    samples = raster.factor**2
    count = total()
    colour = np.dstack([total(metal[:, channel]) for channel in range(3)]) / samples
    return colour, count / samples, total(raster.depth_mm[rows, columns]) / np.maximum(count, 1)


def _compose(linear, tool_mask, raster, colour, alpha, depth, microscope, scale, R, shift):
    """Blur the tool's layer by its depth and motion and lay it over the scene, in place."""
    height, width = alpha.shape
    (x0, y0), margin = raster.origin_px, 12 + int(np.ceil(np.abs(shift).max()))
    tool_mask[y0 : y0 + height, x0 : x0 + width] = np.round(255 * alpha)
    layer = np.dstack([colour, alpha])
    # The image's border extends the tool, elsewhere nothing does.
    sides = [y0, linear.shape[0] - y0 - height, x0, linear.shape[1] - x0 - width]
    pad = [min(margin, side) for side in sides]
    layer = cv2.copyMakeBorder(layer, *pad, cv2.BORDER_CONSTANT, value=0)
    z = np.where(alpha > 0.01, depth, np.nan)  # depth along the axis is z of the microscope frame to a few um
    if np.isfinite(microscope.depth_of_field_mm):
        spread = cv2.blur(np.nan_to_num(z) * (alpha > 0.01), (25, 25)) / np.maximum(
            cv2.blur((alpha > 0.01).astype(np.float32), (25, 25)), 1e-3
        )
        sigma = np.hypot(microscope.psf_px, scale * microscope.defocus_px(np.where(np.isfinite(z), z, spread)))
        sigma = cv2.copyMakeBorder(sigma.astype(np.float32), *pad, cv2.BORDER_REPLICATE)
        layer = _blur_by_depth(layer, sigma, None)
    else:
        layer = _blur(layer, microscope.psf_px)
    kernel = motion_kernel(shift)
    if kernel is not None:
        layer = cv2.filter2D(layer, -1, kernel)
    target = linear[y0 - pad[0] : y0 + height + pad[1], x0 - pad[2] : x0 + width + pad[3]]
    target *= 1 - layer[..., 3:]
    target += layer[..., :3]


def _visibility(raster, landmarks, u, inside, forceps):
    """COCO visibility: hidden where another part of the tool lies clearly in front of the landmark."""
    visibility = np.zeros(3, int)
    for k in np.flatnonzero(inside):
        column, row = np.floor((u[k] + 0.5 - raster.origin_px) * raster.factor).astype(int)
        visibility[k] = 2
        if 0 <= row < raster.part.shape[0] and 0 <= column < raster.part.shape[1]:
            own = forceps.shaft_radius_mm if k == 0 else 0.0
            part = raster.part[row, column]
            in_front = raster.depth_mm[row, column] < landmarks[k, 2] - own - 0.06
            if part not in ((0, 1) if k == 0 else (0, k + 1)) and in_front:
                visibility[k] = 1
    return visibility


def _behind_its_jaw(u: np.ndarray, centres: np.ndarray, radii: np.ndarray, jaw: np.ndarray, zoom: float) -> bool:
    """Whether a blunt jaw that points steeply away hides its own tip: the tip then lies inside the jaw's outline."""
    factor, reach_px = 16, 0.25
    corner = np.round(u) - 2
    shifted = centres[jaw] - np.append(corner / zoom, 0)
    raster = rasterise(shifted, radii[jaw], np.ones(jaw.sum(), int), zoom=zoom, size_px=(5, 5), factor=factor)
    if raster is None:
        return False
    covered = np.zeros((5 * factor, 5 * factor), bool)
    (x0, y0), (height, width) = raster.origin_px, raster.part.shape
    covered[y0 * factor : y0 * factor + height, x0 * factor : x0 * factor + width] = raster.part > 0
    sample = (np.arange(5 * factor) + 0.5) / factor - 0.5
    near = np.add.outer((sample - (u - corner)[1]) ** 2, (sample - (u - corner)[0]) ** 2) < reach_px**2
    return bool(covered[near].all())


def render_pair(
    scene: Scene,
    microscope: Microscope,
    *,
    forceps: Forceps | None = None,
    pose: Pose | None = None,
    later: tuple[Pose, float] | None = None,
    rig: StereoRig | None = None,
    rng: np.random.Generator | None = None,
    factor: int = 3,
    surface: bool = False,
) -> tuple[View, View]:
    """The left and right view of one moment; arguments as for `render_view`, `rig` in the microscope frame.

    Raises
    ------
    ValueError
        If the tool is entirely outside the field of both cameras.
    """
    rig = rig or microscope.rig(_FLAT)
    size = microscope.image_size_px
    if forceps is not None and pose is not None:
        landmarks = forceps.landmarks(pose)
        if not any(((u > -0.5) & (u < np.array(size) - 0.5)).all(axis=1).any() for u in rig.project(landmarks)):
            raise ValueError(
                f"pose: the tool is outside the field; its base is at {np.round(pose.base_mm, 2).tolist()} mm, move it "
                "towards the origin of the microscope frame."
            )
    views = []
    for side, camera in enumerate((rig.left, rig.right)):
        if microscope.inverse_distance_per_mm:
            camera = NearAffineCamera(camera.matrix, microscope.inverse_distance_per_mm, (np.array(size) - 1) / 2)
        views.append(
            render_view(
                scene, microscope, camera, size, side=side, forceps=forceps, pose=pose, later=later, rng=rng,
                factor=factor, surface=surface,
            )
        )  # fmt: skip
    return views[0], views[1]


def surface_grid(
    scene: Scene, camera: AffineCamera | NearAffineCamera, size_px: tuple[int, int], step_px: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The true surface: columns (a,) px, rows (b,) px and points (b, a, 3) mm, microscope frame, seen there.

    Between grid points linear interpolation is right to 1 um for eyes at the default step.
    """
    width, height = size_px
    x_px = np.append(np.arange(0, width - 1, step_px), width - 1).astype(float)
    y_px = np.append(np.arange(0, height - 1, step_px), height - 1).astype(float)
    return x_px, y_px, np.stack(_intersect(scene, camera, tuple(np.meshgrid(x_px, y_px))), axis=-1)
