"""Cameras for other programs: OpenCV YAML and ROS CameraInfo, one camera a file.  `StereoRig.save` writes JSON."""

import json
import re
from pathlib import Path

import cv2
import numpy as np

from lib.cameras import Camera
from lib.files import write_text


def write_opencv(camera: Camera, path: str | Path, image_size_px: tuple[int, int]) -> None:
    """Writes a file for `cv2.FileStorage`; the suffix .yml, .yaml, .xml or .json chooses the format (else a ValueError).

    It holds `projection_matrix` (3 x 4, millimetres in the robot frame to pixels; the last row of an affine camera is
    0 0 0 1), `image_width`, `image_height`, `unit_of_points`, and k = `radial_per_px2` with c = `distortion_centre`: a point
    that the matrix projects to u is imaged at u + k |u - c|^2 (u - c).

    >>> import tempfile
    >>> from lib.cameras import AffineCamera
    >>> file = Path(tempfile.mkdtemp()) / "left.yml"
    >>> write_opencv(AffineCamera([[100, 0, 5, 960], [0, 100, 0, 540]]), file, (1920, 1080))
    >>> storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    >>> storage.getNode("projection_matrix").mat()[0].tolist()
    [100.0, 0.0, 5.0, 960.0]
    """
    path = Path(path)
    if path.suffix not in (".yml", ".yaml", ".xml", ".json"):
        raise ValueError(f"{path}: OpenCV writes .yml, .yaml, .xml or .json.")
    storage = cv2.FileStorage(path.name, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)  # OpenCV hides a full disk
    storage.write("image_width", int(image_size_px[0]))
    storage.write("image_height", int(image_size_px[1]))
    storage.write("unit_of_points", "mm")
    storage.write("projection_matrix", np.array(camera.projection_matrix))
    storage.write("radial_per_px2", float(getattr(camera, "radial_per_px2", 0.0)))
    storage.write("distortion_centre", np.array(getattr(camera, "centre_px", (0.0, 0.0))))
    write_text(path, storage.releaseAndGetString())


def write_ros(camera: Camera, path: str | Path, image_size_px: tuple[int, int], name: str = "camera") -> None:
    """Writes a ROS CameraInfo YAML (camera_info_manager).  P maps millimetres in the robot frame to pixels.

    K and R are identities and D is zero: use only P.  A ValueError refuses a `name` that contains anything but letters,
    digits and underscores, and radial distortion, which D cannot express without a focal length.
    """
    if not re.fullmatch(r"[A-Za-z0-9_]+", name):
        raise ValueError(f"name: ROS takes letters, digits and underscores, got {name!r}.")
    if getattr(camera, "radial_per_px2", 0.0):
        raise ValueError("camera: CameraInfo cannot hold its radial distortion; use write_opencv.")

    def matrix(values: np.ndarray) -> dict:
        return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}

    content = {
        "image_width": int(image_size_px[0]), "image_height": int(image_size_px[1]), "camera_name": name,
        "camera_matrix": matrix(np.eye(3)), "distortion_model": "plumb_bob",
        "distortion_coefficients": matrix(np.zeros((1, 5))), "rectification_matrix": matrix(np.eye(3)),
        "projection_matrix": matrix(camera.projection_matrix),
    }  # fmt: skip
    lines = ["# u = P [x; 1] dehomogenised, x in mm in the robot frame; an affine camera's last row is 0 0 0 1: use P alone."]
    # JSON values are YAML values.
    write_text(path, "\n".join([*lines, *(f"{key}: {json.dumps(value)}" for key, value in content.items())]) + "\n")
