"""The names that notebooks, scripts and other people's checks rely on; each with the arguments and results that they use."""

import inspect
from dataclasses import fields, is_dataclass

import pytest

from lib import (
    adapt,
    calibration,
    cameras,
    correspondences,
    geometry,
    landmarks,
    matching,
    online,
    recordings,
    registration,
)
from lib import surface as surfaces

ATTRIBUTES = {
    geometry.RigidTransform: "R t apply inverse compose",
    cameras.Camera: "project",
    cameras.AffineCamera: "matrix project resect",
    cameras.Resection: "K R t mirrored",
    cameras.NearAffineCamera: "matrix inverse_distance_per_mm centre_px project",
    cameras.StereoRig: "left right project triangulate fundamental epipolar_distance save load",
    cameras.Points: "x_mm covariance_mm2 epipolar_px",
    correspondences.Correspondences: "x_mm u_left u_right covariance_px2 confidence frame landmark time_s "
    "complete subset of_frames",
    calibration.Calibration: "cameras rig inliers cost covariance",
    registration.Registration: "transform covariance",
    matching.Matches: "u_left u_right score covariance_px2",
    surfaces.BSplineSurface: "objective inliers __call__",
    surfaces.Reconstruction: "points surface",
    landmarks.Landmarks: "u covariance confidence",
    landmarks.Detector: "load track __call__",
    recordings.Recording: "open frames kinematics annotations truth",
    recordings.Annotator: "mark know undo redo next_frame",
    online.OnlinePipeline: "step",
    adapt.Adaptation: "detector calibration report improved",
}
ARGUMENTS = {
    calibration.dlt: "x_mm u",
    calibration.calibrate: "data u model weighting sigma_u_px sigma_x_mm covariance_px2 ransac_px seed",
    registration.register: "x_source x_target loss",
    registration.register_images: "rig data u_left u_right covariance_px2",
    matching.match: "left right method rig mask_left mask_right depth_range_mm",
    surfaces.fit_surface: "u x_mm domain control smoothness reject_mm",
    surfaces.reconstruct: "left right rig",
    landmarks.Detector.load: "path_or_name",
    cameras.StereoRig.triangulate: "u_left u_right covariance_px2",
    adapt.adapt: "recording detector labels minutes seed folder",
}


@pytest.mark.parametrize("kind", ATTRIBUTES, ids=lambda kind: kind.__name__)
def test_a_public_class_has_its_attributes(kind):
    stored = {field.name for field in fields(kind)} if is_dataclass(kind) else set()
    assert [name for name in ATTRIBUTES[kind].split() if name not in stored and not hasattr(kind, name)] == []


@pytest.mark.parametrize("function", ARGUMENTS, ids=lambda function: function.__name__)
def test_a_public_function_has_its_arguments(function):
    assert [name for name in ARGUMENTS[function].split() if name not in inspect.signature(function).parameters] == []
