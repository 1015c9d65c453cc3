"""Shapes that the simulator does not render: flat drawings of forceps, which are fast to make, and jaws bent at an elbow.

Drawings do not look like a real tool, but share the definition of the landmarks with it: a straight shaft, two jaws that
leave it at one point of its axis (the base), and the farthest point of each jaw's centre line (its tip).  Networks that are
trained on drawings beside rendered scenes learn this definition, and not only the simulator's shapes and metals.  Bent jaws
are made by warping a rendered image, since the renderer's training families have none.
"""

import itertools

import cv2
import numpy as np

from lib.recordings.annotations import inside

#: A part of the tool: centre line (n, 2) px and radius (n,) px.
Part = tuple[np.ndarray, np.ndarray]

_STRIPS = 6  # number of strips of different shades across a part, which make it look round
#: `bent`: ranges of the elbow's position along the jaw and of its angle (rad); probabilities of inward and of both jaws.
_ELBOW, _ANGLE, _INWARD, _BOTH = (0.5, 0.9), (0.4, 2.2), 0.8, 0.75


def drawn_ground(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Make a ground without a tool from an image (h, w, 3) uint8: its coarse colours under random textures.

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
        cell_px = np.exp(rng.uniform(np.log(2), np.log(0.15 * w)))
        stretch = np.exp(rng.normal(0, 0.5))
        cells_xy = max(int(w / cell_px * stretch), 2), max(int(h / cell_px / stretch), 2)
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
    """Draw a forceps on an image (h, w, 3) uint8; returns the image, landmarks (3, 2) px and their visibility (3,).

    The jaws are about `length_px` long (None = relative to the image); `around` is a landmark to centre (None = anywhere).

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
    if np.linalg.det(u[1:] - u[0]) < 0:  # the jaws cross, and tip_1 is the left one
        u = u[[0, 2, 1]]
    if around is not None:
        shift = (np.array([w, h]) - 1) / 2 + rng.uniform(-8, 8, 2) - u[around]
        u, parts = u + shift, [(line + shift, radius) for line, radius in parts]
    x = image.astype(np.float32)
    if rng.random() < 0.6:
        x = _shadowed(x, parts, length, rng)
    return np.clip(_painted(x, parts, length, rng), 0, 255).astype(np.uint8), u, np.where(inside(u, (w, h)), 2, 0)


def _jaw_shape(rng: np.random.Generator) -> dict[str, float]:
    """Draw the outline of a jaw of length 1: outward bow, bend, hook, taper, end, swelling and teeth, the position of its
    elbow, and the angle (rad) by which it turns inward there; 0 = none.
    """

    def maybe(probability: float, value: float) -> float:
        return value if rng.random() < probability else 0.0

    return {
        "long": rng.uniform(0.75, 1.1), "bow": maybe(0.7, rng.uniform(-0.05, 0.35)), "power": rng.uniform(0.6, 1.8),
        "bend": maybe(0.3, rng.normal(0, 0.3)), "hook": maybe(0.25, rng.uniform(0.02, 0.2)), "start": rng.uniform(0.5, 0.9),
        "taper": rng.uniform(0.1, 1.0), "end": maybe(0.5, rng.uniform(0.1, 1.0)), "swell": maybe(0.25, rng.uniform(0.2, 1.5)),
        "teeth": maybe(0.12, rng.uniform(0.1, 0.5)), "elbow": rng.uniform(0.3, 0.95),
        "turn": maybe(0.4, rng.choice([-1, 1], p=[0.2, 0.8]) * rng.uniform(0.3, 1.9)),
    }  # fmt: skip


def _jaw(
    shape: dict[str, float], side: int, angle: float, length: float, thick: float, base: np.ndarray, aside: float
) -> Part:
    """Returns the centre line (n, 2) px from the base to the tip, and the radius (n,) px."""
    s = np.linspace(0, 1, 24)
    along, across = s * shape["long"], shape["bow"] * np.sin(np.pi * s ** shape["power"]) * side + shape["bend"] * s**2
    across = across - side * shape["hook"] * np.clip((s - shape["start"]) / (1 - shape["start"]), 0, 1) ** 2
    if shape["turn"]:  # beyond the elbow the jaw has another direction; the tip is its end, not the corner
        before, beyond = s <= shape["elbow"], np.maximum(s - shape["elbow"], 0) * shape["long"]
        corner = np.interp(shape["elbow"], s, along), np.interp(shape["elbow"], s, across)
        along = np.where(before, along, corner[0] + beyond * np.cos(shape["turn"]))
        across = np.where(before, across, corner[1] - side * beyond * np.sin(shape["turn"]))
    radius = thick * (1 - shape["taper"] * s) + shape["end"] * thick * np.clip(4 * s - 3, 0, 1)
    radius = radius * (1 + shape["swell"] * np.exp(-(((s - 0.8) / 0.12) ** 2)))
    radius = radius * (1 + shape["teeth"] * (np.arange(24) % 2) * (s > 0.4))
    cos, sin = np.cos(angle), np.sin(angle)
    line = length * (along[:, None] * [cos, sin] + across[:, None] * [-sin, cos])
    line += (1 - s)[:, None] * aside * np.array([-sin, cos])  # the jaws leave the shaft side by side
    return base + line, np.maximum(radius, 0.35)


def _outline(line: np.ndarray, radius: np.ndarray, low: float, high: float) -> np.ndarray:
    """The polygon (2 n, 2) px between two parallels of a line, at `low` and `high` times the radius (-1 to 1)."""
    along = np.gradient(line, axis=0)
    beside = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return np.vstack([line + low * radius[:, None] * beside, (line + high * radius[:, None] * beside)[::-1]])


def fill(image: np.ndarray, polygon: np.ndarray, value: float | list[float]) -> None:
    """Fill a polygon (n, 2) px of an image, in place; its corners are rounded to 1/16 px."""
    cv2.fillPoly(image, [np.round(np.clip(polygon, -3e4, 3e4) * 16).astype(np.int32)], value, cv2.LINE_AA, 4)


def _shadowed(x: np.ndarray, parts: list[Part], length: float, rng: np.random.Generator) -> np.ndarray:
    """Add one to three shadows of the tool, rotated, stretched and shifted as by light from the side."""
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
    own_shades = rng.random() < 0.5  # each part has its own
    for line, radius in parts:
        level = tone * (np.exp(rng.normal(0, 0.35)) if own_shades else 1.0)
        fill(mask, _outline(line, radius, -1, 1), 1.0)
        for low, high in itertools.pairwise(np.linspace(-1, 1, _STRIPS + 1)):
            q = (low + high) / 2
            shade = 1 - round_ * (0.5 + 0.5 * phase * q) * abs(q - 0.3 * phase)
            shade += shine * np.exp(-(((q - where) / 0.25) ** 2))
            fill(layer, _outline(line, radius * 1.05, low - 0.02, high + 0.02), (level * max(shade, 0.05)).tolist())
    if rng.random() < 0.6:  # light and reflections vary along the tool
        cells = max(int(w / (rng.uniform(0.1, 1.0) * length)), 2)
        field = cv2.resize(rng.random((cells, cells), dtype=np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
        layer = layer * (1 + rng.uniform(0.2, 1.0) * (2 * field - 1))[..., None]
    if rng.random() < 0.4:  # the tool reflects the scene
        share = np.float32(rng.uniform(0.1, 0.7))
        around = np.roll(cv2.flip(x, int(rng.integers(-1, 2))), tuple(rng.integers((h, w))), axis=(0, 1))
        layer = layer * (1 - share) + share * around * rng.uniform(0.5, 1.5)
    if rng.random() < 0.3:  # grain and scratches
        layer = layer * (1 + rng.uniform(0.05, 0.3) * rng.standard_normal((h, w), dtype=np.float32))[..., None]
    return x * (1 - mask[..., None]) + layer.astype(np.float32) * mask[..., None]


def bent(
    image: np.ndarray, u: np.ndarray, visibility: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bend one jaw or both in an image (h, w, 3) uint8; returns it, the landmarks (3, 2) px and their visibility (3,).

    The image around the end of a jaw is rotated about the elbow.  The rotation decreases with the distance from the elbow and
    behind it, so that nothing tears.  If the jaws cross then, the tips exchange their names.

    >>> u = np.array([[20.0, 30], [60, 20], [60, 40]])
    >>> image, moved, _ = bent(np.zeros((60, 90, 3), np.uint8), u, np.full(3, 2), np.random.default_rng(0))
    >>> image.shape, moved.shape
    ((60, 90, 3), (3, 2))
    """
    place, turn = rng.uniform(*_ELBOW), rng.uniform(*_ANGLE) * (1 if rng.random() < _INWARD else -1)
    straight = u
    for k in rng.permutation([1, 2])[: 2 if rng.random() < _BOTH else 1]:
        ahead, other = u[k] - u[0], u[3 - k] - u[0]
        sign = np.sign(ahead[0] * other[1] - ahead[1] * other[0]) or 1.0
        elbow, reach = u[0] + place * ahead, (1 - place) * np.linalg.norm(ahead)
        for _ in range(2):  # one rotation by the whole angle would fold the image
            image, u = _turned(image, u, elbow, u[k] - elbow, sign * turn / 2, reach)
    if np.linalg.det(u[1:] - u[0]) * np.linalg.det(straight[1:] - straight[0]) < 0:
        u, visibility = u[[0, 2, 1]], visibility[[0, 2, 1]]
    return image, u, visibility


def _turned(
    image: np.ndarray, u: np.ndarray, elbow: np.ndarray, ahead: np.ndarray, turn: float, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate what lies `ahead` of the elbow, within `reach` px, by up to `turn` rad; at 2 `reach` the rotation ends."""
    radius, first = 2.0 * reach, np.arctan2(*ahead[::-1])
    low = np.clip(np.floor(elbow - radius), 0, image.shape[1::-1]).astype(int)
    high = np.clip(np.ceil(elbow + radius) + 1, 0, image.shape[1::-1]).astype(int)
    if (high <= low).any():
        return image, u

    def turned_by(far: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Rotation (rad) of what the rotated image shows `far` px from the elbow, in the direction `angle`."""
        fade = np.clip((radius - far) / (0.8 * reach), 0, 1)
        return turn * 0.5 * (1 + np.cos(angle - first)) * fade**2 * (3 - 2 * fade)

    z = np.arange(low[0], high[0]) - elbow[0] + 1j * (np.arange(low[1], high[1]) - elbow[1])[:, None]
    z = z * np.exp(-1j * turned_by(np.abs(z), np.angle(z)))  # the source of each pixel
    maps = (z.real + elbow[0]).astype(np.float32), (z.imag + elbow[1]).astype(np.float32)
    image = image.copy()
    image[low[1] : high[1], low[0] : high[0]] = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    far, angle = np.linalg.norm(u - elbow, axis=1), np.arctan2(*(u - elbow).T[::-1])
    now = angle
    for _ in range(60):  # the inverse, by iteration; half steps make it converge
        now = (now + angle + turned_by(far, now)) / 2
    return image, elbow + far[:, None] * np.column_stack([np.cos(now), np.sin(now)])
