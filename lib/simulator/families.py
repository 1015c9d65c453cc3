"""Families of everything that an image depends on, by aspect: tool, light, scene, optics.

Training draws from `TRAINING`.  Validation draws the same, and whole families of its own (`SHIFTED`).  The tests of the far
rung draw families (`FAR`) that neither training nor validation ever sees.  A family is a function that draws one
member of it; its name can be given to `sample(..., without=...)`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lib.simulator.ground import Ground
from lib.simulator.lighting import Lighting, Patch
from lib.simulator.microscope import Microscope
from lib.simulator.shapes import FAR_TOOLS, SHIFTED_TOOLS, TOOLS

__all__ = ["ASPECTS", "FAR", "SHIFTED", "TRAINING"]

ASPECTS = ("tool", "light", "scene", "optics")
Rng = np.random.Generator
Where = tuple[np.ndarray, float, float]  # jaws' middle (3,) mm, their length mm, the scene's z there


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _hue(rng: Rng, spread: float = 0.5) -> tuple[float, float, float]:
    """Gains (3,) of mean one."""
    gain = np.exp(rng.normal(0, spread, 3))
    return tuple(float(v) for v in gain / gain.mean())


# --- light: (rng, microscope, where) -> microscope


def _lit(rng: Rng, microscope: Microscope, lighting: Lighting, hue: float = 0.5, **changes: Any) -> Microscope:
    gain = _hue(rng, hue if rng.random() < 0.6 else 0.12)
    return replace(microscope, lighting=lighting, gain=(gain, gain), **changes)


def _coaxial(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    lighting = Lighting(
        ambient=rng.uniform(0.1, 0.9), tool=_log_uniform(rng, 0.5, 1.6), shadow=rng.uniform(0, 0.7),
        shadow_sigma_mm=rng.uniform(0.08, 0.5),
    )  # fmt: skip
    return _lit(rng, microscope, lighting)


def _oblique(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """Light from the side: long shadows, hard or soft."""
    angle, slope = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 2.5)
    lighting = Lighting(
        ambient=rng.uniform(0.2, 0.8), tool=_log_uniform(rng, 0.4, 1.6), shadow=rng.uniform(0.3, 0.9),
        shadow_sigma_mm=_log_uniform(rng, 0.02, 0.6),
    )  # fmt: skip
    direction = float(slope * np.cos(angle)), float(slope * np.sin(angle))
    return _lit(rng, microscope, lighting, light_slope=direction)


def _near_lamp(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """A lamp beside the tool casts an enlarged shadow that looks like a second tool."""
    middle, _, ground = where
    lamp = (*(middle[:2] + rng.normal(0, 4.0, 2)), ground - rng.uniform(3.0, 10.0))
    lighting = Lighting(
        ambient=rng.uniform(0.05, 0.6), tool=_log_uniform(rng, 0.15, 1.3), shadow=rng.uniform(0.4, 0.95),
        shadow_sigma_mm=_log_uniform(rng, 0.02, 0.3), source_mm=tuple(float(v) for v in lamp),
        spot_edge=rng.uniform(0.3, 1.5),
    )  # fmt: skip
    spot = tuple(float(v) for v in middle[:2] + rng.normal(0, 2.0, 2))
    return _lit(rng, microscope, lighting, spot_mm=spot, spot_radius_mm=rng.uniform(3.0, 9.0))


def _lit_disc(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """An endoilluminator lights a small disc; the rest is dark."""
    middle, length, _ = where
    radius = rng.uniform(0.5, 1.5) * max(length / 2, 0.8)
    spot = middle[:2] + rng.normal(0, 0.5 * radius, 2)
    lighting = Lighting(
        ambient=_log_uniform(rng, 0.015, 0.3), spot_edge=_log_uniform(rng, 0.1, 1.5), tool=_log_uniform(rng, 0.04, 1.0),
        shadow=rng.uniform(0.2, 0.9), shadow_sigma_mm=_log_uniform(rng, 0.03, 0.4),
    )  # fmt: skip
    return _lit(
        rng, microscope, lighting, spot_mm=(float(spot[0]), float(spot[1])), spot_radius_mm=float(radius),
        brightness=microscope.brightness * rng.uniform(0.9, 2.0),
    )  # fmt: skip


def _pupil(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """A lit field seen through a pupil, dark around it, often with light that the lens reflects."""
    middle, length, ground = where
    radius = length * rng.uniform(0.9, 3.0)
    centre = middle[:2] + rng.uniform(-0.7, 0.7, 2) * radius * rng.choice([0.4, 1.0], p=[0.8, 0.2])
    dark = tuple(float(v) for v in _log_uniform(rng, 0.001, 0.06) * np.exp(rng.normal(0, 0.5, 3)))
    place = (float(centre[0]), float(centre[1]), float(min(middle[2], ground) - rng.uniform(0, 2.0)))
    edge = _log_uniform(rng, 0.02, 0.4)
    radii = float(radius), float(radius * rng.uniform(0.75, 1.3))
    patches = [Patch(place, radii, dark, "pupil", rng.uniform(0, 3), edge)]
    for _ in range(rng.integers(0, 3)):
        turn, far = rng.uniform(-np.pi, np.pi), radius * rng.uniform(1.0, 1.7)
        at = (place[0] + far * np.cos(turn), place[1] + far * np.sin(turn), place[2])
        glow = tuple(float(v) for v in _log_uniform(rng, 0.02, 0.6) * np.array(_hue(rng, 0.6)))
        shape = float(radius * rng.uniform(0.03, 0.2)), float(radius * rng.uniform(0.1, 0.9))
        patches.append(Patch(at, shape, glow, "flare", turn, rng.uniform(0.4, 2.0), rng.uniform(0, 0.15)))
    lighting = Lighting(
        ambient=rng.uniform(0.1, 0.9), spot_edge=rng.uniform(0.5, 2.0), tool=_log_uniform(rng, 0.03, 1.2),
        shadow=rng.uniform(0.1, 0.9), shadow_sigma_mm=_log_uniform(rng, 0.03, 0.4), patches=tuple(patches),
        source_mm=_maybe_lamp(rng, middle, ground), scatter=rng.uniform(0, 0.3), scatter_mm=rng.uniform(0.5, 4),
    )  # fmt: skip
    spot = tuple(float(v) for v in middle[:2] + rng.normal(0, 0.8 * radius, 2))
    return _lit(
        rng, microscope, lighting, 0.8, spot_mm=spot, spot_radius_mm=float(radius * rng.uniform(0.4, 1.5)),
        brightness=microscope.brightness * rng.uniform(0.7, 1.8),
    )  # fmt: skip


def _maybe_lamp(rng: Rng, middle: np.ndarray, ground: float) -> tuple[float, float, float] | None:
    if rng.random() < 0.4:
        return None
    x, y = middle[:2] + rng.normal(0, 4.0, 2)
    return float(x), float(y), float(ground - rng.uniform(3.0, 10.0))


def _glare(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """Large hard glare on the scene, and reflections of lenses before it."""
    middle, _, ground = where
    patches = []
    for _ in range(rng.integers(1, 5)):
        near = middle[:2] + rng.normal(0, 3.0, 2)
        radius = _log_uniform(rng, 0.15, 3.0)
        colour = tuple(float(v) for v in rng.uniform(0.5, 3.0) * np.array(_hue(rng, 0.15)))
        role = "glare" if rng.random() < 0.75 else "flare"
        share = 1.0 if role == "glare" else rng.uniform(0.1, 0.6)
        patches.append(
            Patch(
                (float(near[0]), float(near[1]), float(ground)), (radius, radius * _log_uniform(rng, 0.25, 1.0)),
                tuple(share * v for v in colour), role, rng.uniform(0, 3), _log_uniform(rng, 0.05, 2.0),
                rng.choice([0.0, rng.uniform(0, 0.2)]),
            )
        )  # fmt: skip
    lighting = Lighting(
        ambient=rng.uniform(0.2, 0.9), tool=_log_uniform(rng, 0.3, 1.6), patches=tuple(patches),
        shadow=rng.uniform(0.1, 0.8), shadow_sigma_mm=_log_uniform(rng, 0.04, 0.4), scatter=rng.uniform(0, 0.15),
    )  # fmt: skip
    return _lit(rng, microscope, lighting)


def _veil(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """Haze and scattered light take the contrast away."""
    haze = tuple(float(v) for v in rng.uniform(0, 0.35) * np.array(_hue(rng, 0.3)))
    lighting = Lighting(
        ambient=rng.uniform(0.2, 0.9), tool=_log_uniform(rng, 0.2, 1.4), shadow=rng.uniform(0, 0.7), haze=haze,
        shadow_sigma_mm=_log_uniform(rng, 0.06, 0.6), scatter=rng.uniform(0.1, 0.75), scatter_mm=_log_uniform(rng, 0.1, 5.0),
    )  # fmt: skip
    return _lit(rng, microscope, lighting)


def _covered(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """Tissue, blood or a bubble before the tool hides a part of it."""
    middle, length, _ = where
    patches = []
    for _ in range(rng.integers(1, 4)):
        at = middle + np.append(rng.normal(0, 0.45, 2) * length, -rng.uniform(0.5, 2.0))
        radius = length * _log_uniform(rng, 0.1, 0.6)
        colour = tuple(float(v) for v in rng.uniform(0.02, 0.6) * np.array(_hue(rng, 0.6)))
        patches.append(
            Patch(
                tuple(float(v) for v in at), (radius, radius * rng.uniform(0.3, 1.0)), colour, "cover", rng.uniform(0, 3),
                _log_uniform(rng, 0.05, 0.8), rng.uniform(0, 0.2),
            )
        )  # fmt: skip
    lighting = Lighting(
        ambient=rng.uniform(0.2, 0.9), tool=_log_uniform(rng, 0.3, 1.6), patches=tuple(patches), shadow=rng.uniform(0.1, 0.8),
        shadow_sigma_mm=_log_uniform(rng, 0.04, 0.4),
    )  # fmt: skip
    return _lit(rng, microscope, lighting)


def _two_lamps(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """The colour of the light changes across the field."""
    slope = rng.normal(0, 0.16, (3, 2))
    lighting = Lighting(ambient=1.0, tool=rng.uniform(0.5, 1.3), tint_per_mm=tuple(map(tuple, slope.tolist())))
    return _lit(rng, microscope, lighting)


def _slit(rng: Rng, microscope: Microscope, where: Where) -> Microscope:
    """A slit lamp: a bright band across a dark field."""
    middle, length, _ = where
    lighting = Lighting(
        ambient=rng.uniform(0.06, 0.2), band_rad=rng.uniform(0, np.pi), spot_edge=rng.uniform(0.1, 0.5),
        tool=rng.uniform(0.3, 0.9), shadow=rng.uniform(0.2, 0.7), shadow_sigma_mm=rng.uniform(0.05, 0.3),
    )  # fmt: skip
    spot = tuple(float(v) for v in middle[:2] + rng.normal(0, 0.3 * length, 2))
    return _lit(rng, microscope, lighting, spot_mm=spot, spot_radius_mm=length * rng.uniform(0.5, 1.2))


# --- scene: (rng, texture seeds) -> Ground


def _colours(rng: Rng) -> tuple[tuple[float, float, float], ...]:
    """Two to four reflectances: like tissue, grey, or any."""
    n, kind = int(rng.integers(2, 5)), rng.choice(["tissue", "grey", "any"], p=[0.35, 0.15, 0.5])
    level = np.sort(rng.uniform(0.02, 0.85, n)) if rng.random() < 0.8 else rng.uniform(0.02, 0.85, n)
    ranges = {"tissue": ((0.85, 0.2, 0.1), (1, 0.6, 0.5)), "grey": ((1,) * 3, (1,) * 3), "any": ((0.1,) * 3, (1,) * 3)}
    low, high = ranges[kind]
    main, share = rng.uniform(low, high), rng.uniform(0, 1)
    return tuple(tuple(float(v) for v in (share * main + (1 - share) * rng.uniform(low, high)) * one) for one in level)


def _shape(rng: Rng, seed: int) -> dict[str, Any]:
    return {
        "seed": seed, "depth_mm": rng.uniform(0.0, 3.2), "fold_mm": rng.uniform(0.0, 0.18), "tilt_rad": rng.uniform(0.0, 0.1),
        "centre_z_mm": rng.uniform(0.2, 1.8), "turn_rad": float(rng.uniform(-np.pi, np.pi)),
        "gloss": float((rng.random() < 0.6) * rng.uniform(0.1, 2.2)),
    }  # fmt: skip


def _fundus(rng: Rng, seeds: Sequence[int]) -> Ground:
    """A retina: in its own colours, or in any."""
    seed = int(seeds[rng.integers(min(len(seeds), _FUNDI))])
    colours = () if rng.random() < 0.6 else _colours(rng)
    return Ground(**_shape(rng, seed), size_mm=26.0 if rng.random() < 0.6 else _log_uniform(rng, 8, 40), colours=colours)


def _ground(kind: str, overlay: bool = True) -> Callable[[Rng, Sequence[int]], Ground]:
    """A function that draws scenes of one procedural texture, sometimes mixed with another."""

    def draw(rng: Rng, seeds: Sequence[int]) -> Ground:
        seed = int(seeds[rng.integers(min(len(seeds), _PATTERNS))])
        over = str(rng.choice(_TRAINED)) if overlay and rng.random() < 0.4 else None
        return Ground(
            **_shape(rng, seed), kind=kind, size_mm=_log_uniform(rng, 3.0, 30.0), colours=_colours(rng),
            over=over, over_share=rng.uniform(0.15, 0.6),
        )  # fmt: skip

    return draw


_FUNDI, _PATTERNS = 32, 12  # textures of a kind that are kept in memory
_TRAINED = ("smooth", "grainy", "membranes", "blood", "fibres", "vessels", "paper", "skin", "brushed", "dots")


# --- optics: (rng) -> settings of `Video`


def _clean(rng: Rng) -> dict[str, Any]:
    return {}


def _defocused(rng: Rng) -> dict[str, Any]:
    return {"defocus_px": _log_uniform(rng, 1.0, 30.0) if rng.random() < 0.35 else rng.uniform(0.5, 7.0)}


def _noisy(rng: Rng) -> dict[str, Any]:
    strong, wide = _log_uniform(rng, 0.01, 0.12), rng.choice([0.0, rng.uniform(0.4, 2.5)])
    return {"noise": strong, "noise_px": float(wide), "noise_grey": rng.uniform(0, 1), "banding": rng.choice([0.0, 0.01])}


def _compressed(rng: Rng) -> dict[str, Any]:
    return {
        "resample": float(rng.choice([1.0, rng.uniform(1.0, 2.5)])), "chroma": int(rng.choice([1, 2, 4])),
        "qualities": tuple(int(v) for v in rng.integers(12, 80, rng.integers(1, 3))),
    }  # fmt: skip


def _sharpened(rng: Rng) -> dict[str, Any]:
    return {"sharpening": rng.uniform(0.5, 4.0), "sharpening_px": rng.uniform(0.7, 3.0), "contrast": rng.uniform(0.9, 1.4)}


def _grey(rng: Rng) -> dict[str, Any]:
    weights = rng.dirichlet([1.0, 1.0, 1.0])
    tint = _hue(rng, 0.25) if rng.random() < 0.3 else (1.0, 1.0, 1.0)
    return {"colours": tuple(tuple(float(t * w) for w in weights) for t in tint)}


def _cast(rng: Rng) -> dict[str, Any]:
    """Colours mixed, exchanged or washed out."""
    mixed = np.eye(3)[rng.permutation(3)] if rng.random() < 0.5 else np.eye(3)
    mixed = (1 - (share := rng.uniform(0, 0.7))) * mixed + share * rng.dirichlet([1.0] * 3, 3)
    mixed = mixed * np.array(_hue(rng, 0.3))[:, None]
    return {"colours": tuple(map(tuple, mixed.tolist()))}


def _toned(rng: Rng) -> dict[str, Any]:
    """Clipped, flat, dark or bright."""
    return {"gamma": _log_uniform(rng, 0.5, 2.0), "contrast": _log_uniform(rng, 0.35, 2.2), "black": rng.uniform(0, 0.25)}


def _interlaced(rng: Rng) -> dict[str, Any]:
    return {"field_shift_px": float(rng.normal(0, 2.5)), "chroma": int(rng.choice([1, 2])), "noise": rng.uniform(0, 0.03)}


def _mosaic(rng: Rng) -> dict[str, Any]:
    return {"mosaic": True, "noise": rng.uniform(0, 0.03), "sharpening": rng.uniform(0, 1.5)}


def _aberrated(rng: Rng) -> dict[str, Any]:
    """Colours part from each other, points become ellipses, and the light flickers by row."""
    turn, apart = rng.uniform(-np.pi, np.pi), rng.uniform(1.5, 3.5)
    return {
        "fringe_px": (float(apart * np.cos(turn)), float(apart * np.sin(turn))), "defocus_px": rng.uniform(1.5, 3.0),
        "astigmatism": rng.uniform(1.5, 2.2), "banding": rng.uniform(0.01, 0.025),
    }  # fmt: skip


#: Aspect -> name of a family -> the function that draws a member of it.
TRAINING: dict[str, dict[str, Callable]] = {
    "tool": TOOLS,
    "light": {
        "coaxial": _coaxial, "oblique": _oblique, "near_lamp": _near_lamp, "lit_disc": _lit_disc, "pupil": _pupil,
        "glare": _glare, "veil": _veil, "covered": _covered,
    },
    "scene": {"fundus": _fundus} | {kind: _ground(kind) for kind in _TRAINED},
    "optics": {
        "clean": _clean, "defocused": _defocused, "noisy": _noisy, "compressed": _compressed, "sharpened": _sharpened,
        "grey": _grey, "cast": _cast, "toned": _toned, "interlaced": _interlaced,
    },
}  # fmt: skip
SHIFTED: dict[str, dict[str, Callable]] = {
    "tool": SHIFTED_TOOLS, "light": {"two_lamps": _two_lamps}, "scene": {"stones": _ground("stones")},
    "optics": {"mosaic": _mosaic},
}  # fmt: skip
#: Family of the far rung -> what it replaces in each aspect.
FAR: dict[str, dict[str, Callable]] = {
    "angled_jaws": {"tool": FAR_TOOLS["angled_jaws"]},
    "slit_light": {"light": _slit},
    "gauze": {"scene": _ground("gauze", overlay=False)},
    "aberrated": {"optics": _aberrated},
}
FAR["all_far"] = {aspect: draw for family in list(FAR.values()) for aspect, draw in family.items()}
