"""The stereo microscope over the robot: its cameras, focus, light, shutter and sensor.

Microscope frame: origin at the centre of the field on the focal plane, x right and y down in the unrotated
image, z away from the cameras (into the eye), millimetres.
"""

from dataclasses import dataclass, field

import numpy as np

from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.geometry import RigidTransform, check
from lib.simulator.lighting import Lighting
from lib.simulator.video import Video

IMAGE_SIZE_PX = (1920, 1080)

#: Where the reference microscope stands over the reference robot: any general pose would do.
ROBOT_FROM_MICROSCOPE = RigidTransform.from_rotation_vector((0.15, 2.90, -0.25), (12.0, -7.0, 35.0))


@dataclass(frozen=True)
class Microscope:
    """Geometry, optics and sensor.  Two values in a tuple are (left, right); three are (red, green, blue).

    Attributes:
        convergence_rad: Angle between the two viewing directions.
        depth_of_field_mm: Range of z around `focus_z_mm` with a defocus (sd, at 100 px per mm) of at most 1 px; inf = sharp.
        psf_px: Standard deviation of the point spread in focus.
        exposure_s, readout_s: Exposure of a row, and the time from the first to the last row of a rolling shutter.
        light_slope: Direction (x, y) of the lamp, mm sideways per mm of height: a shadow shifts the other way.
        spot_mm, spot_radius_mm: Position where the coaxial light is brightest, and its Gaussian radius.
        brightness, vignetting, gain: Exposure (1 is good), relative loss at the corners, colour gains of each camera.
        full_well, read_noise: Electrons at full scale (infinity switches noise off), and electrons of read noise.
        jpeg_quality: Quality of stored images, 0 to 100; None = lossless.
        inverse_distance_per_mm: One over the working distance; 0 = affine cameras.
        lighting, video: Further properties of the light, and the camera electronics; None = no electronics.
    """

    pixels_per_mm: tuple[float, float] = (100.0, 98.0)
    image_rotation_rad: tuple[float, float] = (0.020, -0.015)
    convergence_rad: float = float(np.deg2rad(6.5))
    image_size_px: tuple[int, int] = IMAGE_SIZE_PX
    depth_of_field_mm: float = 3.0
    focus_z_mm: float = 0.0
    psf_px: float = 0.75
    exposure_s: float = 0.008
    readout_s: float = 0.015
    light_slope: tuple[float, float] = (0.35, -0.25)
    spot_mm: tuple[float, float] = (0.8, -0.5)
    spot_radius_mm: float = 8.5
    brightness: float = 1.0
    vignetting: float = 0.35
    gain: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1.0, 1.0, 1.0), (0.94, 1.0, 1.04))
    full_well: float = 9000.0
    read_noise: float = 9.0
    jpeg_quality: int | None = 92
    inverse_distance_per_mm: float = 0.0
    fps: float = 25.0
    lighting: Lighting = field(default_factory=Lighting)
    video: Video | None = None

    def __post_init__(self) -> None:
        check(self, "image_size_px", lambda v: min(v) >= 16, "must be at least 16 x 16")
        finite = "image_rotation_rad focus_z_mm light_slope spot_mm gain"
        check(self, finite, lambda v: np.isfinite(v).all(), "must be finite")
        check(self, "depth_of_field_mm", lambda v: v > 0, "must be positive (infinity switches defocus off)")
        check(self, "psf_px exposure_s readout_s vignetting read_noise brightness", lambda v: v >= 0, "must not be negative")
        check(self, "full_well", lambda v: v > 0, "must be positive (infinity switches noise off)")
        check(self, "spot_radius_mm fps pixels_per_mm", lambda v: np.min(v) > 0, "must be positive")
        check(self, "jpeg_quality", lambda v: v is None or 0 <= v <= 100, "must lie between 0 and 100 or be None")
        check(self, "inverse_distance_per_mm", lambda v: -0.05 < v < 0.05, "the working distance must exceed 20 mm")
        check(self, "convergence_rad", lambda v: 0 < v < np.pi / 2, "must lie between 0 and pi/2")

    def rig(self, robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE) -> StereoRig:
        """The true cameras, affine or near-affine; `RigidTransform.identity()` gives them in the microscope frame."""
        cameras, centre_px = [], (np.array(self.image_size_px) - 1) / 2
        for side, zoom, roll in zip((+1, -1), self.pixels_per_mm, self.image_rotation_rad, strict=True):
            # The left camera stands at negative x and looks towards positive x.
            tilt = RigidTransform.from_rotation_vector((0.0, -side * self.convergence_rad / 2, 0.0))
            spin = RigidTransform.from_rotation_vector((0.0, 0.0, roll))
            matrix = np.column_stack([zoom * spin.compose(tilt).R[:2], centre_px])
            near = self.inverse_distance_per_mm
            cameras.append(NearAffineCamera(matrix, near, centre_px) if near else AffineCamera(matrix))
        return StereoRig(*cameras).moved(robot_from_microscope)

    def blur_px(self, z_mm: np.ndarray, zoom: float) -> np.ndarray:
        """Standard deviation in px of point spread and defocus at depth z, in an image of `zoom` px per mm."""
        defocus_px = np.abs(z_mm - self.focus_z_mm) / (self.depth_of_field_mm / 2)  # at 100 px per mm
        return np.hypot(self.psf_px, zoom / 100.0 * defocus_px)


def reference_rig(*, robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE, **geometry: object) -> StereoRig:
    """The rig that the simulator models by default, with 10 um per pixel; `geometry` are other attributes of `Microscope`.

    >>> bool(reference_rig().is_affine), bool(reference_rig(inverse_distance_per_mm=1 / 150).is_affine)
    (True, False)
    """
    return Microscope(**geometry).rig(robot_from_microscope)
