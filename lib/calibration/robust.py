"""Joint stereo RANSAC with local optimisation: which rows are correspondences at all.

Samples of four points give both cameras at once; each camera keeps its own best sample, and a row counts only where both
agree.  Local optimisation refits on the rows kept until they no longer change (Chum, Matas and Kittler, "Locally optimized
RANSAC", 2003).  Without a threshold samples are ranked by their median residual (Rousseeuw's least median of squares), the
noise is measured on the rows kept, and a row is dropped where its residual would appear once in 10 000 data sets.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import gammainccinv, gammaincinv
from scipy.stats import f as f_distribution

from lib.calibration.affine import Moments, affine_minimum, distances2, estimate_noise, regress

__all__ = ["NoConsensusError", "consensus", "gate"]

FALSE_ALARM = 1e-4
_ROWS_RANKED = 500
_FEW = 25  # rows, below which the noise of the best sample is no measure


class NoConsensusError(ValueError):
    """The rows agree on no camera, or on two that compete; the text says which, how many rows, and the cure."""


def gate(n: int, m: int) -> float:
    """Largest squared Mahalanobis distance of a row, exceeded once in 10 000 data sets of n rows, m pixels each."""
    return float(2.0 * gammainccinv(m / 2, FALSE_ALARM / n))


def _chi2_quantile(probability: float, freedom: int) -> float:
    """As scipy.stats.chi2.ppf, a hundred times faster."""
    return float(2.0 * gammaincinv(freedom / 2, probability))


def consensus(
    x: np.ndarray, y: np.ndarray, threshold_px: float | None, rng: np.random.Generator, *,
    sigma_x_mm: float | None = None, samples: int = 300,
) -> np.ndarray:  # fmt: skip
    """Rows (n,) bool of x (n, 3) mm and y (n, m) px that agree on one pair of affine cameras.

    `threshold_px` is the largest reprojection distance of a row in any image; None measures the noise and decides by it.
    Samples thinner than five times the robot's accuracy `sigma_x_mm` are not used.  A `NoConsensusError` says that no affine
    camera explains enough rows: a quarter of them, with a threshold a tenth, and eight.
    """
    n, m = y.shape
    if n < 8:
        return np.ones(n, dtype=bool)
    x = x - x.mean(axis=0)
    y_scale = float(y.std(axis=0).max())
    sets = _samples(x, samples, rng, 5.0 * (sigma_x_mm or 0.0))
    H = np.column_stack([x, np.ones(n)])
    M = np.linalg.solve(H[sets], y[sets])  # (s, 4, m)
    rows = np.arange(n) if n <= _ROWS_RANKED else rng.choice(n, _ROWS_RANKED, replace=False)
    residuals = (H[rows] @ M.transpose(1, 0, 2).reshape(4, -1)).reshape(len(rows), len(sets), m // 2, 2)
    residuals -= y[rows].reshape(len(rows), 1, m // 2, 2)
    distance2 = np.einsum("rsck,rsck->csr", residuals, residuals)  # (cameras, samples, rows)
    if threshold_px is None:
        score = np.partition(distance2, len(rows) // 2, axis=2)[:, :, len(rows) // 2]
    else:
        score = np.minimum(distance2, threshold_px**2).sum(axis=2)  # MSAC
    best = score.argmin(axis=1)
    fits = np.hstack([M[b][:, 2 * c : 2 * c + 2] for c, b in enumerate(best)])
    distance2 = ((y - H @ fits) ** 2).reshape(n, m // 2, 2).sum(axis=2)
    if threshold_px is not None:

        def near(keep: np.ndarray) -> np.ndarray:
            r = y - H @ regress(x[keep], y[keep]).T
            return ((r**2).reshape(n, -1, 2).sum(axis=2) < threshold_px**2).all(axis=1)

        keep = _settled(near, (distance2 < threshold_px**2).all(axis=1), 5)
        enough = max(8, n // 10)
    elif n < _FEW:
        keep = _by_growth(x, y, distance2.max(axis=1))
        enough = min(8, n - n // 4)
    else:
        # The median of |r|^2 is 1.386 variances where the noise is Gaussian.
        scale2 = np.median(distance2, axis=0) / _chi2_quantile(0.5, 2) + 1e-18 * y_scale**2
        keep = (distance2 < _chi2_quantile(0.99, 2) * scale2).all(axis=1)
        keep = _by_noise(x, y, keep)
        enough = max(8, int(0.25 * n))
    if keep.sum() < enough:
        raise NoConsensusError(
            f"u: only {int(keep.sum())} of {n} rows agree on affine cameras; check that x_mm and u belong together "
            "(frames, order of landmarks, time offset), or raise ransac_px."
        )
    rms = np.sqrt(((y[keep] - H[keep] @ regress(x[keep], y[keep]).T) ** 2).mean())
    if rms > 0.25 * np.sqrt(y[keep].var(axis=0).mean()):
        raise NoConsensusError(
            f"u: no consensus, all rows look like outliers: the best affine cameras leave {rms:.3g} px RMS; check that x_mm "
            "and u belong together."
        )
    return keep


def _samples(x: np.ndarray, count: int, rng: np.random.Generator, least: float) -> np.ndarray:
    """Sets (count, 4) of rows whose four points span a volume."""
    n = len(x)
    thickness = np.sqrt(np.linalg.eigvalsh(x.T @ x / n)[0])
    sets = np.argpartition(rng.random((3 * count, n)), 4, axis=1)[:, :4] if n < 40 else rng.integers(0, n, (3 * count, 4))
    corners = x[sets] - x[sets].mean(axis=1, keepdims=True)
    smallest = np.sqrt(np.maximum(np.linalg.eigvalsh(np.swapaxes(corners, 1, 2) @ corners)[:, 0], 0.0))
    good = sets[smallest > max(least, 0.3 * thickness)]
    if len(good) < 20:  # thin data: take the best there are
        best = np.argsort(-smallest)[:count]
        good = sets[best[smallest[best] > 1e-9 * thickness]]
    return good[:count]


def _settled(judge: Callable[[np.ndarray], np.ndarray], keep: np.ndarray, fewest: int, rounds: int = 10) -> np.ndarray:
    """The rows (n,) bool that `judge` keeps, refitted to them until they no longer change."""
    for _ in range(rounds):
        if keep.sum() < fewest:
            break
        keep, before = judge(keep), keep
        if (keep == before).all():
            break
    return keep


def _by_growth(x: np.ndarray, y: np.ndarray, distance2: np.ndarray) -> np.ndarray:
    """Few rows: from the half that agrees best, taking in the next best row as long as an F test lets it.

    Of few rows some minimal sample always fits a few others by chance, so its residuals say too little about the noise
    (Atkinson and Riani, "Robust diagnostic regression analysis", 2000: the forward search).
    """
    n, m = y.shape
    H, size = np.column_stack([x, np.ones(n)]), (n + 5) // 2
    keep = np.argsort(distance2)[:size]
    for _ in range(10):  # concentrate: the rows nearest to their own fit
        keep, before = np.argsort(((y - H @ regress(x[keep], y[keep]).T) ** 2).sum(axis=1))[:size], keep
        if set(keep) == set(before):
            break
    while len(keep) < n:
        M = regress(x[keep], y[keep])
        r = y - H @ M.T
        sigmas = estimate_noise(r[keep], M[:, :3], 4 * m)
        # A row outside the fit is predicted with the fit's own uncertainty.
        leverage = np.einsum("ni,ij,nj->n", H, np.linalg.inv(H[keep].T @ H[keep]), H)
        distance2 = distances2(r, M[:, :3], *sigmas, 1e-11 * np.abs(y).max()) / (1.0 + leverage)
        distance2[keep] = -1.0
        order, freedom = np.argsort(distance2), m * (len(keep) - 4) // 2
        if distance2[order[len(keep)]] > m * f_distribution.isf(FALSE_ALARM / n, m, max(freedom, 1)):
            break
        keep = order[: len(keep) + 1]
    return np.isin(np.arange(n), keep)


def _by_noise(x: np.ndarray, y: np.ndarray, keep: np.ndarray) -> np.ndarray:
    n, m = y.shape

    def distance2(keep: np.ndarray) -> np.ndarray:
        fitted = affine_minimum(Moments.of(x[keep], y[keep]), 1.0, 0.0).matrix
        r = y - x @ fitted[:, :3].T - fitted[:, 3]
        sigmas = estimate_noise(r[keep], fitted[:, :3], 4 * m)
        # Rounding sets the floor for data without noise.
        found = distances2(r, fitted[:, :3], *sigmas, 1e-11 * np.abs(y).max())
        # Heavy tails or a model error widen the bound: the median of the distance is known.
        return found / max(1.0, np.median(found[keep]) / _chi2_quantile(0.5, m))

    # A first cut at 99 % and a last at the gate: the noise is measured on a set that is not yet contaminated.
    keep = _settled(lambda keep: distance2(keep) < _chi2_quantile(0.99, m), keep, 6, rounds=3)
    return _settled(lambda keep: distance2(keep) < gate(n, m), keep, 6)
