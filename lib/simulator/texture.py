"""Procedural textures: a fundus with pigment, vessels, disc, macula and sclera; and patterns of many kinds.

A texture is a reflectance (n, n, 3) uint8 RGB with display gamma; rows and columns run along y and x of the microscope frame.
"""

import math
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from lib.recordings import read_image

#: Side of the square that a texture covers on the eye.
EXTENT_MM = 26.0
#: Encoding of textures and camera images: value = linear ** (1 / GAMMA).
GAMMA = 2.2
_SIDE_PX = 768  # side of a pattern
Rng = np.random.Generator

# Linear reflectance (red, green, blue) of healthy, dark, pale and brown fundi; an eye mixes two of them.
_PIGMENTS = np.array([[0.50, 0.165, 0.062], [0.36, 0.085, 0.035], [0.62, 0.28, 0.14], [0.34, 0.16, 0.075]])
_DISC = np.array([0.70, 0.42, 0.20])
_SCLERA = np.array([0.70, 0.53, 0.45])
# Absorption of blood per unit of optical density, for red, green and blue light.
_BLOOD = {"artery": np.array([0.35, 1.5, 1.3]), "vein": np.array([0.75, 1.75, 1.5])}


def smooth_noise(rng: np.random.Generator, size_px: int, cells: int, octaves: int = 1, gain: float = 0.5) -> np.ndarray:
    """Band-limited noise (size_px, size_px) float32 of unit variance, `cells` blobs across at the first octave."""
    total = np.zeros((size_px, size_px), np.float32)
    for octave in range(octaves):
        n = min(cells * 2**octave, size_px) + 4
        grid = rng.standard_normal((n, n), dtype=np.float32)
        total += gain**octave * cv2.resize(grid, (size_px, size_px), interpolation=cv2.INTER_CUBIC)
    return total / max(float(total.std()), 1e-6)


def _vessel_tree(rng: np.random.Generator, disc_mm: np.ndarray, kind: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centre lines (k, 2) mm and widths (k,) mm of one kind of vessel, grown outwards from the optic disc."""
    caliber = 0.17 if kind == "vein" else 0.125
    towards_centre = np.arctan2(-disc_mm[1], -disc_mm[0])
    branches, stack = [], []
    for arcade in (-2.2, -1.15, 1.15, 2.2):
        heading = towards_centre + arcade + rng.normal(0, 0.15) + (0.12 if kind == "vein" else -0.12)
        bend = -np.sign(arcade) * rng.uniform(0.10, 0.17) * (1 if abs(arcade) < 1.5 else 0.3)
        stack.append(((disc_mm + rng.normal(0, 0.08, 2)).tolist(), heading, caliber * rng.uniform(0.8, 1.15), bend))
    while stack and len(branches) < 60:
        (x, y), heading, width, bend = stack.pop()
        line, widths, wiggle, step, since = [(x, y)], [width], 0.0, 0.12, 0.0
        while width > 0.02 and max(abs(x), abs(y)) < EXTENT_MM / 2:
            wiggle = 0.8 * wiggle + rng.normal(0, 0.03)
            outwards = math.atan2(y - disc_mm[1], x - disc_mm[0])
            heading += bend * step + wiggle + 0.03 * math.sin(outwards - heading)
            bend *= 0.99
            x, y = x + step * math.cos(heading), y + step * math.sin(heading)
            width *= 0.994
            line.append((x, y))
            widths.append(width)
            since += step
            if since > 0.7 and rng.random() < 0.09:
                side, share = rng.choice([-1, 1]), rng.uniform(0.35, 0.8)
                if (child := width * share) > 0.024:
                    stack.append(((x, y), heading + side * rng.uniform(0.5, 1.1), child, -side * rng.uniform(0, 0.2)))
                    width *= (1 - share**3) ** (1 / 3) * 0.3 + 0.7  # Murray's law, softened
                    heading -= side * 0.15 * share
                since = 0.0
        branches.append((np.array(line), np.array(widths)))
    return branches


def _draw(branches: list[tuple[np.ndarray, np.ndarray]], size_px: int, share: float = 1.0) -> np.ndarray:
    """Optical density (size_px, size_px), 0 to 1, of vessels drawn with `share` of their width."""
    image, scale = np.zeros((size_px, size_px), np.uint8), size_px / EXTENT_MM
    for line, widths in branches:
        pixels = np.round(((line + EXTENT_MM / 2) * scale - 0.5) * 16).astype(np.int32).tolist()
        for a, b, width in zip(pixels[:-1], pixels[1:], (widths[1:] * share * scale).tolist(), strict=True):
            cv2.line(image, a, b, int(255 * min(1.0, 0.35 + width / 14.0)), max(1, round(width)), cv2.LINE_AA, 4)
    return image.astype(np.float32) / 255


@lru_cache(maxsize=128)
def fundus_texture(seed: int, size_px: int = 2048, rim_mm: float = 9.3) -> np.ndarray:
    """Reflectance of a fundus, (size_px, size_px, 3) uint8 RGB, read-only, whose retina ends `rim_mm` from the centre."""
    rng = np.random.default_rng([seed, 7])
    axis = (np.arange(size_px, dtype=np.float32) + 0.5) * (EXTENT_MM / size_px) - EXTENT_MM / 2
    x, y = np.meshgrid(axis, axis)
    pigment = rng.dirichlet([0.9] * len(_PIGMENTS)) @ _PIGMENTS
    angle = rng.uniform(0, 2 * np.pi)
    disc = rng.uniform(2.0, 5.0) * np.array([np.cos(angle), np.sin(angle)])
    macula = disc + rng.uniform(4.0, 5.0) * -np.array([np.cos(angle), np.sin(angle)])

    # Pigment is log-normal; choroidal vessels show as a pale net through it.
    density = 0.14 * smooth_noise(rng, size_px, 5, 3) + 0.06 * smooth_noise(rng, size_px, 60, 3, 0.7)
    density += 0.08 * smooth_noise(rng, size_px, 420, 2, 0.9)
    net = np.exp(-((smooth_noise(rng, size_px, 22, 2) / 0.35) ** 2))
    net += 0.6 * np.exp(-((smooth_noise(rng, size_px, 40, 2) / 0.3) ** 2))
    density -= rng.uniform(0.10, 0.34) * net * (0.6 + 0.4 * np.tanh(smooth_noise(rng, size_px, 3)))
    density += 0.35 * np.exp(-((x - macula[0]) ** 2 + (y - macula[1]) ** 2) / (2 * 0.8**2))

    artery, vein = _vessel_tree(rng, disc, "artery"), _vessel_tree(rng, disc, "vein")
    blur = (0, 0), size_px / 2048
    artery_map, vein_map = (cv2.GaussianBlur(_draw(tree, size_px), *blur) for tree in (artery, vein))
    reflex = cv2.GaussianBlur(_draw(artery, size_px, 0.3), *blur)

    distance = np.hypot((x - disc[0]) * rng.uniform(0.9, 1.1), (y - disc[1]))
    radius = rng.uniform(0.75, 1.0)
    disc_share = 1 / (1 + np.exp((distance - radius - 0.05 * smooth_noise(rng, size_px, 40, 2)) / 0.09))
    cup = np.exp(-((distance / (0.55 * radius)) ** 2))
    ring = np.exp(-(((distance - radius - 0.12) / 0.12) ** 2))

    rim = rim_mm + 0.12 * smooth_noise(rng, size_px, 8, 3)
    rho = np.hypot(x, y)
    sclera_share = 1 / (1 + np.exp(np.clip((rim - rho) / 0.09, -60, 60)))
    blotches = 0.10 * smooth_noise(rng, size_px, 14, 3) + 0.05 * smooth_noise(rng, size_px, 300, 2, 0.9)
    border = np.exp(-(((rho - rim) / 0.22) ** 2))

    texture = np.empty((size_px, size_px, 3), np.uint8)
    for channel in range(3):
        retina = pigment[channel] * np.exp(-(0.75, 1.0, 1.1)[channel] * density - 0.35 * ring)
        pale = _DISC[channel] * (0.75 + 0.35 * cup) * np.exp(-0.4 * density)
        value = retina + disc_share * (pale - retina)
        value *= np.exp(-_BLOOD["artery"][channel] * 0.55 * artery_map - _BLOOD["vein"][channel] * 0.75 * vein_map)
        value += 0.09 * reflex * (1.0, 0.55, 0.45)[channel]
        sclera = _SCLERA[channel] * np.exp(-(0.6, 1.0, 1.0)[channel] * (0.25 + blotches)) * (1 - 0.15 * border)
        value += sclera_share * (sclera - value)
        value *= 1 - 0.45 * border * (0.6, 1.0, 1.0)[channel]
        texture[..., channel] = np.round(255 * np.clip(value, 0, 1) ** (1 / GAMMA))
    texture.setflags(write=False)
    return texture


@lru_cache(maxsize=64)
def photograph_texture(path: str | Path, size_px: int = 2048) -> np.ndarray:
    """Make a texture from any photograph: its central square, resized to `size_px`."""
    image = read_image(Path(path))
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    texture = cv2.resize(image[top : top + side, left : left + side], (size_px, size_px), interpolation=cv2.INTER_AREA)
    texture.setflags(write=False)
    return texture


@lru_cache(maxsize=256)
def pattern(kind: str, seed: int) -> np.ndarray:
    """Make a pattern (n, n) uint8 that covers the whole range of values."""
    value = _KINDS[kind](np.random.default_rng([seed, 13]))
    low, high = np.percentile(value[::4, ::4], [0.5, 99.5])
    return np.uint8(255 * np.clip((value - low) / max(high - low, 1e-6), 0, 1))


def _noise(rng: Rng, cells: int, octaves: int = 1, gain: float = 0.5) -> np.ndarray:
    return smooth_noise(rng, _SIDE_PX, cells, octaves, gain)


def _soft(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Blur an image; values of a uint8 image are divided by 255."""
    return cv2.GaussianBlur(image, (0, 0), sigma_px).astype(np.float32) / (255 if image.dtype == np.uint8 else 1)


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
    """Curves, 0 to 1, of random widths; `turn` is the spread of their bends, `spread` that of their directions, in rad."""
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
    """Distance to the nearest of n points, divided by its standard deviation, and the label of that point."""
    ground = np.full((_SIDE_PX, _SIDE_PX), 255, np.uint8)
    ground[tuple(rng.integers(0, _SIDE_PX, (2, n)))] = 0
    distance, label = cv2.distanceTransformWithLabels(ground, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    return distance / distance.std(), label


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
    """Cells of constant brightness, darker towards their borders."""
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
    "membranes": _membranes, "blood": _blood, "vessels": _vessels, "skin": lambda rng: (
        _noise(rng, 60, 4, 0.7) + _noise(rng, 5) - rng.uniform(0.3, 1) * _cells(rng, int(rng.integers(300, 3000)))[0]
    ), "brushed": _brushed, "dots": _dots, "stones": _stones, "gauze": _gauze,
}  # fmt: skip
