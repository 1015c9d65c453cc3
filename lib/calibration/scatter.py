"""Covariance of estimates whose noise level is estimated and whose errors are correlated, in time or within a frame.

The errors of a landmark are modelled as a first-order autoregression over the frames.  Its correlation follows from the
residuals (restricted maximum likelihood, averaged over the posterior).  The landmarks of a frame may share an error of the
robot's position, as they do if it reports a pose; its variance follows from the products of their residuals.  The estimates
do not change; their covariance is the sandwich H^-1 (J^T W R W J) H^-1 (Liang and Zeger, "Longitudinal data analysis using
generalized linear models", 1986).
"""

import numpy as np
from scipy.special import chdtri, fdtri

from lib.least_squares import inverse

_CORRELATIONS = np.array([0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.88, 0.94, 0.97])
_PRIOR = np.append(0.5, np.full(8, 0.5 / 8))  # prior probability of each: even odds that the errors are independent


def sandwich(
    J: np.ndarray, weight: np.ndarray, r: np.ndarray, J_x: np.ndarray, frame: np.ndarray | None = None,
    landmark: np.ndarray | None = None, prior: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Covariance (p, p) of estimates from rows of estimated noise level, and the equivalent number of independent rows.

    Args:
        J, weight, r: (n, m, p) derivatives, (1 or n, m, m) inverse covariances of the rows, which include the robot's noise,
            and (n, m) residuals; zero where not seen.
        J_x: (1 or n, m, 3) derivatives by the robot's position.
        frame, landmark: (n,) of the rows, whose errors may be correlated; None: they are independent.
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
    share = chance * variance
    meat = prior + sum(_correlated(K[rows][:, view], gaps, share) for rows, view, gaps in groups)
    meat = meat + _shared(J, weight, r, J_x, frame, landmark, share, known)
    sd = np.sqrt(np.diag(known))
    unit = np.outer(sd, sd)
    ratio = np.linalg.slogdet(information * unit)[1] - np.linalg.slogdet(meat * unit)[1]
    return wider * known @ meat @ known, float(n * np.exp(min(ratio / p, 0.0)))


def _correlated(K: np.ndarray, gaps: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Covariance (p, p) of the sum of the scores K (n, c, p) of successive rows; `share` weights each of `_CORRELATIONS`."""
    decay = _CORRELATIONS[:, None] ** gaps
    past = np.tile(K[:, None], (1, len(share), 1, 1))  # for each row: the sum of the rows up to it, with decayed weights
    for before, now, kept in zip(past[:-1], past[1:], decay.T[:, :, None, None], strict=True):
        now += kept * before
    half = np.tensordot(K, np.einsum("t,ntip->nip", share, past) - share.sum() / 2 * K, axes=([0, 1], [0, 1]))
    return half + half.T


def _shared(
    J: np.ndarray, weight: np.ndarray, r: np.ndarray, J_x: np.ndarray, frame: np.ndarray, landmark: np.ndarray,
    share: np.ndarray, known: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """What errors of the robot's position that the landmarks of a `frame` (n,) share add to the covariance of the scores.

    That is their covariance between two landmarks of a frame; `weight` contains that of a single landmark.  The products of
    the residuals of two landmarks in a frame give the variance of these errors, at most what `weight` allows.  Their
    expectation allows for the part that the fit absorbs, with the `known` covariance (p, p) of independent errors.
    """
    frames, place = np.unique(frame, return_inverse=True)

    def total(values: np.ndarray) -> np.ndarray:
        """The sum in each frame."""
        sums = np.zeros((len(frames), *values.shape[1:]))
        np.add.at(sums, place, values)
        return sums

    moved = np.broadcast_to(weight @ J_x, (len(J), J.shape[1], 3))
    pull, stiff, scores = np.einsum("nmi,nm->ni", moved, r), J_x.mT @ moved, moved.mT @ J
    others = total(scores)[place] - scores  # the sums of the other landmarks in the frame, (n, 3, p)
    product, expected = ((total(one) ** 2).sum() - (one**2).sum() for one in (pull, stiff))
    pairs = known @ np.tensordot(scores, others, axes=([0, 1], [0, 1]))
    expected += np.trace(pairs @ pairs) - 2 * np.einsum("nip,nij,njq,pq->", others, stiff, others, known, optimize=True)
    most_mm2 = 1.0 / max(np.linalg.eigvalsh(stiff).max(), 1e-300)  # beyond it, landmarks would correlate by more than 1
    variance_mm2 = min((product + np.trace(pairs)) / max(expected, 1e-300), most_mm2)
    if len(frames) < 2 or expected <= 0 or variance_mm2 <= 0:
        return np.zeros_like(known)
    gaps = np.diff(frames) / np.median(np.diff(frames))
    own = [_correlated(total(scores * (landmark == k)[:, None, None]), gaps, share) for k in np.unique(landmark)]
    return variance_mm2 * (_correlated(total(scores), gaps, share) - sum(own))


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
