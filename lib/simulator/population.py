"""Training images: eye, tool, pose, light, optics, glints and noise are drawn anew for every image.

Eyes of `RESERVED_SEEDS` and tools with jaws of `RESERVED_JAW_MM` are never drawn.  Test recordings use them, so no test
frame shows an eye or a tool of the training.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from lib.cameras import AffineCamera
from lib.geometry import RigidTransform
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import IMAGE_SIZE_PX, Microscope
from lib.simulator.render import render_view
from lib.simulator.window import Window

__all__ = ["RESERVED_JAW_MM", "RESERVED_SEEDS", "TEXTURE_SEEDS", "VALIDATION_TEXTURE_SEEDS"]
__all__ += ["random_eye", "random_forceps", "random_microscope", "random_pose", "reserved_forceps", "sample"]

#: Eyes (and the textures and brush marks that go with them) that training never draws.
RESERVED_SEEDS = range(0, 10_000)
#: Textures of the training eyes: few enough to stay in memory, each turned, tinted and shaped anew per image.
TEXTURE_SEEDS = range(10_000, 10_096)
#: Textures of the eyes that validate a training: none of those it sees.
VALIDATION_TEXTURE_SEEDS = range(10_096, 10_112)
#: Jaw lengths that training never draws: recordings for tests have tools of these.
RESERVED_JAW_MM = (2.95, 3.15)
_TEXTURE_PX = 1536


def random_eye(rng: np.random.Generator, textures: Sequence[int] = TEXTURE_SEEDS) -> Eye:
    """An eye of the training population: shape, folds, gloss, and one of `textures`."""
    return Eye(
        seed=int(textures[rng.integers(len(textures))]), radius_mm=9.3, texture_px=_TEXTURE_PX,
        depth_mm=rng.uniform(1.2, 3.2), fold_mm=rng.uniform(0.02, 0.18), tilt_rad=rng.uniform(0.0, 0.08),
        centre_z_mm=rng.uniform(0.4, 1.8), gloss=float(rng.choice([0.0, 1.0], p=[0.08, 0.92]) * rng.uniform(0.3, 2.2)),
        turn_rad=float(rng.uniform(-np.pi, np.pi)),
    )  # fmt: skip


def random_forceps(rng: np.random.Generator, seed: int | None = None) -> Forceps:
    """A design: jaws of 2 to 4 mm (not the reserved lengths), width, taper, arch, bend, hook and metal."""
    low, high = RESERVED_JAW_MM
    length = rng.uniform(2.0, 4.0 - (high - low))
    return Forceps(
        shaft_radius_mm=rng.uniform(0.22, 0.38), jaw_length_mm=float(length + (high - low) * (length >= low)),
        jaw_radius_mm=rng.uniform(0.07, 0.19), tip_radius_mm=rng.uniform(0.003, 0.006), taper=rng.uniform(0.5, 0.95),
        bow_mm=rng.uniform(0.02, 0.38), bend_mm=rng.uniform(-0.1, 0.35),
        hook_mm=rng.choice([0.0, 1.0]) * rng.uniform(0.02, 0.12),
        brightness=rng.uniform(0.18, 0.85), brushed=rng.uniform(0.0, 0.45),
        seed=int(rng.integers(RESERVED_SEEDS.stop, 2**31)) if seed is None else seed,
    )  # fmt: skip


def reserved_forceps(rng: np.random.Generator, seed: int) -> Forceps:
    """A design that training never draws; `seed`, one of `RESERVED_SEEDS`, makes its brush marks."""
    return replace(
        random_forceps(rng, seed), shaft_radius_mm=0.30, jaw_length_mm=float(rng.uniform(*RESERVED_JAW_MM)),
        jaw_radius_mm=float(rng.uniform(0.10, 0.15)), brightness=float(rng.uniform(0.45, 0.65)),
    )  # fmt: skip


def random_pose(rng: np.random.Generator, forceps: Forceps, surface_z_mm: float = 0.8) -> Pose:
    """A pose whose jaws lie in the field, between the retina and 3 mm above it, the shaft coming from anywhere."""
    azimuth = rng.uniform(-np.pi, np.pi)
    # The tips, not the base, fill the field; one time in ten they leave it a little.
    reach = 1.03 if rng.random() < 0.1 else 0.93
    tips = rng.uniform(-1, 1, 2) * IMAGE_SIZE_PX / 200 * reach
    pitch = rng.uniform(0.08, 0.75)
    flat = forceps.jaw_length_mm * np.cos(pitch)
    tip_z = max(surface_z_mm - rng.exponential(0.9), -2.5)
    base = [*(tips - flat * np.array([np.cos(azimuth), np.sin(azimuth)])), tip_z - forceps.jaw_length_mm * np.sin(pitch)]
    opening = 0.0 if rng.random() < 0.12 else rng.uniform(0.05, 0.55) * forceps.jaw_length_mm
    roll = np.clip(rng.normal(0, 0.4), -0.95, 0.95)
    return Pose(tuple(float(v) for v in base), azimuth, pitch, float(roll), opening)


def random_microscope(rng: np.random.Generator) -> Microscope:
    """Light, optics and sensor of one image."""
    tint = np.exp(rng.normal(0, [0.16, 0.10, 0.20]))
    gain = tuple(float(v) for v in tint / tint.mean())
    return Microscope(
        depth_of_field_mm=float(np.exp(rng.uniform(np.log(1.8), np.log(6.0)))), focus_z_mm=rng.normal(0, 0.6),
        psf_px=rng.uniform(0.5, 1.5), exposure_s=rng.uniform(0.002, 0.02), readout_s=0.0,
        light_slope=tuple(float(v) for v in rng.uniform(-0.9, 0.9, 2)),
        spot_mm=tuple(float(v) for v in rng.normal(0, 2.5, 2)), spot_radius_mm=rng.uniform(4.5, 14.0),
        brightness=float(np.exp(rng.normal(-0.1, 0.38))), vignetting=rng.uniform(0.0, 0.7), gain=(gain, gain),
        full_well=float(np.exp(rng.uniform(np.log(1500), np.log(20000)))), read_noise=rng.uniform(2, 20),
        jpeg_quality=int(rng.integers(60, 98)),
    )  # fmt: skip


def sample(
    rng: np.random.Generator, *, crop_px: int | None = None, size_px: tuple[int, int] | None = None,
    around: int | None = None, jitter: float = 0.35, textures: Sequence[int] = TEXTURE_SEEDS,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """One view, not a pair, with its landmarks; `rng` decides everything.

    Args:
        crop_px: Side of a square window of the full-resolution image that holds the jaws somewhere.
        size_px: (w, h) of the whole field shrunk to this size.  Without either size the image is the full-HD field.
        around: The landmark that a window holds, 0 base, 1 or 2 a tip; None = the jaws' centre.
        jitter: How far it may lie from the window's centre, as a share of the window's side.
        textures: Seeds of the fundus textures to draw from; each takes a second to make and then stays in memory.

    Returns: image (h, w, 3) uint8 RGB; u (3, 2) px of base, tip_1, tip_2, also if outside; visibility (3,): 0 outside,
        1 hidden, 2 visible.

    Raises:
        ValueError: If both sizes are given, or one is too small.
    """
    if crop_px is not None and size_px is not None:
        raise ValueError("crop_px, size_px: give one, a window at full resolution or the field at a reduced one.")
    if min(crop_px or 64, *(size_px or (64, 64))) < 32:
        raise ValueError(f"crop_px, size_px: must be at least 32, got {crop_px}, {size_px}.")
    eye, forceps, microscope = random_eye(rng, textures), random_forceps(rng), random_microscope(rng)
    pose = random_pose(rng, forceps, eye.centre_z_mm - 0.35 * eye.depth_mm)
    magnification = 100.0 * rng.uniform(0.85, 1.18)  # px per mm
    side = rng.choice([-1, 1])
    tilt = RigidTransform.from_rotation_vector((rng.normal(0, 0.01), -side * 0.057 + rng.normal(0, 0.01), 0.0))
    spin = RigidTransform.from_rotation_vector((0.0, 0.0, rng.normal(0, 0.05)))
    field = np.array(IMAGE_SIZE_PX)
    camera = AffineCamera(np.column_stack([magnification * spin.compose(tilt).R[:2], (field - 1) / 2]))
    if crop_px is not None:
        landmarks = camera.project(forceps.landmarks(pose))
        held = landmarks.mean(axis=0) if around is None else landmarks[around]
        origin = held - (crop_px - 1) / 2 + rng.uniform(-jitter, jitter, 2) * crop_px
        origin = np.round(np.clip(origin, 0, np.maximum(field - crop_px, 0)))
        window = Window.around(camera, origin + crop_px / 2, (crop_px, crop_px), IMAGE_SIZE_PX)
    else:
        # The renderer's pixels are square: fill the width and stretch the rows afterwards.
        size_px = size_px or IMAGE_SIZE_PX
        shrink = size_px[0] / field[0]
        camera = AffineCamera(np.column_stack([camera.linear * shrink, (camera.offset_px + 0.5) * shrink - 0.5]))
        window = Window(camera, (size_px[0], round(field[1] * size_px[0] / field[0])))
        microscope = replace(microscope, psf_px=max(0.45, microscope.psf_px * shrink))
    speed = rng.normal(0, 2.0, 3) * (rng.random() < 0.5)
    later = (replace(pose, base_mm=tuple(np.asarray(pose.base_mm) + 1e-3 * speed)), 1e-3)
    view = render_view(eye, microscope, window, forceps=forceps, pose=pose, later=later, rng=rng)
    image, u = view.image, view.u
    if size_px is not None and tuple(size_px) != window.size_px:
        factor = np.array(size_px) / window.size_px
        image = cv2.resize(image, size_px, interpolation=cv2.INTER_AREA if factor[1] < 1 else cv2.INTER_LINEAR)
        u = (u + 0.5) * factor - 0.5
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, microscope.jpeg_quality])[1]
    return cv2.imdecode(encoded, cv2.IMREAD_COLOR), u, view.visibility
