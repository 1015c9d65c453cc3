"""Damped least squares (Levenberg-Marquardt) for energies that are given with their normal equations.

Nocedal and Wright, "Numerical Optimization", 2006, Sec. 10.3.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


def inverse(information: np.ndarray) -> np.ndarray:
    """Inverse (p, p) of an information matrix, that is the covariance, of parameters whose units may differ widely.

    >>> inverse(np.diag([4.0, 1e-8])).round(2).tolist()
    [[0.25, 0.0], [0.0, 100000000.0]]
    """
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)


@dataclass(frozen=True, eq=False)
class Minimum:
    """A minimum: its `state`, and `energy` and `work` as the caller's functions returned them.

    `information` (p, p) is the Gauss-Newton Hessian there; `converged` is False if the number of iterations was reached.
    """

    state: Any
    energy: float
    work: Any
    information: np.ndarray
    converged: bool


def minimise(
    start: Any, evaluate: Callable[[Any], tuple[float, Any] | None],
    normal_equations: Callable[[Any, Any], tuple[np.ndarray, np.ndarray]], move: Callable[[Any, np.ndarray], Any], *,
    rank: int | None = None, iterations: int = 60, tolerance: float = 1e-13,
) -> Minimum:  # fmt: skip
    """Minimum of an energy by damped Gauss-Newton steps; no step raises the energy.

    Args:
        start: The first state, of any type.
        evaluate: state -> (energy, work), or None if the state is not allowed; `work` is passed to `normal_equations`.
        normal_equations: (state, work) -> (information (p, p), gradient (p,)): the Gauss-Newton Hessian of the energy
            and its negative gradient J^T W r.
        move: (state, step (p,)) -> the state after the step.
        rank: Number of directions that the data determine; steps do not change the others.  None is all p.
        iterations, tolerance: Largest number of steps; smallest relative decrease of the energy that is worth a step.

    A ValueError refuses a start that is not allowed.  Example: the x with exp(x) = 2.

    >>> def evaluate(x):
    ...     return 0.5 * float(2 - np.exp(x)) ** 2, 2 - np.exp(x)
    >>> def normal_equations(x, r):
    ...     return np.array([[np.exp(2 * x)]]), np.array([np.exp(x) * r])
    >>> found = minimise(0.0, evaluate, normal_equations, lambda x, step: x + step[0])
    >>> print(round(found.state, 6), found.converged)
    0.693147 True
    """
    first = evaluate(start)
    if first is None:
        raise ValueError("start: the energy is not defined there.")
    state, (energy, work), damping = start, first, 0.0
    for steps in range(iterations + 1):
        information, gradient = normal_equations(state, work)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        if rank is not None:
            values, vectors = values[-rank:], vectors[:, -rank:]
        values = np.maximum(values, 1e-15 * values[-1])
        along = vectors.T @ (scale * gradient)
        converged = bool(0.5 * (along**2 / values).sum() <= tolerance * energy + 1e-22)
        if converged or steps == iterations:
            break
        for _ in range(12):
            trial = move(state, scale * (vectors @ (along / (values + damping))))
            new = evaluate(trial)
            if new is not None and new[0] <= energy * (1 + 1e-14) + 1e-300:
                break
            damping = max(10.0 * damping, 1e-6)
        else:
            converged = True  # no step lowers the energy: the limit of rounding
            break
        state, (energy, work), damping = trial, new, damping / 30.0 if damping > 1e-9 else 0.0
    return Minimum(state, energy, work, information, converged)
