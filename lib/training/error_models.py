"""Fit of the error model of each stage, from which covariance and confidence come, on validation images."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, chndtr, expit
from tqdm.auto import tqdm

from lib.landmarks.detector import CLOSE, TRACKED_FROM, Detector, Landmarks
from lib.landmarks.error_model import FEATURES, ErrorModel, Rough, features_of
from lib.landmarks.metrics import GROSS_PX, tool_length_px
from lib.landmarks.windows import CLOSEUP_REACH_PX, CLOSEUP_ZOOM, expected_in_closeup, map_points
from lib.training.samples import LabelledImage

#: Motion of a tool at 2 mm/s between two frames at 25 Hz, and the tool's length at the same scale.
TRACKED_SHIFT_PX, _LENGTH_PX = 8.0, 300.0
#: Weight of a prior, as a number of landmarks.  Chosen by the calibration on held-out scenes after a fit on 20 others.
_PRIOR = 20.0
#: Ridge penalties on the slopes of the two log variances and of the logit; chosen on held-out scenes.
_RIDGE = (1e-2, 1e-2, 1e-3)
_CHI2_95 = chdtri(2, 0.05)  # 95 % quantile of chi-square with 2 degrees of freedom
#: Larger errors, in pixels of a stage's input, are gross: the covariance does not describe them.
_GROSS_PX = {"frame": GROSS_PX, "tool": 10.0, "again": 8.0}


class Seen(NamedTuple):
    """Peaks of landmarks with index `landmark` (m,): their `features` (m, 3, 9) by `features_of`, and their `errors` (m, 2).

    All in pixels of the stage's input.  Errors are NaN without a label; one within `tolerance` (m,) counts as correct.
    `moved` (m, 2) is the correction of a closeup at gain 1.  `known` (m,) is False if a landmark is in view but unlabelled.
    `label_sd` (m,) is the standard deviation of the labels along each axis.
    """

    features: np.ndarray
    errors: np.ndarray
    tolerance: np.ndarray
    landmark: np.ndarray
    moved: np.ndarray
    known: np.ndarray
    label_sd: np.ndarray

    def fit(self, gross_px: float, prior: ErrorModel | None = None) -> ErrorModel:
        """Fit the variances by maximum likelihood of the errors below `gross_px`, the confidence by logistic regression.

        An error is the sum of the detector's and the label's; the fitted variance is the detector's alone.  It is log-linear
        in the features.  The tips are mirror images of each other and share all coefficients.  The fewer the landmarks, the
        closer the coefficients stay to the `prior`.  Errors have longer tails than a Gaussian: if the mean normalised squared
        error is 2, more than 5 % lie outside the 95 % ellipses; if 5 % do, the mean is below 2.  The constants are set
        halfway between the two, for the base and for the tips.

        Raises ValueError for fewer than 20 landmarks and no prior.
        """
        size = np.linalg.norm(self.errors, axis=1)
        use = np.isfinite(size) & (size < gross_px)
        if use.sum() < 20:
            if prior is not None:
                return prior
            raise ValueError(f"images: only {use.sum()} landmarks to calibrate on; give at least 20.")
        squared, label_var, tip = self.errors[use] ** 2, self.label_sd[use] ** 2, self.landmark > 0
        label_var = label_var * min(1.0, 0.9 * squared.mean() / max(label_var.mean(), 1e-12))  # if better than stated

        def fitted(row: int, loss: Callable[[np.ndarray], tuple], among: np.ndarray, start: np.ndarray) -> np.ndarray:
            """Coefficients beta that minimise the mean of a loss of ``x @ beta``; `loss` returns values and derivatives.

            A ridge penalty keeps them near `start` if that is a prior; else it keeps the slopes small.
            """
            x = np.column_stack([~tip, tip, self.features[:, row, 1:]])[among].astype(float)
            start = np.array(start)[[0, 1, *range(3, FEATURES + 2)]]  # with one tip for both
            slopes, centre = np.arange(len(start)) > len(start) - FEATURES, np.where(prior is not None, start, 0.0)
            ridge = np.full(len(start), _PRIOR / len(x)) if prior is not None else _RIDGE[row] * slopes

            def penalised(beta: np.ndarray) -> tuple[float, np.ndarray]:
                value, slope = loss(x @ beta)
                return value.mean() + ridge @ (beta - centre) ** 2, x.T @ slope / len(x) + 2 * ridge * (beta - centre)

            return minimize(penalised, start, jac=True, method="L-BFGS-B").x[[0, 1, 1, *range(2, FEATURES + 1)]]

        def variance(axis: int) -> np.ndarray:
            def deviance(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                own = np.exp(z)
                ratio = squared[:, axis] / (own + label_var)
                return np.log(own + label_var) + ratio, (1 - ratio) * own / (own + label_var)

            start = [np.log(max(squared[:, axis].mean(), 1e-6))] * 3 + [0.0] * (FEATURES - 1)
            return fitted(axis, deviance, use, start if prior is None else prior.log_variance[axis])

        log_variance = np.array([variance(0), variance(1)])
        own = np.exp((ErrorModel(log_variance).coefficients[self.landmark, :2] * self.features[:, :2]).sum(-1))
        correct = self._correct(own)[self.known]
        start = (prior or ErrorModel()).logit
        logit = fitted(2, lambda z: (np.logaddexp(0, z) - correct * z, expit(z) - correct), self.known, start)
        total = own[use] + label_var[:, None]
        normalised, own_share = (squared / total).sum(1), own[use] / total
        for group, columns in ((~tip[use], np.s_[:1]), (tip[use], np.s_[1:3])):
            if group.any():
                share = 0.5 * own_share[group].mean() * group.sum() / (group.sum() + (_PRIOR if prior is not None else 0))
                log_variance[:, columns] += share * np.log(np.quantile(normalised[group], 0.95) / _CHI2_95)
        return ErrorModel(log_variance, logit)

    def _correct(self, own: np.ndarray) -> np.ndarray:
        """(m,) probability that a landmark with variances `own` (m, 2) is correct, given its distance from the label."""
        label_var = np.maximum(self.label_sd[:, None] ** 2, 1e-9)
        mean, variance = self.errors * own / (own + label_var), (own * label_var / (own + label_var)).mean(axis=1)
        inside = chndtr(self.tolerance**2 / variance, 2, np.minimum((mean**2).sum(axis=1) / variance, 1e4))
        return np.where(self.label_sd > 0, np.nan_to_num(inside), np.linalg.norm(self.errors, axis=1) <= self.tolerance)

    def gain(self, gross_px: float, gains: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Gain (one of `gains`) and bias (3, 2) along each axis that minimise the mean absolute error of base and tips."""
        # Errors of the expected position must not be gross; gross errors of the closeup itself count.
        use = np.linalg.norm(self.errors - self.moved, axis=1) < gross_px
        best, bias = np.ones((3, 2)), np.zeros((3, 2))
        for k, axis in product(([0], [1, 2]), (0, 1)):  # the base, and both tips
            own = use & np.isin(self.landmark, k)
            if own.any():
                residual = self.errors[own, axis] + (np.asarray(gains)[:, None] - 1) * self.moved[own, axis]
                centre = np.median(residual, axis=1)
                i = np.abs(residual - centre[:, None]).mean(1).argmin()
                best[k, axis], bias[k, axis] = gains[i], centre[i]
        return best, bias


def seen_by(detector: Detector, stage: str, labelled: LabelledImage, rough: Landmarks, found: tuple) -> Seen:
    """Compare a stage's peaks in one image with the labels, given the landmarks `rough` of the previous stage.

    `found` is the result of `Detector.stage_peaks` for them.
    """
    labels = labelled.in_view
    # A stage that only guides the next one is correct if the next one can find the landmark there.
    share = 0.25 if stage in ("frame", "tool") and len(detector.networks) > 1 else 0.05
    tolerance, label_sd = np.repeat(share * tool_length_px(labelled.u), 3), np.broadcast_to(labelled.sd_px, 3)
    known = (np.isfinite(labels).all(1) & np.isfinite(tolerance)) | (labelled.visibility == 0)
    peaks, matrices, which = found
    landmark, at = which[:, 1], peaks.u[:, 0].double().numpy()
    before = None if stage in ("frame", "tracking") else Rough.in_windows(rough.u, rough.confidence, matrices, which)
    features = features_of(peaks.double(), before)[:, 0].numpy()
    keep, moved = np.ones(len(at), bool), np.zeros(at.shape)
    if stage in CLOSE:
        keep = peaks.value[:, 0].numpy() > 0
        moved = at - expected_in_closeup(detector.closeup_network.config.size_px, landmark)
    errors = at - map_points(matrices, labels[landmark])
    zoom = np.sqrt(np.abs(np.linalg.det(matrices[:, :, :2])))
    tolerance, label_sd = zoom * tolerance[landmark], zoom * label_sd[landmark]
    return Seen(*(part[keep] for part in (features, errors, tolerance, landmark, moved, known[landmark], label_sd)))


def _fitted(stage: str, parts: Sequence[Seen], prior: ErrorModel | None) -> ErrorModel:
    """Fit the error model of a stage.  Raises ValueError if it found too few landmarks and there is no prior."""
    if not any(len(part.landmark) for part in parts):
        if prior is not None:
            return prior
        raise ValueError("images: the detector finds nothing in them to calibrate on; give other images.")
    seen = Seen(*map(np.concatenate, zip(*parts, strict=True)))
    gross_px = _GROSS_PX.get(stage, CLOSEUP_REACH_PX * min(CLOSEUP_ZOOM))
    if stage not in CLOSE:
        return seen.fit(gross_px, prior)
    # A prior's gain and bias were fitted on many exact labels; a few labels may have a constant error.  While tracking, the
    # expected position is that of an earlier frame and no evidence, so the gain is 1.
    gains = [1.0] if stage == "tracking" else np.linspace(0, 1, 51)
    gain, bias = seen.gain(gross_px, gains) if prior is None else map(np.array, (prior.gain, prior.bias))
    seen = seen._replace(errors=seen.errors + (gain[seen.landmark] - 1) * seen.moved - bias[seen.landmark])
    return replace(seen.fit(gross_px, prior), gain=gain, bias=bias)


def fit_error_models(
    detector: Detector, images: Iterable[LabelledImage], *, for_closeups: Sequence[LabelledImage] = (), anew: bool = True,
    progress: bool = False,
) -> Detector:  # fmt: skip
    """Fit the error model of every stage on validation images, which no training saw.  Returns a new detector.

    A closeup's correction is multiplied by the gain that minimises the validation error, and its bias is subtracted; while
    tracking the gain is 1.  Tracking is fitted on the same images, with the tool displaced by `TRACKED_SHIFT_PX` (rms), and
    by five times as much with probability 1/4.

    Args:
        images: Easy and hard ones, since confidence is learnt from failures, and of many tools, since errors within a
            recording are correlated by its one tool.
        for_closeups: More images, for gain, bias and covariance of the stages that use closeups, and for tracking.
        anew: False = start from the detector's own error models, which change more the more landmarks are found.

    Raises ValueError if too few landmarks are found in the images and there is no model to start from.
    """
    images = list(images)
    n, images, before = len(images), [*images, *for_closeups], detector.error_models
    # Closeups are fitted on their full corrections, not on those scaled by an earlier gain.
    detector = replace(detector, error_models={k: v for k, v in detector.error_models.items() if k not in CLOSE})
    rough = [Landmarks.none(1)] * len(images)
    rng = np.random.default_rng(0)
    for stage in detector.stages:
        parts, found = [], []
        for labelled, start in zip(tqdm(images, disable=not progress, unit="image", desc=stage), rough, strict=True):
            if stage == "tracking":  # the tool jumps sometimes, which tracking has to notice
                if not (start.confidence >= TRACKED_FROM).all():
                    continue  # tracking does not start from such an image
                moved_px = TRACKED_SHIFT_PX * (5 if rng.random() < 0.25 else 1) * tool_length_px(start.u) / _LENGTH_PX
                start = replace(start, u=start.u + rng.normal(0, moved_px / np.sqrt(2), (1, 1, 2)))
                start = detector.refine(labelled.image[None], start, stage)
            found.append(detector.stage_peaks(labelled.image[None], start.u, stage))
            parts.append(seen_by(detector, stage, labelled, start, found[-1]))
        if stage in ("closeup", "closer"):  # their confidence is fitted on `images` alone
            parts[n:] = (part._replace(known=np.zeros_like(part.known)) for part in parts[n:])
        fit = _fitted(stage, parts if stage in CLOSE else parts[:n], None if anew else before.get(stage))
        detector = replace(detector, error_models=detector.error_models | {stage: fit})
        if stage == "frame":  # the landmarks from which the next stage starts
            rough = [detector.searched(image, detector.coarse(image)) for image in (part.image[None] for part in images)]
        elif stage != "tracking":
            known = [None] * len(images) if stage in CLOSE else found  # a closeup's correction depends on the gain
            parts = zip(images, rough, known, strict=True)
            rough = [detector.refine(labelled.image[None], start, stage, seen) for labelled, start, seen in parts]
    return detector
