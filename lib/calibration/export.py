"""Calibrations for other programs: JSON (everything), OpenCV YAML and ROS CameraInfo (one camera a file), and back."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np

from lib.calibration.estimate import Calibration
from lib.cameras import AffineCamera, NearAffineCamera, StereoRig, camera_from_dict, camera_to_dict

__all__ = ["read_json", "read_opencv", "read_ros", "write_json", "write_opencv", "write_ros"]

Camera = AffineCamera | NearAffineCamera


def _write(path: str | Path, text: str) -> None:
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _read(path: str | Path) -> str:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    return path.read_text(encoding="utf-8")


def _camera(P: np.ndarray, radial_per_px2: float, path: str | Path) -> Camera:
    try:
        if P.shape != (3, 4):
            raise ValueError(f"the projection matrix is {P.shape}, not (3, 4)")
        if not P[2, :3].any():
            return AffineCamera(P[:2] / P[2, 3])
        return NearAffineCamera.from_projection_matrix(P, radial_per_px2)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_json(calibration: Calibration, path: str | Path) -> None:
    """Cameras, covariances, noise levels, model and units; the file appears whole or not at all."""
    names = ["left", "right"] if len(calibration.cameras) == 2 else ["camera"]
    content = {
        "format": "microstereo.calibration",
        "units": {"point": "mm", "image": "px", "inverse_distance": "1/mm"},
        "model": calibration.model,
        "weighting": calibration.weighting,
        "image_size_px": calibration.image_size_px,
        "sigma_u_px": calibration.sigma_u_px,
        "sigma_x_mm": calibration.sigma_x_mm,
        "rows": len(calibration.inliers),
        "inliers": int(calibration.inliers.sum()),
        "reprojection_rms_px": calibration.reprojection_rms_px,
        "cameras": {name: camera_to_dict(camera) for name, camera in zip(names, calibration.cameras, strict=True)},
        "matrix_covariance": calibration.covariance.tolist(),
        "parameters": calibration.parameter_names,
        "parameter_covariance": calibration.parameter_covariance.tolist(),
    }
    _write(path, json.dumps(content, indent=1) + "\n")


def read_json(path: str | Path) -> tuple[Camera, ...] | StereoRig:
    """The rig (or the one camera, in a tuple) that `write_json` wrote.

    Raises
    ------
    FileNotFoundError, ValueError
        Naming the file.
    """
    try:
        cameras = json.loads(_read(path))["cameras"]
        if set(cameras) == {"left", "right"}:
            return StereoRig(camera_from_dict(cameras["left"]), camera_from_dict(cameras["right"]))
        return (camera_from_dict(cameras["camera"]),)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: not a calibration written by write_json ({type(error).__name__}: {error})."
        ) from None


def write_opencv(camera: Camera, path: str | Path, image_size_px: tuple[int, int]) -> None:
    """OpenCV FileStorage YAML: `projection_matrix` 3 x 4 (affine: last row 0 0 0 1), image size, radial term."""
    values = ", ".join(repr(float(v)) for v in camera.projection_matrix.ravel())
    radial = camera.radial_per_px2 if isinstance(camera, NearAffineCamera) else 0.0
    _write(
        path,
        "%YAML:1.0\n---\n"
        f"image_width: {int(image_size_px[0])}\nimage_height: {int(image_size_px[1])}\n"
        'unit_of_points: "mm"\n'
        f"projection_matrix: !!opencv-matrix\n   rows: 3\n   cols: 4\n   dt: d\n   data: [ {values} ]\n"
        f"radial_per_px2: {radial!r}\n",
    )


def read_opencv(path: str | Path) -> Camera:
    """The camera of an OpenCV YAML file with a `projection_matrix`.

    Raises
    ------
    FileNotFoundError, ValueError
        Naming the file.
    """
    text = _read(path)
    found = re.search(
        r"projection_matrix:\s*!!opencv-matrix\s+rows:\s*3\s+cols:\s*4\s+dt:\s*\w\s+data:\s*\[(.*?)\]", text, re.S
    )
    if not found:
        raise ValueError(f"{path}: no 3 x 4 projection_matrix; write_opencv or cv2.FileStorage writes one.")
    radial = re.search(r"^radial_per_px2:\s*(\S+)", text, re.M)
    return _camera(_numbers(found.group(1), path), float(radial.group(1)) if radial else 0.0, path)


def _numbers(text: str, path: str | Path) -> np.ndarray:
    try:
        return np.array([float(v) for v in text.split(",")]).reshape(3, 4)
    except ValueError as error:
        raise ValueError(f"{path}: projection matrix: {error}.") from None


def write_ros(camera: Camera, path: str | Path, image_size_px: tuple[int, int], name: str = "camera") -> None:
    """ROS CameraInfo YAML (camera_info_manager).  P carries the whole camera, millimetres of the robot frame to pixels.

    K and R are identities and D is zero, since an affine camera has no pinhole K: only P has a meaning.

    Raises
    ------
    ValueError
        For radial distortion, which D cannot state without a focal length.
    """
    if isinstance(camera, NearAffineCamera) and camera.radial_per_px2:
        raise ValueError("camera: CameraInfo cannot hold its radial distortion; use write_json or write_opencv.")
    P = camera.projection_matrix

    def block(key: str, matrix: np.ndarray) -> str:
        values = ", ".join(repr(float(v)) for v in matrix.ravel())
        return f"{key}:\n  rows: {matrix.shape[0]}\n  cols: {matrix.shape[1]}\n  data: [{values}]\n"

    _write(
        path,
        "# u = P [x; 1] dehomogenised, x in mm in the robot frame; an affine camera's last row is 0 0 0 1: use P alone.\n"
        f"image_width: {int(image_size_px[0])}\nimage_height: {int(image_size_px[1])}\ncamera_name: {name}\n"
        + block("camera_matrix", np.eye(3))
        + "distortion_model: plumb_bob\n"
        + block("distortion_coefficients", np.zeros((1, 5)))
        + block("rectification_matrix", np.eye(3))
        + block("projection_matrix", P),
    )


def read_ros(path: str | Path) -> Camera:
    """The camera of a CameraInfo YAML whose P maps millimetres of the robot frame to pixels.

    Raises
    ------
    FileNotFoundError, ValueError
        Naming the file.
    """
    text = _read(path)
    found = re.search(r"projection_matrix:\s*\n\s*rows:\s*3\s*\n\s*cols:\s*4\s*\n\s*data:\s*\[(.*?)\]", text, re.S)
    if not found:
        raise ValueError(f"{path}: no 3 x 4 projection_matrix; is it a CameraInfo file?")
    return _camera(_numbers(found.group(1), path), 0.0, path)
