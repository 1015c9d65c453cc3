"""Outlines beyond the simulator's: flat drawings of forceps, many a second, and rendered jaws bent at an elbow.

Drawings are no pictures of a real tool.  What they share with real ones is what a landmark is: a straight shaft, two jaws
that leave it at one point of its axis (the base), and the farthest point of each jaw's centre line (its tip).  Training on
them, beside rendered scenes, makes the networks look for that and not for the shapes and metals that the simulator knows.
Bent jaws are a warp of the image, since the renderer's training families have none.
"""

import itertools

import cv2
import numpy as np

from lib.recordings.annotations import inside

#: Centre line (n, 2) px and radius (n,) px.
Part = tuple[np.ndarray, np.ndarray]

_STRIPS = 6  # of different shades across a part, which make it look round
#: Where along a jaw its elbow is, by how much it turns there (rad), and how often inward; how often both jaws have one.
_PLACE, _TURN, _INWARD, _BOTH = (0.5, 0.9), (0.4, 2.2), 0.8, 0.75


def drawn_ground(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A ground without a tool, made of an image (h, w, 3) uint8: its large patches of colour, under random textures.

    >>> drawn_ground(np.full((90, 160, 3), 90, np.uint8), np.random.default_rng(0)).shape
    (90, 160, 3)
    """
    h, w = image.shape[:2]
    cells = int(rng.integers(3, 9))
    coarse = cv2.resize(image, (2 * cells, cells), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.5:
        coarse = rng.permutation(coarse.reshape(-1, 3)).reshape(coarse.shape)
    x = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    for _ in range(rng.integers(1, 5)):
        fine = np.exp(rng.uniform(np.log(2), np.log(0.15 * w)))  # px a cell
        stretch = np.exp(rng.normal(0, 0.5))
        cells_xy = max(int(w / fine * stretch), 2), max(int(h / fine / stretch), 2)
        noise = rng.standard_normal((cells_xy[1], cells_xy[0]), dtype=np.float32)
        noise = cv2.resize(noise, (w, h), interpolation=cv2.INTER_CUBIC if rng.random() < 0.8 else cv2.INTER_NEAREST)
        if rng.random() < 0.4:  # threads, vessels, cracks
            noise = 1.5 * np.exp(-((noise / rng.uniform(0.1, 0.4)) ** 2)) * rng.choice([-1, 1])
        if rng.random() < 0.5:
            turned = cv2.getRotationMatrix2D((w / 2, h / 2), rng.uniform(0, 180), 1.3)
            noise = cv2.warpAffine(noise, turned, (w, h), borderMode=cv2.BORDER_REFLECT)
        x = x + noise[..., None] * (rng.uniform(2, 30) * rng.dirichlet((2, 2, 2)) * 2).astype(np.float32)
    for _ in range(rng.integers(0, 5) if rng.random() < 0.5 else 0):  # patches with edges
        corners = rng.uniform((0, 0), (w, h)) + rng.normal(0, rng.uniform(0.02, 0.2) * w, (int(rng.integers(3, 8)), 2))
        fill(x, corners, rng.uniform(0, 220, 3).tolist())
    return np.clip(x, 0, 255).astype(np.uint8)


def drawn_tool(
    image: np.ndarray, rng: np.random.Generator, *, length_px: float | None = None, around: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A forceps drawn on an image (h, w, 3) uint8: the image, landmarks (3, 2) px and their visibility (3,).

    Its jaws are about `length_px` long (None: to suit the image), and landmark `around` is near the middle (None: anywhere).

    >>> image, u, visibility = drawn_tool(np.full((90, 160, 3), 90, np.uint8), np.random.default_rng(0))
    >>> image.shape, u.shape
    ((90, 160, 3), (3, 2))
    """
    h, w = image.shape[:2]
    length = length_px or np.exp(rng.uniform(np.log(0.045), np.log(0.3))) * w
    angle = rng.uniform(-np.pi, np.pi)
    ahead = np.array([np.cos(angle), np.sin(angle)])
    base = rng.uniform((0.05 * w, 0.05 * h), (0.95 * w, 0.95 * h)) - 0.5 * length * ahead
    opening = rng.choice([0.0, 1.0], p=[0.12, 0.88]) * rng.uniform(0.05, 1.1 if rng.random() < 0.8 else 1.6)
    lean = rng.normal(0, 0.15) + (rng.choice([-1, 1]) * rng.uniform(0.3, 0.9) if rng.random() < 0.15 else 0.0)
    shape = _jaw_shape(rng)
    other = shape if rng.random() < 0.7 else _jaw_shape(rng)
    thick = rng.uniform(0.025, 0.11) * length
    shaft_radius = np.clip(rng.uniform(0.5, 2.6) * thick + 0.02 * length, 0.8, 0.3 * length)
    aside = 0.4 * min(thick, shaft_radius)
    parts = [_jaw(jaw, side, angle + lean + side * opening / 2, length, thick, base, side * aside)
             for side, jaw in ((-1, shape), (1, other))]  # fmt: skip
    u = np.array([base, *(line[-1] for line, _ in parts)])
    back = np.linspace(0, 1, 12)[:, None]
    bent = rng.normal(0, 0.03) if rng.random() < 0.2 else 0.0
    shaft = base - back * 1.6 * w * ahead + (bent * back**2) * 1.6 * w * np.array([-ahead[1], ahead[0]])
    radius = shaft_radius * (1 + rng.uniform(-0.2, 1.2) * back[:, 0])
    if rng.random() < 0.3:  # a sleeve
        radius = np.where(np.arange(12) > rng.integers(1, 4), radius * rng.uniform(1.1, 2.0), radius)
    if rng.random() < 0.3:  # rounded or conical end
        radius[0] *= rng.uniform(0.2, 0.8)
    parts.insert(int(rng.choice([0, 2])), (shaft, radius))
    if np.linalg.det(u[1:] - u[0]) < 0:  # the jaws cross: tip_1 is the left one
        u = u[[0, 2, 1]]
    if around is not None:
        shift = (np.array([w, h]) - 1) / 2 + rng.uniform(-8, 8, 2) - u[around]
        u, parts = u + shift, [(line + shift, radius) for line, radius in parts]
    x = image.astype(np.float32)
    if rng.random() < 0.6:
        x = _shadowed(x, parts, length, rng)
    return np.clip(_painted(x, parts, length, rng), 0, 255).astype(np.uint8), u, np.where(inside(u, (w, h)), 2, 0)


def _jaw_shape(rng: np.random.Generator) -> dict[str, float]:
    """The outline of a jaw of length 1: its bow outward, bend, hook, taper, end and swelling; the place of its elbow and the
    angle (rad) by which it turns inward there, 0 = none.
    """

    def some(share: float, value: float) -> float:
        return value if rng.random() < share else 0.0

    return {
        "long": rng.uniform(0.75, 1.1), "bow": some(0.7, rng.uniform(-0.05, 0.35)), "power": rng.uniform(0.6, 1.8),
        "bend": some(0.3, rng.normal(0, 0.3)), "hook": some(0.25, rng.uniform(0.02, 0.2)), "start": rng.uniform(0.5, 0.9),
        "taper": rng.uniform(0.1, 1.0), "end": some(0.5, rng.uniform(0.1, 1.0)), "swell": some(0.25, rng.uniform(0.2, 1.5)),
        "teeth": some(0.12, rng.uniform(0.1, 0.5)), "elbow": rng.uniform(0.3, 0.95),
        "turn": some(0.4, rng.choice([-1, 1], p=[0.2, 0.8]) * rng.uniform(0.3, 1.9)),
    }  # fmt: skip


def _jaw(
    shape: dict[str, float], side: int, angle: float, length: float, thick: float, base: np.ndarray, aside: float
) -> Part:
    """Centre line (n, 2) px from the base to the tip, and radius (n,) px."""
    s = np.linspace(0, 1, 24)
    along, across = s * shape["long"], shape["bow"] * np.sin(np.pi * s ** shape["power"]) * side + shape["bend"] * s**2
    across = across - side * shape["hook"] * np.clip((s - shape["start"]) / (1 - shape["start"]), 0, 1) ** 2
    if shape["turn"]:  # beyond the elbow the jaw goes on in another direction: its tip is its end, not the corner
        before, beyond = s <= shape["elbow"], np.maximum(s - shape["elbow"], 0) * shape["long"]
        corner = np.interp(shape["elbow"], s, along), np.interp(shape["elbow"], s, across)
        along = np.where(before, along, corner[0] + beyond * np.cos(shape["turn"]))
        across = np.where(before, across, corner[1] - side * beyond * np.sin(shape["turn"]))
    radius = thick * (1 - shape["taper"] * s) + shape["end"] * thick * np.clip(4 * s - 3, 0, 1)
    radius = radius * (1 + shape["swell"] * np.exp(-(((s - 0.8) / 0.12) ** 2)))
    radius = radius * (1 + shape["teeth"] * (np.arange(24) % 2) * (s > 0.4))
    cos, sin = np.cos(angle), np.sin(angle)
    line = length * (along[:, None] * [cos, sin] + across[:, None] * [-sin, cos])
    line += (1 - s)[:, None] * aside * np.array([-sin, cos])  # the jaws leave the shaft beside each other
    return base + line, np.maximum(radius, 0.35)


def _outline(line: np.ndarray, radius: np.ndarray, low: float, high: float) -> np.ndarray:
    """The polygon between two fractions (-1 to 1) of the radius beside a line."""
    along = np.gradient(line, axis=0)
    beside = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return np.vstack([line + low * radius[:, None] * beside, (line + high * radius[:, None] * beside)[::-1]])


def fill(image: np.ndarray, polygon: np.ndarray, value: float | list[float]) -> None:
    """Fill a polygon (n, 2) px of an image, in place, to a sixteenth of a pixel."""
    cv2.fillPoly(image, [np.round(np.clip(polygon, -3e4, 3e4) * 16).astype(np.int32)], value, cv2.LINE_AA, 4)


def _shadowed(x: np.ndarray, parts: list[Part], length: float, rng: np.random.Generator) -> np.ndarray:
    """With up to three shadows, which lights from the side turn, stretch and move, until they look like tools."""
    for _ in range(rng.choice(3, p=[0.6, 0.3, 0.1]) + 1):
        mask, grown = np.zeros(x.shape[:2], np.float32), rng.uniform(0.8, 1.3)
        base, offset = parts[1][0][0], rng.normal(0, rng.choice([0.15, 0.6]), 2) * length
        cast = cv2.Rodrigues(np.array([0, 0, rng.normal(0, 0.2)]))[0][:2, :2] @ (np.eye(2) + rng.normal(0, 0.12, (2, 2)))
        for line, radius in parts:
            line = (line - base) @ cast.T + base + offset
            fill(mask, _outline(line, grown * radius, -1, 1), 1.0)
        mask = cv2.GaussianBlur(mask, (0, 0), np.exp(rng.uniform(np.log(0.5), np.log(0.2 * length + 1))))
        x = x * (1 - np.float32(rng.uniform(0.2, 0.9)) * mask)[..., None]
    return x


def _painted(x: np.ndarray, parts: list[Part], length: float, rng: np.random.Generator) -> np.ndarray:
    h, w = x.shape[:2]
    tone = np.exp(rng.uniform(np.log(12), np.log(230))) * np.exp(rng.normal(0, rng.choice([0.04, 0.3], p=[0.7, 0.3]), 3))
    layer, mask = np.zeros_like(x), np.zeros((h, w), np.float32)
    phase, round_, shine, where = rng.uniform(-1, 1), rng.uniform(0, 1), rng.uniform(0, 1.5), rng.uniform(-0.7, 0.7)
    own = rng.random() < 0.5  # each part has its own shade
    for line, radius in parts:
        level = tone * (np.exp(rng.normal(0, 0.35)) if own else 1.0)
        fill(mask, _outline(line, radius, -1, 1), 1.0)
        for low, high in itertools.pairwise(np.linspace(-1, 1, _STRIPS + 1)):
            q = (low + high) / 2
            shade = 1 - round_ * (0.5 + 0.5 * phase * q) * abs(q - 0.3 * phase)
            shade += shine * np.exp(-(((q - where) / 0.25) ** 2))
            fill(layer, _outline(line, radius * 1.05, low - 0.02, high + 0.02), (level * max(shade, 0.05)).tolist())
    if rng.random() < 0.6:  # light and reflections that change along it
        cells = max(int(w / (rng.uniform(0.1, 1.0) * length)), 2)
        field = cv2.resize(rng.random((cells, cells), dtype=np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
        layer = layer * (1 + rng.uniform(0.2, 1.0) * (2 * field - 1))[..., None]
    if rng.random() < 0.4:  # mirrors the field
        share = np.float32(rng.uniform(0.1, 0.7))
        around = np.roll(cv2.flip(x, int(rng.integers(-1, 2))), tuple(rng.integers((h, w))), axis=(0, 1))
        layer = layer * (1 - share) + share * around * rng.uniform(0.5, 1.5)
    if rng.random() < 0.3:  # grain and scratches
        layer = layer * (1 + rng.uniform(0.05, 0.3) * rng.standard_normal((h, w), dtype=np.float32))[..., None]
    return x * (1 - mask[..., None]) + layer.astype(np.float32) * mask[..., None]


def bent(
    image: np.ndarray, u: np.ndarray, visibility: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image (h, w, 3) uint8 with one jaw or both bent, its landmarks (3, 2) px and their visibility (3,).

    What lies round the end of a jaw is turned about the elbow, what is farther or behind less, so that nothing tears.  Where
    the jaws cross, the tips exchange their names.

    >>> u = np.array([[20.0, 30], [60, 20], [60, 40]])
    >>> image, moved, _ = bent(np.zeros((60, 90, 3), np.uint8), u, np.full(3, 2), np.random.default_rng(0))
    >>> image.shape, moved.shape
    ((60, 90, 3), (3, 2))
    """
    place, turn = rng.uniform(*_PLACE), rng.uniform(*_TURN) * (1 if rng.random() < _INWARD else -1)
    straight = u
    for k in rng.permutation([1, 2])[: 2 if rng.random() < _BOTH else 1]:
        ahead, other = u[k] - u[0], u[3 - k] - u[0]
        sign = np.sign(ahead[0] * other[1] - ahead[1] * other[0]) or 1.0
        elbow, reach = u[0] + place * ahead, (1 - place) * np.linalg.norm(ahead)
        for _ in range(2):  # a larger turn at once would fold the image
            image, u = _turned(image, u, elbow, u[k] - elbow, sign * turn / 2, reach)
    if np.linalg.det(u[1:] - u[0]) * np.linalg.det(straight[1:] - straight[0]) < 0:
        u, visibility = u[[0, 2, 1]], visibility[[0, 2, 1]]
    return image, u, visibility


def _turned(
    image: np.ndarray, u: np.ndarray, elbow: np.ndarray, ahead: np.ndarray, turn: float, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """What lies `ahead` of the elbow, within `reach` px, turned about it by up to `turn` rad; within twice that, by less."""
    radius, first = 2.0 * reach, np.arctan2(*ahead[::-1])
    low = np.clip(np.floor(elbow - radius), 0, image.shape[1::-1]).astype(int)
    high = np.clip(np.ceil(elbow + radius) + 1, 0, image.shape[1::-1]).astype(int)
    if (high <= low).any():
        return image, u

    def turned_by(far: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """The turn (rad) of what is then seen `far` px from the elbow at an `angle`."""
        fade = np.clip((radius - far) / (0.8 * reach), 0, 1)
        return turn * 0.5 * (1 + np.cos(angle - first)) * fade**2 * (3 - 2 * fade)

    z = np.arange(low[0], high[0]) - elbow[0] + 1j * (np.arange(low[1], high[1]) - elbow[1])[:, None]
    z = z * np.exp(-1j * turned_by(np.abs(z), np.angle(z)))  # where a pixel comes from
    maps = (z.real + elbow[0]).astype(np.float32), (z.imag + elbow[1]).astype(np.float32)
    image = image.copy()
    image[low[1] : high[1], low[0] : high[0]] = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    far, angle = np.linalg.norm(u - elbow, axis=1), np.arctan2(*(u - elbow).T[::-1])
    now = angle
    for _ in range(60):  # the inverse: half a step contracts
        now = (now + angle + turned_by(far, now)) / 2
    return image, elbow + far[:, None] * np.column_stack([np.cos(now), np.sin(now)])
