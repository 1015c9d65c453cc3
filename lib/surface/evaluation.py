"""How good a reconstruction is where the truth is known.  Nothing here is seen by an estimator."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lib.cameras import AffineCamera, StereoRig
from lib.matching import RECTIFIED, DisparityScore, Matches, match, score_against_disparity
from lib.surface.bspline import BSplineSurface
from lib.surface.sphere import Sphere

__all__ = [
    "RealPair",
    "compare_matchers",
    "error_variants",
    "real_pair",
    "rms_um",
    "surface_error_mm",
]

TruthSurface = Callable[[np.ndarray], np.ndarray]


def surface_error_mm(
    surface: BSplineSurface | Sphere,
    truth: TruthSurface,
    x_px: np.ndarray,
    y_px: np.ndarray,
    *,
    camera: AffineCamera | None = None,
) -> np.ndarray:
    """Psi(u) - truth(u), (len(y), len(x), 3) mm, on a lattice of left pixels; NaN where either has no surface.

    `camera` is needed for a sphere, to find where its rays meet it.
    """
    u = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2).astype(np.float64)
    x = surface.along_view(u, camera) if isinstance(surface, Sphere) else surface(u)
    return (x - truth(u)).reshape(len(y_px), len(x_px), 3)


def rms_um(error_mm: np.ndarray, where: np.ndarray | None = None) -> float:
    """Root mean square length in um of error vectors (..., 3) mm, over the ones that are finite and `where` (...)."""
    length = np.linalg.norm(error_mm, axis=-1)
    chosen = np.isfinite(length) if where is None else np.isfinite(length) & where
    return float(1000 * np.sqrt(np.mean(length[chosen] ** 2))) if chosen.any() else float("nan")


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


def real_pair(folder: Path) -> RealPair:
    """Read left.png, right.png, disparity.npz (x_right = x_left - disparity) and, where there is one, occlusion.png.

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
