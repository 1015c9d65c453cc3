"""Affine and near-affine cameras and the calibrated stereo pair."""

from lib.cameras.affine import AffineCamera, Camera, Resection, normal_to
from lib.cameras.near_affine import NearAffineCamera, radial_derivative
from lib.cameras.rig import Points, StereoRig

__all__ = [
    "AffineCamera", "Camera", "NearAffineCamera", "Points", "Resection", "StereoRig", "normal_to", "radial_derivative",
]  # fmt: skip
