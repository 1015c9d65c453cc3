"""Families of tools, drawn at random: how jaws, shafts and surfaces are shaped, and objects that have no landmarks."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lib.simulator.forceps import Finish, Instrument, Jaw, Pose

__all__ = ["TOOLS", "beside", "drawn", "random_object"]

#: Family -> ranges of its jaws' shapes, the arguments of `_jaw`.
_JAWS: dict[str, dict[str, Any]] = {
    "plain_jaws": {"bow": (0.005, 0.13), "thick": (0.025, 0.06), "bend": (-0.05, 0.12), "flex": (0.2, 0.8)},
    "needle_jaws": {"bow": (0, 0.05), "thick": (0.012, 0.03), "taper": (0.3, 1.2)},
    "bowed_jaws": {"bow": (0.1, 0.38), "power": (0.6, 1.4), "skew": (0.7, 1.4), "thick": (0.015, 0.06), "flex": (0, 0.6)},
    "looped_jaws": {"ring": (0.05, 0.16), "start": (0.3, 0.65), "thick": (0.008, 0.022), "flex": (0, 0.5)},
    "spoon_jaws": {"cup": (0.02, 0.06), "start": (0.4, 0.75), "thick": (0.012, 0.03), "bow": (0, 0.15)},
    "serrated_jaws": {"teeth": (0.5, 1.4), "start": (0.2, 0.6), "bow": (0.03, 0.12), "thick": (0.03, 0.06), "n": [12, 18]},
    "blunt_jaws": {"thick": (0.03, 0.08), "end": (0.015, 0.05), "bow": (0, 0.12), "taper": (0.5, 1.5)},
    "curved_jaws": {"bend": [(-0.55, -0.2), (0.2, 0.55)], "bow": (0, 0.15), "thick": (0.02, 0.05), "flex": (0, 0.6)},
    "asymmetric_jaws": {"long": (0.65, 1.1), "bow": (0, 0.25), "thick": (0.015, 0.07), "end": (0.002, 0.02)},
    "hooked_jaws": {"claw": (0.7, 1.5), "start": (0.65, 0.85), "thick": (0.02, 0.04), "flex": 0.0},
    "angled_jaws": {"turn": [(-0.95, -0.45), (0.45, 0.95)], "start": (0.08, 0.3), "bow": (0.02, 0.12)},
}
_FINISHES: dict[str, dict[str, Any]] = {
    "steel": {"level": (0.25, 0.65), "matt": (0.2, 0.8), "mirror": (0.3, 0.8), "shine": (0.1, 1.0)},
    "mirror": {"level": (0.75, 0.92), "matt": (0.0, 0.15), "mirror": (0.8, 1.1), "shine": (0.5, 1.5)},
    "matt": {"level": (0.2, 0.9), "matt": (0.8, 1.2), "mirror": (0, 0.08), "shine": (0, 0.15)},
    "dark": {"level": (0.02, 0.1), "matt": (0.4, 1.0), "mirror": (0, 0.6), "shine": (0, 0.6)},
    "coloured": {"level": (0.3, 0.9), "matt": (0.4, 1.1), "mirror": (0, 0.4), "shine": (0, 0.6), "hue": (0.1, 1.0)},
}


def drawn(rng: np.random.Generator, ranges: Mapping[str, Any]) -> dict[str, Any]:
    """One value for each name.

    (low, high) is a uniform range, (low, high, "log") a log-uniform one, a list a choice of these; else the value itself.

    >>> drawn(np.random.default_rng(0), {"flex": 0.5, "n": [12]})
    {'flex': 0.5, 'n': 12}
    """

    def one(value: Any) -> Any:
        if isinstance(value, list):
            return one(value[rng.integers(len(value))])
        if isinstance(value, tuple):
            low, high = value[:2]
            return float(np.exp(rng.uniform(np.log(low), np.log(high))) if len(value) == 3 else rng.uniform(low, high))
        return value

    return {name: one(value) for name, value in ranges.items()}


def _jaw(
    length: float, side: int, *, long: float = 1.0, bow: float = 0.0, power: float = 1.1, skew: float = 1.0,
    bend: float = 0.0, thick: float = 0.04, end: float = 0.002, taper: float = 0.7, flex: float = 0.5, n: int = 14,
    start: float = 0.5, cup: float = 0.0, teeth: float = 0.0, ring: float = 0.0, claw: float = 0.0, turn: float = 0.0,
) -> Jaw:  # fmt: skip
    """A jaw of `n` cones, on `side` +1 or -1; lengths are shares of `length`, angles rad.

    Args:
        long, bend: Its own length, and how far it leaves the plane of the jaws.
        bow, power, skew: How far it arches outwards, how evenly, and where most.
        thick, end, taper: Radii at both ends, and the exponent between.
        start: Where a cup, teeth, a ring or a kink begins.
        cup, teeth, ring: Radius that a cup adds, height of teeth in radii, and half width of a ring.
        claw, turn: Angles of a kink: inwards, or both jaws to one side.
    """
    s = 1 - (1 - np.linspace(0, 1, n)) ** 1.3
    beyond = np.clip((s - start) / (1 - start), 0, 1)
    radii = end + (thick - end) * (1 - s) ** taper + cup * np.sin(np.pi / 2 * beyond) ** 1.5
    x = s * (long - radii[-1])
    y = 0.5 * thick * (1 - s) ** 2 + bow * np.sin(np.pi * s**skew) ** power + radii[-1] * s
    if ring:
        angle = np.pi - np.linspace(0, 2 * np.pi, 19)
        stem, half = np.linspace(0, start, 6)[:-1], (long - start) / 2 - thick / 2
        x = np.append(stem, start + half * (1 + np.cos(angle)))
        y = np.append(stem / start * (ring + thick), ring + thick + ring * np.sin(angle))
        line, radii = np.column_stack([x, y, -bend * x * x]), np.full(len(x), thick)
        return Jaw(length * line, length * radii, length * np.array([long, ring + thick, -bend]), flex)
    if claw or turn:
        angle, far = (side * turn if turn else -claw), np.clip(x - start, 0, None)
        x, y = x - far * (1 - np.cos(angle)), y + far * np.sin(angle) + (1 - start) * np.sin(claw) * np.clip(x / start, 0, 1)
    line = np.column_stack([x, y, -bend * s**2])
    last = line[-1] - line[-2]
    tip = line[-1] + radii[-1] * last / np.linalg.norm(last)
    if teeth:
        middle = (line[1:] + line[:-1]) / 2
        sharp = middle - np.column_stack([0 * s[1:], np.where(beyond[1:] > 0, (1 + teeth) * radii[1:], 0), 0 * s[1:]])
        line = np.vstack([line[:1], np.stack([middle, sharp, middle, line[1:]], axis=1).reshape(-1, 3)])
        radii = np.append(radii[0], np.stack([radii[1:], 0.3 * radii[1:], radii[1:], radii[1:]], axis=1))
    return Jaw(length * line, length * radii, length * tip, flex)


def _finish(rng: np.random.Generator) -> Finish:
    value = drawn(rng, _FINISHES[rng.choice(list(_FINISHES), p=[0.3, 0.15, 0.2, 0.2, 0.15])])
    colour = value.pop("level") * np.exp(rng.normal(0, 0.06, 3)) * rng.uniform(value.pop("hue", 1.0), 1.0, 3)
    value |= drawn(rng, {"sharpness": (6, 120, "log"), "brushed": (0, 0.4)})
    return Finish(tuple(float(v) for v in np.clip(colour, 0.01, 0.95)), **value)


def _profile(rng: np.random.Generator, radius: float) -> tuple[tuple[float, float], ...]:
    """A plain shaft, or one with a step, a taper, a sleeve at its end or a collar."""
    kind, a, b = rng.integers(6), radius * rng.uniform(0.5, 3), radius * rng.uniform(1, 8)
    wide = radius * rng.uniform(1.15, 1.8)
    return {
        1: ((0.0, radius), (b, radius), (b + 0.02, wide)),
        2: ((0.0, radius), (a, radius), (a + b, wide)),
        3: ((0.0, wide), (a, wide), (a + 0.02, radius)),
        4: ((0.0, radius), (a, radius), (a + 0.02, wide), (a + b, wide), (a + b + 0.02, radius)),
    }.get(int(kind), ((0.0, radius),))


def _tool(family: str) -> Callable[[np.random.Generator, float], Instrument]:
    """A function of (rng, size): a tool of that family with jaws of 2 to 4 mm times `size`."""

    def draw(rng: np.random.Generator, size: float) -> Instrument:
        length = rng.uniform(2.0, 4.0) * size
        common = {"taper": (0.3, 1.2), "flex": (0, 0.9), "bend": (-0.12, 0.12)} | _JAWS[family]
        first = second = drawn(rng, common)
        share = 0.5
        if family == "asymmetric_jaws":
            second, share = drawn(rng, common), float(rng.choice([rng.uniform(0.3, 0.7), 0.0, 1.0]))
        jaws = (replace(_jaw(length, 1, **first), share=share), replace(_jaw(length, -1, **second), share=1 - share))
        shaft = _finish(rng)
        radius = length * drawn(rng, {"": (0.045, 0.17, "log")})[""]
        radius = max(radius, 1.1 * max(float(jaw.radii[0]) for jaw in jaws))
        finishes = shaft, (_finish(rng) if rng.random() < 0.35 else shaft)
        bend = float(rng.normal(0, 0.004) * (rng.random() < 0.3))
        return Instrument(jaws, _profile(rng, radius), finishes, bend, seed=int(rng.integers(2**31)))

    return draw


#: Families of tools: functions of (rng, size).
TOOLS = {family: _tool(family) for family in _JAWS}


def random_object(rng: np.random.Generator, size: float) -> Instrument:
    """A needle, light pipe, cannula, hook or scissors: it has none of the landmarks."""
    radius, kind = 0.3 * size * rng.uniform(0.6, 1.5), rng.choice(["needle", "pipe", "cannula", "hook", "scissors"])
    long, profile, jaws = radius * rng.uniform(4, 12), ((0.0, radius),), ()
    if kind == "needle":
        profile = ((0.0, 0.02 * radius), (long, radius))
    elif kind == "cannula":
        profile = ((0.0, 0.3 * radius), (long, 0.3 * radius), (long + 0.05, radius))
    elif kind == "hook":
        jaws = (_jaw(long, 1, claw=-rng.uniform(1.0, 2.2), start=rng.uniform(0.4, 0.9), thick=0.3 * radius / long),)
    elif kind == "scissors":
        blades = {"turn": rng.choice([-1, 1]) * rng.uniform(0.3, 0.9), "start": 0.02, "thick": 0.75 * radius / (0.6 * long)}
        jaws = tuple(_jaw(0.6 * long, side, taper=1.0, **blades) for side in (1, -1))
    finish = _finish(rng)
    return Instrument(jaws, profile, (finish, finish), has_landmarks=False, seed=int(rng.integers(2**31)))


def beside(rng: np.random.Generator, tool: Instrument, size: float, base_mm: np.ndarray, surface_z_mm: float) -> Instrument:
    """The tool with another object that stands still near `base_mm`."""
    place = (*(base_mm[:2] + rng.normal(0, 3.0, 2)), surface_z_mm - rng.uniform(0.2, 3.0))
    pose = Pose(tuple(float(v) for v in place), rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.9), opening_mm=0.0)
    return replace(tool, others=((random_object(rng, size * rng.uniform(0.6, 1.6)), pose),))
