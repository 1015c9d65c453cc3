"""`Matches`: the result of every matcher."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

#: Standard deviation of `u_left`.  The point is chosen, not measured, but the centre of a patch is only this well defined.
SIGMA_LEFT_PX = 0.05


@dataclass(frozen=True, eq=False)
class Matches:
    """Semi-dense matches of a stereo pair.

    Attributes:
        u_left, u_right: (n, 2) px, integer coordinates at pixel centres.  `u_left` lies on a lattice chosen by the matcher.
        score: (n,) confidence in [0, 1], larger is better.  Comparable within one call, not between methods.
        covariance_px2: (n, 4, 4) of (u_left, u_right); the left block is small (see `SIGMA_LEFT_PX`).
        peak_ratio: (n,) response at the match over the best one elsewhere; at 1 or below another position fits as well.
            Infinite if the responses elsewhere are 0, NaN if no other position was searched.
        reciprocal: (n,) bool, True if matching back from the right image leads to the same left patch (DeepMatching,
            band), or to within a pixel (SGBM, DIS).  `match` drops the others by default.
        method: Name of the matcher.
        epipolar_px: Median over the matches of |`StereoRig.epipolar_distance`|; NaN without a rig or matches.
        ambiguous: Share of the precise matches that fit another place on their epipolar line nearly as well (band): their
            score is 0, so `match` drops them by default.  NaN for other matchers.
    """

    u_left: np.ndarray
    u_right: np.ndarray
    score: np.ndarray
    covariance_px2: np.ndarray
    peak_ratio: np.ndarray
    reciprocal: np.ndarray
    method: str
    epipolar_px: float = float("nan")
    ambiguous: float = float("nan")

    @classmethod
    def none(cls, method: str) -> Self:
        """The result of a matcher that found nothing."""
        empty, u = np.zeros(0), np.zeros((0, 2))
        return cls(u, u, empty, np.zeros((0, 4, 4)), peak_ratio=empty, reciprocal=empty.astype(bool), method=method)

    def __len__(self) -> int:
        return len(self.u_left)

    def sigma_along(self, direction: np.ndarray) -> np.ndarray:
        """Standard deviation (n,) px of each match along a direction (4,) of (u_left, u_right)."""
        return np.sqrt(np.einsum("i,nij,j->n", direction, self.covariance_px2, direction))

    def keep(self, chosen: np.ndarray) -> Self:
        """The matches of a mask (n,) or of indices."""
        names = ("u_left", "u_right", "score", "covariance_px2", "peak_ratio", "reciprocal")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})
