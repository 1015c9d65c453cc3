"""Images of imaging effects: the same view with one effect at a time."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from lib.geometry import RigidTransform
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.render import View, render_view
from lib.simulator.rig import Microscope
from lib.simulator.window import Window

#: A microscope without imperfections: everything is sharp, evenly lit, free of noise and stored without loss.
PLAIN = Microscope(
    depth_of_field_mm=float("inf"),
    psf_px=0.5,
    exposure_s=0.0,
    readout_s=0.0,
    spot_radius_mm=1e3,
    vignetting=0.0,
    gain=((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
    full_well=float("inf"),
    jpeg_quality=None,
)


def render_window(
    eye: Eye,
    forceps: Forceps,
    pose: Pose,
    microscope: Microscope,
    *,
    side: int = 0,
    size_px: tuple[int, int] = (420, 320),
    velocity_mm_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
) -> View:
    """Render a window of the full-resolution image around the jaws, which is fast enough for a slider.

    `velocity_mm_s` is the velocity of the tool, which causes motion blur and the effect of the rolling shutter.
    """
    rig = microscope.rig(RigidTransform.identity())
    centre = rig.left.project(forceps.landmarks(pose)).mean(axis=0)
    window = Window.around((rig.left, rig.right)[side], centre, size_px, microscope.image_size_px)
    later = (replace(pose, base_mm=tuple(np.asarray(pose.base_mm) + 1e-3 * np.asarray(velocity_mm_s))), 1e-3)
    rng = np.random.default_rng(seed)
    view = render_view(
        eye, microscope, window, side=side, forceps=forceps, pose=pose, later=later, rng=rng, factor=3
    )
    if microscope.jpeg_quality is None:
        return view
    data = cv2.imencode(".jpg", view.image, [cv2.IMWRITE_JPEG_QUALITY, microscope.jpeg_quality])[1]
    return view._replace(image=cv2.imdecode(data, cv2.IMREAD_COLOR))


def effect_gallery(eye: Eye, forceps: Forceps, pose: Pose) -> dict[str, np.ndarray]:
    """Title -> image (h, w, 3): no effect, each effect alone (most stronger than by default, to make it visible), and all."""
    matt = replace(eye, gloss=0.0)
    fast = (9.0, 14.0, 0.0)
    default = Microscope()
    shots = {
        "Geometry, texture, shadow": (matt, PLAIN, {}),
        "+ wet surface, left camera": (eye, PLAIN, {}),
        "+ wet surface, right camera": (eye, PLAIN, {"side": 1}),
        "Defocus, depth of field 1 mm": (matt, replace(PLAIN, depth_of_field_mm=1.0), {}),
        "Motion blur, 17 mm/s, 20 ms": (matt, replace(PLAIN, exposure_s=0.020), {"velocity_mm_s": fast}),
        "Rolling shutter, 120 mm/s": (matt, replace(PLAIN, readout_s=0.03), {"velocity_mm_s": (120.0, 0.0, 0.0)}),
        "Coaxial light, vignetting": (
            matt,
            replace(PLAIN, spot_radius_mm=1.2, spot_mm=(pose.base_mm[0] + 2.5, pose.base_mm[1] - 1.0), vignetting=0.9),
            {},
        ),
        "Shot and read noise": (matt, replace(PLAIN, full_well=150.0, read_noise=8.0), {}),
        "JPEG, quality 15": (matt, replace(PLAIN, jpeg_quality=15), {}),
        "Colour of the other camera": (matt, replace(PLAIN, gain=((0.8, 1.0, 1.35),) * 2), {}),
        "All, default left": (eye, default, {}),
        "All, default right": (eye, default, {"side": 1}),
    }
    return {
        title: render_window(scene, forceps, pose, microscope, **options).image
        for title, (scene, microscope, options) in shots.items()
    }
