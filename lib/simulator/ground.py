"""Scenes that are no fundus: procedural textures of many statistics in any colours, on the shape of an `Eye`."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

from lib.simulator.eye import Eye
from lib.simulator.texture import GAMMA, fundus_texture, photograph_texture, smooth_noise

__all__ = ["Ground"]

_SIDE_PX, _FUNDUS_PX, _FILMS = 768, 1024, 8
Rng = np.random.Generator


@dataclass(frozen=True)
class Ground(Eye):
    """A surface with any texture.

    Attributes:
        kind: "fundus", "photograph" (at `texture_path`) or the name of a procedural texture, one of `_KINDS`.
        size_mm: Side of the square that one texture covers; its mirror images cover the rest.
        colours: Linear reflectances (k, 3), from dark to bright texture; none = a fundus or photograph in its own colours.
        over, over_share: A second texture that is mixed with the first, and its share.
    """

    kind: str = "fundus"
    size_mm: float = Eye.extent_mm
    colours: tuple[tuple[float, float, float], ...] = ()
    over: str | None = None
    over_share: float = 0.4

    @property
    def extent_mm(self) -> float:
        """As `Scene` wants it."""
        return self.size_mm

    @property
    def border(self) -> int:
        """What lies beyond the texture, in OpenCV's terms."""
        return cv2.BORDER_REFLECT

    @property
    def film_seed(self) -> int:
        """Seed of the wet film's ripples: few, as they are kept in memory."""
        return self.seed % _FILMS

    @cached_property
    def texture(self) -> np.ndarray:
        """Reflectance (n, n, 3) uint8 RGB."""
        if self.kind == "photograph":
            return photograph_texture(self.texture_path, _FUNDUS_PX)
        if self.kind == "fundus":
            plain = fundus_texture(self.seed, _FUNDUS_PX, self.radius_mm)
            if not self.colours:
                return plain
            plain = cv2.cvtColor(plain, cv2.COLOR_RGB2GRAY)
        else:
            plain = _pattern(self.kind, self.seed)
        if self.over is not None:
            other = cv2.resize(_pattern(self.over, self.seed + 1), plain.shape)
            plain = cv2.addWeighted(plain, 1 - self.over_share, other, self.over_share, 0)
        stops = np.linspace(0, 255, len(self.colours))
        table = np.stack([np.interp(np.arange(256), stops, channel) for channel in np.transpose(self.colours)], axis=-1)
        return cv2.LUT(cv2.merge([plain] * 3), np.uint8(255 * np.clip(table, 0, 1)[None] ** (1 / GAMMA)))


@lru_cache(maxsize=256)
def _pattern(kind: str, seed: int) -> np.ndarray:
    """A texture (n, n) uint8 over the whole range."""
    value = _KINDS[kind](np.random.default_rng([seed, 13]))
    low, high = np.percentile(value[::4, ::4], [0.5, 99.5])
    return np.uint8(255 * np.clip((value - low) / max(high - low, 1e-6), 0, 1))


def _noise(rng: Rng, cells: int, octaves: int = 1, gain: float = 0.5) -> np.ndarray:
    return smooth_noise(rng, _SIDE_PX, cells, octaves, gain)


def _soft(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Blurred, as shares of 255 if the image is uint8."""
    scale = 255 if image.dtype == np.uint8 else 1
    return cv2.GaussianBlur(image, (0, 0), sigma_px).astype(np.float32) / scale


def _membranes(rng: Rng) -> np.ndarray:
    """Sheets whose folds and edges are bright lines."""
    total = np.zeros((_SIDE_PX, _SIDE_PX), np.float32)
    for _ in range(4):
        sheet = _noise(rng, int(rng.integers(4, 14)), 3)
        total += 0.5 * (sheet > rng.normal(0, 0.4)) + np.exp(-((sheet / rng.uniform(0.05, 0.2)) ** 2))
    return _soft(total, rng.uniform(0.8, 3.0))


def _blood(rng: Rng) -> np.ndarray:
    """Dark pools on a blotchy surface."""
    pool = (_noise(rng, int(rng.integers(4, 12)), 3, 0.6) - rng.uniform(0.2, 1.0)) / rng.uniform(0.03, 0.3)
    return 0.5 * _noise(rng, 30, 3) - 4 / (1 + np.exp(-np.clip(pool, -30, 30)))


def _lines(rng: Rng, n: int, width: tuple[float, float], turn: float, spread: float) -> np.ndarray:
    """Curves, 0 to 1, of random widths; `turn` bends them, `spread` is how much their directions differ."""
    total, main = np.zeros((_SIDE_PX, _SIDE_PX), np.uint8), rng.uniform(0, np.pi)
    for _ in range(n):
        heading = main + rng.normal(0, spread) + np.cumsum(rng.normal(0, turn, 40))
        step = _SIDE_PX / 25 * np.column_stack([np.cos(heading), np.sin(heading)])
        path = rng.uniform(-0.4, 1.1, 2) * _SIDE_PX + np.cumsum(step, axis=0)
        thick = max(1, round(float(np.exp(rng.uniform(*np.log(width))))))
        cv2.polylines(total, [np.int32(path * 16)], False, int(rng.integers(60, 255)), thick, cv2.LINE_AA, 4)
    return _soft(total, 0.8)


def _vessels(rng: Rng) -> np.ndarray:
    fine = _lines(rng, int(rng.integers(10, 50)), (1, 3), 0.2, 2.0)
    both = _lines(rng, int(rng.integers(3, 10)), (4, 16), 0.12, 2.0) + 0.6 * fine
    return rng.choice([-1, 1]) * both + 0.15 * _noise(rng, 8, 4)


def _cells(rng: Rng, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the nearest of n points, in its standard deviations, and which point that is."""
    ground = np.full((_SIDE_PX, _SIDE_PX), 255, np.uint8)
    ground[tuple(rng.integers(0, _SIDE_PX, (2, n)))] = 0
    distance, label = cv2.distanceTransformWithLabels(ground, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    return distance / distance.std(), label


def _skin(rng: Rng) -> np.ndarray:
    return _noise(rng, 60, 4, 0.7) + _noise(rng, 5) - rng.uniform(0.3, 1) * _cells(rng, int(rng.integers(300, 3000)))[0]


def _brushed(rng: Rng) -> np.ndarray:
    marks = rng.standard_normal((_SIDE_PX, _SIDE_PX), dtype=np.float32)
    marks = cv2.GaussianBlur(marks, (0, 0), sigmaX=rng.uniform(20, 90), sigmaY=rng.uniform(0.6, 2.0))
    return marks / marks.std() + 0.7 * _noise(rng, 4)


def _dots(rng: Rng) -> np.ndarray:
    """A phantom: dots of one size at random places."""
    total, radius = np.zeros((_SIDE_PX, _SIDE_PX), np.uint8), int(rng.integers(3, 14))
    for x, y in rng.integers(0, _SIDE_PX, (int(rng.integers(60, 500)), 2)):
        cv2.circle(total, (int(x), int(y)), radius, 255, -1, cv2.LINE_AA)
    return rng.choice([-1, 1]) * _soft(total, rng.uniform(0.5, 3))


def _stones(rng: Rng) -> np.ndarray:
    """Pieces of one brightness each, with dark joints."""
    distance, label = _cells(rng, int(rng.integers(100, 1500)))
    return _soft(rng.uniform(0, 1, int(label.max()) + 1).astype(np.float32)[label], 1.0) - 0.08 * distance


def _gauze(rng: Rng) -> np.ndarray:
    """A woven lattice of threads that pass over and under each other."""
    y, x = np.mgrid[:_SIDE_PX, :_SIDE_PX].astype(np.float32)
    pitch, fill = rng.uniform(18, 44), rng.uniform(0.25, 0.45)
    p, q = (x + 3 * _noise(rng, 8)) / pitch, (y + 3 * _noise(rng, 8)) / pitch
    warp, weft = (np.sqrt(np.clip(1 - ((axis % 1 - 0.5) / fill) ** 2, 0, 1)) for axis in (p, q))
    over = np.cos(np.pi * np.floor(p)) * np.cos(np.pi * np.floor(q))
    return np.maximum(warp * (1 + 0.3 * over), weft * (1 - 0.3 * over)) + 0.06 * _noise(rng, 200)


_KINDS = {
    "smooth": lambda rng: _noise(rng, int(rng.integers(2, 6))),
    "grainy": lambda rng: _noise(rng, int(rng.integers(20, 200)), 4, rng.uniform(0.5, 0.95)) + 0.7 * _noise(rng, 4),
    "fibres": lambda rng: _lines(rng, int(rng.integers(60, 400)), (1, 6), 0.08, rng.uniform(0.1, 2)) + 0.1 * _noise(rng, 6),
    "paper": lambda rng: 0.3 * _lines(rng, 250, (1, 2), 0.15, 3.0) + 0.1 * (_noise(rng, 300, 2, 0.9) + _noise(rng, 6, 2)),
    "membranes": _membranes, "blood": _blood, "vessels": _vessels, "skin": _skin, "brushed": _brushed, "dots": _dots,
    "stones": _stones, "gauze": _gauze,
}  # fmt: skip
