"""Families of everything that an image depends on, by aspect: tool, light, scene, optics.

Training draws from `TRAINING`.  Validation draws the same, and whole families of its own (`SHIFTED`).  The tests of the far
rung draw families (`FAR`) that neither training nor validation ever sees.  A family is a function that draws one
member of it; its name can be given to `sample(..., without=...)`.  How ranges are written, see `lib.simulator.shapes.drawn`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lib.simulator.eye import Ground
from lib.simulator.lighting import Lighting, Patch
from lib.simulator.rig import Microscope
from lib.simulator.shapes import TOOLS, drawn

__all__ = ["ASPECTS", "FAR", "SHIFTED", "TRAINING"]

ASPECTS = ("tool", "light", "scene", "optics")
Rng = np.random.Generator


def _hue(rng: Rng, spread: float = 0.5, level: float = 1.0) -> tuple[float, float, float]:
    """A colour (3,) of mean `level`."""
    gain = np.exp(rng.normal(0, spread, 3))
    return tuple(float(v) for v in level * gain / gain.mean())


def _floats(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


# --- light: functions of (rng, microscope, jaws' middle (3,) mm, their length mm, the scene's z there)


def _light(ranges: dict[str, Any], patches: Callable | None = None) -> Callable:
    """Lights whose `Lighting` has these ranges, and

    slope: how far a shadow moves, mm per mm of height;  lamp: probability of a lamp near the scene;
    spot: radius of the lit spot in lengths of the jaws;  hue: spread of the colour;  power: exposure;  haze_level.
    """
    common = {"ambient": (0.15, 0.9), "tool": (0.3, 1.6, "log"), "shadow": (0, 0.8), "shadow_sigma_mm": (0.03, 0.5, "log")}

    def draw(rng: Rng, microscope: Microscope, middle: np.ndarray, length: float, ground: float) -> Microscope:
        value = drawn(rng, common | {"hue": [0.1, 0.5], "power": 1.0, "haze_level": 0.0, "lamp": 0.0} | ranges)
        gain, changes = _hue(rng, value.pop("hue")), {}
        if "slope" in value:
            angle = rng.uniform(-np.pi, np.pi)
            changes["light_slope"] = _floats(value.pop("slope") * np.array([np.cos(angle), np.sin(angle)]))
        if "spot" in value:
            radius = max(value.pop("spot") * length, 0.5)
            changes |= {"spot_mm": _floats(middle[:2] + rng.normal(0, 0.5 * radius, 2)), "spot_radius_mm": radius}
        if rng.random() < value.pop("lamp"):
            value["source_mm"] = _floats(np.append(middle[:2] + rng.normal(0, 4.0, 2), ground - rng.uniform(3.0, 10.0)))
        changes["brightness"] = microscope.brightness * value.pop("power")
        value["haze"] = _hue(rng, 0.3, value.pop("haze_level"))
        if "band" in value:
            value["band_rad"] = value.pop("band") * np.pi
        if "tint" in value:
            value["tint_per_mm"] = tuple(map(tuple, rng.normal(0, value.pop("tint"), (3, 2)).tolist()))
        lighting = Lighting(**value, patches=tuple(patches(rng, middle, length, ground)) if patches else ())
        return replace(microscope, lighting=lighting, gain=(gain, gain), **changes)

    return draw


def _patch(rng: Rng, at: np.ndarray, radius: float, colour: Sequence[float], role: str, ranges: dict[str, Any]) -> Patch:
    common = {"round": (0.3, 1.0), "edge": (0.05, 2.0, "log"), "turn_rad": (0, 3.0), "wobble": [0.0, (0, 0.2)]}
    value = drawn(rng, common | ranges)
    return Patch(_floats(at), (float(radius), float(radius * value.pop("round"))), tuple(colour), role, **value)


def _glare(rng: Rng, middle: np.ndarray, length: float, ground: float) -> list[Patch]:
    """Large hard glare on the scene, and reflections of lenses before it."""
    patches = []
    for _ in range(rng.integers(1, 5)):
        role, share = ("glare", 1.0) if rng.random() < 0.75 else ("flare", rng.uniform(0.1, 0.6))
        at = np.append(middle[:2] + rng.normal(0, 3.0, 2), ground)
        colour = _hue(rng, 0.15, share * rng.uniform(0.5, 3.0))
        patches.append(_patch(rng, at, np.exp(rng.uniform(np.log(0.15), np.log(3.0))), colour, role, {}))
    return patches


def _cover(rng: Rng, middle: np.ndarray, length: float, ground: float) -> list[Patch]:
    """Tissue, blood or a bubble that hides a part of the tool."""
    return [
        _patch(
            rng, middle + np.append(rng.normal(0, 0.45, 2) * length, -rng.uniform(0.5, 2.0)),
            length * rng.uniform(0.15, 0.55), _hue(rng, 0.6, rng.uniform(0.02, 0.6)), "cover", {"edge": (0.05, 0.8, "log")},
        )
        for _ in range(rng.integers(2, 5))
    ]  # fmt: skip


def _pupil(rng: Rng, middle: np.ndarray, length: float, ground: float) -> list[Patch]:
    """The edge of a pupil, dark beyond, and light that lenses reflect outside it."""
    radius = length * rng.uniform(0.9, 3.0)
    away = rng.uniform(-0.7, 0.7, 2) * radius * (1.0 if rng.random() < 0.2 else 0.4)
    at = np.append(middle[:2] + away, min(middle[2], ground) - rng.uniform(0, 2.0))
    dark = _hue(rng, 0.5, float(np.exp(rng.uniform(np.log(0.001), np.log(0.05)))))
    patches = [_patch(rng, at, radius, dark, "pupil", {"round": (0.75, 1.3), "edge": (0.02, 0.4, "log"), "wobble": 0.0})]
    for _ in range(rng.integers(0, 3)):
        turn, far = rng.uniform(-np.pi, np.pi), radius * rng.uniform(1.0, 1.7)
        beyond = at + [far * np.cos(turn), far * np.sin(turn), 0]
        colour, wide = _hue(rng, 0.6, rng.uniform(0.02, 0.4)), radius * rng.uniform(0.03, 0.2)
        patches.append(_patch(rng, beyond, wide, colour, "flare", {"round": (1, 8, "log"), "turn_rad": turn}))
    return patches


# --- scene: functions of (rng, texture seeds)

_FUNDI, _PATTERNS = 32, 12  # textures of a kind that are kept in memory
_TRAINED = ("smooth", "grainy", "membranes", "blood", "fibres", "vessels", "paper", "skin", "brushed", "dots")


def _colours(rng: Rng) -> tuple[tuple[float, float, float], ...]:
    """Two to four reflectances: like tissue, grey, or any."""
    n, kind = int(rng.integers(2, 5)), rng.choice(["tissue", "grey", "any"], p=[0.35, 0.15, 0.5])
    level = rng.uniform(0.02, 0.85, n)
    level = np.sort(level) if rng.random() < 0.8 else level
    ranges = {"tissue": ((0.85, 0.2, 0.1), (1, 0.6, 0.5)), "grey": ((1,) * 3, (1,) * 3), "any": ((0.1,) * 3, (1,) * 3)}
    low, high = ranges[kind]
    main, share = rng.uniform(low, high), rng.uniform(0, 1)
    return tuple(_floats((share * main + (1 - share) * rng.uniform(low, high)) * one) for one in level)


def _ground(kind: str, overlay: bool = True) -> Callable[[Rng, Sequence[int]], Ground]:
    """A function that draws scenes of one texture; a procedural one is sometimes mixed with another."""
    shape = {
        "depth_mm": (0.0, 3.2), "fold_mm": (0.0, 0.18), "tilt_rad": (0.0, 0.1), "centre_z_mm": (0.2, 1.8),
        "turn_rad": (-3.14, 3.14), "gloss": [0.0, (0.1, 2.2)], "over_share": (0.15, 0.6),
        "size_mm": [26.0, (8, 40, "log")] if kind == "fundus" else (3.0, 30.0, "log"),
    }  # fmt: skip

    def draw(rng: Rng, seeds: Sequence[int]) -> Ground:
        value, count = drawn(rng, shape), min(len(seeds), _FUNDI if kind == "fundus" else _PATTERNS)
        over = str(rng.choice(_TRAINED)) if overlay and kind != "fundus" and rng.random() < 0.4 else None
        colours = () if kind == "fundus" and rng.random() < 0.6 else _colours(rng)
        return Ground(seed=int(seeds[rng.integers(count)]), kind=kind, colours=colours, over=over, **value)

    return draw


# --- optics: functions of (rng) that draw settings of `Video`


def _camera(colours: Callable[[Rng], np.ndarray] | None = None, **ranges: Any) -> Callable[[Rng], dict[str, Any]]:
    def draw(rng: Rng) -> dict[str, Any]:
        return drawn(rng, ranges) | ({"colours": tuple(map(tuple, colours(rng).tolist()))} if colours else {})

    return draw


def _grey(rng: Rng) -> np.ndarray:
    return np.outer(_hue(rng, rng.choice([0.0, 0.2])), rng.dirichlet([1.0, 1.0, 1.0]))


def _cast(rng: Rng) -> np.ndarray:
    """Colours mixed, exchanged or washed out."""
    share, order = rng.uniform(0, 0.7), rng.permutation(3) if rng.random() < 0.5 else np.arange(3)
    return ((1 - share) * np.eye(3)[order] + share * rng.dirichlet([1.0] * 3, 3)) * np.array(_hue(rng, 0.3))[:, None]


#: Aspect -> name of a family -> the function that draws a member of it.
SHIFTED: dict[str, dict[str, Callable]] = {
    "tool": {"hooked_jaws": TOOLS["hooked_jaws"]},
    "light": {"two_lamps": _light({"ambient": 1.0, "tint": 0.16})},
    "scene": {"stones": _ground("stones")},
    "optics": {"mosaic": _camera(mosaic=True, noise=(0, 0.03), sharpening=(0, 1.5))},
}
#: Family of the far rung -> what it replaces in each aspect.
FAR: dict[str, dict[str, Callable]] = {
    "angled_jaws": {"tool": TOOLS["angled_jaws"]},
    "slit_light": {"light": _light({"ambient": (0.06, 0.2), "band": (0, 1), "spot": (0.5, 1.2), "spot_edge": (0.1, 0.5)})},
    "gauze": {"scene": _ground("gauze", overlay=False)},
    "aberrated": {"optics": _camera(fringe_px=(1.5, 3.5), defocus_px=(1.5, 3.0), astigmatism=(1.5, 2.2), banding=0.02)},
}
FAR["all_far"] = {aspect: draw for family in list(FAR.values()) for aspect, draw in family.items()}
TRAINING: dict[str, dict[str, Callable]] = {
    "tool": {name: draw for name, draw in TOOLS.items() if name not in {*SHIFTED["tool"], *FAR}},
    "light": {
        "coaxial": _light({"shadow_sigma_mm": (0.08, 0.5)}),
        "oblique": _light({"slope": (0.5, 2.5), "shadow": (0.3, 0.9)}),
        "near_lamp": _light({"lamp": 1.0, "spot": (1, 3), "spot_edge": (0.3, 1.5), "shadow": (0.4, 0.95)}),
        "lit_disc": _light({"ambient": (0.015, 0.3, "log"), "spot": (0.25, 0.8), "spot_edge": (0.1, 1.5, "log"),
                            "tool": (0.04, 1.0, "log"), "power": (1.0, 2.0)}),
        "pupil": _light({"lamp": 0.6, "hue": (0.1, 0.8), "spot": (0.8, 3), "spot_edge": (0.5, 2.0), "power": (0.8, 1.8),
                         "tool": (0.03, 1.2, "log"), "scatter": (0, 0.3), "scatter_mm": (0.5, 4.0)}, _pupil),
        "glare": _light({"scatter": (0, 0.15)}, _glare),
        "veil": _light({"haze_level": (0, 0.35), "scatter": (0.1, 0.75), "scatter_mm": (0.1, 5.0, "log")}),
        "covered": _light({}, _cover),
    },
    "scene": {kind: _ground(kind) for kind in ("fundus", *_TRAINED)},
    "optics": {
        "clean": _camera(),
        "defocused": _camera(defocus_px=[(0.5, 7.0), (0.5, 7.0), (2.0, 30.0, "log")]),
        "noisy": _camera(noise=(0.01, 0.12, "log"), noise_px=[0.0, (0.4, 2.5)], noise_grey=(0, 1), banding=[0.0, 0.01]),
        "compressed": _camera(resample=[1.0, (1.0, 2.5)], chroma=[1, 2, 4], quality=(12, 70)),
        "sharpened": _camera(sharpening=(0.5, 4.0), sharpening_px=(0.7, 3.0), contrast=(0.9, 1.4)),
        "grey": _camera(_grey),
        "cast": _camera(_cast),
        "toned": _camera(gamma=(0.5, 2.0, "log"), contrast=(0.35, 2.2, "log"), black=(0, 0.25)),
        "interlaced": _camera(field_shift_px=(-4.0, 4.0), chroma=[1, 2], noise=(0, 0.03)),
    },
}  # fmt: skip
