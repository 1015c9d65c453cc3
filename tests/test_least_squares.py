"""The damped least-squares loop: a hard valley, a rank that the data leave open, states that are not allowed."""

import numpy as np
import pytest

from lib.least_squares import minimise


def problem(residuals, jacobian):
    def evaluate(x):
        r = residuals(x)
        return 0.5 * float(r @ r), r

    def normal_equations(x, r):
        J = jacobian(x)
        return J.T @ J, -J.T @ r

    return evaluate, normal_equations, np.add


def test_rosenbrocks_valley_is_descended_to_its_end():
    found = minimise(
        np.array([-1.2, 1.0]),
        *problem(
            lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
            lambda x: np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]),
        ),
    )
    np.testing.assert_allclose(found.state, [1, 1], atol=1e-9)
    assert found.converged and found.energy < 1e-18


def test_directions_beyond_the_rank_are_left_alone():
    A = np.array([[1.0, 1.0], [2.0, 2.0], [1.0, 1.0]])
    b = np.array([2.0, 4.0, 2.5])
    found = minimise(np.array([3.0, 0.0]), *problem(lambda x: A @ x - b, lambda x: A), rank=1)
    np.testing.assert_allclose(found.state[0] - found.state[1], 3.0, atol=1e-12)
    assert found.converged and found.state.sum() == pytest.approx(A[:, 0] @ b / 6)


def test_a_step_out_of_the_domain_is_shortened():
    evaluate, normal_equations, move = problem(lambda x: np.log(x / 2), lambda x: np.diag(1 / x))
    guarded = minimise(np.array([30.0]), lambda x: evaluate(x) if x.min() > 0 else None, normal_equations, move)
    assert guarded.state[0] == pytest.approx(2)
    with pytest.raises(ValueError, match="start"):
        minimise(np.array([-1.0]), lambda x: None, normal_equations, move)


def test_iterations_that_run_out_are_told():
    assert not minimise(np.array([30.0]), *problem(lambda x: x**3, lambda x: np.diag(3 * x**2)), iterations=2).converged
