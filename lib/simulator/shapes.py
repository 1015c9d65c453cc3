"""Families of tools, drawn at random: how jaws, shafts and surfaces are shaped, and objects that have no landmarks."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lib.simulator.forceps import Pose
from lib.simulator.instruments import Finish, Instrument, Jaw

__all__ = ["FAR_TOOLS", "SHIFTED_TOOLS", "TOOLS", "beside", "random_object"]


def _jaw(
    rng: np.random.Generator, length: float, *, bow: float = 0.0, power: float = 1.1, skew: float = 1.0, root: float = 0.02,
    bend: float = 0.0, thick: float = 0.04, end: float = 0.002, taper: float = 0.7, flex: float = 0.5, n: int = 14,
) -> Jaw:  # fmt: skip
    """A jaw that arches outwards by `bow`, bends out of its plane by `bend`, and thins from `thick` to `end`.

    All but the exponents are shares of `length`.
    """
    s = 1 - (1 - np.linspace(0, 1, n)) ** 1.3
    radii = length * (end + (thick - end) * (1 - s) ** taper)
    reach = length - radii[-1]
    y = length * (root * (1 - s) ** 2 + bow * np.sin(np.pi * s**skew) ** power) + radii[-1]
    return _ended(np.column_stack([reach * s, y, -bend * length * s**2]), radii, flex)


def _ended(line: np.ndarray, radii: np.ndarray, flex: float) -> Jaw:
    """The jaw whose tip lies one radius beyond the last centre."""
    end = line[-1] - line[-2]
    return Jaw(line, radii, line[-1] + radii[-1] * end / np.linalg.norm(end), flex)


def _needle(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    shape = {"bow": rng.uniform(0, 0.05), "thick": rng.uniform(0.012, 0.03), "taper": rng.uniform(0.3, 1.2)}
    return _twins(rng, length, bend=rng.uniform(-0.1, 0.1), flex=rng.uniform(0, 1), **shape)


def _twins(rng: np.random.Generator, length: float, **shape: float) -> tuple[Jaw, Jaw]:
    """Two jaws that differ a little."""
    return tuple(_jaw(rng, length, **{k: v * (1 + rng.normal(0, 0.03)) for k, v in shape.items()}) for _ in range(2))


def _bowed(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    return _twins(
        rng, length, bow=rng.uniform(0.1, 0.38), power=rng.uniform(0.6, 1.4), skew=rng.uniform(0.7, 1.4),
        thick=rng.uniform(0.015, 0.06), taper=rng.uniform(0.3, 1.0), bend=rng.uniform(-0.15, 0.15), flex=rng.uniform(0, 0.6),
    )  # fmt: skip


def _looped(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """Each jaw ends in a ring of wire."""
    stem, wide = rng.uniform(0.3, 0.65), rng.uniform(0.05, 0.16)
    wire, flex, tilt = rng.uniform(0.008, 0.022), rng.uniform(0, 0.5), rng.uniform(-0.9, 0.9)

    def ring() -> Jaw:
        long = (1 - stem) / 2 - wire / 2
        angle = np.pi - np.linspace(0, 2 * np.pi, 19)
        x = stem + long * (1 + np.cos(angle))
        across = wide * np.sin(angle)
        y, z = wire + wide * (1 + 0.0 * x) * np.cos(tilt) + across * np.cos(tilt), across * np.sin(tilt)
        start = np.column_stack([np.linspace(0, stem, 6)[:-1], np.linspace(0.02, y[0], 6)[:-1], np.zeros(5)])
        line = length * np.vstack([start, np.column_stack([x, y, z])])
        far = length * np.array([stem + 2 * long + wire, y[0], 0.0])
        return Jaw(line, np.full(len(line), wire * length), far, flex)

    return ring(), ring()


def _spoon(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """Thin stems that end in wide cups."""
    thin, wide, start = rng.uniform(0.012, 0.03), rng.uniform(0.035, 0.08), rng.uniform(0.4, 0.75)
    bow, bend, flex = rng.uniform(0, 0.15), rng.uniform(-0.1, 0.1), rng.uniform(0, 1)

    def cup() -> Jaw:
        s = np.linspace(0, 1, 16)
        t = np.clip((s - start) / (1 - start), 0, 1)
        radii = length * (thin + (wide - thin) * np.sin(np.pi / 2 * t) ** 1.5)
        x = s * (length - radii[-1])
        y = length * bow * np.sin(np.pi * s) + np.maximum(radii * t, 0.02 * length * (1 - s))
        return _ended(np.column_stack([x, y, -bend * length * s**2]), radii, flex)

    return cup(), cup()


def _serrated(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """Teeth on the inner sides."""
    plain = _jaw(
        rng, length, bow=rng.uniform(0.03, 0.12), thick=rng.uniform(0.03, 0.06), end=rng.uniform(0.004, 0.015),
        flex=rng.uniform(0, 0.5), n=int(rng.integers(12, 22)), bend=rng.uniform(-0.1, 0.1),
    )  # fmt: skip
    high, first, line, radii = rng.uniform(0.5, 1.4), rng.uniform(0.2, 0.6), [], []
    for a, r, b in zip(plain.line, plain.radii, [*plain.line[1:], None], strict=True):
        line.append(a)
        radii.append(r)
        if b is not None and a[0] > first * length and a[0] < 0.93 * length:
            middle = (a + b) / 2
            line += [middle, middle - [0, min(high * r + r, max(middle[1], 0) + 0.5 * r), 0], middle]
            radii += [r, 0.25 * r, r]
    jaw = replace(plain, line=np.array(line), radii=np.array(radii))
    return jaw, jaw


def _blunt(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """Thick jaws with round ends."""
    thick = rng.uniform(0.03, 0.08)
    return _twins(
        rng, length, thick=thick, end=thick * rng.uniform(0.5, 1.0), bow=rng.uniform(0, 0.12), taper=rng.uniform(0.5, 1.5),
        flex=rng.uniform(0, 0.8), root=thick, bend=rng.uniform(-0.15, 0.15),
    )  # fmt: skip


def _curved(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """Both jaws curve out of their plane."""
    bend = rng.choice([-1, 1]) * rng.uniform(0.2, 0.55)
    return _twins(
        rng, length, bend=bend, bow=rng.uniform(0, 0.15), thick=rng.uniform(0.02, 0.05), taper=rng.uniform(0.4, 1.0),
        flex=rng.uniform(0, 0.6),
    )  # fmt: skip


def _asymmetric(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """One jaw is longer, thicker or straighter than the other, and one may stand still."""
    share = rng.choice([rng.uniform(0.3, 0.7), 0.0, 1.0])
    jaws = [
        _jaw(
            rng, length * rng.uniform(0.7, 1.1), bow=rng.uniform(0, 0.25), thick=rng.uniform(0.015, 0.07),
            end=rng.uniform(0.002, 0.02), taper=rng.uniform(0.3, 1.2), bend=rng.uniform(-0.15, 0.15),
            flex=rng.uniform(0, 0.8),
        )
        for _ in range(2)
    ]  # fmt: skip
    return replace(jaws[0], share=share), replace(jaws[1], share=1 - share)


def _plain(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """As the reference forceps."""
    return _twins(
        rng, length, bow=rng.uniform(0.005, 0.13), thick=rng.uniform(0.025, 0.06), taper=rng.uniform(0.4, 1.0),
        bend=rng.uniform(-0.05, 0.12), flex=rng.uniform(0.2, 0.8),
    )  # fmt: skip


def _hooked(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """The last part of each jaw turns sharply inwards."""
    turn, start = rng.uniform(0.7, 1.5), rng.uniform(0.65, 0.85)
    thick, gap = rng.uniform(0.02, 0.04), (1 - start) * np.sin(turn)

    def jaw() -> Jaw:
        arm = np.column_stack([np.linspace(0, start, 8), np.linspace(0.03, gap + 0.01, 8), np.zeros(8)])
        t = np.linspace(0, 1, 5)[1:, None] * (1 - start)
        claw = arm[-1] + t * [np.cos(turn), -np.sin(turn), 0]
        line = np.vstack([arm, claw]) * length
        return _ended(line, length * np.interp(np.arange(len(line)), [0, 8, 11], [thick, 0.6 * thick, 0.004]), 0.0)

    return jaw(), jaw()


def _angled(rng: np.random.Generator, length: float) -> tuple[Jaw, Jaw]:
    """Both jaws turn off sideways, to the same side, at an angle with the shaft."""
    angle, start = rng.choice([-1, 1]) * rng.uniform(0.45, 0.95), rng.uniform(0.08, 0.3)
    bow, thick, flex = rng.uniform(0.02, 0.12), rng.uniform(0.02, 0.05), rng.uniform(0, 0.4)
    jaws = []
    for side in (1, -1):
        jaw = _jaw(rng, length, bow=bow, thick=thick, n=16)
        beyond = np.clip(jaw.line[:, 0] - start * length, 0, None)
        line = jaw.line.copy()
        line[:, 0] -= beyond * (1 - np.cos(angle))
        line[:, 1] += side * beyond * np.sin(angle)
        jaws.append(_ended(line, jaw.radii, flex))
    return tuple(jaws)


Shape = Callable[[np.random.Generator, float], tuple[Jaw, Jaw]]
_SHAPES: dict[str, Shape] = {
    "plain_jaws": _plain, "needle_jaws": _needle, "bowed_jaws": _bowed, "looped_jaws": _looped, "spoon_jaws": _spoon,
    "serrated_jaws": _serrated, "blunt_jaws": _blunt, "curved_jaws": _curved, "asymmetric_jaws": _asymmetric,
}  # fmt: skip


def _finish(rng: np.random.Generator) -> Finish:
    """Steel, mirror, matt, dark, coloured or coated."""
    kind = rng.choice(["steel", "mirror", "matt", "dark", "coloured"], p=[0.3, 0.15, 0.2, 0.2, 0.15])
    tint = np.exp(rng.normal(0, 0.06, 3))
    levels = {"steel": (0.25, 0.65), "mirror": (0.75, 0.92), "matt": (0.2, 0.9), "dark": (0.02, 0.1)}
    colour = rng.uniform(*levels.get(kind, (0.3, 0.9))) * tint
    if kind == "coloured":
        colour = colour * rng.uniform(0.1, 1.0, 3)
    values = {
        "steel": {"matt": rng.uniform(0.2, 0.8), "mirror": rng.uniform(0.3, 0.8), "shine": rng.uniform(0.1, 1.0)},
        "mirror": {"matt": rng.uniform(0.0, 0.15), "mirror": rng.uniform(0.8, 1.1), "shine": rng.uniform(0.5, 1.5)},
        "matt": {"matt": rng.uniform(0.8, 1.2), "mirror": rng.uniform(0, 0.08), "shine": rng.uniform(0, 0.15)},
        "dark": {"matt": rng.uniform(0.4, 1.0), "mirror": rng.uniform(0, 0.6), "shine": rng.uniform(0, 0.6)},
        "coloured": {"matt": rng.uniform(0.4, 1.1), "mirror": rng.uniform(0, 0.4), "shine": rng.uniform(0, 0.6)},
    }[kind]
    sharpness = float(np.exp(rng.uniform(np.log(6), np.log(120))))
    values |= {"sharpness": sharpness, "brushed": rng.uniform(0, 0.4)}
    return Finish(tuple(float(v) for v in np.clip(colour, 0.01, 0.95)), **values)


def _profile(rng: np.random.Generator, radius: float) -> tuple[tuple[float, float], ...]:
    """A plain shaft, or one with steps, a neck, a collar or a taper."""
    kind, a, b = rng.integers(6), radius * rng.uniform(0.5, 3), radius * rng.uniform(1, 8)
    wide = radius * rng.uniform(1.15, 1.8)
    return {
        1: ((0.0, radius), (b, radius), (b + 0.02, wide)),
        2: ((0.0, radius), (a, radius), (a + b, wide)),
        3: ((0.0, wide), (a, wide), (a + 0.02, radius)),
        4: ((0.0, radius), (a, radius), (a + 0.02, wide), (a + b, wide), (a + b + 0.02, radius)),
    }.get(int(kind), ((0.0, radius),))


def _tool(shape: Shape) -> Callable[[np.random.Generator, float], Instrument]:
    """A function of (rng, size): a tool of that shape with jaws of 2 to 4 mm times `size`."""

    def draw(rng: np.random.Generator, size: float) -> Instrument:
        length = rng.uniform(2.0, 4.0) * size
        jaws, shaft = shape(rng, length), _finish(rng)
        thick = max(float(jaw.radii[0]) for jaw in jaws)
        radius = max(length * float(np.exp(rng.uniform(np.log(0.045), np.log(0.17)))), 1.1 * thick)
        finishes = shaft, (_finish(rng) if rng.random() < 0.35 else shaft)
        bend = rng.normal(0, 0.004) * (rng.random() < 0.3)
        return Instrument(jaws, _profile(rng, radius), (), finishes, float(bend), seed=int(rng.integers(2**31)))

    return draw


#: Families of tools that training draws; that validation draws beside them; that only far tests draw.
TOOLS = {name: _tool(shape) for name, shape in _SHAPES.items()}
SHIFTED_TOOLS = {"hooked_jaws": _tool(_hooked)}
FAR_TOOLS = {"angled_jaws": _tool(_angled)}


def random_object(rng: np.random.Generator, size: float) -> Instrument:
    """A needle, light pipe, cannula, hook or scissors: it has none of the landmarks."""
    radius, kind = 0.3 * size * rng.uniform(0.6, 1.5), rng.choice(["needle", "pipe", "cannula", "hook", "scissors"])
    profile, extra = ((0.0, radius),), []
    if kind == "needle":
        profile = ((0.0, 0.02 * radius), (radius * rng.uniform(4, 12), radius))
    elif kind == "cannula":
        long = radius * rng.uniform(6, 20)
        profile = ((0.0, 0.3 * radius), (long, 0.3 * radius), (long + 0.05, radius))
    elif kind == "hook":
        t, curl = np.linspace(0, 1, 14)[:, None], rng.uniform(0.8, 3.0)
        angle, long = np.cumsum(curl * 2 * t**2 / 7, axis=0), radius * rng.uniform(4, 9)
        steps = np.hstack([np.cos(angle), np.sin(angle), 0 * t]) * long / 14
        extra = [(np.cumsum(steps, axis=0), radius * np.linspace(0.35, 0.08, 14))]
    elif kind == "scissors":
        turn, long = rng.choice([-1, 1]) * rng.uniform(0.3, 0.9), radius * rng.uniform(3, 6)
        for open_rad in (0.0, rng.uniform(0.05, 0.35)):
            t, angle = np.linspace(0, 1, 8)[:, None], turn + open_rad
            extra.append((t * long * [np.cos(angle), np.sin(angle), 0.1], radius * np.linspace(0.75, 0.05, 8)))
    finish = _finish(rng)
    return Instrument((), profile, tuple(extra), (finish, finish), seed=int(rng.integers(2**31)))


def beside(rng: np.random.Generator, tool: Instrument, size: float, base_mm: np.ndarray, surface_z_mm: float) -> Instrument:
    """The tool with another object that stands still near `base_mm`."""
    place = (*(base_mm[:2] + rng.normal(0, 3.0, 2)), surface_z_mm - rng.uniform(0.2, 3.0))
    pose = Pose(tuple(float(v) for v in place), rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.9))
    return replace(tool, others=((random_object(rng, size * rng.uniform(0.6, 1.6)), pose),))
