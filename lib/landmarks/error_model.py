"""The error model, which converts peaks to covariance and confidence.  It is fitted on validation images."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from lib.landmarks.heatmaps import Peaks
from lib.landmarks.windows import CLOSEUP_REACH_PX, CLOSEUP_ZOOM, expected_in_closeup, map_points

#: Number of features of a peak.
FEATURES = 9
#: Distance of the tips, as a share of the tool's length, below which the jaws look shut.
_SHUT = 0.15
_WRONG = 3.0  # a wrong landmark has 1 + this times the variance of a right one; not fitted, chosen on validation images


class Rough(NamedTuple):
    """The result of the previous stage.  Agreement with it is evidence that a peak is right.

    Attributes:
        u: (n, k, 2) the landmark in pixels of this stage's input; NaN where it was not found.
        logit, together: (n, k) logit of its confidence, and the mean of this logit over the three landmarks of the tool.
        shut: (n, k) from 1 where the tips coincide to 0 where they are far apart; 0 also unless both tips were found.
    """

    u: Tensor
    logit: Tensor
    together: Tensor
    shut: Tensor

    @classmethod
    def of(cls, u: Tensor, confidence: Tensor) -> Self:
        """Make it from the tool's landmarks u (n, 3, 2) px and their confidence (n, 3).  Torch can trace this function."""
        confidence = confidence.clamp(1e-3, 0.999)
        logit = (confidence / (1 - confidence)).log()
        length = (u[..., 1:, :] - u[..., :1, :]).square().sum(-1).sqrt().mean(-1)
        shut = (-(u[..., 1, :] - u[..., 2, :]).square().sum(-1) / (_SHUT * length) ** 2).exp()
        shut = torch.where(shut >= 0, shut, torch.zeros_like(shut))  # NaN becomes 0
        return cls(u, logit, *(part.expand_as(logit) for part in (logit.mean(-1, keepdim=True), shut[..., None])))

    @classmethod
    def in_windows(cls, u: np.ndarray, confidence: np.ndarray, matrices: np.ndarray, which: np.ndarray) -> Self:
        """Make it from landmarks u (n, 3, 2) px and their confidence (n, 3), for windows as `Detector.stage_peaks` gives."""
        i, own = which[:, 0], (np.arange(len(which)), which[:, 1])
        parts = map_points(matrices[:, None], u[i]), confidence[i]
        return cls(*(part[own][:, None] for part in cls.of(*map(torch.from_numpy, parts))))


@dataclass(frozen=True)
class ErrorModel:
    """The error model of one stage, fitted by `lib.training.error_models.fit_error_models`.

    The covariance of a peak is diagonal in the axes of the stage's input.  In an upright window these run along the tool
    and across it, the directions in which errors differ most.  The logarithm of a right landmark's variance, in px^2 of
    that input, is a linear function of the peak's features (`features_of`), and so is the logit of the confidence.  The
    two tips share their coefficients, since they are mirror images of each other.

    Attributes:
        log_variance: (2, 11): for x and y the constants of base, tip_1 and tip_2, and the slopes of the other features.
        logit: (11,) in the same order.  If 9 numbers or fewer are given, the first is the constant of all three landmarks.
        gain, bias: (3, 2) for base, tip_1 and tip_2 along x and y, for closeups only.  A closeup's correction is multiplied
            by the gain, which minimises the validation error; the bias, in closeup pixels, is then subtracted.

        >>> ErrorModel().coefficients.shape
        (3, 3, 9)
    """

    log_variance: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 0.0, 1.0, *(FEATURES - 2) * (0.0,)),) * 2
    logit: tuple[float, ...] = (-4.0, 0.0, 8.0, *(FEATURES - 3) * (0.0,))
    gain: tuple[tuple[float, ...], ...] = ((1.0, 1.0),) * 3
    bias: tuple[tuple[float, ...], ...] = ((0.0, 0.0),) * 3

    def __post_init__(self) -> None:
        shapes = {"log_variance": (2, FEATURES + 2), "logit": (FEATURES + 2,), "gain": (3, 2), "bias": (3, 2)}
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            if name == "logit" and 0 < value.size <= FEATURES:
                value = np.concatenate([np.repeat(value[:1], 3), value[1:]])
            if name in ("log_variance", "logit") and value.ndim == len(shape) and value.shape[-1] < shape[-1]:
                value = np.pad(value, {-1: (0, shape[-1] - value.shape[-1])})  # missing slopes are 0
            if value.shape != shape:
                raise ValueError(f"{name}: expected {shape}, got {value.shape}; fit anew (`python3 -m lib train assemble`).")
            object.__setattr__(self, name, tuple(map(tuple, value.tolist())) if value.ndim == 2 else tuple(value.tolist()))

    @property
    def coefficients(self) -> np.ndarray:
        """(landmark, 3, 9): coefficients of the features for the log variance along x, along y, and for the logit."""
        rows = np.array([*self.log_variance, self.logit])
        return np.stack([np.column_stack([rows[:, k], rows[:, 3:]]) for k in range(3)])


def features_of(peaks: Peaks, rough: Rough | None = None) -> Tensor:
    """Features (..., 3, 9) of peaks, in pixels of the stage's input: for the variance along x, along y, and for the logit.

    The nine are 1, the log of the fit's variance, the peak's height, |log of its relative width|, the height elsewhere, the
    log of the distance from the previous stage's landmark, and `logit`, `together` and `shut` of `Rough`.  Without `rough`
    the last four are 0.  `shut` is a feature because a rod or a needle looks like a tool with shut jaws.
    """
    covariance = torch.where(torch.isfinite(peaks.covariance), peaks.covariance, torch.eye(2, dtype=peaks.u.dtype))
    (xx, xy), (yx, yy) = (row.unbind(-1) for row in covariance.unbind(-2))
    both = (xx * yy - xy * yx).clamp_min(1e-12).sqrt()
    one, height, width = torch.ones_like(peaks.value), peaks.value.clamp(-0.5, 1.5), peaks.width.log().abs()
    moved, logit, together, shut = (torch.zeros_like(one),) * 4
    if rough is not None:
        distance = (peaks.u - rough.u.to(peaks.u.dtype)).square().sum(-1)
        moved = torch.where(distance < 1e4, distance, torch.full_like(distance, 1e4)).sqrt()  # NaN becomes 1e4 too
        moved = (1 + moved / 2).log()
        logit, together, shut = (part.to(one.dtype).clamp(-6, 6) for part in (rough.logit, rough.together, rough.shut))
    shared = [height, width, peaks.rival.clamp(-0.5, 1.5), moved, logit, together, shut]
    return torch.stack([torch.stack([one, v.clamp(1e-4, 1e4).log(), *shared], -1) for v in (xx, yy, both)], -2)


def covariance_and_confidence(
    peaks: Peaks, rough: Rough | None, fit: ErrorModel, landmark: np.ndarray | slice = np.s_[:]
) -> tuple[Tensor, Tensor]:
    """Covariance (..., 2, 2) px^2 of peaks in the stage's input, which allows for wrong landmarks, and confidence (...).

    `landmark` is the index of each peak's landmark.  Torch can trace this function.
    """
    features = features_of(peaks, rough)
    value = (features * torch.tensor(fit.coefficients[landmark], dtype=features.dtype)).sum(-1)
    confidence = torch.sigmoid(value[..., 2])
    variance = value[..., :2].clamp(-12, 12).exp() * (1 + _WRONG * (1 - confidence))[..., None]
    return variance[..., None] * torch.eye(2, dtype=variance.dtype), confidence


def closeup_peaks(found: Tensor, size_px: int) -> Peaks:
    """Convert outputs (n, 4) of an `OffsetNetwork` to peaks (n, 1) of height and width 1."""
    u = (size_px - 1) / 2 + found[:, None, :2]
    one = torch.ones_like(u[..., 0])
    variance = 2 * (2 * found[:, None, 2:]).exp()  # 2 b^2 of a Laplace distribution; the network predicts log b
    return Peaks(u, one, one, variance[..., None] * torch.eye(2, dtype=variance.dtype), 0 * one)


def corrected(peaks: Peaks, fit: ErrorModel, size_px: int, landmark: np.ndarray) -> Peaks:
    """Apply gain and bias to closeups' peaks (n, k): expected position of `landmark` (n, k) + gain * correction - bias.

    A peak farther away than `CLOSEUP_REACH_PX` gets the value 0: the network was not trained for such distances, so it is
    probably something else.  Torch can trace this function.
    """
    reach = CLOSEUP_REACH_PX * np.array(CLOSEUP_ZOOM)
    parts = (expected_in_closeup(size_px, landmark), *(np.array(part)[landmark] for part in (fit.gain, fit.bias, reach)))
    expected, gain, bias, reach = (torch.tensor(part, dtype=peaks.u.dtype) for part in parts)
    move = peaks.u - expected
    near = (move.square().sum(-1) < reach.square()).to(move.dtype)
    return peaks._replace(u=expected + gain * move - bias, value=peaks.value * near)
