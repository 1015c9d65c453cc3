"""Images for training, validation and tests, each drawn at random from named families (`families.py`).

A part of the training images is from the narrow population, the eyes and forceps of the reference rig.  Some eyes and tools
are reserved for test recordings, so no test frame shows an eye or a tool of the training.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lib.cameras import AffineCamera
from lib.geometry import RigidTransform
from lib.recordings.annotations import inside
from lib.simulator.eye import Eye, Ground
from lib.simulator.families import ASPECTS, FAR, SHIFTED, TRAINING, beside, draw, drawn, random_object
from lib.simulator.forceps import Forceps, Instrument, Pose
from lib.simulator.render import render_view
from lib.simulator.rig import IMAGE_SIZE_PX, Microscope
from lib.simulator.texture import Rng
from lib.simulator.video import Video, compressed
from lib.simulator.window import Window

#: Families from which the populations of `FAR` draw the aspects that are not shifted.
_ORDINARY = {"light": ("coaxial", "oblique", "near_lamp", "glare"), "optics": ("clean", "grey", "cast")}
#: The populations from which `sample` draws, beside the families of `FAR`.
POPULATIONS = ("training", "validation", "near", "empty")

#: Seeds of eyes, and of their textures and brush marks, that training never draws.
RESERVED_SEEDS = range(0, 10_000)
#: Seeds of textures for training (few enough to stay in memory; each eye rotates, tints and shapes them anew) and validation.
TEXTURE_SEEDS, VALIDATION_TEXTURE_SEEDS = range(10_000, 10_096), range(10_096, 10_112)
_TEST_TEXTURE_SEEDS = range(9_000, 9_016)
#: Range of jaw lengths that training never draws; the tools of test recordings have such lengths.
RESERVED_JAW_MM = (2.95, 3.15)
_TEXTURE_PX = 1536
_PHOTOGRAPHED = 0.4  # if there are photographs: share of the scenes, except the reference rig's, with a photograph as ground
_NARROW, _NARROW_TEXTURES = 0.2, 32  # share of the narrow population in training, and number of its textures


def random_forceps(rng: Rng, seed: int | None = None) -> Forceps:
    """Draw a design: jaws of 2 to 4 mm (without the reserved lengths), width, taper, arch, bend, hook and metal."""
    low, high = RESERVED_JAW_MM
    length = rng.uniform(2.0, 4.0 - (high - low))
    return Forceps(
        shaft_radius_mm=rng.uniform(0.22, 0.38), jaw_length_mm=length + (high - low) * (length >= low),
        jaw_radius_mm=rng.uniform(0.07, 0.19), tip_radius_mm=rng.uniform(0.003, 0.006), taper=rng.uniform(0.5, 0.95),
        bow_mm=rng.uniform(0.02, 0.38), bend_mm=rng.uniform(-0.1, 0.35),
        hook_mm=rng.choice([0.0, 1.0]) * rng.uniform(0.02, 0.12),
        brightness=rng.uniform(0.18, 0.85), brushed=rng.uniform(0.0, 0.45),
        seed=int(rng.integers(RESERVED_SEEDS.stop, 2**31)) if seed is None else seed,
    )  # fmt: skip


def reserved_forceps(rng: Rng, seed: int) -> Forceps:
    """Draw a design that training never draws; `seed`, one of `RESERVED_SEEDS`, is that of its brush marks."""
    plain, own = random_forceps(rng, seed), {"jaw_length_mm": RESERVED_JAW_MM, "jaw_radius_mm": (0.10, 0.15)}
    return replace(plain, shaft_radius_mm=0.30, **drawn(rng, own | {"brightness": (0.45, 0.65)}))


def random_pose(rng: Rng, forceps: Forceps, surface_z_mm: float = 0.8) -> Pose:
    """Draw a pose with the jaws in the field, between the retina and 3 mm above it, and the shaft from any direction."""
    azimuth, length = rng.uniform(-np.pi, np.pi), forceps.jaw_length_mm
    tips = _tips(rng, 1.03 if rng.random() < 0.1 else 0.93)
    pitch = rng.uniform(0.08, 0.75)
    tip_z = max(surface_z_mm - rng.exponential(0.9), -2.5)
    opening = 0.0 if rng.random() < 0.12 else rng.uniform(0.05, 0.55) * length
    return _reaching(tips, tip_z, length, azimuth, pitch, np.clip(rng.normal(0, 0.4), -0.95, 0.95), opening)


def _microscope(rng: Rng) -> Microscope:
    """Draw light, optics and sensor of one image."""
    tint = np.exp(rng.normal(0, [0.16, 0.10, 0.20]))
    gain = tuple((tint / tint.mean()).tolist())
    return Microscope(
        depth_of_field_mm=draw(rng, (1.8, 6.0, "log")), focus_z_mm=rng.normal(0, 0.6), psf_px=rng.uniform(0.5, 1.5),
        exposure_s=rng.uniform(0.002, 0.02), readout_s=0.0, light_slope=tuple(rng.uniform(-0.9, 0.9, 2).tolist()),
        spot_mm=tuple(rng.normal(0, 2.5, 2).tolist()), spot_radius_mm=rng.uniform(4.5, 14.0),
        brightness=float(np.exp(rng.normal(-0.1, 0.38))), vignetting=rng.uniform(0.0, 0.7), gain=(gain, gain),
        full_well=draw(rng, (1500, 20000, "log")), read_noise=rng.uniform(2, 20), jpeg_quality=int(rng.integers(60, 98)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Setup:
    """Content of an image, its microscope, and the `families` (aspect -> name).  Without forceps a window looks at `pose`."""

    scene: Eye
    forceps: Forceps | Instrument | None
    microscope: Microscope
    pose: Pose
    families: dict[str, str]


def _narrow_setup(rng: Rng, textures: Sequence[int], kind: type[Eye]) -> Setup:
    """Draw an eye and a forceps of the reference rig; `kind` is `Eye` or `Ground`, `textures` are the texture seeds."""
    eye = kind(
        seed=int(textures[rng.integers(len(textures))]), texture_px=_TEXTURE_PX, depth_mm=rng.uniform(1.2, 3.2),
        fold_mm=rng.uniform(0.02, 0.18), tilt_rad=rng.uniform(0.0, 0.08), centre_z_mm=rng.uniform(0.4, 1.8),
        gloss=float(rng.choice([0.0, 1.0], p=[0.08, 0.92]) * rng.uniform(0.3, 2.2)), turn_rad=rng.uniform(-np.pi, np.pi),
    )  # fmt: skip
    forceps, microscope = random_forceps(rng), _microscope(rng)
    families = {"tool": "plain_jaws", "light": "coaxial", "scene": "fundus", "optics": "clean"}
    return Setup(eye, forceps, microscope, random_pose(rng, forceps, eye.centre_z_mm - 0.35 * eye.depth_mm), families)


def random_setup(
    rng: Rng, population: str = "training", *, textures: Sequence[int] | None = None, without: Sequence[str] = (),
    photographs: Sequence[Path] = (), centred: bool = False,
) -> Setup:  # fmt: skip
    """Draw the content of an image; see `sample` for the arguments.  `centred` puts tool and light in the field's centre."""
    choices = _choices(population, without)
    if textures is None:
        own = {"training": TEXTURE_SEEDS, "empty": TEXTURE_SEEDS, "validation": VALIDATION_TEXTURE_SEEDS}
        textures = own.get(population, _TEST_TEXTURE_SEEDS)
    if population == "near" or (population == "training" and rng.random() < _NARROW):
        # `Ground` has few different wet films, which stay in memory.
        return _narrow_setup(rng, textures[:_NARROW_TEXTURES], Eye if population == "near" else Ground)
    if population == "validation":  # at least one aspect has a family that training never draws
        shifted = rng.random(len(ASPECTS)) < 0.35
        shifted[rng.integers(len(ASPECTS))] = True
        choices |= {aspect: SHIFTED[aspect] for aspect, new in zip(ASPECTS, shifted, strict=True) if new}
    names = {aspect: str(rng.choice(list(known))) for aspect, known in choices.items()}
    if "fundus" in choices["scene"] and rng.random() < 0.25:
        names["scene"] = "fundus"
    members = {aspect: choices[aspect][name] for aspect, name in names.items()}
    scene = members["scene"](rng, textures)
    if photographs and rng.random() < _PHOTOGRAPHED:
        scene = replace(scene, texture_path=photographs[rng.integers(len(photographs))])
    surface_z_mm = scene.centre_z_mm - 0.35 * scene.depth_mm
    sizes = (0.5, 1.3) if population in FAR else (0.2, 0.8) if names["light"] == "pupil" else (0.25, 1.5)
    size = draw(rng, (*sizes, "log"))
    if population == "empty":
        tool = random_object(rng, size) if rng.random() < 0.75 else None
    elif names["tool"] == "plain_jaws" and rng.random() < 0.5:
        plain = random_forceps(rng)
        tool = replace(plain, **{name: value * size for name, value in vars(plain).items() if name.endswith("_mm")})
    else:
        tool = members["tool"](rng, size)
    length = tool.jaw_length_mm if tool else 3 * size
    pose = Pose((-length / 2, 0.0, -0.5)) if centred else _wide_pose(rng, length, surface_z_mm)
    if isinstance(tool, Instrument) and rng.random() < 0.3:
        tool = beside(rng, tool, size, np.array(pose.base_mm), surface_z_mm)
    middle = np.array(pose.base_mm) + 0.5 * length * pose.microscope_from_tool[:, 0]
    # The exposure roughly suits the scene, as that of a camera.
    exposed = np.exp(rng.normal(-1.4, 0.55)) / (1.45 * np.mean((scene.texture[::16, ::16] / 255.0) ** 2.2) + 0.02)
    microscope = replace(_microscope(rng), brightness=float(np.clip(exposed, 0.1, 5.0)))
    microscope = members["light"](rng, microscope, middle, length, surface_z_mm)
    settings = members["optics"](rng)
    if rng.random() < 0.35:  # the camera has the faults of two families
        settings = choices["optics"][str(rng.choice(list(choices["optics"])))](rng) | settings
    microscope = replace(microscope, jpeg_quality=int(rng.integers(40, 98)), video=Video(**settings))
    return Setup(scene, tool, microscope, pose, names)


def _choices(population: str, without: Sequence[str]) -> dict[str, dict[str, Callable]]:
    """Aspect -> families from which a population draws, except those `without`."""
    if population not in (*POPULATIONS, *FAR):
        raise ValueError(f"population: one of {', '.join((*POPULATIONS, *FAR))}, got {population!r}.")
    if unknown := set(without) - {name for known in TRAINING.values() for name in known}:
        raise ValueError(f"without: no such family in training: {', '.join(sorted(unknown))}.")
    ordinary = _ORDINARY if population in FAR else {}  # one aspect, or all, is new; the others are ordinary
    choices = {aspect: {n: draw for n, draw in known.items() if n in ordinary.get(aspect, known) and n not in without}
               for aspect, known in TRAINING.items()}  # fmt: skip
    if empty := [aspect for aspect, known in choices.items() if not known]:
        raise ValueError(f"without: leaves no family of {', '.join(empty)}.")
    return choices | {aspect: {population: draw} for aspect, draw in FAR.get(population, {}).items()}


def _wide_pose(rng: Rng, length: float, surface_z_mm: float) -> Pose:
    """As `random_pose`, but with wider openings, steeper tools, and more tools that are partly outside the field."""
    azimuth, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 1.0)
    tips = _tips(rng, 1.15 if rng.random() < 0.15 else 0.93)
    tip_z = max(surface_z_mm - rng.exponential(0.9), -2.5)
    opening = length * (rng.choice([0.0, 1.0], p=[0.15, 0.85]) * rng.uniform(0.05, 0.65 if rng.random() < 0.8 else 1.41))
    return _reaching(tips, tip_z, length, azimuth, pitch, np.clip(rng.normal(0, 0.45), -1.0, 1.0), opening)


def _tips(rng: Rng, reach: float) -> np.ndarray:
    """Draw the tips' position (2,) mm, uniform in a field `reach` times as large: the tips shall fill it, not the base."""
    return rng.uniform(-1, 1, 2) * IMAGE_SIZE_PX / 200 * reach


def _reaching(tips: np.ndarray, z: float, length: float, azimuth: float, pitch: float, roll: float, opening: float) -> Pose:
    """The pose in which a tool of this length has its tips at (`tips`, `z`) mm."""
    base = [*(tips - (length * np.cos(pitch) * np.array([np.cos(azimuth), np.sin(azimuth)]))), z - length * np.sin(pitch)]
    return Pose(tuple(float(v) for v in base), azimuth, pitch, float(roll), float(opening))


def sample(
    rng: Rng, *, crop_px: int | None = None, size_px: tuple[int, int] | None = None, around: int | None = None,
    jitter: float = 0.35, textures: Sequence[int] | None = None, population: str = "training", without: Sequence[str] = (),
    photographs: Sequence[Path] = (),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Draw and render one view (not a stereo pair) with its landmarks; `rng` determines everything.

    Args:
        crop_px: Side of a square window of the full-resolution image, somewhere around the jaws.
        size_px: (w, h) to which the whole field is shrunk.  Without either size the image is the full-HD field.
        around, jitter: The landmark that a window contains: 0 base, 1 or 2 a tip, None = the landmarks' mean.  Its largest
            distance from the window's centre along each axis, as a share of the window's side.
        textures: Seeds from which the texture is drawn; textures are kept in memory.  None = those of the population.
        population: "training"; "validation", with families beside those of training; "near", the reference rig's eyes and
            forceps alone; "empty", scenes and objects without the tool; or a family of `FAR`, which training never draws.
        without: Families of `TRAINING` to leave out.
        photographs: Image files, each of which may be the ground of a scene.

    Returns: image (h, w, 3) uint8 RGB; u (3, 2) px of base, tip_1, tip_2, also if outside, NaN without the tool;
        visibility (3,): 0 outside, 1 hidden, 2 visible.  Raises ValueError for two sizes, small ones, or unknown names.
    """
    if crop_px is not None and size_px is not None:
        raise ValueError("crop_px, size_px: give one, a window at full resolution or the field at a reduced one.")
    if min(crop_px or 64, *(size_px or (64, 64))) < 32:
        raise ValueError(f"crop_px, size_px: must be at least 32, got {crop_px}, {size_px}.")
    setup = random_setup(rng, population, textures=textures, without=without, photographs=photographs)
    forceps, pose, microscope = setup.forceps, setup.pose, setup.microscope
    landmarks = np.full((3, 3), np.nan) if forceps is None else forceps.landmarks(pose)
    has_landmarks = np.isfinite(landmarks).all()
    magnification = 100.0 * rng.uniform(0.85, 1.18)  # px per mm
    side = rng.choice([-1, 1])
    tilt = RigidTransform.from_rotation_vector((rng.normal(0, 0.01), -side * 0.057 + rng.normal(0, 0.01), 0.0))
    spin = RigidTransform.from_rotation_vector((0.0, 0.0, rng.normal(0, 0.05)))
    field, shrink = np.array(IMAGE_SIZE_PX), 1.0
    camera = AffineCamera(np.column_stack([magnification * spin.compose(tilt).R[:2], (field - 1) / 2]))
    if crop_px is not None:
        seen = camera.project(landmarks if has_landmarks else np.array([pose.base_mm] * 3))
        held = seen.mean(axis=0) if around is None else seen[around]
        origin = held - (crop_px - 1) / 2 + rng.uniform(-jitter, jitter, 2) * crop_px
        origin = np.round(np.clip(origin, 0, np.maximum(field - crop_px, 0)))
        window = Window.around(camera, origin + crop_px / 2, (crop_px, crop_px), IMAGE_SIZE_PX)
        size_px = window.size_px
    else:
        # The renderer's pixels are square: fill the width and stretch the rows afterwards.
        size_px = size_px or IMAGE_SIZE_PX
        shrink = size_px[0] / field[0]
        camera = AffineCamera(np.column_stack([camera.linear * shrink, (camera.offset_px + 0.5) * shrink - 0.5]))
        window = Window(camera, (size_px[0], round(field[1] * size_px[0] / field[0])))
        microscope = replace(microscope, psf_px=max(0.45, microscope.psf_px * shrink))
    speed = rng.normal(0, 2.0 if population == "near" else rng.choice([2.0, 6.0]), 3) * (rng.random() < 0.5)
    moved = replace(pose, base_mm=tuple(np.asarray(pose.base_mm) + 1e-3 * speed))
    shown = {"forceps": forceps, "pose": pose, "later": (moved, 1e-3) if has_landmarks else None}
    image, u, visibility, *_ = render_view(setup.scene, replace(microscope, video=None), window, **shown, rng=rng)
    if tuple(size_px) != window.size_px:
        factor = np.array(size_px) / window.size_px
        image = cv2.resize(image, size_px, interpolation=cv2.INTER_AREA if factor[1] < 1 else cv2.INTER_LINEAR)
        u = (u + 0.5) * factor - 0.5
    if microscope.video is not None:  # applied last, to the final size
        if crop_px is None and rng.random() < 0.3:
            image, u, visibility = _distorted(image, u, visibility, rng.uniform(-0.25, 0.25))
        image = microscope.video.shrunk(shrink)(image, rng)
    return compressed(image, microscope.jpeg_quality), u, visibility


def _distorted(image: np.ndarray, u: np.ndarray, visibility: np.ndarray, strength: float) -> tuple[np.ndarray, ...]:
    """Distort an image and its landmarks radially, as a lens does; `strength` is the relative change at the corner."""
    size = np.array(image.shape[1::-1])
    centre, reach2 = (size - 1) / 2, float(((size / 2) ** 2).sum())

    def grow(radius2: np.ndarray) -> np.ndarray:
        """Radius of a pixel's source divided by its own radius; the source never lies outside the image."""
        return (1 + strength / reach2 * radius2) / (1 + max(strength, 0.0))

    columns, rows = np.meshgrid(np.arange(size[0]) - centre[0], np.arange(size[1]) - centre[1])
    scale = grow(columns * columns + rows * rows)
    maps = ((columns * scale + centre[0]).astype(np.float32), (rows * scale + centre[1]).astype(np.float32))
    image = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    before = after = u - centre
    for _ in range(30):
        after = before / grow((after**2).sum(axis=1, keepdims=True))
    return image, after + centre, np.where(inside(after + centre, size), visibility, 0)
