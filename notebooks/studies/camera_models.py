"""Which camera model do the data need?  Likelihood-ratio tests and BIC over nested models."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from lib.calibration.calibration import Calibration
from lib.calibration.estimate import calibrate
from lib.calibration.models import Model
from lib.correspondences import Correspondences

#: Model -> the next more general one, the most constrained first; a likelihood-ratio test of the two decides whether
#: the constraint holds.  The cameras of a pair differ in zoom, so `common_zoom` is the first to be rejected.
_FREER = {
    "common_zoom": "square", "square": "zero_skew", "zero_skew": "affine", "affine": "affine+distance",
    "square+distance": "zero_skew+distance", "zero_skew+distance": "zero_skew+distances", "zero_skew+distances": None,
    "affine+distance": None, "zero_skew+distance+radial": None,
}  # fmt: skip
LADDER = tuple(_FREER)


@dataclass(frozen=True)
class Rung:
    """One model fitted to the data: its name, its number of `parameters` and the fit.

    Attributes:
        chi_square, bic: Twice the energy at the common noise levels; this plus parameters * ln(number of pixel coordinates).
        against, p_value: The model in which it is nested; probability of a larger likelihood ratio if the constraint is true.
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
    """All models at the noise levels of the most general one, and the model that BIC chooses."""

    rungs: list[Rung]
    sigma_u_px: float
    sigma_x_mm: float

    @property
    def best(self) -> Rung:
        """The model with the smallest BIC."""
        return min(self.rungs, key=lambda rung: rung.bic)

    def __getitem__(self, model: str) -> Rung:
        return next(rung for rung in self.rungs if rung.model == model)

    def __str__(self) -> str:
        lines = [f"{'model':28s} {'par':>4s} {'chi2':>10s} {'BIC - best':>10s} {'p(constraint)':>14s}"]
        for rung in self.rungs:
            p, mark = "" if rung.against is None else f"{rung.p_value:.3g}", " <- chosen" if rung is self.best else ""
            above = rung.bic - self.best.bic
            lines.append(f"{rung.model:28s} {rung.parameters:4d} {rung.chi_square:10.1f} {above:10.1f} {p:>14s}{mark}")
        return "\n".join(lines)


def compare_models(
    data: Correspondences | ArrayLike, u: Sequence[ArrayLike] | None = None, *, models: Sequence[str] = LADDER,
    **options: object,
) -> Comparison:  # fmt: skip
    """Fit every model on the same rows with the same noise levels, and compare.

    Rows, offsets and noise levels are those of the most general model (most parameters), so a model error increases
    chi-square instead of the noise level.  `data`, `u`, `options` and errors are those of `calibrate`.  For a single camera
    the models that constrain two cameras are left out.

    For example ``compare_models(data, models=("common_zoom", "square", "affine")).best.model``.
    """
    cameras = 1 if u is not None and len(u) == 1 else 2
    if cameras == 1:
        models = [m for m in models if m != "common_zoom" and "distances" not in m]
    most = max(models, key=lambda m: len(Model.parse(m, cameras).parameter_names))
    freest = calibrate(data, u, model=most, **options)
    rows, covariance = freest.inliers, freest.covariance_px2
    x, pixels = freest.x_mm[rows], np.split(freest.y_px[rows], cameras, axis=1)
    if cameras == 2:  # only the views that the most general model uses
        pixels = [np.where(used[:, None], u, np.nan) for used, u in zip(freest.view_inliers[rows].T, pixels, strict=True)]
        x, pixels = Correspondences.of_points(x, *pixels), None
    same = {
        "sigma_u_px": freest.sigma_u_px, "sigma_x_mm": freest.sigma_x_mm, "image_size_px": freest.image_size_px,
        "offsets": False if pixels is None else None,
        "covariance_px2": covariance if covariance is None or len(covariance) == 1 else covariance[rows],
    }  # fmt: skip
    fits = {m: calibrate(x, pixels, model=m, ransac_px=np.inf, checks=False, **same) for m in models}
    rungs = []
    for m, c in fits.items():
        k, value, freer, p = len(c.parameter_names), 2.0 * c.cost, _FREER.get(m), np.nan
        freer = freer if freer in fits else None
        if freer is not None:
            gain, more = value - 2.0 * fits[freer].cost, len(fits[freer].parameter_names) - k
            p = float(chdtrc(more, max(gain, 0.0)))
        rungs.append(Rung(m, k, value, value + k * float(np.log(2 * freest.view_inliers.sum())), freer, p, c))
    return Comparison(rungs, freest.sigma_u_px, freest.sigma_x_mm)
