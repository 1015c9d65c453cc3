"""Robust search for the detections that agree on an affine camera (the inliers), in each camera separately.

Random samples of four points give affine cameras, ranked by the sum of log distances (the scale of each row is marginalised).
The best ones start an expectation maximisation of a mixture of three populations: inliers (Gaussian), outliers near the tool
(a Gaussian at least four times as wide), and outliers anywhere (uniform).  A few rows cannot determine a mixture.  There a
forward search starts from the half of the rows that agrees best and adds one row after another.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from lib.calibration.affine import regress
from lib.correspondences import DataError

FALSE_ALARM = 1e-4
_SAMPLES = (100, 300, 1000)  # numbers of samples, tried one after another until some are free of outliers
_ROWS_RANKED = 300  # number of rows by which samples are ranked
_STARTS = 12  # number of samples that start the expectation maximisation
_FEW = 25  # number of a view's rows below which the forward search is used
_MORE_THAN_CHANCE = 5.0  # difference of log evidence: in clean data a subset agrees better than all rows by up to 4
_LEAST_SHARE = 0.25  # smallest share of inliers in a view
_STILL = 0.03  # the inliers' extent in an image, as a share of that of all rows, below which they stand still
#: The wider Gaussian is the heavy tail of the inliers if it is at most this many times as wide, else it is contamination.
_CONTRAST = 8.0
#: Largest noise as a share of the pixels' extent: with outliers that are not clearly separated, and otherwise.
_LARGEST_NOISE = (0.01, 0.25)
_TAILS = 0.1  # share of outliers that may still be the tails of the noise; a larger share must be clearly separated
_LOOSE = 3.0  # factor on the largest noise up to which offsets of the landmarks may be the reason
#: Rounds of the fit of a camera at a finite distance, and its largest noise relative to that of the first camera of its rows.
_ROUNDS, _ALIKE = 4, 1.1
_NEARLY_ALL = 0.8  # if a camera explains more than this share of the rows, a subset may agree better by chance

NO_CONSENSUS_CURE = "check that x_mm and u belong together (frames, landmarks, clocks) and that the detector knows this tool"


class NoConsensusError(DataError):
    """The rows agree on no camera, or on two that compete; the text says which, how many rows, and the cure."""

    def __init__(self, text: str, sigma_px: float = np.nan) -> None:  # a process that gets it sets the number later
        super().__init__(text)
        self.sigma_px = sigma_px


class LooseCameraError(NoConsensusError):
    """Most rows agree on one camera, but loosely, by `sigma_px`; constant offsets of the landmarks may be the reason."""


class CompetingCamerasError(NoConsensusError):
    """Some rows agree on one camera, by `sigma_px`, and as many others on another one."""


def gate(n: int) -> float:
    """Largest squared Mahalanobis distance of an inlier in an image, exceeded in 1 of 10 000 data sets of n rows."""
    return float(2.0 * np.log(n / FALSE_ALARM))  # a quantile of chi-square with 2 degrees of freedom


def consensus(
    x: np.ndarray, y: np.ndarray, threshold_px: float | None, rng: np.random.Generator, *, sigma_x_mm: float | None = None,
    near: bool = False,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Inlier views (n, cameras) bool of positions x (n, 3) mm and pixels y (n, m), NaN = not seen, and gates (cameras,).

    A gate is the squared Mahalanobis distance up to which a row is more probably an inlier than an outlier.  `threshold_px`
    is the largest reprojection error of an inlier; None estimates the noise instead.  Samples thinner than five times the
    robot's accuracy `sigma_x_mm` are not used.  `near`: the cameras may be at a finite distance.  A `NoConsensusError` says
    why the rows agree on no camera.
    """
    views = np.isfinite(y).reshape(len(y), -1, 2).all(axis=2)
    names, gates = ["u_left", "u_right"] if views.shape[1] == 2 else ["u"], []
    for c, name in enumerate(names):
        rows = np.flatnonzero(views[:, c])
        found = _one_camera(name, x[rows], y[rows, 2 * c : 2 * c + 2], threshold_px, rng, 5.0 * (sigma_x_mm or 0.0), near)
        views[rows, c] = found.keep
        gates.append(found.gate2)
    return views, np.array(gates)


class _Found(NamedTuple):
    """The rows `keep` (n,) bool that agree on a camera `matrix` (2, 4), their noise, that of the wider Gaussian, the gate."""

    keep: np.ndarray
    matrix: np.ndarray
    sigma_px: float
    wider_px: float
    gate2: float


def _one_camera(
    name: str, x: np.ndarray, u: np.ndarray, threshold_px: float | None, rng: np.random.Generator, least_mm: float, near: bool
) -> _Found:
    """The rows of x (n, 3) and u (n, 2) that agree on a camera; a NoConsensusError if there is none, or more than one."""
    n = len(u)
    if n < 8:
        return _Found(np.ones(n, dtype=bool), regress(x, u), 0.0, np.inf, np.inf)
    if threshold_px is None and n < _FEW:
        found = _by_growth(x, u, rng, least_mm)
        enough = min(8, n - n // 4)
    else:
        found = _tightest(x, u, threshold_px, rng, least_mm)
        enough = max(8, int((_LEAST_SHARE if threshold_px is None else 0.1) * n))
    count, extent = int(found.keep.sum()), float(np.sqrt(np.prod(_extent(u))))
    if count < enough:
        what = f"only {count} of {n} rows agree on an affine camera"
        raise NoConsensusError(f"{name}: no consensus, {what}; {NO_CONSENSUS_CURE}.")
    if n - count > 0.2 * n and (_extent(u[found.keep]) < _STILL * _extent(u).max()).all():
        what = f"the {count} of {n} rows that agree stand still in the image, so they show no moving tool"
        raise NoConsensusError(f"{name}: no consensus, {what}; {NO_CONSENSUS_CURE}.")
    apart = n - count <= _TAILS * n or found.wider_px >= _CONTRAST * found.sigma_px
    if found.sigma_px > _LARGEST_NOISE[1 if apart else 0] * extent:
        what = f"no affine camera agrees: the best one errs by {found.sigma_px:.3g} px in {count} of {n} rows"
        text = f"{name}: no consensus, {what}, and the others are not clearly separated; {NO_CONSENSUS_CURE}."
        loose = 2 * count > n and found.sigma_px < _LOOSE * _LARGEST_NOISE[0] * extent
        raise LooseCameraError(text, found.sigma_px) if loose else NoConsensusError(text)
    rest, least = np.flatnonzero(~found.keep), max(10, 0.2 * n, 0.5 * count)
    if threshold_px is not None or len(rest) < least:
        return found
    other = _tightest(x[rest], u[rest], None, rng, least_mm)
    first, second = np.flatnonzero(found.keep), rest[other.keep]
    r = u[second] - x[second] @ found.matrix[:, :3].T - found.matrix[:, 3]
    beside = np.sqrt((r**2).sum(axis=1).mean() / 2) > max(_CONTRAST * found.sigma_px, _LARGEST_NOISE[0] * extent)
    if len(second) < least or other.sigma_px > 3.0 * found.sigma_px or not beside:
        return found
    if near and (joint := _at_finite_distance(x, u, np.union1d(first, second), found)):
        return joint
    early, late = sorted((first, second), key=np.median)
    cut = np.sort(np.concatenate([first, second]))[len(early)]
    if (early < cut).mean() + (late >= cut).mean() > 1.8:
        cure = f"rows up to {cut - 1} and the later ones: the camera moved or a clock jumped, calibrate each part alone"
    else:
        cure = "mixed over the recording: look for two tools, two clocks, or landmarks that are mistaken for each other"
    text = f"{name}: two consensuses compete, {len(first)} and {len(second)} of {n} rows agree on two cameras; {cure}."
    raise CompetingCamerasError(text, found.sigma_px)


def _at_finite_distance(x: np.ndarray, u: np.ndarray, rows: np.ndarray, found: _Found) -> _Found | None:
    """The rows of both cameras that compete, if one at a finite distance explains them as well as `found` its own, else None.

    It images x at u = M [x; 1] - z (u - c) / d, with z along the view, and c the middle of the pixels.
    """
    n, matrix, centre = len(u), found.matrix, np.median(u, axis=0)
    H = np.column_stack([x, np.ones(n)])
    for _ in range(_ROUNDS):
        view = np.cross(*matrix[:, :3])
        z = (x - x.mean(axis=0)) @ (view / max(np.linalg.norm(view), 1e-300))
        of_matrix = np.einsum("ij,nk->nijk", np.eye(2), H).reshape(n, 2, 8)
        D = np.concatenate([of_matrix, (z[:, None] * (centre - u))[..., None]], axis=2)
        beta = np.linalg.lstsq(D[rows].reshape(-1, 9), u[rows].ravel())[0]
        matrix, r2 = beta[:8].reshape(2, 4), ((u - D @ beta) ** 2).sum(axis=1)
    sigma = float(np.sqrt(np.median(r2[rows]) / (2 * np.log(2))))  # of a coordinate
    keep = r2 < gate(n) * sigma**2
    alike = sigma <= _ALIKE * found.sigma_px and keep[rows].mean() >= _NEARLY_ALL and (1.0 + beta[8] * z[keep] > 0).all()
    return _Found(keep, matrix, sigma, np.inf, gate(n)) if alike else None


def _by_growth(x: np.ndarray, u: np.ndarray, rng: np.random.Generator, least_mm: float) -> _Found:
    """Forward search for few rows: starts from the half that agrees best, adds the next best row while it passes an F test.

    Among few rows, some minimal sample always fits a few others by chance, so its residuals underestimate the noise
    (Atkinson and Riani, "Robust diagnostic regression analysis", 2000).
    """
    n, size = len(u), (len(u) + 5) // 2
    centred, H = (np.column_stack([positions, np.ones(n)]) for positions in (x - x.mean(axis=0), x))
    distance2 = _distances2(centred, u, _sampled(centred, u, 300, rng, least_mm))
    best = np.partition(distance2, n // 2, axis=1)[:, n // 2].argmin()  # least median of squares
    keep = np.argsort(distance2[best])[:size]
    for _ in range(10):  # concentration steps: refit, then keep the nearest rows
        keep, before = np.argsort(((u - H @ regress(x[keep], u[keep]).T) ** 2).sum(axis=1))[:size], keep
        if set(keep) == set(before):
            break
    while len(keep) < n:
        r = u - H @ regress(x[keep], u[keep]).T
        freedom = 2 * (len(keep) - 4)
        variance = (r[keep] ** 2).sum() / max(freedom, 1) + (1e-11 * np.abs(u).max()) ** 2
        # The residual of a row outside the fit also contains the fit's uncertainty.
        leverage = np.einsum("ni,ij,nj->n", H, np.linalg.pinv(H[keep].T @ H[keep]), H)
        distance2 = (r**2).sum(axis=1) / variance / (1.0 + leverage)
        distance2[keep] = -1.0
        order = np.argsort(distance2)
        if distance2[order[len(keep)]] > 2.0 * fdtri(2, max(freedom, 1), 1.0 - FALSE_ALARM / n):
            break
        keep = order[: len(keep) + 1]
    matrix = regress(x[keep], u[keep])
    r = u[keep] - x[keep] @ matrix[:, :3].T - matrix[:, 3]
    sigma = float(np.sqrt((r**2).sum() / max(r.size - 8, 2)))
    return _Found(np.isin(np.arange(n), keep), matrix, sigma, np.inf, gate(n))


def _extent(u: np.ndarray) -> np.ndarray:
    """(2,) width and height of the area of the pixels, robust to 10 % of outliers at each end."""
    low, high = np.transpose([np.interp([0.1, 0.9], np.linspace(0, 1, len(u)), np.sort(one)) for one in u.T])
    return np.maximum((high - low) / 0.8, 1e-9)


def _sampled(H: np.ndarray, u: np.ndarray, count: int, rng: np.random.Generator, least_mm: float) -> np.ndarray:
    """Cameras (up to count, 4, 2) from H = [x, 1] (n, 4) and u (n, 2), each through four points that span a large volume."""
    n, x = len(H), H[:, :3]
    sets = np.argpartition(rng.random((3 * count, n)), 4, axis=1)[:, :4] if n < 40 else rng.integers(0, n, (3 * count, 4))
    volume = np.abs(np.linalg.det(x[sets[:, 1:]] - x[sets[:, :1]]))
    sets, volume = (values[np.argsort(-volume)[:count]] for values in (sets, volume))  # those of the largest volume
    corners, least = x[sets] - x[sets].mean(axis=1, keepdims=True), 1e-6 * np.abs(x).max()  # rounding errors are 1e-8
    thick = volume / np.maximum((corners**2).sum(axis=(1, 2)), 1e-300)  # a lower bound
    thin = thick <= max(least, least_mm)
    thick[thin] = np.sqrt(np.maximum(np.linalg.eigvalsh(corners[thin].mT @ corners[thin])[:, 0], 0.0))
    if not (spans := thick > least).any():
        raise DataError("x_mm: no four of the positions span a volume; move the tool through more places and depths.")
    sets, thick = sets[spans], thick[spans]
    fine = thick > least_mm
    sets = sets[fine] if fine.sum() >= 20 else sets[np.argsort(-thick)[:20]]
    return np.linalg.solve(H[sets], u[sets])


def _distances2(H: np.ndarray, u: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Squared distances (k, n) of pixels u (n, 2) to the projections of H (n, 4) by cameras M (k, 4, 2)."""
    r = (M.transpose(2, 0, 1).reshape(-1, 4) @ H.T).reshape(2, len(M), len(H))
    r -= u.T[:, None]
    return r[0] ** 2 + r[1] ** 2


def _scale_free(distance2: np.ndarray, area: float) -> np.ndarray:
    """Scores (k,) of cameras from squared distances (k, n), low = good: a sum of logs, which assumes no noise level."""
    return np.log(np.minimum(distance2, area / np.pi) + 1e-7 * area).sum(axis=1)


def tightest_sample(x: np.ndarray, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The camera (2, 4) through four of the points x (n, 3) mm that is nearest to most of the pixels u (n, 2)."""
    H = np.column_stack([x, np.ones(len(x))])
    M = _sampled(H, u, 150, rng, 0.0)
    return M[_scale_free(_distances2(H, u, M), float(np.prod(_extent(u)))).argmin()].T


def _tightest(x: np.ndarray, u: np.ndarray, threshold_px: float | None, rng: np.random.Generator, least_mm: float) -> _Found:
    """The inliers of the camera of maximum evidence, or with `threshold_px` of the one with the least MSAC score."""
    n, middle = len(u), np.median(u, axis=0)
    u = u - middle
    area = float(np.prod(_extent(u)))
    H = np.column_stack([x - x.mean(axis=0), np.ones(n)])
    some = np.arange(n) if n <= _ROWS_RANKED else rng.choice(n, _ROWS_RANKED, replace=False)
    M, score, near2 = np.empty((0, 4, 2)), np.empty(0), np.empty(0)
    for count in _SAMPLES:
        new = _sampled(H, u, count, rng, least_mm)
        distance2 = _distances2(H[some], u[some], new)
        ranks = _scale_free(distance2, area) if threshold_px is None else np.minimum(distance2, threshold_px**2).sum(axis=1)
        rank = min(max(6, int(0.15 * len(some))), len(some) - 1)
        low = np.partition(distance2, rank, axis=1)[:, rank]
        M, score, near2 = (np.concatenate(pair) for pair in ((M, new), (score, ranks), (near2, low)))
        best = np.argsort(score)[:_STARTS]
        M, score, near2 = M[best], score[best], near2[best]
        # If more than half of the rows agree with the best sample, enough samples are free of outliers.
        if threshold_px is None and (_distances2(H[some], u[some], M[:1])[0] < 16.0 * near2[0]).mean() > 0.5:
            break
    if threshold_px is not None:
        keep, before = _distances2(H, u, M[:1])[0] < threshold_px**2, None
        for _ in range(10):  # refitted until the rows no longer change
            if keep.sum() < 5 or np.array_equal(keep, before):
                break
            keep, before = _distances2(H, u, regress(H[keep, :3], u[keep]).T[None])[0] < threshold_px**2, keep
        return _Found(keep, regress(H[keep, :3], u[keep]) if keep.sum() > 3 else np.zeros((2, 4)), 0.0, np.inf, np.inf)
    scales = np.sqrt(np.append(near2 / 8, np.median(_distances2(H[some], u[some], M[:4]), axis=1)))
    M, scales, share, evidence = _mixture(H[some], u[some], np.concatenate([M, M[:4]]), scales, area, 8)
    # Continue with the best of each noise level and with the one of most rows; the others would converge to the same.
    order = np.argsort(-evidence)
    level = np.round(3.0 * np.log(scales[order, 0]))
    few = order[np.sort(np.unique(level, return_index=True)[1])][:5]
    few = np.unique([*few, share[:, 0].argmax()])
    M, scales, share, evidence = _mixture(H[some], u[some], M[few], scales[few, 0], area, 50)
    # If a camera explains nearly all rows, one that explains fewer must have a clearly higher evidence.
    best, most = evidence.argmax(), share[:, 0].argmax()
    chance = evidence[best] < evidence[most] + _MORE_THAN_CHANCE or share[best, 0] < _LEAST_SHARE
    best = most if share[most, 0] > _NEARLY_ALL and chance else best
    if len(some) < n:
        M, scales, share, _ = _mixture(H, u, M[[best]], scales[[best], 0], area, 30)
        best = 0
    sigma, wider = scales[best].tolist()
    share = share[best]
    gate2 = gate(n)
    if wider > _CONTRAST * sigma:  # contamination: keep a row if it is more probably an inlier than an outlier
        wrong = share[1] / wider**2 + 2.0 * np.pi * share[2] / area
        gate2 = float(np.clip(2.0 * np.log(share[0] / sigma**2 / wrong), 4.0, gate2))
    keep = _distances2(H, u, M[[best]])[0] < gate2 * sigma**2
    matrix = M[best].T.copy()
    matrix[:, 3] += middle - matrix[:, :3] @ x.mean(axis=0)
    return _Found(keep, matrix, sigma, wider, gate2)


def _mixture(
    H: np.ndarray, u: np.ndarray, M: np.ndarray, sigma: np.ndarray, area: float, rounds: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Expectation maximisation of the three populations from k cameras M (k, 4, 2) and noise levels `sigma` (k,).

    Returns the cameras, scales (k, 2) and shares (k, 3) of the populations, and the log evidence (k,): the likelihood with
    the cameras integrated out.  The evidence is low for a camera that fits a few rows closely by chance.
    """
    n, k, side = len(u), len(M), np.sqrt(area)
    products = np.hstack([(H[:, :, None] * other[:, None]).reshape(n, -1) for other in (H, u)])
    floor = 1e-7 * side
    variance = np.array([np.maximum(sigma, floor), np.maximum(6.0 * sigma, 0.017 * side)]) ** 2  # (2, k)
    share = np.tile([[0.4], [0.3], [0.3]], k)  # (3, k)
    before, distance2 = -np.inf, _distances2(H, u, M)
    for i in range(rounds):
        scale = 1.0 / variance
        at_peak = share[:2] * scale * (area / (2.0 * np.pi * share[2]))
        # Odds relative to the uniform population; the exponential is slow below -500.
        p = at_peak[:, :, None] * np.exp(np.maximum((-0.5 * scale)[:, :, None] * distance2, -500.0))
        total = 1.0 + p[0] + p[1]
        likelihood = np.log(total).sum(axis=1) + n * np.log(share[2] / area)
        if i > 5 and (likelihood - before < 1e-3).all():
            break
        p /= total
        before = likelihood
        moments = (p[0] * scale[0, :, None] + p[1] * scale[1, :, None]) @ products
        moments[:, :16:5] += 1e-12 * moments[:, :16:5].sum(axis=1, keepdims=True)  # the diagonal
        G = moments[:, :16].reshape(k, 4, 4)
        M = np.linalg.solve(G, moments[:, 16:].reshape(k, 4, 2))
        distance2 = _distances2(H, u, M)
        mass, squares = p.sum(axis=2), np.einsum("ckn,kn->ck", p, distance2)
        # The camera's eight parameters cost degrees of freedom of both populations, in proportion to their weights.
        lost = 8.0 * mass[0] / (mass[0] + mass[1] * variance[0] / variance[1])
        first = np.maximum(squares[0] / np.maximum(2.0 * mass[0] - lost, 1.0), floor**2)
        second = np.maximum(squares[1] / np.maximum(2.0 * mass[1], 1e-9), 16.0 * first)
        variance = np.array([first, np.minimum(second, (0.1 * side + 4.0 * np.sqrt(first)) ** 2)])
        share = np.array([*(mass + 1.0), n + 1.0 - mass[0] - mass[1]]) / (n + 3)
    return M, np.sqrt(variance.T), share.T, likelihood - np.linalg.slogdet(G)[1]
