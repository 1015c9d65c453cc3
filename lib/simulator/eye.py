"""Scenes: textured smooth height fields z(x, y) in the microscope frame, for the fundus of an eye or any other surface."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Protocol

import cv2
import numpy as np

from lib.geometry import check
from lib.simulator.texture import EXTENT_MM, GAMMA, fundus_texture, pattern, photograph_texture

_FUNDUS_PX, _FILMS = 1024, 8


class Scene(Protocol):
    """A surface for the renderer.  Lengths are mm in the microscope frame (z points into the eye).

    `height(x, y)` is the surface z.  `texture` is its reflectance (n, n, 3) uint8 over a square of side `extent_mm`
    around the origin.  `gloss` is the strength of the wet film's mirror image; 0 is a matt surface.  Optional: the map
    `texture_from_surface` (2, 3) from (x, y, 1) to mm in the texture; `step_px` between rays, 8 or less if rough.
    """

    gloss: float
    extent_mm: float
    texture: np.ndarray

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Eye:
    """An open-sky eye: a smooth bowl with folds and tilt, with the cut rim at the border of the field.

    Attributes:
        seed: Seed of the folds, the tilt and the procedural texture.
        radius_mm, depth_mm: Radius of the cut rim, and depth of the bowl's deepest point below it.
        fold_mm, tilt_rad: Amplitude of the retina's folds, and standard deviation of the tilt about x and y.
        centre_z_mm: z of the deepest point; 0 is the focal plane, positive is deeper.
        texture_path: A photograph that replaces the procedural texture.
        gloss: Strength of the reflection of the wet surface; 0 switches it off.
        turn_rad: Rotation of the texture on the surface, so that one texture serves many eyes.
    """

    extent_mm: ClassVar[float] = EXTENT_MM
    seed: int = 0
    radius_mm: float = 9.3
    depth_mm: float = 2.2
    fold_mm: float = 0.10
    tilt_rad: float = 0.04
    centre_z_mm: float = 1.1
    texture_path: str | Path | None = None
    texture_px: int = 2048
    gloss: float = 1.0
    turn_rad: float = 0.0

    def __post_init__(self) -> None:
        check(self, "radius_mm", lambda v: v > 0, "must be positive")
        check(self, "depth_mm", lambda v: 0 <= v < self.radius_mm, f"must lie between 0 and the radius {self.radius_mm}")
        check(self, "fold_mm", lambda v: 0 <= v <= 0.5, "must lie between 0 and 0.5 so that no fold hides another")
        check(self, "tilt_rad", lambda v: 0 <= v <= 0.3, "must lie between 0 and 0.3")
        check(self, "gloss", lambda v: v >= 0, "must not be negative")
        check(self, "texture_px", lambda v: v >= 64, "must be at least 64")

    @property
    def texture_from_surface(self) -> np.ndarray:
        """(2, 3): maps (x, y, 1) of a surface point to texture coordinates in mm from the texture's middle."""
        cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0]])

    @property
    def texture(self) -> np.ndarray:
        """Reflectance (n, n, 3) uint8 RGB."""
        if self.texture_path is not None:
            return photograph_texture(self.texture_path, self.texture_px)
        return fundus_texture(self.seed, self.texture_px, self.radius_mm)

    @cached_property
    def _shape(self) -> tuple[np.ndarray, np.ndarray]:
        """Tilt (2,) and folds (k, 4): wave vector x, y in 1/mm, phase, amplitude mm."""
        rng = np.random.default_rng([self.seed, 11])
        tilt = rng.normal(0, self.tilt_rad, 2).clip(-2.5 * self.tilt_rad, 2.5 * self.tilt_rad)
        wavelength = rng.uniform(3.5, 9.0, 7)
        direction, phase = rng.uniform(0, 2 * np.pi, (2, 7))
        amplitude = self.fold_mm * rng.uniform(0.3, 1.0, 7) * (wavelength / 9.0)
        wave = 2 * np.pi / wavelength
        return tilt, np.column_stack([wave * np.cos(direction), wave * np.sin(direction), phase, amplitude])

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Surface z in mm at (x, y) in mm, any shape."""
        tilt, folds = self._shape
        t = (x * x + y * y) / self.radius_mm**2
        # Parabola inside the rim, level outside it.
        z = self.centre_z_mm - self.depth_mm * t / np.cbrt(1 + (t / 1.25) ** 3) + tilt[0] * x + tilt[1] * y
        for wave_x, wave_y, phase, amplitude in folds:
            z = z + amplitude * (np.sin(wave_x * x + wave_y * y + phase) - np.sin(phase))
        return z


@dataclass(frozen=True)
class Ground(Eye):
    """A surface with any texture.  `border` is OpenCV's border mode, which continues the texture.

    Attributes:
        kind: "fundus", or the name of a pattern (`lib.simulator.texture`).
        extent_mm: Side of the square that one texture covers; its mirror images cover the rest.
        colours: Linear reflectances (k, 3), from dark to bright texture; empty = a fundus in its own colours.
        over, over_share: A second texture that is mixed with the first, and its share.
    """

    border: ClassVar[int] = cv2.BORDER_REFLECT
    kind: str = "fundus"
    extent_mm: float = EXTENT_MM
    colours: tuple[tuple[float, float, float], ...] = ()
    over: str | None = None
    over_share: float = 0.4

    @property
    def film_seed(self) -> int:
        """Seed of the wet film's ripples.  There are few, because films are kept in memory."""
        return self.seed % _FILMS

    @cached_property
    def texture(self) -> np.ndarray:
        """Reflectance (n, n, 3) uint8 RGB."""
        if self.texture_path is not None:
            return photograph_texture(self.texture_path, _FUNDUS_PX)
        if self.kind == "fundus":
            plain = fundus_texture(self.seed, _FUNDUS_PX, self.radius_mm)
            if not self.colours:
                return plain
            plain = cv2.cvtColor(plain, cv2.COLOR_RGB2GRAY)
        else:
            plain = pattern(self.kind, self.seed)
        if self.over is not None:
            other = cv2.resize(pattern(self.over, self.seed + 1), plain.shape)
            plain = cv2.addWeighted(plain, 1 - self.over_share, other, self.over_share, 0)
        stops = np.linspace(0, 255, len(self.colours))
        table = np.stack([np.interp(np.arange(256), stops, channel) for channel in np.transpose(self.colours)], axis=-1)
        return cv2.LUT(cv2.merge([plain] * 3), np.uint8(255 * np.clip(table, 0, 1)[None] ** (1 / GAMMA)))
