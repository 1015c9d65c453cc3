"""Which model do the data ask for: likelihood-ratio tests and BIC over the ladder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from lib.calibration.calibration import Calibration
from lib.calibration.estimate import calibrate

__all__ = ["LADDER", "Comparison", "Rung", "compare_models"]

#: From the stiffest to the freest; a pair's cameras have their own zoom, so `common_zoom` is the first to fall.
LADDER = (
    "common_zoom",
    "square",
    "zero_skew",
    "affine",
    "square+distance",
    "zero_skew+distance",
    "zero_skew+distances",
    "affine+distance",
    "zero_skew+distance+radial",
)
#: Each model's next freer one, whose likelihood-ratio test asks whether the constraint between them holds.
_FREER = {
    "common_zoom": "square",
    "square": "zero_skew",
    "zero_skew": "affine",
    "affine": "affine+distance",
    "square+distance": "zero_skew+distance",
    "zero_skew+distance": "zero_skew+distances",
    "zero_skew+distances": None,
    "affine+distance": None,
    "zero_skew+distance+radial": None,
}


@dataclass(frozen=True)
class Rung:
    """One model on the data.

    Attributes
    ----------
    model, parameters:
        Its name and number of parameters.
    chi_square:
        Twice the energy at the common noise levels.
    bic:
        chi_square + parameters ln(number of pixel coordinates); the least is the choice.
    against, p_value:
        The freer model it is nested in, and the probability of a larger likelihood ratio if the constraint is true.
    calibration:
        The fit.
    """

    model: str
    parameters: int
    chi_square: float
    bic: float
    against: str | None
    p_value: float
    calibration: Calibration


@dataclass(frozen=True)
class Comparison:
    """All rungs at the noise levels of the freest, and the model that BIC chooses."""

    rungs: list[Rung]
    sigma_u_px: float
    sigma_x_mm: float

    @property
    def best(self) -> Rung:
        """The rung of least BIC."""
        return min(self.rungs, key=lambda rung: rung.bic)

    def __getitem__(self, model: str) -> Rung:
        return next(rung for rung in self.rungs if rung.model == model)

    def __str__(self) -> str:
        lines = [f"{'model':28s} {'par':>4s} {'chi2':>10s} {'BIC - best':>10s} {'p(constraint)':>14s}"]
        for rung in self.rungs:
            p = "" if rung.against is None else f"{rung.p_value:.3g}"
            mark = " <- chosen" if rung is self.best else ""
            above = rung.bic - self.best.bic
            lines.append(f"{rung.model:28s} {rung.parameters:4d} {rung.chi_square:10.1f} {above:10.1f} {p:>14s}{mark}")
        return "\n".join(lines)


def compare_models(
    x_mm: ArrayLike,
    u: Sequence[ArrayLike],
    *,
    models: Sequence[str] = LADDER,
    sigma_u_px: float | None = None,
    sigma_x_mm: float | None = None,
    covariance_px2: ArrayLike | None = None,
    ransac_px: float | None = None,
    seed: int = 0,
    image_size_px: tuple[int, int] | None = None,
) -> Comparison:
    """Fit every model on the same rows with the same noise levels, and compare.

    The rows and, where not given, the noise levels are those of the freest model (most parameters), so a model error
    shows as chi-square instead of hiding in larger noise.  Arguments as in `calibrate`; of a single camera the models
    that tie two cameras are left out.

    Raises
    ------
    ValueError
        As `calibrate`.
    """
    single = len(u) == 1
    if single:
        models = [m for m in models if m != "common_zoom" and "distances" not in m]
    common = {"covariance_px2": covariance_px2, "seed": seed, "image_size_px": image_size_px}
    fits = [
        calibrate(x_mm, u, model=m, sigma_u_px=sigma_u_px, sigma_x_mm=sigma_x_mm, ransac_px=ransac_px, **common)
        for m in models
    ]
    freest = max(fits, key=lambda c: len(c.parameter_names))
    rows = freest.inliers
    if covariance_px2 is not None and freest.covariance_px2.ndim == 3:
        common["covariance_px2"] = freest.covariance_px2[rows]
    x, pixels = freest.x_mm[rows], [p[rows] for p in np.split(freest.y_px, len(u), axis=1)]
    levels = {"sigma_u_px": freest.sigma_u_px, "sigma_x_mm": freest.sigma_x_mm}
    fits = {m: calibrate(x, pixels, model=m, ransac_px=np.inf, checks=False, **levels, **common) for m in models}
    observations = x.shape[0] * 2 * len(u)
    rungs = []
    for m, c in fits.items():
        k, value = len(c.parameter_names), 2.0 * c.cost
        freer = _FREER.get(m) if _FREER.get(m) in fits else None
        p = np.nan
        if freer is not None:
            gain, more = value - 2.0 * fits[freer].cost, len(fits[freer].parameter_names) - k
            p = float(chi2.sf(max(gain, 0.0), more))
        rungs.append(Rung(m, k, value, value + k * float(np.log(observations)), freer, p, c))
    return Comparison(rungs, freest.sigma_u_px, freest.sigma_x_mm)
