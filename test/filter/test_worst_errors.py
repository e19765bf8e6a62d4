"""The table of worst errors against 60 digits."""

import math

import mpmath as mp
import numpy as np
import pytest
import se3_oracle as oracle
import se3_reference
import worst_errors

from tactile_filter import _fusion
from tactile_geometry import se3


def test_worst_errors_are_within_their_tolerances():
    worst = worst_errors.worst_errors(se3, 3)
    print("\n" + worst_errors.table(worst))
    for name, (error, angle) in worst.items():
        assert error <= worst_errors.TOLERANCES[name], (name, error, angle)


def test_the_numpy_reference_is_good_to_a_few_units_in_the_last_place():
    worst = worst_errors.worst_errors(se3_reference, 1)
    for name, (error, angle) in worst.items():
        assert error <= 8 * worst_errors.TOLERANCES[name], (name, error, angle)


@pytest.mark.parametrize("angle", [math.pi, math.pi + 1e-9, 4.0, 6.0])
def test_log_of_more_than_a_half_turn_is_the_other_way_round(angle):
    xi = np.array([0.1, 0.2, 0.3, 0.0, 0.6 * angle, 0.8 * angle])
    found = se3.log(se3.exp(xi))
    assert np.linalg.norm(found[3:]) <= math.pi
    np.testing.assert_allclose(se3.exp(found), se3.exp(xi), atol=1e-13)


def test_log_of_a_matrix_that_is_not_quite_a_rotation_is_that_of_a_rotation_as_near():
    rng = np.random.default_rng(0)
    for angle in (1e-3, 1.0, 3.0, math.pi - 1e-6):
        xi = next(worst_errors.tangents(angle, 3))
        T = se3.exp(xi)
        T[:3, :3] += 1e-9 * rng.uniform(-1, 1, (3, 3))
        assert np.linalg.norm(se3.log(T)[3:] - xi[3:]) <= 6e-9
        nearest = oracle.exact_rotation(T)
        assert oracle.worst(nearest[:3, :3], se3.exp(se3.log(T))[:3, :3]) <= 6e-9


@pytest.mark.parametrize("angle", [0.3, 2.0, 3.1])
def test_closed_forms_of_the_oracle_are_its_definitions(angle):
    for xi in worst_errors.tangents(angle, 3):
        T = oracle.exp(xi)
        assert mp.mnorm(oracle.closed_exp(xi) - T, "f") < 1e-45
        assert mp.norm(oracle.closed_log(T) - mp.matrix([mp.mpf(x) for x in xi])) < 1e-45
        J = oracle.inverse_left_jacobian(xi)
        assert mp.mnorm(oracle.closed_inverse_jacobian(xi) - J, "f") < 1e-45 * mp.mnorm(J, "f")


def test_every_instruction_set_gives_the_same_bits():
    results, best = [], _fusion.instruction_set()
    for name in ("base", best):
        _fusion.instruction_set(name)
        for angle in (0.0, 1e-9, 0.3, 2.0, 3.1, 6.0, 100.0):
            xi = next(worst_errors.tangents(angle, 3))
            T = se3.exp(xi)
            results.append(
                (T, se3.log(T), se3.left_jacobian(xi), se3.inverse_left_jacobian(xi), se3.adjoint(T))
            )
    half = len(results) // 2
    for one, other in zip(results[:half], results[half:], strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)
