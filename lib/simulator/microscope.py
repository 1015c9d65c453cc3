"""The stereo microscope: geometry of its two cameras, focus, light, shutter and sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lib.cameras import StereoRig
from lib.geometry import RigidTransform
from lib.simulator.rig import IMAGE_SIZE_PX, ROBOT_FROM_MICROSCOPE, reference_rig

__all__ = ["Microscope"]


@dataclass(frozen=True)
class Microscope:
    """Optics and sensor.  Two values in a tuple are (left, right); three are (red, green, blue).

    Attributes
    ----------
    pixels_per_mm, image_rotation_rad, convergence_rad, image_size_px:
        Geometry, as in `reference_rig`.
    depth_of_field_mm:
        Total range about `focus_z_mm` within which blur adds at most one pixel (standard deviation, at the
        default zoom) to the sharpest image; infinity switches defocus off.
    psf_px:
        Standard deviation of the in-focus point spread.
    exposure_s, readout_s:
        Exposure of a row, and the time between the exposures of the first and the last row (rolling shutter).
    light_slope:
        Obliqueness of the light (x, y): how far a shadow moves on the retina per mm of height.
    spot_mm, spot_radius_mm:
        Where the coaxial light is brightest, and its Gaussian radius.
    brightness, vignetting, gain:
        Exposure (1 is well exposed), loss at the corners, and each eye's colour gains.
    full_well, read_noise:
        Electrons at full scale (shot noise) and of read noise; `full_well` infinite switches noise off.
    jpeg_quality:
        Of stored images, 0 to 100; None keeps them lossless.
    inverse_distance_per_mm:
        One over the working distance; 0 is affine.
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

    def __post_init__(self) -> None:
        if min(self.image_size_px) < 16:
            raise ValueError(f"image_size_px: must be at least 16 x 16, got {self.image_size_px}.")
        if not self.depth_of_field_mm > 0:
            raise ValueError(
                f"depth_of_field_mm: must be positive (infinity switches defocus off), got {self.depth_of_field_mm}."
            )
        for name in ("psf_px", "exposure_s", "readout_s", "vignetting", "read_noise", "brightness"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: must not be negative, got {getattr(self, name)}.")
        if not self.full_well > 0:
            raise ValueError(f"full_well: must be positive (infinity switches noise off), got {self.full_well}.")
        if not self.spot_radius_mm > 0:
            raise ValueError(f"spot_radius_mm: must be positive, got {self.spot_radius_mm}.")
        if self.jpeg_quality is not None and not 0 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality: must lie between 0 and 100 or be None, got {self.jpeg_quality}.")
        if not -0.05 < self.inverse_distance_per_mm < 0.05:
            raise ValueError(
                f"inverse_distance_per_mm: the working distance must exceed 20 mm, got {self.inverse_distance_per_mm}."
            )
        self.rig(RigidTransform.identity())  # refuses a zoom or convergence that is no rig

    def rig(self, robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE) -> StereoRig:
        """The true affine cameras; in the microscope frame with `RigidTransform.identity()`."""
        return reference_rig(
            pixels_per_mm=self.pixels_per_mm,
            image_rotation_rad=self.image_rotation_rad,
            convergence_rad=self.convergence_rad,
            image_size_px=self.image_size_px,
            robot_from_microscope=robot_from_microscope,
        )

    def defocus_px(self, z_mm: np.ndarray) -> np.ndarray:
        """Standard deviation of the defocus at depth z, at 100 px per mm: 1 px at the ends of the depth of field."""
        return np.abs(np.asarray(z_mm) - self.focus_z_mm) / (self.depth_of_field_mm / 2)
