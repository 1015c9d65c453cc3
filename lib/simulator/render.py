"""Renders the image of a scene and a tool by one camera of the microscope, with ground truth.

All in linear light; the optics follow in the order of a microscope: defocus, motion blur, vignetting, sensor noise, gamma.
"""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from lib.geometry import RigidTransform
from lib.recordings.annotations import inside
from lib.simulator.eye import Scene
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.rig import Microscope
from lib.simulator.texture import GAMMA, smooth_noise
from lib.simulator.tool import compose, tool_in_view
from lib.simulator.window import Grid, Window, blur_by_depth, intersect

_LINEAR = (np.arange(256, dtype=np.float32) / 255) ** GAMMA
_BUMP_MM, _BUMP_PX = 10.0, 1024


class View(NamedTuple):
    """One camera's image (h, w, 3) uint8 RGB and its ground truth.

    Attributes:
        u, visibility: Landmarks (3, 2) px in the image, NaN without a tool; (3,) COCO: 0 outside, 1 hidden, 2 visible.
        surface_mm: (h, w), the scene's z in the microscope frame, or None if not requested.
        tool_mask, glint_mask: (h, w) uint8: the share of a pixel that the sharp tool covers; 255 where a glint saturates.
    """

    image: np.ndarray
    u: np.ndarray
    visibility: np.ndarray
    surface_mm: np.ndarray | None
    tool_mask: np.ndarray
    glint_mask: np.ndarray


@lru_cache(maxsize=10)
def _bumps(seed: int) -> np.ndarray:
    """Slopes (n, n, 2) float32 of the wet film's ripples, over a square of `_BUMP_MM` that tiles by reflection."""
    rng = np.random.default_rng([seed, 5])
    return np.dstack([smooth_noise(rng, _BUMP_PX, 5, 2) + 0.2 * smooth_noise(rng, _BUMP_PX, 50) for _ in range(2)])


def render_view(
    scene: Scene, microscope: Microscope, window: Window, *, side: int = 0,
    forceps: Forceps | None = None, pose: Pose | None = None, later: tuple[Pose, float] | None = None,
    rng: np.random.Generator | None = None, factor: int = 2, surface: bool = False,
) -> View:  # fmt: skip
    """Render a window of a camera's image.

    Args:
        side: 0 left, 1 right: determines the colour gains.
        forceps, pose, later: The tool at the time of the image, or None; `later` is (pose, seconds later), for its motion.
        rng: Draws the sensor noise; None = no noise.
        factor: Samples per pixel and axis at the tool's edges.
        surface: True = also return the scene's z at every pixel.

    >>> from lib.simulator import Eye
    >>> microscope = Microscope(pixels_per_mm=(4.0, 4.0), image_size_px=(80, 60))
    >>> left = microscope.rig(RigidTransform.identity()).left
    >>> render_view(Eye(texture_px=64), microscope, Window(left, (80, 60))).image.shape
    (60, 80, 3)
    """
    grid = Grid(window.size_px, getattr(scene, "step_px", 8))
    x, y, z = intersect(scene, window, grid.u)
    has_tool = forceps is not None and pose is not None

    # The slope, and usually the light, vary smoothly: the coarse grid is enough.
    eps = 1e-3
    slope_x = (scene.height(x + eps, y) - scene.height(x - eps, y)) / (2 * eps)
    slope_y = (scene.height(x, y + eps) - scene.height(x, y - eps)) / (2 * eps)
    light_x, light_y = np.multiply(microscope.light_slope, 0.35)
    lambert = (1 + light_x * slope_x + light_y * slope_y) / np.sqrt(1 + slope_x**2 + slope_y**2)
    light = microscope.brightness * 1.45 * np.clip(lambert, 0.05, None)
    lighting, at = microscope.lighting, (x, y, z)
    hard = lighting.spot_edge is not None or lighting.shadow_sigma_mm < 0.1  # hard borders need every pixel
    if hard:
        light, *at = (grid.full(values) for values in (light, x, y, z))
    light = light * lighting.spot(*at[:2], microscope.spot_mm, microscope.spot_radius_mm)
    if has_tool:
        light = light * lighting.shaded(at, forceps.nodes(pose), microscope.light_slope)
    light = light if hard else grid.full(light)
    to_texture = scene.texture.shape[0] / scene.extent_mm
    (a, b, c), (d, e, f) = getattr(scene, "texture_from_surface", np.eye(2, 3))
    map_x = grid.full((a * x + b * y + c + scene.extent_mm / 2) * to_texture - 0.5)
    map_y = grid.full((d * x + e * y + f + scene.extent_mm / 2) * to_texture - 0.5)
    border = getattr(scene, "border", cv2.BORDER_REPLICATE)
    linear = cv2.LUT(cv2.remap(scene.texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=border), _LINEAR)
    linear *= light[..., None]
    glint_mask, tool_mask = np.zeros((2, *linear.shape[:2]), np.uint8)
    if scene.gloss > 0:
        # A film mirrors the lamp where its normal bisects the directions of light and view.
        want_x, want_y = (np.array([light_x, light_y]) - window.R[2, :2] / window.R[2, 2]) / 2
        film_x, film_y = grid.full(-0.6 * slope_x + want_x), grid.full(-0.6 * slope_y + want_y)
        place = (axis * np.float32(_BUMP_PX / _BUMP_MM / to_texture) for axis in (map_x, map_y))
        film = _bumps(getattr(scene, "film_seed", getattr(scene, "seed", 0)))
        bump = np.float32(0.13) * cv2.remap(film, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        film_x += bump[..., 0]
        film_y += bump[..., 1]
        mirror = film_x * film_x + film_y * film_y
        # A narrow core that saturates, in a broad sheen.
        sheen = cv2.exp(mirror * np.float32(-1 / (2 * 0.09**2)))
        mirror = np.float32(2.2) * cv2.exp(mirror * np.float32(-1 / (2 * 0.011**2)))
        mirror += np.float32(0.10) * sheen
        mirror *= light * np.float32(scene.gloss)
        glint_mask[mirror > 0.55] = 255
        linear += mirror[..., None]
    for patch in lighting.patches:
        if patch.role == "glare":  # behind the tool
            patch.lay(linear, window)
    linear = blur_by_depth(linear, microscope.blur_px(z, window.zoom), grid)

    u, visibility = np.full((3, 2), np.nan), np.zeros(3, int)
    if has_tool:
        tool = tool_in_view(window, forceps, pose, later, readout_s=microscope.readout_s, factor=factor)
        u, visibility = tool.u, tool.visibility
        if tool.raster is not None and tool.raster.hit[0].size:
            compose(linear, tool_mask, tool, forceps, window, microscope, (light_x, light_y), float(np.mean(z)))
    visibility = lighting.in_front(linear, window, u, visibility)
    field = np.array(window.field_px)
    centre = (field - 1) / 2 - window.origin_px
    radius2 = ((grid.u[0] - centre[0]) ** 2 + (grid.u[1] - centre[1]) ** 2) / (np.hypot(*field) / 2) ** 2
    linear *= grid.full(1 - microscope.vignetting * radius2)[..., None]
    linear *= np.array(microscope.gain[side], np.float32)
    if rng is not None and np.isfinite(microscope.full_well):
        variance = np.clip(linear, 0, 1.2) * np.float32(1 / microscope.full_well)
        variance += np.float32((microscope.read_noise / microscope.full_well) ** 2)
        linear += np.sqrt(variance) * rng.standard_normal(linear.shape, dtype=np.float32)
    glint_mask[tool_mask > 0] = 0
    image = cv2.convertScaleAbs(cv2.pow(np.clip(linear, 0, 1), 1 / GAMMA), alpha=255)
    if microscope.video is not None:
        image = microscope.video(image, rng)
    return View(image, u, visibility, grid.full(z) if surface else None, tool_mask, glint_mask)


def render_pair(
    scene: Scene, microscope: Microscope, *, forceps: Forceps | None = None, pose: Pose | None = None, **options: object
) -> tuple[View, View]:
    """Render the left and right view at one time; arguments as for `render_view`.

    Raises ValueError if the tool is entirely outside the field of both cameras.
    """
    rig, size = microscope.rig(RigidTransform.identity()), microscope.image_size_px
    if forceps and pose and not any(inside(u, size).any() for u in rig.project(forceps.landmarks(pose))):
        base = f"its base is at {np.round(pose.base_mm, 2).tolist()} mm"
        raise ValueError(f"pose: the tool is outside the field; {base}, move it towards the microscope frame's origin.")
    options = {"factor": 3} | options | {"forceps": forceps, "pose": pose}
    windows = Window(rig.left, size), Window(rig.right, size)
    return tuple(render_view(scene, microscope, window, side=k, **options) for k, window in enumerate(windows))
