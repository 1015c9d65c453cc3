"""A world whose answers are known: detector and matcher look landmarks and retina up instead of looking at pixels."""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from types import SimpleNamespace

import numpy as np

from lib.cameras import AffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.landmarks import Landmarks
from lib.online import FrameResult, OnlinePipeline, Settings
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.moved_cameras import tool_frames

RIG = reference_rig()
SELDOM = Settings(surface_every=20)  # for long runs, where the surface is not the point
CENTRE_MM = ROBOT_FROM_MICROSCOPE.t
#: The eye of these tests: a plane 1.5 mm below the focal plane.
DEPTH_MM = 1.5
BLACK = np.zeros((24, 32, 3), np.uint8)


@cache
def _path_mm(n: int, seed: int) -> np.ndarray:
    """(n, 3, 3) landmarks of a tool that jumps; worked out once for all worlds."""
    return tool_frames(n, rng=np.random.default_rng(seed), sigma_x_mm=0.0).true_x_mm.reshape(-1, 3, 3)


class World:
    """A tool that jumps from pose to pose; `smooth` lets it glide, as in a video."""

    def __init__(self, seed: int = 0, sigma_px: float = 1.0, *, smooth: bool = False, still: bool = False, n: int = 400):
        self.rng = np.random.default_rng(seed)
        self.rig, self.sigma_px, self.depth_mm = RIG, sigma_px, DEPTH_MM
        x = _path_mm(n, seed + 1).copy()
        if smooth:
            t = np.arange(n)[:, None, None] / 25.0
            sway = np.array([3.0, 2.0, 0.8]) * np.sin(t * np.array([1.1, 1.7, 0.7]) + np.array([0.0, 1.0, 2.0]))
            x = x[:1] + ROBOT_FROM_MICROSCOPE.apply(sway.reshape(-1, 3)).reshape(sway.shape) - CENTRE_MM
        self.x_mm = np.repeat(x[:1], n, axis=0) if still else x
        self.frame = -1

    def advance(self) -> np.ndarray:
        self.frame += 1
        return self.x_mm[self.frame % len(self.x_mm)] + self.rng.normal(0, 0.01, (3, 3))

    @property
    def images(self) -> tuple[np.ndarray, np.ndarray]:
        """Noise: no two frames are alike."""
        return tuple(self.rng.integers(0, 255, (2, *BLACK.shape), dtype=np.uint8))

    def detect(self, images: np.ndarray) -> Landmarks:
        assert images.shape == (2, *BLACK.shape)
        u = np.stack(self.rig.project(self.x_mm[self.frame % len(self.x_mm)]))
        covariance = np.tile(self.sigma_px**2 * np.eye(2), (2, 3, 1, 1))
        return Landmarks(u + self.rng.normal(0, self.sigma_px, u.shape), covariance, np.full((2, 3), 0.9))

    def reconstruct(self, left, right, rig, *, u_landmarks, seconds, setting, **options) -> SimpleNamespace:
        assert np.shape(u_landmarks) == (2, 3, 2)
        x, y = np.meshgrid(np.linspace(-6, 6, 25), np.linspace(-4, 4, 17))
        plane = np.stack([x.ravel(), y.ravel(), np.full(x.size, self.depth_mm)], axis=1)
        u_left, u_right = self.rig.project(ROBOT_FROM_MICROSCOPE.apply(plane))
        seconds |= {"mask": 0.01, "match": 0.02, "triangulate": 0.03, "surface": 0.04}
        points = rig.triangulate(u_left, u_right)
        plane = Plane(u_left, points.x_mm)
        matches = SimpleNamespace(epipolar_px=float(np.median(np.abs(points.epipolar_px))))
        found = {"surface": plane, "points": points, "matches": matches, "u": u_left, "rig": rig}
        return SimpleNamespace(**found, depth_range_mm=lambda margin: (-9.0, 9.0))

    def true_distance_mm(self) -> np.ndarray:
        """Along the view of the left camera."""
        x = self.x_mm[self.frame % len(self.x_mm)]
        height = self.depth_mm - ROBOT_FROM_MICROSCOPE.inverse().apply(x)[:, 2]
        return height / (self.rig.left.viewing_direction @ ROBOT_FROM_MICROSCOPE.R[:, 2])


class Plane:
    """A surface that is a plane in the image: what the pipeline asks of a surface, and no more."""

    fit = SimpleNamespace(smoothness=1.0)

    def __init__(self, u: np.ndarray, x: np.ndarray) -> None:
        self.coefficients = np.linalg.lstsq(np.column_stack([u, np.ones(len(u))]), x, rcond=None)[0]

    def __call__(self, u: np.ndarray) -> np.ndarray:
        return np.column_stack([u, np.ones(len(u))]) @ self.coefficients

    def derivative(self, u: np.ndarray, order: tuple[int, int]) -> np.ndarray:
        return np.tile(self.coefficients[order.index(1)], (len(u), 1))

    def normal(self, u: np.ndarray) -> np.ndarray:
        normal = np.cross(self.coefficients[1], self.coefficients[0])
        return np.tile(normal / np.linalg.norm(normal), (len(u), 1))

    def covariance(self, u: np.ndarray) -> np.ndarray:
        return np.zeros((len(u), 3, 3))

    def distance(self, x_mm: np.ndarray, camera: AffineCamera) -> SimpleNamespace:
        u = camera.project(x_mm)
        gap = self(u) - x_mm
        along_normal = -np.einsum("ni,ni->n", gap, self.normal(u))
        nearest = {"nearest_u": u, "nearest_mm": self(u)}
        return SimpleNamespace(along_view_mm=gap @ camera.viewing_direction, along_normal_mm=along_normal, **nearest)


def make(world: World, **options) -> OnlinePipeline:
    components = {"detector": world.detect, "reconstruct": world.reconstruct} | options
    return OnlinePipeline(**components)


def run(pipeline: OnlinePipeline, world: World, n: int) -> list[FrameResult]:
    results = []
    for _ in range(n):
        told = world.advance()
        results.append(pipeline.step(*world.images, told))
    return results


@cache
def _started(seed: int, sigma_px: float, smooth: bool, n: int) -> tuple[World, OnlinePipeline, list[FrameResult]]:
    if shorter := max((k for k in (10, 20, 60) if k < n), default=0):  # goes on from what other tests start with
        world, pipeline, results = deepcopy(_started(seed, sigma_px, smooth, shorter))
    else:
        world = World(seed, sigma_px, smooth=smooth)
        pipeline, results = make(world, settings=SELDOM), []
    return world, pipeline, results + run(pipeline, world, n - len(results))


def started(
    n: int = 60, *, seed: int = 5, sigma_px: float = 1.0, smooth: bool = False
) -> tuple[World, OnlinePipeline, list[FrameResult]]:
    """A world, a pipeline that calibrated itself in it, and its `n` results; made once, everybody gets a copy."""
    made = _started(seed, sigma_px, smooth, n)
    assert made[2][-1].state == "tracking"
    return deepcopy(made)


def rig_error_mm(rig: StereoRig, world: World) -> float:
    x = world.x_mm[:100].reshape(-1, 3)
    return float(np.sqrt(((rig.triangulate(*world.rig.project(x)).x_mm - x) ** 2).sum(axis=1).mean()))


def shifted(rig: StereoRig, shift_mm) -> StereoRig:
    return rig.moved(RigidTransform(np.eye(3), np.asarray(shift_mm, dtype=float)))
