"""From a stereo pair to its surface in one call: masks, matches, epipolar filter, triangulation, fit (Sec. IV-B)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration import Calibration
from lib.cameras import Points, StereoRig
from lib.matching import Matches, glint_mask, match, tool_mask
from lib.surface.bspline import BSplineSurface
from lib.surface.fitting import fit_surface
from lib.surface.joint import refine_rig

__all__ = ["EPIPOLAR_SIGMAS", "Reconstruction", "epipolar_inliers", "reconstruct"]

#: Matches further from their epipolar line than so many standard deviations are dropped.
EPIPOLAR_SIGMAS = 2.0


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What one stereo pair gave.

    Attributes
    ----------
    surface:
        Fitted to `points` over the image points `matches.u_left`.
    matches, points:
        The matches that passed the epipolar filter, and their points.
    n_matches:
        Matches before the filter.
    mask_left:
        (h, w) bool, True where tool or glints hid the surface.
    seconds:
        Wall clock of each stage, in order.
    rig:
        The cameras that made the points: as given, or a calibration brought to agree with the matches.
    """

    surface: BSplineSurface
    matches: Matches
    points: Points
    n_matches: int
    mask_left: np.ndarray
    seconds: dict[str, float]
    rig: StereoRig


def epipolar_inliers(rig: StereoRig, matches: Matches, *, sigmas: float = EPIPOLAR_SIGMAS) -> np.ndarray:
    """Which matches (n,) lie on their epipolar lines, by the standard deviation that each match states.

    The distances' median is taken out first: a calibrated rig may be off by a fraction of a pixel, for all alike.
    """
    distance = rig.epipolar_distance(matches.u_left, matches.u_right)
    normal = rig.epipolar_normal
    sigma = np.sqrt(np.einsum("i,nij,j->n", normal, matches.covariance_px2, normal))
    return np.abs(distance - np.median(distance)) < sigmas * sigma if len(distance) else np.zeros(0, dtype=bool)


def reconstruct(
    left: np.ndarray,
    right: np.ndarray,
    rig: StereoRig | Calibration,
    *,
    setting: str = "quality",
    u_landmarks: tuple[ArrayLike, ArrayLike] | None = None,
    mask_left: np.ndarray | None = None,
    mask_right: np.ndarray | None = None,
    method: str | None = None,
    depth_only: bool | None = None,
    domain: tuple[float, float, float, float] | None = None,
    control: tuple[int, int] = (20, 20),
    smoothness: float | None = None,
    reject_mm: float | None = None,
) -> Reconstruction:
    """The surface that a calibrated stereo pair shows.

    Parameters
    ----------
    left, right:
        (h, w, 3) uint8 RGB.
    rig:
        The cameras; or the calibration that found them, and then a first, fast matching corrects its epipolar geometry
        (`refine_rig`), so that matches do not slide along edges.
    setting:
        "quality", or "fast" for several pairs a second; see `lib.matching.match`.
    u_landmarks:
        Landmarks of the tool, (3, 2) px left and right, to mask the tool; NaN = missing.
    mask_left, mask_right:
        (h, w) bool, more that is to be ignored (True), beside glints and tool.
    method:
        Of `lib.matching.match`.
    depth_only:
        Fit the depth along the left view alone, one spline in the place of three; None does in the fast setting.
    domain:
        (x0, y0, x1, y1) px; None is what the matches cover.
    control, smoothness, reject_mm:
        As for `fit_surface`.

    Raises
    ------
    ValueError
        As `match` and `fit_surface` do: unfit images, a rig that does not fit them, too few matches.
    """
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    with stage("mask"):
        with ThreadPoolExecutor(2) as pool:
            masks = list(pool.map(glint_mask, (left, right)))
        for side, image in enumerate((left, right)):
            if u_landmarks is not None:
                masks[side] |= tool_mask(image.shape[:2], u_landmarks[side])
            more = (mask_left, mask_right)[side]
            if more is not None:
                if np.shape(more) != masks[side].shape or np.asarray(more).dtype != bool:
                    raise ValueError(
                        f"{('mask_left', 'mask_right')[side]}: expected a bool array {masks[side].shape}, True = ignore, "
                        f"got {np.asarray(more).dtype} {np.shape(more)}."
                    )
                masks[side] |= more
    if isinstance(rig, Calibration):
        with stage("refine"):
            first = match(left, right, rig=rig.rig, mask_left=masks[0], mask_right=masks[1], setting="fast")
            rig = refine_rig(rig, first)
    with stage("match"):
        found = match(
            left, right, rig=rig, method=method, mask_left=masks[0], mask_right=masks[1], setting=setting
        )  # fmt: skip
    with stage("triangulate"):
        matches = found.keep(epipolar_inliers(rig, found))
        points = rig.triangulate(matches.u_left, matches.u_right, matches.covariance_px2)
    with stage("surface"):
        if domain is None:
            if not len(matches):
                raise ValueError("left, right: no match lies on its epipolar line; is there texture, does the rig fit?")
            domain = (*matches.u_left.min(axis=0).tolist(), *matches.u_left.max(axis=0).tolist())
        fast = setting == "fast"
        surface = fit_surface(
            matches.u_left,
            points.x_mm,
            domain=domain,
            control=control,
            smoothness=smoothness,
            reject_mm=reject_mm,
            camera=rig.left if (fast if depth_only is None else depth_only) else None,
            tolerance=1e-4 if fast else 1e-8,
            quick=fast,
        )
    return Reconstruction(surface, matches, points, len(found), masks[0], seconds, rig)
