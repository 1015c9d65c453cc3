"""Families of everything on which an image depends, by aspect: tool, light, scene, optics.

Training draws from `TRAINING`.  Validation draws from the same families, and from some of its own (`SHIFTED`).  Tests with a
large shift draw from families (`FAR`) that neither training nor validation uses.  A family is a function that draws one of
its members; its name can be given to `sample(..., without=...)`.  `draw` explains the notation of ranges.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lib.simulator.eye import Ground
from lib.simulator.forceps import Finish, Instrument, Jaw, Pose
from lib.simulator.lighting import Lighting, Patch
from lib.simulator.rig import Microscope
from lib.simulator.texture import Rng

ASPECTS = ("tool", "light", "scene", "optics")


def draw(rng: Rng, value: Any) -> Any:
    """Draw uniformly from (low, high), log-uniformly from (low, high, "log"), or from an item of a list; keep other values.

    >>> draw(np.random.default_rng(0), [12]), draw(np.random.default_rng(0), (2.0, 2.0))
    (12, 2.0)
    """
    if isinstance(value, list):
        return draw(rng, value[rng.integers(len(value))])
    if isinstance(value, tuple):
        low, high = value[:2]
        return float(np.exp(rng.uniform(np.log(low), np.log(high))) if len(value) == 3 else rng.uniform(low, high))
    return value


def drawn(rng: Rng, ranges: Mapping[str, Any]) -> dict[str, Any]:
    """Draw one value for each name."""
    return {name: draw(rng, value) for name, value in ranges.items()}


def _hue(rng: Rng, spread: float = 0.5, level: float = 1.0) -> tuple[float, float, float]:
    """Draw a colour (3,) of mean `level`."""
    gain = np.exp(rng.normal(0, spread, 3))
    return tuple((level * gain / gain.mean()).tolist())


# --- tool: functions of (rng, size), and objects that have no landmarks

#: Family -> ranges of the arguments of `_jaw`.
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


def _jaw(
    length: float, side: int, *, long: float = 1.0, bow: float = 0.0, power: float = 1.1, skew: float = 1.0,
    bend: float = 0.0, thick: float = 0.04, end: float = 0.002, taper: float = 0.7, flex: float = 0.5, n: int = 14,
    start: float = 0.5, cup: float = 0.0, teeth: float = 0.0, ring: float = 0.0, claw: float = 0.0, turn: float = 0.0,
) -> Jaw:  # fmt: skip
    """Make a jaw of `n` nodes, on `side` +1 or -1; lengths are shares of `length`, angles rad.

    Args:
        long, bend: Its own length, and the distance by which its end leaves the plane of the jaws.
        bow, power, skew: Height of the outward arch, and exponents of its shape and of the position of its top.
        thick, end, taper: Radii at both ends, and the exponent between.
        start: Position where a cup, teeth, a ring or a kink begins.
        cup, teeth, ring: Radius that a cup adds, height of teeth in radii, and half width of a ring.
        claw, turn: Angle of a kink inwards, or of a kink of both jaws to the same side.
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


def _finish(rng: Rng) -> Finish:
    value = drawn(rng, _FINISHES[rng.choice(list(_FINISHES), p=[0.3, 0.15, 0.2, 0.2, 0.15])])
    colour = value.pop("level") * np.exp(rng.normal(0, 0.06, 3)) * rng.uniform(value.pop("hue", 1.0), 1.0, 3)
    value |= drawn(rng, {"sharpness": (6, 120, "log"), "brushed": (0, 0.4)})
    return Finish(tuple(np.clip(colour, 0.01, 0.95).tolist()), **value)


def _profile(rng: Rng, radius: float) -> tuple[tuple[float, float], ...]:
    """Draw the profile of a shaft: plain, or with a step, a taper, a sleeve at its end or a collar."""
    kind, a, b = rng.integers(6), radius * rng.uniform(0.5, 3), radius * rng.uniform(1, 8)
    wide = radius * rng.uniform(1.15, 1.8)
    return {
        1: ((0.0, radius), (b, radius), (b + 0.02, wide)),
        2: ((0.0, radius), (a, radius), (a + b, wide)),
        3: ((0.0, wide), (a, wide), (a + 0.02, radius)),
        4: ((0.0, radius), (a, radius), (a + 0.02, wide), (a + b, wide), (a + b + 0.02, radius)),
    }.get(int(kind), ((0.0, radius),))


def _tool(family: str, rng: Rng, size: float) -> Instrument:
    """Draw a tool of a family, with jaws of 2 to 4 mm times `size`."""
    length = rng.uniform(2.0, 4.0) * size
    common = {"taper": (0.3, 1.2), "flex": (0, 0.9), "bend": (-0.12, 0.12)} | _JAWS[family]
    first = second = drawn(rng, common)
    share = 0.5
    if family == "asymmetric_jaws":
        second, share = drawn(rng, common), float(rng.choice([rng.uniform(0.3, 0.7), 0.0, 1.0]))
    jaws = (replace(_jaw(length, 1, **first), share=share), replace(_jaw(length, -1, **second), share=1 - share))
    shaft = _finish(rng)
    radius = max(length * draw(rng, (0.045, 0.17, "log")), 1.1 * max(float(jaw.radii[0]) for jaw in jaws))
    finishes = shaft, (_finish(rng) if rng.random() < 0.35 else shaft)
    bend = float(rng.normal(0, 0.004) * (rng.random() < 0.3))
    return Instrument(jaws, _profile(rng, radius), finishes, bend, seed=int(rng.integers(2**31)))


#: Families of tools: functions of (rng, size).
TOOLS = {family: partial(_tool, family) for family in _JAWS}


def random_object(rng: Rng, size: float) -> Instrument:
    """Draw a needle, light pipe, cannula, hook or scissors, which have none of the landmarks."""
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


def beside(rng: Rng, tool: Instrument, size: float, base_mm: np.ndarray, surface_z_mm: float) -> Instrument:
    """Returns the tool with another object beside it, which stands still near `base_mm`."""
    place = (*(base_mm[:2] + rng.normal(0, 3.0, 2)), surface_z_mm - rng.uniform(0.2, 3.0))
    pose = Pose(tuple(float(v) for v in place), rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.9), opening_mm=0.0)
    return replace(tool, others=((random_object(rng, size * rng.uniform(0.6, 1.6)), pose),))


# --- light: functions of (rng, microscope, jaws' middle (3,) mm, their length mm, the scene's z there)


def _light(
    rng: Rng, microscope: Microscope, middle: np.ndarray, length: float, ground: float, *,
    patches: Callable[..., Iterator[Patch]] | None = None, **ranges: Any,
) -> Microscope:  # fmt: skip
    """Returns the microscope with a `Lighting` drawn from `ranges` and with `patches`.  Ranges can also have

    slope: shift of a shadow, mm per mm of height;  lamp: probability of a lamp near the scene;
    spot: radius of the lit spot in jaw lengths;  hue: spread of the colour;  power: exposure;  haze_level.
    """
    common = {"ambient": (0.15, 0.9), "tool": (0.3, 1.6, "log"), "shadow": (0, 0.8), "shadow_sigma_mm": (0.03, 0.5, "log")}
    value = drawn(rng, common | {"hue": [0.1, 0.5], "power": 1.0, "haze_level": 0.0, "lamp": 0.0} | ranges)
    gain, changes = _hue(rng, value.pop("hue")), {}
    if "slope" in value:
        angle = rng.uniform(-np.pi, np.pi)
        changes["light_slope"] = tuple((value.pop("slope") * np.array([np.cos(angle), np.sin(angle)])).tolist())
    if "spot" in value:
        radius = max(value.pop("spot") * length, 0.5)
        changes |= {"spot_mm": tuple((middle[:2] + rng.normal(0, 0.5 * radius, 2)).tolist()), "spot_radius_mm": radius}
    if rng.random() < value.pop("lamp"):
        value["source_mm"] = (*(middle[:2] + rng.normal(0, 4.0, 2)).tolist(), float(ground - rng.uniform(3.0, 10.0)))
    changes["brightness"] = microscope.brightness * value.pop("power")
    value["haze"] = _hue(rng, 0.3, value.pop("haze_level"))
    if "tint" in value:
        value["tint_per_mm"] = tuple(map(tuple, rng.normal(0, value.pop("tint"), (3, 2)).tolist()))
    lighting = Lighting(**value, patches=tuple(patches(rng, middle, length, ground)) if patches else ())
    return replace(microscope, lighting=lighting, gain=(gain, gain), **changes)


def _patch(rng: Rng, at: np.ndarray, radius: float, colour: Sequence[float], role: str, **ranges: Any) -> Patch:
    common = {"round": (0.3, 1.0), "edge": (0.05, 2.0, "log"), "turn_rad": (0, 3.0), "wobble": [0.0, (0, 0.2)]}
    value = drawn(rng, common | ranges)
    return Patch(tuple(at.tolist()), (float(radius), float(radius * value.pop("round"))), tuple(colour), role, **value)


def _glare(rng: Rng, middle: np.ndarray, length: float, ground: float) -> Iterator[Patch]:
    """Large hard glare on the scene, and reflections of lenses in front of it."""
    for _ in range(rng.integers(1, 5)):
        role, share = ("glare", 1.0) if rng.random() < 0.75 else ("flare", rng.uniform(0.1, 0.6))
        at = np.append(middle[:2] + rng.normal(0, 3.0, 2), ground)
        colour = _hue(rng, 0.15, share * rng.uniform(0.5, 3.0))
        yield _patch(rng, at, draw(rng, (0.15, 3.0, "log")), colour, role)


def _cover(rng: Rng, middle: np.ndarray, length: float, ground: float) -> Iterator[Patch]:
    """Tissue, blood or a bubble that hides a part of the tool."""
    for _ in range(rng.integers(2, 5)):
        at = middle + np.append(rng.normal(0, 0.45, 2) * length, -rng.uniform(0.5, 2.0))
        radius, colour = length * rng.uniform(0.15, 0.55), _hue(rng, 0.6, rng.uniform(0.02, 0.6))
        yield _patch(rng, at, radius, colour, "cover", edge=(0.05, 0.8, "log"))


def _pupil(rng: Rng, middle: np.ndarray, length: float, ground: float) -> Iterator[Patch]:
    """The edge of a pupil, dark outside, where lenses may reflect light."""
    radius = length * rng.uniform(0.9, 3.0)
    away = rng.uniform(-0.7, 0.7, 2) * radius * (1.0 if rng.random() < 0.2 else 0.4)
    at = np.append(middle[:2] + away, min(middle[2], ground) - rng.uniform(0, 2.0))
    dark = _hue(rng, 0.5, draw(rng, (0.001, 0.05, "log")))
    yield _patch(rng, at, radius, dark, "pupil", round=(0.75, 1.3), edge=(0.02, 0.4, "log"), wobble=0.0)
    for _ in range(rng.integers(0, 3)):
        turn, far = rng.uniform(-np.pi, np.pi), radius * rng.uniform(1.0, 1.7)
        beyond = at + [far * np.cos(turn), far * np.sin(turn), 0]
        colour, wide = _hue(rng, 0.6, rng.uniform(0.02, 0.4)), radius * rng.uniform(0.03, 0.2)
        yield _patch(rng, beyond, wide, colour, "flare", round=(1, 8, "log"), turn_rad=turn)


# --- scene: functions of (rng, texture seeds)

_FUNDI, _PATTERNS = 32, 12  # number of fundi, and of textures of each pattern, which are kept in memory
_TRAINED = ("smooth", "grainy", "membranes", "blood", "fibres", "vessels", "paper", "skin", "brushed", "dots")


def _colours(rng: Rng) -> tuple[tuple[float, float, float], ...]:
    """Draw two to four reflectances: like tissue, grey, or any."""
    n, kind = int(rng.integers(2, 5)), rng.choice(["tissue", "grey", "any"], p=[0.35, 0.15, 0.5])
    level = rng.uniform(0.02, 0.85, n)
    level = np.sort(level) if rng.random() < 0.8 else level
    ranges = {"tissue": ((0.85, 0.2, 0.1), (1, 0.6, 0.5)), "grey": ((1,) * 3, (1,) * 3), "any": ((0.1,) * 3, (1,) * 3)}
    low, high = ranges[kind]
    main, share = rng.uniform(low, high), rng.uniform(0, 1)
    return tuple(tuple(((share * main + (1 - share) * rng.uniform(low, high)) * one).tolist()) for one in level)


def _ground(kind: str, rng: Rng, seeds: Sequence[int], *, overlay: bool = True) -> Ground:
    """Draw a scene of one texture; a pattern is sometimes mixed with another."""
    fundus = kind == "fundus"
    value = drawn(rng, {
        "depth_mm": (0.0, 3.2), "fold_mm": (0.0, 0.18), "tilt_rad": (0.0, 0.1), "centre_z_mm": (0.2, 1.8),
        "turn_rad": (-3.14, 3.14), "gloss": [0.0, (0.1, 2.2)], "over_share": (0.15, 0.6),
        "extent_mm": [26.0, (8, 40, "log")] if fundus else (3.0, 30.0, "log"),
    })  # fmt: skip
    over = str(rng.choice(_TRAINED)) if overlay and not fundus and rng.random() < 0.4 else None
    colours = () if fundus and rng.random() < 0.6 else _colours(rng)
    count = min(len(seeds), _FUNDI if fundus else _PATTERNS)
    return Ground(seed=int(seeds[rng.integers(count)]), kind=kind, colours=colours, over=over, **value)


# --- optics: functions of (rng) that draw attributes of `Video`


def _camera(rng: Rng, *, colours: Callable[[Rng], np.ndarray] | None = None, **ranges: Any) -> dict[str, Any]:
    return drawn(rng, ranges) | ({"colours": tuple(map(tuple, colours(rng).tolist()))} if colours else {})


def _cast(rng: Rng) -> np.ndarray:
    """Draw a colour matrix (3, 3) that mixes, exchanges or washes out the colours."""
    share, order = rng.uniform(0, 0.7), rng.permutation(3) if rng.random() < 0.5 else np.arange(3)
    return ((1 - share) * np.eye(3)[order] + share * rng.dirichlet([1.0] * 3, 3)) * np.array(_hue(rng, 0.3))[:, None]


#: Aspect -> name of a family -> the function that draws a member of it.
SHIFTED: dict[str, dict[str, Callable]] = {
    "tool": {"hooked_jaws": TOOLS["hooked_jaws"]},
    "light": {"two_lamps": partial(_light, ambient=1.0, tint=0.16)},
    "scene": {"stones": partial(_ground, "stones")},
    "optics": {"mosaic": partial(_camera, mosaic=True, noise=(0, 0.03), sharpening=(0, 1.5))},
}
#: Family with a large shift -> what it replaces in each aspect.
FAR: dict[str, dict[str, Callable]] = {
    "angled_jaws": {"tool": TOOLS["angled_jaws"]},
    "slit_light": {"light": partial(_light, ambient=(0.06, 0.2), band_rad=(0, np.pi), spot=(0.5, 1.2), spot_edge=(0.1, 0.5))},
    "gauze": {"scene": partial(_ground, "gauze", overlay=False)},
    "aberrated": {
        "optics": partial(_camera, fringe_px=(1.5, 3.5), defocus_px=(1.5, 3.0), astigmatism=(1.5, 2.2), banding=0.02)
    },
}
FAR["all_far"] = {aspect: member for family in list(FAR.values()) for aspect, member in family.items()}
TRAINING: dict[str, dict[str, Callable]] = {
    "tool": {name: tool for name, tool in TOOLS.items() if name not in {*SHIFTED["tool"], *FAR}},
    "light": {
        "coaxial": partial(_light, shadow_sigma_mm=(0.08, 0.5)),
        "oblique": partial(_light, slope=(0.5, 2.5), shadow=(0.3, 0.9)),
        "near_lamp": partial(_light, lamp=1.0, spot=(1, 3), spot_edge=(0.3, 1.5), shadow=(0.4, 0.95)),
        "lit_disc": partial(_light, ambient=(0.015, 0.3, "log"), spot=(0.25, 0.8), spot_edge=(0.1, 1.5, "log"),
                            tool=(0.04, 1.0, "log"), power=(1.0, 2.0)),
        "pupil": partial(_light, patches=_pupil, lamp=0.6, hue=(0.1, 0.8), spot=(0.8, 3), spot_edge=(0.5, 2.0),
                         power=(0.8, 1.8), tool=(0.03, 1.2, "log"), scatter=(0, 0.3), scatter_mm=(0.5, 4.0)),
        "glare": partial(_light, patches=_glare, scatter=(0, 0.15)),
        "veil": partial(_light, haze_level=(0, 0.35), scatter=(0.1, 0.75), scatter_mm=(0.1, 5.0, "log")),
        "covered": partial(_light, patches=_cover),
    },
    "scene": {kind: partial(_ground, kind) for kind in ("fundus", *_TRAINED)},
    "optics": {
        "clean": _camera,
        "defocused": partial(_camera, defocus_px=[(0.5, 7.0), (0.5, 7.0), (2.0, 30.0, "log")]),
        "noisy": partial(_camera, noise=(0.01, 0.12, "log"), noise_px=[0.0, (0.4, 2.5)], noise_grey=(0, 1),
                         banding=[0.0, 0.01]),
        "compressed": partial(_camera, resample=[1.0, (1.0, 2.5)], chroma=[1, 2, 4], quality=(12, 70)),
        "sharpened": partial(_camera, sharpening=(0.5, 4.0), sharpening_px=(0.7, 3.0), contrast=(0.9, 1.4)),
        "grey": partial(_camera, colours=lambda rng: np.outer(_hue(rng, rng.choice([0.0, 0.2])), rng.dirichlet([1.0] * 3))),
        "cast": partial(_camera, colours=_cast),
        "toned": partial(_camera, gamma=(0.5, 2.0, "log"), contrast=(0.35, 2.2, "log"), black=(0, 0.25)),
        "interlaced": partial(_camera, field_shift_px=(-4.0, 4.0), chroma=[1, 2], noise=(0, 0.03)),
    },
}  # fmt: skip
