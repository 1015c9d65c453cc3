"""A small affine stereo pair of a curved, textured surface whose every match is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from lib.cameras import AffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.simulator.rig import reference_rig

SIZE_PX = (640, 360)
PIXELS_PER_MM = 100.0


@dataclass(frozen=True)
class Pair:
    """Images, their rig, and the exact surface point (n, 3) mm seen at left pixels (n, 2)."""

    left: np.ndarray
    right: np.ndarray
    rig: StereoRig
    surface: Callable[[np.ndarray], np.ndarray]

    def errors_px(self, matches) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the right points along and off the epipolar line, (n,) px each."""
        error = matches.u_right - self.rig.right.project(self.surface(matches.u_left))
        along = self.rig.right.linear @ self.rig.left.viewing_direction
        along /= np.linalg.norm(along)
        return error @ along, error @ np.array([-along[1], along[0]])


def _height_mm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.25 * np.sin(1.1 * x + 0.4) * np.cos(0.9 * y) + 0.05 * x - (x**2 + y**2) / 24


def _points(camera: AffineCamera, u: np.ndarray) -> np.ndarray:
    """Where the rays of pixels (..., 2) meet the surface: a fixed point, as the surface is flat."""
    inverse, z = np.linalg.inv(camera.linear[:, :2]), np.zeros(u.shape[:-1])
    for _ in range(15):
        xy = (u - camera.offset_px - camera.linear[:, 2] * z[..., None]) @ inverse.T
        z = _height_mm(xy[..., 0], xy[..., 1])
    return np.concatenate([xy, z[..., None]], axis=-1)


def _texture(rng: np.random.Generator, size: int = 1024) -> np.ndarray:
    texture = np.full((size, size), 130.0, np.float32)
    for sigma, amplitude in ((1.2, 4), (3, 6), (8, 9), (25, 10)):
        noise = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), sigma)
        texture += amplitude * noise / noise.std()
    for _ in range(50):
        point, heading = rng.uniform(0, size, 2), rng.uniform(0, 2 * np.pi)
        line = [point]
        for _ in range(40):
            heading += rng.normal(0, 0.12)
            point = point + 20 * np.array([np.cos(heading), np.sin(heading)])
            line.append(point)
        drawn = np.zeros((size, size), np.uint8)
        cv2.polylines(drawn, [np.round(line).astype(np.int32)], False, 255, int(rng.integers(2, 8)), cv2.LINE_AA)
        texture -= cv2.GaussianBlur(drawn, (0, 0), 1.2).astype(np.float32) / 255 * rng.uniform(15, 45)
    return texture


def _render(camera: AffineCamera, texture: np.ndarray, gain: float, blur_px: float, rng) -> np.ndarray:
    x, y = np.meshgrid(np.arange(SIZE_PX[0], dtype=float), np.arange(SIZE_PX[1], dtype=float))
    points = _points(camera, np.stack([x, y], axis=-1))
    at = (points[..., :2] * 95 + len(texture) / 2).astype(np.float32)
    image = cv2.GaussianBlur(
        cv2.remap(texture, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), (0, 0), blur_px
    )
    return np.clip(gain * image + rng.normal(0, 2.0, image.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def affine_pair() -> Pair:
    """640 x 360 px of the reference rig; the right image is darker and blurred more, both have 2 DN of noise."""
    rng = np.random.default_rng(7)
    rig = reference_rig(robot_from_microscope=RigidTransform.identity(), image_size_px=SIZE_PX)
    texture = _texture(rng)
    left, right = _render(rig.left, texture, 1.0, 0.6, rng), _render(rig.right, texture, 0.9, 0.9, rng)
    return Pair(left, right, rig, lambda u: _points(rig.left, u))


@pytest.fixture(scope="session")
def textured() -> np.ndarray:
    """A grey image (128, 160) of random texture."""
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.standard_normal((128, 160)).astype(np.float32), (0, 0), 1.5)
    return np.clip(128 + 35 * noise / noise.std(), 0, 255).astype(np.uint8)
