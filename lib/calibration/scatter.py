"""Covariance of estimates whose noise level is estimated and whose errors are correlated between neighbouring frames.

The errors of a landmark are modelled as a first-order autoregression over the frames.  Its correlation follows from the
residuals (restricted maximum likelihood, averaged over the posterior).  The estimates do not change; their covariance is the
sandwich H^-1 (J^T W R W J) H^-1 (Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986).
"""

import numpy as np
from scipy.special import chdtri, fdtri

from lib.least_squares import inverse

_CORRELATIONS = np.array([0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.88, 0.94, 0.97])
_PRIOR = np.append(0.5, np.full(8, 0.5 / 8))  # prior probability of each: even odds that the errors are independent


def sandwich(
    J: np.ndarray, weight: np.ndarray, r: np.ndarray, frame: np.ndarray | None = None, landmark: np.ndarray | None = None,
    prior: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Covariance (p, p) of estimates from rows of estimated noise level, and the equivalent number of independent rows.

    Args:
        J, weight, r: (n, m, p) derivatives, (1 or n, m, m) inverse covariances, (n, m) residuals; zero where not seen.
        frame, landmark: (n,) of the rows, whose errors may be correlated from frame to frame; None: they are independent.
        prior: (p, p) Fisher information of a prior, 0 if there is none.
    """
    n, m, p = J.shape
    seen = np.broadcast_to(np.diagonal(weight, axis1=1, axis2=2) > 0, (n, m))
    # Half of the coordinates determine the noise along an axis, so 95 % regions of a pair follow F in place of chi-square.
    wider = 4.0 * fdtri(4, max(0.5 * (seen.sum() - p), 3.0), 0.95) / chdtri(4, 0.05)
    values, vectors = np.linalg.eigh(weight)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)
    K, e = root @ J, (root @ r[:, :, None])[:, :, 0]
    information = np.tensordot(K, K, axes=([0, 1], [0, 1])) + prior
    known = inverse(information)
    if frame is None:
        return wider * known, float(n)
    frames = np.unique(frame)
    step = np.median(np.diff(frames)) if len(frames) > 1 else 1.0
    groups = []  # rows of one landmark in one view, in the order of their frames
    for k in np.unique(landmark):
        for c in range(m // 2):
            rows = np.flatnonzero((landmark == k) & seen[:, 2 * c])
            rows = rows[np.argsort(frame[rows], kind="stable")]
            groups.append((rows, slice(2 * c, 2 * c + 2), np.diff(frame[rows]) / step))
    chance, variance = _posterior(K, e, groups, known)
    meat, share = np.zeros((p, p)) + prior, chance * variance
    for rows, view, gaps in groups:
        k, decay = K[rows][:, view], _CORRELATIONS[:, None] ** gaps
        past = np.tile(k[:, None], (1, len(share), 1, 1))  # for each row: the sum of the rows up to it, with decayed weights
        for before, now, kept in zip(past[:-1], past[1:], decay.T[:, :, None, None], strict=True):
            now += kept * before
        half = np.tensordot(k, np.einsum("t,ntip->nip", share, past) - share.sum() / 2 * k, axes=([0, 1], [0, 1]))
        meat += half + half.T
    sd = np.sqrt(np.diag(known))
    unit = np.outer(sd, sd)
    ratio = np.linalg.slogdet(information * unit)[1] - np.linalg.slogdet(meat * unit)[1]
    return wider * known @ meat @ known, float(n * np.exp(min(ratio / p, 0.0)))


def _posterior(K: np.ndarray, e: np.ndarray, groups: list[tuple], known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probability of each correlation, and the variance of the whitened residuals under it relative to that under none."""
    p, unit = K.shape[2], np.linalg.cholesky(known)  # scales the parameters to unit covariance
    both, t = np.concatenate([K, e[:, :, None]], axis=2), len(_CORRELATIONS)
    squares, log = np.zeros((t, p + 1, p + 1)), np.zeros(t)
    for rows, view, gaps in groups:  # subtracting the predicted part whitens an autoregression
        values, kept = both[rows][:, view].reshape(-1, 2 * (p + 1)), _CORRELATIONS[:, None] ** gaps
        sd = np.sqrt(np.maximum(1.0 - kept**2, 1e-9))
        later = (values[1:] - kept[:, :, None] * values[:-1]) / sd[:, :, None]
        white = np.concatenate([np.tile(values[:1], (t, 1, 1)), later], axis=1).reshape(t, -1, p + 1)
        squares += white.mT @ white
        log += 4.0 * np.log(sd).sum(axis=1)
    freedom = max(2 * sum(len(rows) for rows, *_ in groups) - p, 1)
    values, vectors = np.linalg.eigh(unit.T @ squares[:, :p, :p] @ unit)
    values = np.maximum(values, 1e-12)
    along = (squares[:, p:, :p] @ unit @ vectors)[:, 0]
    variance = (squares[:, p, p] - (along**2 / values).sum(axis=1)) / freedom
    likelihood = -0.5 * (log + np.log(values).sum(axis=1) + freedom * np.log(np.maximum(variance, 1e-300)))
    chance = _PRIOR * np.exp(likelihood - likelihood.max())
    return chance / chance.sum(), variance / max(variance[0], 1e-300)
