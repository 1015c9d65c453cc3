"""The errors of reconstructions with known truth.  No estimator uses anything from here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import RegularGridInterpolator

from lib.cameras import AffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.matching import RECTIFIED, Matches, match
from lib.simulator.dataset import TEST_SEQUENCES, sequence_design, sequence_name
from lib.simulator.eye import Eye, Scene
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.render import render_pair
from lib.simulator.rig import IMAGE_SIZE_PX, ROBOT_FROM_MICROSCOPE, Microscope
from lib.simulator.window import surface_grid
from lib.surface import BSplineSurface, Reconstruction, reconstruct
from notebooks.studies.matching_evaluation import (
    CONFIDENCES,
    DisparityScore,
    detection_auc,
    score_against_disparity,
    sparsification,
)
from notebooks.studies.scenes import OBJECTS, Relief
from notebooks.studies.sphere import Sphere, fit_sphere

#: The domain of `retina_points`: a full-HD image, px.
DOMAIN = (0.0, 0.0, 1920.0, 1080.0)

TruthSurface = Callable[[np.ndarray], np.ndarray]


def surface_error_mm(
    surface: BSplineSurface | Sphere,
    truth: TruthSurface,
    x_px: np.ndarray,
    y_px: np.ndarray,
    *,
    camera: AffineCamera | None = None,
) -> np.ndarray:
    """Error Psi(u) - truth(u), (len(y), len(x), 3) mm, on a lattice of left pixels; NaN if either has no surface there.

    `camera` is needed for a sphere, to find where its rays meet it.
    """
    u = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2).astype(np.float64)
    x = surface.along_view(u, camera) if isinstance(surface, Sphere) else surface(u)
    return (x - truth(u)).reshape(len(y_px), len(x_px), 3)


def rms_um(error_mm: np.ndarray, where: np.ndarray | None = None) -> float:
    """Root mean square length in um of error vectors (..., 3) mm, over those that are finite and `where` (...) is true."""
    length = np.linalg.norm(error_mm, axis=-1)
    chosen = np.isfinite(length) if where is None else np.isfinite(length) & where
    return float(1000 * np.sqrt(np.mean(length[chosen] ** 2))) if chosen.any() else float("nan")


def aligned_rms_um(error_mm: np.ndarray, truth_mm: np.ndarray, where: np.ndarray | None = None) -> dict[str, float]:
    """RMS length in um of errors (..., 3) of points `truth_mm` (..., 3), without and with alignment to the truth.

    "robot frame" is the error without alignment, which matters for a tool.  "rigid" and "affine" are the errors after the
    best motion and the best affine map.  With exact matches a wrong affine calibration causes an affine map only, so the
    error after it comes from matching.
    """
    chosen = np.isfinite(error_mm).all(axis=-1) & np.isfinite(truth_mm).all(axis=-1)
    if where is not None:
        chosen &= where
    truth, error = truth_mm[chosen], error_mm[chosen]
    if len(truth) < 4:
        return dict.fromkeys(("robot frame", "rigid", "affine"), float("nan"))
    found = truth + error
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    design = np.column_stack([a, np.ones(len(a))])
    remaining = {
        "robot frame": error,
        "rigid": a @ R - b,
        "affine": design @ np.linalg.lstsq(design, b, rcond=None)[0] - b,
    }
    return {name: float(1000 * np.sqrt((e**2).sum(axis=1).mean())) for name, e in remaining.items()}


def surface_on_rays(
    camera: AffineCamera, height_mm: Callable[[np.ndarray, np.ndarray], np.ndarray], u: np.ndarray
) -> np.ndarray:
    """Points (n, 3) mm, robot frame, in which rays of pixels u (n, 2) meet z = `height_mm(x, y)` of the microscope frame.

    The view is nearly parallel to the microscope's axis, so steps along the ray by the remaining height converge fast.
    """
    ray = (u - camera.offset_px) @ np.linalg.pinv(camera.linear).T
    along = np.full(len(u), float(camera.viewing_direction @ ROBOT_FROM_MICROSCOPE.t))
    for _ in range(60):
        x = ROBOT_FROM_MICROSCOPE.inverse().apply(ray + along[:, None] * camera.viewing_direction)
        along -= x[:, 2] - height_mm(x[:, 0], x[:, 1])
    return ray + along[:, None] * camera.viewing_direction


@dataclass(frozen=True, eq=False)
class SimulatedPair:
    """Images (h, w, 3) uint8 of one scene, the exact `rig` in the robot frame, and `truth(u)`: the surface point (n, 3) mm
    that the left camera sees at pixels (n, 2); `eye` is True if a sphere is a sensible prior."""

    name: str
    left: np.ndarray
    right: np.ndarray
    rig: StereoRig
    truth: TruthSurface
    eye: bool


def simulated_pair(
    name: str, scene: Scene, microscope: Microscope, *, seed: int = 0, eye: bool = True
) -> SimulatedPair:
    """One pair of a scene without a tool; a full-HD pair takes 1.5 CPU seconds, and the texture of an eye another 1.5."""
    views = render_pair(scene, microscope, rng=np.random.default_rng([seed, 109]))
    rig = microscope.rig()
    x_px, y_px, x_mm = surface_grid(
        scene, microscope.rig(RigidTransform.identity()).left, microscope.image_size_px, step_px=4
    )
    truth = RegularGridInterpolator((y_px, x_px), ROBOT_FROM_MICROSCOPE.apply(x_mm), bounds_error=False)
    return SimulatedPair(name, views[0].image, views[1].image, rig, lambda u: truth(np.asarray(u)[:, ::-1]), eye)


def eyes(*, shrink: int = 1, seed: int = 0) -> Iterator[SimulatedPair]:
    """The eyes of the simulated data set's three test sequences, through their microscopes."""
    for index in TEST_SEQUENCES:
        design = sequence_design(seed, index, shrink=shrink)
        yield simulated_pair(sequence_name(index).replace("_", " "), design.eye, design.microscope, seed=index)


def objects(*, shrink: int = 1) -> Iterator[SimulatedPair]:
    """The four everyday objects under the reference rig."""
    microscope = Microscope(
        image_size_px=tuple(side // shrink for side in IMAGE_SIZE_PX),
        pixels_per_mm=tuple(zoom / shrink for zoom in Microscope.pixels_per_mm),
    )
    for index, name in enumerate(OBJECTS):
        yield simulated_pair(name, Relief(name), microscope, seed=index, eye=False)


def retina_points(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Left pixels (n, 2) in `DOMAIN` and points (n, 3) mm of a bowl under the reference rig, 10 % outliers."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(DOMAIN[:2], DOMAIN[2:], (n, 2))
    x, y = ((u - (960, 540)) / 100).T
    depth = np.sqrt(144 - x**2 - y**2) - 12 + 0.1 * np.sin(x) * np.cos(1.3 * y)
    found = np.column_stack([x, y, depth]) + rng.normal(size=(n, 3)) * (0.005, 0.005, 0.06)
    wild = rng.random(n) < 0.1
    found[wild, 2] += rng.uniform(-2, 2, wild.sum())
    return u, ROBOT_FROM_MICROSCOPE.apply(found)


@cache
def full_hd_pair() -> tuple:
    """(left, right, rig, truth) of a simulated eye with forceps and glints under the reference rig."""
    microscope = Microscope()
    eye, pose = Eye(seed=9001), Pose(base_mm=(1.5, 0.5, -1.0), azimuth_rad=2.8)
    left, right = render_pair(eye, microscope, forceps=Forceps(), pose=pose, rng=np.random.default_rng(1))
    rig = microscope.rig()
    return left, right, rig, partial(surface_on_rays, rig.left, eye.height)


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated pair, its reconstruction, and the errors on a lattice of left pixels.

    Attributes
    ----------
    x_px, y_px:
        The lattice.
    error_mm:
        (len(y), len(x), 3) errors of the surface; `sphere_error_mm` those of the sphere prior, None for objects.
    seen:
        (len(y), len(x)) bool, False under reflections.
    rms_um, sphere_rms_um:
        3D RMS errors over `seen`; `sphere_rms_um` is NaN for objects.
    """

    pair: SimulatedPair
    found: Reconstruction
    x_px: np.ndarray
    y_px: np.ndarray
    error_mm: np.ndarray
    sphere_error_mm: np.ndarray | None
    seen: np.ndarray
    rms_um: float
    sphere_rms_um: float


def case(pair: SimulatedPair, **options) -> Case:
    """Reconstruct a simulated pair with its true cameras, and judge it; `options` go to `reconstruct`."""
    height, width = pair.left.shape[:2]
    step = max(1, width // 160)
    x_px, y_px = np.arange(0, width, step), np.arange(0, height, step)
    found = reconstruct(pair.left, pair.right, pair.rig, **options)
    seen = ~found.mask_left[np.ix_(y_px, x_px)]
    error = surface_error_mm(found.surface, pair.truth, x_px, y_px)
    sphere_error = None
    if pair.eye:
        sphere_error = surface_error_mm(fit_sphere(found.points.x_mm), pair.truth, x_px, y_px, camera=pair.rig.left)
    sphere_rms = rms_um(sphere_error, seen) if pair.eye else float("nan")
    return Case(pair, found, x_px, y_px, error, sphere_error, seen, rms_um(error, seen), sphere_rms)


def wrong_matches(matches: Matches, truth: TruthSurface, rig: StereoRig, *, limit_px: float = 2.0) -> np.ndarray:
    """(n,) 1 for matches with an error above `limit_px` in the right image, otherwise 0; NaN where there is no truth."""
    x = truth(matches.u_left)
    off = np.linalg.norm(matches.u_right - rig.right.project(x), axis=1)
    return np.where(np.isfinite(off), off > limit_px, np.nan)


def confidence_curves(matches: Matches, wrong: np.ndarray, kept: np.ndarray) -> dict[str, tuple[float, np.ndarray]]:
    """For each confidence: its AUC as a detector of wrong matches, and the wrong share of the most confident `kept` (k,).

    `wrong` (n,) is the result of `wrong_matches`, NaN if unknown.
    """
    known = np.isfinite(wrong)
    bad = wrong[known] > 0
    found = {}
    for name in CONFIDENCES:
        value = getattr(matches, name)[known]
        found[name] = detection_auc(value, bad), sparsification(value, bad, kept)
    return found


def error_variants(
    variants: Mapping[str, tuple[BSplineSurface | Sphere, StereoRig]],
    truth: TruthSurface,
    x_px: np.ndarray,
    y_px: np.ndarray,
) -> dict[str, np.ndarray]:
    """Error vectors, as `surface_error_mm`, of each named surface with the rig that it was made with."""
    return {
        name: surface_error_mm(surface, truth, x_px, y_px, camera=rig.left) for name, (surface, rig) in variants.items()
    }


@dataclass(frozen=True, eq=False)
class RealPair:
    """A rectified photograph pair, (h, w[, 3]) uint8, with measured disparity (h, w) px, NaN = unknown or occluded."""

    name: str
    left: np.ndarray
    right: np.ndarray
    disparity_px: np.ndarray

    def wrong_matches(self, matches: Matches, *, limit_px: float = 2.0) -> np.ndarray:
        """(n,) 1 for matches that differ from the disparity by more than `limit_px`, otherwise 0; NaN if it is unknown.

        If the disparity is known but the point is hidden from the right camera, its match counts, too, usually as wrong.
        """
        height, width = self.disparity_px.shape
        x, y = np.clip(np.rint(matches.u_left), 0, (width - 1, height - 1)).astype(int).T
        off = np.abs(matches.u_left[:, 0] - matches.u_right[:, 0] - self.disparity_px[y, x])
        return np.where(np.isfinite(off), off > limit_px, np.nan)

    def left_part(self, width_px: int, height_px: int) -> RealPair:
        """The left part of the photographs with this aspect ratio (all, if they are narrower), resized to this size."""
        width = min(round(self.left.shape[0] * width_px / height_px), self.left.shape[1])
        scale, size = width_px / width, (width_px, height_px)
        resample = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        images = (
            cv2.resize(np.ascontiguousarray(image[:, :width]), size, interpolation=resample)
            for image in (self.left, self.right)
        )
        disparity = scale * cv2.resize(self.disparity_px[:, :width], size, interpolation=cv2.INTER_NEAREST)
        return RealPair(self.name, *images, disparity)


def real_pair(folder: Path) -> RealPair:
    """Read left.png, right.png, disparity.npz (x_right = x_left - disparity) and, if there is one, occlusion.png.

    Raises
    ------
    FileNotFoundError, ValueError
        Naming the file.
    """
    images = []
    for side in ("left", "right"):
        path = folder / f"{side}.png"
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise FileNotFoundError(f"{path}: missing, or not an image.")
        images.append(image if image.ndim == 2 else np.ascontiguousarray(image[..., 2::-1]))
    path = folder / "disparity.npz"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: missing.")
    with np.load(path, allow_pickle=False) as stored:
        disparity = np.array(stored["arr_0"], dtype=np.float32)
    if disparity.shape != images[0].shape[:2]:
        raise ValueError(f"{path}: disparity is {disparity.shape}, the image {images[0].shape[:2]}.")
    disparity[~np.isfinite(disparity) | (disparity <= 0)] = np.nan
    if (folder / "occlusion.png").is_file():
        disparity[cv2.imread(str(folder / "occlusion.png"), cv2.IMREAD_GRAYSCALE) == 0] = np.nan
    return RealPair(folder.name, *images, disparity)


def compare_matchers(
    pair: RealPair, methods: Mapping[str, dict], *, flat_window_px: int | None = 3
) -> dict[str, tuple[Matches, DisparityScore, float]]:
    """Matches, score and seconds of each method on a real pair; `methods` maps names to arguments of `match`."""
    results = {}
    for name, arguments in methods.items():
        start = time.perf_counter()
        matches = match(
            pair.left, pair.right, rig=None if arguments.get("method") == "deepmatching" else RECTIFIED, **arguments
        )
        seconds = time.perf_counter() - start
        score = score_against_disparity(matches, pair.disparity_px, flat_window_px=flat_window_px)
        results[name] = (matches, score, seconds)
    return results
