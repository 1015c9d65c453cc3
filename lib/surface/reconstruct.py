"""From a stereo pair to its surface: mask, refine, match, triangulate, fit (paper Sec. IV-B)."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from lib.calibration import Calibration
from lib.cameras import Points, StereoRig
from lib.matching import Matches, checked_mask, dark_mask, glint_mask, match, tool_mask
from lib.surface.bspline import BSplineSurface, fewest_points, fit_surface, sign_inflation

#: Matches farther from their epipolar line than this many of their own standard deviations are dropped.
EPIPOLAR_SIGMAS = 2.0
#: Least number of matches from which the bend of all epipolar lines is estimated; with fewer only their common shift is.
_BENDING = 100
#: Share of ambiguous matches (`Matches.ambiguous`) above which the texture repeats too much to be trusted; on dots printed
#: in a grid, 2 to 8 % of the matches were ambiguous and the surface was right.
AMBIGUOUS = 0.25
#: Points whose third nearest neighbour is this many times as far as usual are dropped.
_ALONE = 6.0
#: Width, in cells of the surface, of the squares in which errors of matches are taken as shared: a spline follows them there.
_SHARED_CELLS = 2.0
#: For `refine_rig`: number of correlated matches that count as one; standard deviations above which residuals lose weight.
_CORRELATED, _SOFT = 10.0, 2.0


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The reconstruction from one stereo pair.

    Attributes:
        surface: Fitted to `points` over the left image points `u`.
        points: The triangulated points.  Their covariances are those of the matches, or larger: see `as_scattered`.
        matches: The matches that passed the epipolar filter, and whose points have neighbours; one for each point.
        n_matches: Number of matches before these filters.
        mask_left: (h, w) bool, True where tool, glints or darkness hid the surface.
        rig: The cameras that triangulated the points: as given, or refined by the matches.
        seconds: Wall clock of each stage: "mask", "refine" (if the rig was refined), "match", "triangulate", "surface".
    """

    surface: BSplineSurface
    points: Points
    matches: Matches
    n_matches: int
    mask_left: np.ndarray
    rig: StereoRig
    seconds: dict[str, float]

    @property
    def u(self) -> np.ndarray:
        """Left image points (n, 2) px of `points`."""
        return self.matches.u_left

    def depth_range_mm(self, margin_mm: float = 0.0) -> tuple[float, float]:
        """(near, far) of 99 % of the points along the left camera's view, plus a margin, as `lib.matching.match` takes it."""
        low, high = np.percentile(self.points.x_mm @ self.rig.left.viewing_direction, (0.5, 99.5))
        return float(low) - margin_mm, float(high) + margin_mm


def epipolar_inliers(rig: StereoRig, matches: Matches) -> np.ndarray:
    """Mask (n,) of the matches within `EPIPOLAR_SIGMAS` of their standard deviations from their epipolar lines.

    An error of the calibration shifts, turns and bends all epipolar lines by up to some pixels.  So a robust quadratic
    function of the left image point is subtracted from the distances first.  Matches that no point explains are dropped.
    """
    return np.abs(_off_lines(rig, matches)) < EPIPOLAR_SIGMAS * matches.sigma_along(rig.epipolar_normal)


def _off_lines(rig: StereoRig, matches: Matches) -> np.ndarray:
    """Distances (n,) px of the matches from the epipolar lines, less what is common to them; NaN if no point explains it."""
    distance, sigma = rig.epipolar_distance(matches.u_left, matches.u_right), matches.sigma_along(rig.epipolar_normal)
    known = np.isfinite(distance)
    common = np.median(distance[known]) if known.any() else 0.0
    if known.sum() >= _BENDING:
        x, y = ((matches.u_left - matches.u_left.mean(axis=0)) / np.maximum(matches.u_left.std(axis=0), 1)).T
        bend = np.column_stack([x * x, x * y, y * y, x, y, np.ones(len(x))])
        common = common + bend @ _regression(bend[known], distance[known] - common, sigma[known])[0]
    return distance - common


def in_company(x_mm: np.ndarray) -> np.ndarray:
    """Mask (n,) of the points that are not alone: between textured parts a surface would pass through a wrong one."""
    third = KDTree(x_mm).query(x_mm, k=4)[0][:, 3]  # the first is the point itself; infinite with fewer points
    return third <= _ALONE * np.median(third) if len(x_mm) else np.zeros(0, dtype=bool)


def as_scattered(points: Points, off_mm: np.ndarray, view: np.ndarray, inliers: np.ndarray) -> Points:
    """The points with larger covariances, if they scatter about the surface more than these state.

    A matcher cannot know all its errors: noise, focus and texture of the images differ.  The distances `off_mm` (n, 3) of
    the points from a surface show most of them.  So the covariances are scaled to the median distance of the `inliers`
    along `view` (3,), but never made smaller.

    >>> rng = np.random.default_rng(0)
    >>> points = Points(np.zeros((999, 3)), np.tile(0.01 * np.eye(3), (999, 1, 1)), np.zeros(999))
    >>> scaled = as_scattered(points, rng.normal(0, 0.3, (999, 3)), np.array([0, 0, 1.0]), np.full(999, True))
    >>> float(scaled.covariance_mm2[0, 2, 2].round(1))
    0.1
    """
    sd_mm = np.sqrt(np.einsum("i,nij,j->n", view, points.covariance_mm2, view))
    ratio = 1.4826 * float(np.median(np.abs(off_mm @ view)[inliers] / sd_mm[inliers]))
    return replace(points, covariance_mm2=points.covariance_mm2 * max(ratio, 1.0) ** 2)


def refine_rig(calibration: Calibration, matches: Matches) -> StereoRig:
    """The cameras that agree best with their own calibration and with the epipolar geometry of dense matches.

    In the space of a match's four pixels, the unit normal n to the derivatives by its point is the direction that no point
    explains.  So the match's residual along n is that of the cameras plus noise, linear in small changes of their
    parameters.  The update of a Kalman filter with the calibration as its prior corrects all parameters by a robust
    regression over all matches.  Few or poor matches change little.

    Args:
        calibration: Of a stereo pair; a ValueError refuses a single camera.
        matches: From `lib.matching.match` with its rig, best of the static scene, with the tool masked.
    """
    rig, prior = calibration.pair, calibration.parameter_covariance
    points = rig.triangulate(matches.u_left, matches.u_right, matches.covariance_px2)
    matches, x_mm = matches.keep(known := np.isfinite(points.x_mm).all(axis=1)), points.x_mm[known]
    if len(matches) < 5:
        return rig
    by_point, by_parameters = calibration.derivatives(x_mm)
    normal = np.linalg.svd(by_point)[0][:, :, 3]
    off = np.hstack([matches.u_left, matches.u_right]) - np.hstack(rig.project(x_mm))
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, matches.covariance_px2, normal))
    measured, information = _regression(np.einsum("ni,nip->np", normal, by_parameters), (normal * off).sum(axis=1), sigma)
    # Information form, since matches alone leave most combinations of the parameters undetermined.
    step = prior @ np.linalg.solve(np.eye(len(prior)) + information @ prior, information @ measured)
    return StereoRig(*calibration.minimum.state.moved(step).cameras())


def _regression(x: np.ndarray, value: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Robust coefficients (k,) of value (n,) on x (n, k), and their information: reweighted least squares."""
    design = x / sigma[:, None]
    target, weight = value / sigma, np.ones(len(x))
    for _ in range(20):
        weighted = design * weight[:, None]
        information = weighted.T @ design
        found = np.linalg.lstsq(information, weighted.T @ target, rcond=1e-12)[0]
        residual = target - design @ found
        scale = max(1.4826 * np.median(np.abs(residual)), 1.0)  # not below the matches' stated noise
        before, weight = weight, 1 / (1 + (residual / (_SOFT * scale)) ** 2) ** 2
        if np.abs(weight - before).max() < 1e-4:  # mostly after 7 rounds
            break
    return found, information / (_CORRELATED * scale**2)


def reconstruct(
    left: np.ndarray, right: np.ndarray, rig: StereoRig | Calibration, *, setting: str = "quality",
    method: str | Callable | None = None, refine: bool | None = None,
    u_landmarks: tuple[ArrayLike, ArrayLike] | None = None, mask_left: np.ndarray | None = None,
    mask_right: np.ndarray | None = None, percentiles: tuple[float, float] = (0.0, 100.0),
    control: tuple[int, int] = (20, 20), smoothness: float | None = None, depth_only: bool | None = None,
    depth_range_mm: tuple[float, float] | None = None, max_epipolar_px: float = 6.0, seconds: dict[str, float] | None = None,
) -> Reconstruction:  # fmt: skip
    """Reconstruct the surface that a calibrated stereo pair shows.

    Args:
        left, right: (h, w, 3) uint8 RGB.
        rig: The cameras, or the calibration that found them.
        setting: "quality", or "fast" for several pairs a second: coarser matching (see `lib.matching.match`), an
            approximate choice of smoothness, and `depth_only`.
        method: The matcher; see `lib.matching.match`.
        refine: Correct the rig with a first, fast matching (`refine_rig`); None = if a calibration is given.
        u_landmarks: Landmarks of the tool, (3, 2) px left and right, to mask the tool; NaN = missing.
        mask_left, mask_right: (h, w) bool, True = ignore, in addition to glints, darkness and tool.
        percentiles: (low, high) of the matches' coordinates that bound the surface's domain; (1, 99) leaves out the rim.
        control, smoothness: As for `fit_surface`; the smoothness of an earlier frame (`surface.fit.smoothness`) saves time.
        depth_only: Fit one spline instead of three: the depth along the rays of the left camera, which must be affine.
            None is True in the fast setting with an affine rig.
        depth_range_mm, max_epipolar_px: As for `match`; the `depth_range_mm` of an earlier frame's result saves time.
        seconds: A dictionary to which each stage adds its seconds as it ends, also if it fails.

    A ValueError refuses wrong arguments, and images without matches; see also `match` and `fit_surface`.

    >>> from lib import paths
    >>> from lib.recordings import Recording
    >>> recording = Recording.open(paths.SHIPPED_RECORDING)
    >>> pair, truth = recording.frames[0], recording.truth
    >>> tool = truth.u_left[0], truth.u_right[0]
    >>> found = reconstruct(pair.left, pair.right, truth.rig, setting="fast", u_landmarks=tool)
    >>> bool(len(found.u) > 3000 and found.surface.distance([truth.landmarks_mm[0, 1]], truth.rig.left).along_view_mm > 0)
    True
    """
    seconds = {} if seconds is None else seconds
    calibration, rig = (rig, rig.pair) if isinstance(rig, Calibration) else (None, rig)
    if refine and calibration is None:
        raise ValueError("refine: needs the covariance of the rig; give the Calibration in place of its rig.")
    refine = calibration is not None if refine is None else refine
    low, high = percentiles
    if not 0 <= low < high <= 100:
        raise ValueError(f"percentiles: expected 0 <= low < high <= 100, got {percentiles}.")
    fast = setting == "fast"

    with _timed(seconds, "mask"):
        masks = {f"mask_{name}": glint_mask(image) | dark_mask(image) for name, image in (("left", left), ("right", right))}
        for side, (name, given) in enumerate((("mask_left", mask_left), ("mask_right", mask_right))):
            if masks[name].all():
                raise ValueError(f"{name.removeprefix('mask_')}: the whole image is saturated; change the exposure.")
            if u_landmarks is not None:
                masks[name] |= tool_mask(masks[name].shape, u_landmarks[side])
            if given is not None:
                masks[name] |= checked_mask(given, masks[name].shape, name)
    if refine:
        with _timed(seconds, "refine"):
            rig = refine_rig(calibration, match(left, right, rig=rig, setting="fast", **masks))
    with _timed(seconds, "match"):
        where = {"depth_range_mm": depth_range_mm, "max_epipolar_px": max_epipolar_px}
        found = match(left, right, rig=rig, method=method, setting=setting, **where, **masks)
    with _timed(seconds, "triangulate"):
        matches = found.keep(epipolar_inliers(rig, found))
        points = rig.triangulate(matches.u_left, matches.u_right, matches.covariance_px2)
        accompanied = in_company(points.x_mm)
        matches, points = matches.keep(accompanied), points.keep(accompanied)
    with _timed(seconds, "surface"):
        if len(matches) < (least := fewest_points(control)):
            cure = "Are both images sharp and textured, do they show the same part, does the rig fit?"
            cure += " The texture repeats, so most matches fit several places." if found.ambiguous > 0.5 else ""
            raise ValueError(f"left, right: {len(matches)} matches lie on their epipolar lines; {least} are needed. {cure}")
        domain = tuple(np.percentile(matches.u_left, percentiles, axis=0).ravel().tolist())
        depth_only = fast and rig.is_affine if depth_only is None else depth_only
        how = {"control": control, "smoothness": smoothness, "camera": rig.left if depth_only else None, "quick": fast}
        surface = fit_surface(matches.u_left, points.x_mm, domain=domain, **how)
        # Along the lines the surface follows errors that neighbours share.  Across them no surface hides these errors.
        kept = surface.inliers
        off = _off_lines(rig, matches)[kept, None]
        inflation = float(sign_inflation(surface.grid, matches.u_left[kept], off, _SHARED_CELLS)[0])
        surface = replace(surface, fit=replace(surface.fit, inflation=inflation))
        points = as_scattered(points, points.x_mm - surface(matches.u_left), rig.left.viewing_direction, kept)
    return Reconstruction(surface, points, matches, len(found), masks["mask_left"], rig, dict(seconds))


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds.pop(stage, None)  # so that the stage stands last
        seconds[stage] = time.perf_counter() - start
