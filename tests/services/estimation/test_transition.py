from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, FloatArray, sojourns

from trackmesh.services.estimation.transition import chain, stationary, transition_matrix

times_s = st.floats(0.0, 1000.0)


def matrix(sojourn_s: FloatArray, dt_s: float) -> FloatArray:
    out = np.empty((len(sojourn_s), len(sojourn_s)))
    transition_matrix(chain(sojourn_s), dt_s, out)
    return out


def generator(sojourn_s: FloatArray) -> FloatArray:
    r = len(sojourn_s)
    G = np.tile(1.0 / (sojourn_s * max(r - 1, 1)), (r, 1)).T
    np.fill_diagonal(G, -1.0 / sojourn_s if r > 1 else 0.0)
    return G


@LAW
@given(sojourns, times_s)
def test_rows_are_probabilities(tau: FloatArray, dt: float) -> None:
    Pi = matrix(tau, dt)
    assert np.all(Pi >= 0)
    np.testing.assert_allclose(Pi.sum(axis=1), 1.0, atol=1e-14)


@LAW
@given(sojourns, times_s)
def test_equals_the_matrix_exponential(tau: FloatArray, dt: float) -> None:
    np.testing.assert_allclose(matrix(tau, dt), scipy.linalg.expm(generator(tau) * dt), atol=1e-11)


@LAW
@given(sojourns, times_s, times_s)
def test_two_intervals_are_one(tau: FloatArray, a: float, b: float) -> None:
    np.testing.assert_allclose(matrix(tau, a) @ matrix(tau, b), matrix(tau, a + b), atol=1e-11)


@LAW
@given(sojourns)
def test_no_time_no_transition(tau: FloatArray) -> None:
    np.testing.assert_allclose(matrix(tau, 0.0), np.eye(len(tau)), atol=1e-13)


@LAW
@given(sojourns, times_s)
def test_the_stationary_probabilities_stay_and_are_the_limit(tau: FloatArray, dt: float) -> None:
    p = stationary(tau)
    np.testing.assert_allclose(p @ matrix(tau, dt), p, atol=1e-12)
    np.testing.assert_allclose(matrix(tau, 1e6), np.tile(p, (len(tau), 1)), atol=1e-10)


def test_row_is_from_and_column_is_to() -> None:
    # A model with a short sojourn is left soon, one with a long sojourn is not.
    Pi = matrix(np.array([1.0, 1000.0]), 1.0)
    assert Pi[0, 1] > 0.5 > Pi[1, 0]


@pytest.mark.parametrize("tau", [[10.0, 0.0], [-1.0], [np.nan, 1.0]])
def test_a_sojourn_time_that_is_not_positive_is_refused(tau: list[float]) -> None:
    with pytest.raises(ValueError, match="positive"):
        chain(np.array(tau))
