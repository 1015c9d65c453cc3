"""Faults that an affine camera absorbs: only the optics that it implies tell of them.

A microscope's camera has square pixels without skew and stands on its own side of the head.  A robot axis of the wrong scale
breaks the first, exchanged eyes or a mirrored axis the second.
"""

from collections.abc import Iterator

import numpy as np

from lib.trust.case import Hypothesis
from lib.trust.fitting import Problem, Robust

__all__ = ["optical_faults"]

#: Standard deviations of a camera's skew and log pixel aspect.
_SKEW_SD, _ASPECT_SD = 0.002, 0.003
#: A common log aspect above this is no lens: the images were resized, and their aspect is free.
_RESIZED = 0.1


def optical_faults(problem: Problem, fit: Robust) -> Iterator[Hypothesis]:
    """Scaled axes, and a left camera that stands on the right."""
    rows = [8 * c + 4 * i + j for c in range(2) for i in range(2) for j in range(3)]
    A, covariance = fit.M[:, :, :3], fit.camera_covariance[np.ix_(rows, rows)]
    few = 2 * problem.used.sum() < 40
    if few or not np.isfinite(covariance).all() or min(np.linalg.svd(a, compute_uv=False)[1] for a in A) < 1e-6:
        return
    yield from _scaled(A, covariance)
    yield from _reflected(problem, A, covariance)


def _constraints(A: np.ndarray) -> np.ndarray:
    """(..., 4) skew of the left and right camera, log aspects, of A (..., 2, 2, 3): all 0 for square pixels."""
    size = np.linalg.norm(A, axis=-1)
    skew = (A[..., 0, :] * A[..., 1, :]).sum(axis=-1) / size.prod(axis=-1)
    return np.concatenate([skew, np.log(size[..., 0] / size[..., 1])], axis=-1)


def _scaled(A: np.ndarray, covariance: np.ndarray) -> Iterator[Hypothesis]:
    tolerance = np.diag(np.square([_SKEW_SD, _SKEW_SD, _ASPECT_SD, _ASPECT_SD]))
    if abs(_constraints(A)[2:].mean()) > _RESIZED:
        tolerance[2:, 2:] += 1.0

    step = 1e-6 * np.abs(A).max()
    near = step * np.eye(12).reshape(12, 2, 2, 3)

    def misfit(scale: np.ndarray) -> float:
        found = _constraints(A * scale)
        J = (_constraints((A + near) * scale) - found).T / step
        return float(found @ np.linalg.solve(J @ covariance @ J.T + tolerance, found))

    none = misfit(np.ones(3))
    logs = np.log(12.0) * np.linspace(-1, 1, 161)
    for axis in range(3):
        values = np.array([misfit(np.exp(log * np.eye(3)[axis])) for log in logs])
        best = int(values.argmin())
        log, spacing = logs[best], logs[1] - logs[0]
        three = values[max(best - 1, 0) : best + 2]
        bend = (three[0] - 2 * three[1] + three[2]) / spacing**2 if len(three) == 3 else 0.0
        if bend > 0:
            log += 0.5 * (three[0] - three[2]) / bend / spacing
        sd = float(np.sqrt(2.0 / bend)) if bend > 0 else np.inf
        scale = float(np.exp(-log))  # A times s is plausible, so the robot's numbers are 1/s too small
        name, gain = "xyz"[axis], 0.5 * (none - values[best]) - 1.5
        text = f"The cameras' pixels are skewed or oblong, and square if the robot's {name} is divided by {1 / scale:.3f}."
        cure = f"Check the units and the scale of the {name} columns of kinematics.csv."
        explained = 1.0 - float(values[best]) / max(none, 1e-9)
        yield Hypothesis("scaled_axis", text, cure, 1 / scale, sd / scale, "times", explained, float(gain))


def _reflected(problem: Problem, A: np.ndarray, covariance: np.ndarray) -> Iterator[Hypothesis]:
    def along(entries: np.ndarray) -> tuple[float, float]:
        (a, b), (c, d) = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in entries.reshape(2, 2, 3))
        left, right = np.cross(a, b), np.cross(c, d)
        left, right = left / np.linalg.norm(left), right / np.linalg.norm(right)
        return (left - right) @ (a + c) / 2, (left - right) @ (b + d) / 2

    rows = A / np.linalg.norm(A, axis=2, keepdims=True)
    if (rows[0] * rows[1]).sum(axis=1).min() < np.cos(np.deg2rad(30)):
        return  # the images are turned against each other: no left or right
    (side, across), step = along(A.ravel()), 1e-6 * np.abs(A).max()
    J = np.array([(along(A.ravel() + step * e)[0] - side) / step for e in np.eye(12)])
    sd = float(np.sqrt(J @ covariance @ J))
    if not (np.deg2rad(1) < np.hypot(side, across) < np.deg2rad(30) and side < -max(3.0 * abs(across), 5.0 * sd)):
        return
    view = np.cross(A, np.roll(A, -1, axis=1))[:, 0].sum(axis=0)  # away from the cameras, if nothing is mirrored
    tips, base = problem.landmark > 0, problem.landmark == 0
    known = tips.any() and base.any()
    deeper = np.nanmedian(problem.x[tips, 0] @ view) - np.nanmedian(problem.x[base, 0] @ view) if known else 1.0
    degrees = np.rad2deg(-side)
    shared = float(degrees), float(np.rad2deg(sd)), "degrees", 1.0, float(0.5 * (side / sd) ** 2)
    where = f"The left camera stands on the right, by {degrees:.1f} degrees"
    if deeper > 0:
        text = f"{where}, and the tool points away from the cameras: the images of the two eyes are exchanged."
        yield Hypothesis("exchanged_eyes", text, "Exchange the folders left/ and right/ (or u_left and u_right).", *shared)
    else:
        text = f"{where}, and the tool points at the cameras: an axis of the robot is mirrored."
        cure = "Use a right-handed robot frame: negate one axis, or exchange two, in kinematics.csv."
        yield Hypothesis("mirrored_axis", text, cure, *shared)
