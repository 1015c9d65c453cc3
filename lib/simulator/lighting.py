"""Light and its disturbances beyond the reference microscope: lit discs, pupils, glare, shadows, haze, occluders."""

from dataclasses import dataclass

import cv2
import numpy as np

from lib.geometry import check
from lib.simulator.forceps import Nodes
from lib.simulator.window import Grid, Window

_HALF_MM = 14.0  # half the side of the square in which shadows are computed


@dataclass(frozen=True)
class Patch:
    """A soft ellipse of a linear colour (3,) in a plane parallel to the image, microscope frame.

    Attributes:
        radii_mm, turn_rad: Half axes, and the direction of the first.
        role: "glare" adds light to the scene, behind the tool; "flare" adds it in front; "cover" hides what is behind it;
            "pupil" hides everything outside it.
        edge, wobble: Width of its border, and amplitude of the border's irregularity, as shares of its radius.
    """

    centre_mm: tuple[float, float, float]
    radii_mm: tuple[float, float]
    colour: tuple[float, float, float]
    role: str
    turn_rad: float = 0.0
    edge: float = 0.1
    wobble: float = 0.0

    def lay(self, linear: np.ndarray, window: Window) -> np.ndarray:
        """Draw the patch over the image (h, w, 3) of a window, in place.  Returns a mask (h, w) of what it hides."""
        u = tuple(np.meshgrid(*(np.arange(side, dtype=np.float32) for side in window.size_px)))
        x, y = window.rays(u, np.float32(self.centre_mm[2]))
        dx, dy = x - self.centre_mm[0], y - self.centre_mm[1]
        cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
        p, q = (dx * cosine + dy * sine) / self.radii_mm[0], (dy * cosine - dx * sine) / self.radii_mm[1]
        radius = np.sqrt(p * p + q * q)
        if self.wobble:
            angle, phase = np.arctan2(q, p), 37.0 * self.turn_rad
            waves = ((2, 1.0), (3, 0.7), (7, 0.5))
            radius = radius * (1 + self.wobble * sum(size * np.sin(k * angle + k * phase) for k, size in waves))
        share = _inside(radius, self.edge).astype(np.float32)
        if self.role == "pupil":
            share = 1 - share
        adds = self.role in ("glare", "flare")
        if not adds:
            linear *= 1 - share[..., None]
        linear += share[..., None] * np.float32(self.colour)
        return share * max(self.colour) > 1.0 if adds else share > 0.7


@dataclass(frozen=True)
class Lighting:
    """The light on a scene, and what lies between scene and camera; the defaults are the reference microscope's light.

    Attributes:
        ambient, tool: Shares of the light that reach the scene outside the spot, and the tool.
        spot_edge: Border of a lit disc, as a share of `Microscope.spot_radius_mm`; None = a Gaussian spot of that radius.
        band_rad: Direction of the spot if it is a band; None = a disc.
        shadow, shadow_sigma_mm: Depth (0 to 1) and softness of the tool's shadow.
        source_mm: Position of a lamp near the scene that casts the shadow; None = distant light (`Microscope.light_slope`).
        scatter, haze: Share of the light that arrives blurred over `scatter_mm`, and light (3,) added everywhere.
        tint_per_mm: (3, 2) relative change of each colour per mm along x and y, as by lamps of two colours.
    """

    ambient: float = 0.25
    spot_edge: float | None = None
    band_rad: float | None = None
    tool: float = 1.0
    shadow: float = 0.62
    shadow_sigma_mm: float = 0.11
    source_mm: tuple[float, float, float] | None = None
    patches: tuple[Patch, ...] = ()
    scatter: float = 0.0
    scatter_mm: float = 1.0
    haze: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tint_per_mm: tuple[tuple[float, float], ...] | None = None

    def __post_init__(self) -> None:
        numbers = "ambient tool shadow shadow_sigma_mm scatter scatter_mm haze"
        check(self, numbers, lambda v: np.isfinite(v).all(), "must be finite")

    def spot(self, x: np.ndarray, y: np.ndarray, middle_mm: tuple[float, float], radius_mm: float) -> np.ndarray:
        """Light, 0 to 1, at (x, y) mm of a scene, for a spot with this middle and radius."""
        x, y = x - middle_mm[0], y - middle_mm[1]
        turn = self.band_rad
        distance = (np.hypot(x, y) if turn is None else np.abs(y * np.cos(turn) - x * np.sin(turn))) / radius_mm
        lit = np.exp(-(distance**2) / 2) if self.spot_edge is None else _inside(distance, self.spot_edge)
        return self.ambient + (1 - self.ambient) * lit

    def shaded(self, at: tuple[np.ndarray, ...], nodes: Nodes, slope: tuple[float, float]) -> np.ndarray:
        """Share of the light that the tool's shadow leaves at surface points at = (x, y, z) mm."""
        (x, y, z), (centres, radii, chains) = at, nodes
        scale = 40.0 if self.shadow_sigma_mm < 0.1 else 20.0
        if self.source_mm is None:
            flat, grow = centres[:, :2] + np.multiply(slope, centres[:, 2:]), np.ones(len(radii))
            columns, rows = x + slope[0] * z, y + slope[1] * z
        else:
            lamp, ground = np.array(self.source_mm), float(np.mean(z))
            grow = (ground - lamp[2]) / np.maximum(centres[:, 2] - lamp[2], 0.3)
            flat, columns, rows = lamp[:2] + (centres[:, :2] - lamp[:2]) * grow[:, None], x, y
        wide = radii * grow
        mask = np.zeros((int(2 * _HALF_MM * scale),) * 2, np.uint8)  # the tool's silhouette
        width_px = np.clip((wide[:-1] + wide[1:]) * scale, 1, 200)
        ends = np.clip(np.round((flat + _HALF_MM) * scale * 16), -(2**20), 2**20).astype(int).tolist()
        for k in np.flatnonzero(chains[1:] == chains[:-1]):
            cv2.line(mask, ends[k], ends[k + 1], 255, int(width_px[k]), cv2.LINE_AA, 4)
        small = cv2.resize(mask, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) if self.shadow_sigma_mm > 0.3 else mask
        scale *= small.shape[0] / mask.shape[0]
        near = cv2.GaussianBlur(small, (0, 0), max(self.shadow_sigma_mm * scale, 0.4))
        place = (((axis + _HALF_MM) * scale - 0.5).astype(np.float32) for axis in (columns, rows))
        return 1 - self.shadow / 255 * cv2.remap(near, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)

    def in_front(self, linear: np.ndarray, window: Window, u: np.ndarray, visibility: np.ndarray) -> np.ndarray:
        """Draw what lies in front of the tool on the image (h, w, 3), in place.  Returns the new visibility (3,)."""
        if self.tint_per_mm is not None:
            grid = Grid(window.size_px, 8)
            x, y = window.rays(grid.u, np.zeros_like(grid.u[0]))
            for channel, (along_x, along_y) in enumerate(self.tint_per_mm):
                linear[..., channel] *= grid.full(np.clip(1 + along_x * x + along_y * y, 0.1, 3.0))
        if self.scatter:
            small = cv2.resize(linear, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
            small = cv2.GaussianBlur(small, (0, 0), max(self.scatter_mm * window.zoom / 8, 0.5))
            linear *= 1 - self.scatter
            linear += self.scatter * cv2.resize(small, linear.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        visibility = visibility.copy()
        for patch in self.patches:
            if patch.role != "glare":
                hides, seen = patch.lay(linear, window), visibility == 2
                column, row = np.round(u[seen]).astype(int).T
                visibility[seen] = np.where(hides[row, column], 1, 2)
        if any(self.haze):
            linear += np.float32(self.haze)
        return visibility


def _inside(radius: np.ndarray, edge: float) -> np.ndarray:
    """1 where the radius is below one and 0 beyond, with a border of width `edge`."""
    return 1 / (1 + np.exp(np.clip((radius - 1) * (4 / max(edge, 1e-3)), -40, 40)))
