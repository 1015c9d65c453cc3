"""A real robot: a da Vinci research kit whose tool carries two red spheres, seen by one colour camera.

The data set `dvrk_hand_eye` (Imperial College London, BSD-3) holds 50 frames and the recorded positions of joint 4.
The spheres are on the shaft, which always passes through the origin of the robot's base (the remote centre).  So a sphere
is at p + l p / |p|, for a joint at p, with one unknown length l, which is estimated with the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from lib.calibration import Calibration, calibrate


@dataclass(frozen=True, eq=False)
class RobotFrames:
    """Frames with both spheres found: `index` (n,), `joint_mm` (n, 3), `u` (n, 2 spheres, 2) px, `radius_px` (n, 2)."""

    folder: Path
    index: np.ndarray
    joint_mm: np.ndarray
    u: np.ndarray
    radius_px: np.ndarray
    image_size_px: tuple[int, int]

    def image(self, row: int) -> np.ndarray:
        """The image (h, w, 3) uint8 RGB of the frame in `row`."""
        return _read(self.folder, int(self.index[row]))


def _read(folder: Path, index: int) -> np.ndarray:
    path = folder / "rgb" / f"{index:02d}.jpg"
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(f"{path}: missing or not an image.")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_robot_frames(folder: str | Path) -> RobotFrames:
    """Find the spheres in every frame of the data set; frames in which one is not found are left out.

    Raises
    ------
    FileNotFoundError, ValueError
        Naming the file that is missing or does not fit.
    """
    folder = Path(folder)
    path = folder / "pos_des.txt"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: missing; the folder should hold the data set dvrk_hand_eye.")
    joint_mm = 1000.0 * np.loadtxt(path)
    if joint_mm.ndim != 2 or joint_mm.shape[1] != 3:
        raise ValueError(f"{path}: expected three columns, got shape {joint_mm.shape}.")
    rows, centres, radii, size = [], [], [], None
    for i in range(len(joint_mm)):
        image = _read(folder, i)
        size = (image.shape[1], image.shape[0])
        found = find_spheres(image)
        if found is not None:
            rows.append(i)
            centres.append(found[:, :2])
            radii.append(found[:, 2])
    return RobotFrames(folder, np.array(rows), joint_mm[rows], np.array(centres), np.array(radii), size)


def find_spheres(image: np.ndarray) -> np.ndarray | None:
    """The two red spheres of an RGB image, upper first: (2, 3) of x, y, radius in px; None unless both are found.

    A red region gives a rough circle.  Along 180 rays the steepest decrease of redness gives the outline to sub-pixel
    accuracy.  A robust fit of a circle ignores the parts where the shaft, highlights or tape cross the outline.
    """
    channels = image.astype(np.float32)
    redness = channels[:, :, 0] - np.maximum(channels[:, :, 1], channels[:, :, 2])
    mask = cv2.morphologyEx((redness > 60).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask)
    areas = stats[1:, cv2.CC_STAT_AREA]
    if count < 3 or np.sort(areas)[-2] < 500:
        return None
    two = 1 + np.argsort(-areas)[:2]
    found = []
    for label in two[np.argsort(centroids[two, 1])]:
        contours, _ = cv2.findContours((labels == label).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outline = max(contours, key=len)[:, 0].astype(np.float64)
        circle = _fit_circle(outline, scale_px=2.0)
        for _ in range(3):
            circle = _fit_circle(_edge(redness, circle), scale_px=0.7, start=circle)
        found.append(circle)
    return np.array(found)


def _edge(redness: np.ndarray, circle: np.ndarray, reach_px: float = 6.0, rays: int = 180) -> np.ndarray:
    """Points (m, 2) of the steepest decrease of redness along rays, near the circle."""
    angle = np.linspace(0, 2 * np.pi, rays, endpoint=False)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    offsets = np.arange(-reach_px, reach_px + 0.25, 0.5)
    at = circle[:2] + (circle[2] + offsets)[:, None, None] * direction
    smooth = cv2.GaussianBlur(redness, (0, 0), 1.0)
    profile = cv2.remap(smooth, at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), cv2.INTER_LINEAR)
    fall = profile[:-2] - profile[2:]
    best = fall.argmax(axis=0)
    inside = (best > 0) & (best < len(fall) - 1)
    columns = np.flatnonzero(inside)
    before, top, after = (fall[best[columns] + k, columns] for k in (-1, 0, 1))
    curvature = before - 2 * top + after
    shift = np.where(curvature < 0, 0.5 * (before - after) / np.minimum(curvature, -1e-6), 0.0)
    radius = circle[2] + offsets[1 + best[columns]] + 0.5 * shift
    strong = top > 0.3 * np.median(top)
    return circle[:2] + radius[strong, None] * direction[columns[strong]]


def _fit_circle(points: np.ndarray, scale_px: float, start: np.ndarray | None = None) -> np.ndarray:
    """x, y, radius of the circle that minimises Cauchy's loss of the radial distances."""
    if start is None:
        A = np.column_stack([2 * points, np.ones(len(points))])
        x, y, c = np.linalg.lstsq(A, (points**2).sum(axis=1), rcond=None)[0]
        start = np.array([x, y, np.sqrt(c + x**2 + y**2)])
    circle = start
    for _ in range(30):
        d = points - circle[:2]
        distance = np.linalg.norm(d, axis=1)
        r = distance - circle[2]
        w = 1.0 / (1.0 + (r / scale_px) ** 2)
        J = np.column_stack([-d / distance[:, None], -np.ones(len(d))])
        step = np.linalg.solve(J.T @ (J * w[:, None]), -J.T @ (w * r))
        circle = circle + step
        if np.abs(step).max() < 1e-4:
            break
    return circle


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A camera from one sphere: the calibration, the length l (mm), its leave-one-out residuals (n, 2) px and their RMS."""

    calibration: Calibration
    along_shaft_mm: float
    leave_one_out_px: np.ndarray

    @property
    def leave_one_out_rms_px(self) -> float:
        """RMS error of a pixel coordinate, each frame predicted from the others."""
        return float(np.sqrt((self.leave_one_out_px**2).mean()))

    @property
    def focal_px(self) -> float:
        """Zoom over 1/distance: the focal length of the equivalent pinhole camera; infinite for an affine camera."""
        distance, _ = self.calibration.inverse_distance_per_mm
        K = self.calibration.cameras[0].resect().K
        return float(np.sqrt(K[0, 0] * K[1, 1]) / distance) if distance else float("inf")


def calibrate_sphere(
    joint_mm: ArrayLike,
    u: ArrayLike,
    *,
    model: str,
    image_size_px: tuple[int, int],
    along_shaft_mm: float | None = None,
) -> SphereFit:
    """Estimate camera and length l from one sphere; each leave-one-out residual comes from a fit without its frame.

    Parameters
    ----------
    joint_mm, u:
        (n, 3) recorded positions, (n, 2) px.
    model:
        As in `calibrate`, for one camera.
    along_shaft_mm:
        l, if it is known.
    """
    joint, u = np.asarray(joint_mm, dtype=np.float64), np.asarray(u, dtype=np.float64)
    direction = joint / np.linalg.norm(joint, axis=1, keepdims=True)
    options = {"model": model, "sigma_x_mm": 0.0, "sigma_u_px": 1.0, "ransac_px": np.inf, "checks": False}

    def fit(rows: np.ndarray, length: float) -> Calibration:
        return calibrate(joint[rows] + length * direction[rows], [u[rows]], image_size_px=image_size_px, **options)

    def best_length(rows: np.ndarray, bounds: tuple[float, float]) -> float:
        if along_shaft_mm is not None:
            return along_shaft_mm
        return float(
            minimize_scalar(lambda s: fit(rows, s).cost, bounds=bounds, method="bounded", options={"xatol": 0.05}).x
        )

    everything = np.ones(len(u), dtype=bool)
    length = best_length(everything, (-150.0, 150.0))
    errors = np.empty_like(u)
    for i in range(len(u)):
        rows = everything.copy()
        rows[i] = False
        without = best_length(rows, (length - 15.0, length + 15.0))
        camera = fit(rows, without).cameras[0]
        errors[i] = u[i] - camera.project(joint[i] + without * direction[i])[0]
    options["sigma_u_px"] = None
    return SphereFit(fit(everything, length), length, errors)
