from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, MODELS, TVIMM, FloatArray, chain, sojourns

from trackmesh.services.estimation.transition import generator, modes, stationary, transition_by_modes, uniformised

times_s = st.floats(0.0, 1000.0)


def matrix(sojourn_s: FloatArray, dt_s: float) -> FloatArray:
    return chain(generator(sojourn_s), dt_s)


def written_out(sojourn_s: FloatArray) -> FloatArray:
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
    np.testing.assert_allclose(matrix(tau, dt), scipy.linalg.expm(written_out(tau) * dt), atol=1e-11)


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
    p = stationary(generator(tau))
    np.testing.assert_allclose(p @ matrix(tau, dt), p, atol=1e-12)
    np.testing.assert_allclose(matrix(tau, 1e6), np.tile(p, (len(tau), 1)), atol=1e-10)


def test_row_is_from_and_column_is_to() -> None:
    # A model with a short sojourn is left soon, one with a long sojourn is not.
    Pi = matrix(np.array([1.0, 1000.0]), 1.0)
    assert Pi[0, 1] > 0.5 > Pi[1, 0]


@pytest.mark.parametrize("tau", [[10.0, 0.0], [-1.0], [np.nan, 1.0]])
def test_a_sojourn_time_that_is_not_positive_is_refused(tau: list[float]) -> None:
    with pytest.raises(ValueError, match="positive"):
        generator(np.array(tau))


@LAW
@given(st.integers(0, 2**32 - 1), st.integers(2, 6), times_s)
def test_any_jumps_give_the_matrix_exponential(seed: int, r: int, dt: float) -> None:
    """Chains that go round as well, whose generators have complex eigenvalues."""
    rng = np.random.default_rng(seed)
    J = rng.dirichlet(np.full(r, 0.3), r) * (1.0 - np.eye(r)) + np.roll(np.eye(r), 1, axis=1) * rng.uniform(0, 3)
    J /= J.sum(axis=1, keepdims=True)
    tau = rng.uniform(1.0, 100.0, r)
    np.testing.assert_allclose(
        chain(generator(tau, J), dt), scipy.linalg.expm((J - np.eye(r)) / tau[:, None] * dt), atol=1e-11
    )


def test_a_chain_without_eigenvectors() -> None:
    J, tau = np.array([[0.0, 1.0, 0.0], [0.5, 0.0, 0.5], [0.0, 1.0, 0.0]]), np.array([1.0, 1.0, 1.0])
    J[2], J[0] = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    for dt in (0.1, 3.0, 1e6, 1e300):
        out = chain(generator(tau, J), dt)
        np.testing.assert_allclose(out.sum(axis=1), 1.0, atol=1e-14)
        if dt < 1e6:
            np.testing.assert_allclose(out, scipy.linalg.expm((J - np.eye(3)) * dt), atol=1e-13)
        else:
            np.testing.assert_allclose(out, np.tile(stationary(generator(tau, J)), (3, 1)), atol=1e-12)


@pytest.mark.parametrize("J", [np.eye(2), np.ones((2, 2)), [[0.0, 0.5], [1.0, 0.0]], np.ones((3, 3))])
def test_jumps_that_are_none_are_refused(J: FloatArray) -> None:
    with pytest.raises(ValueError, match="jumps must be"):
        generator(np.ones(2), np.asarray(J))


@LAW
@given(sojourns, st.integers(0, 3))
def test_a_uniformised_chain_jumps_at_one_rate(tau: FloatArray, more: int) -> None:
    r = len(tau)
    U, rate = uniformised(generator(tau), r + more)
    assert np.all(U >= 0)
    U, U2, U3 = U
    np.testing.assert_allclose(U.sum(axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(U2, U @ U, atol=1e-15)
    np.testing.assert_allclose(U3, U @ U2, atol=1e-15)
    np.testing.assert_allclose(rate * (U[:r, :r] - np.eye(r)), generator(tau), rtol=1e-12, atol=1e-15)
    assert np.array_equal(U[r:], np.eye(r + more)[r:])


@LAW
@given(tau=sojourns, dt=times_s, more=st.integers(0, 2))
def test_both_ways_to_a_transition_matrix_agree(tau: FloatArray, dt: float, more: int) -> None:
    G, size = generator(tau), len(tau) + more
    by_modes = modes(G, size)
    if not by_modes.usable:
        return
    out, work = np.empty((2, size, size))
    transition_by_modes(*by_modes[1:], dt, out, work)
    np.testing.assert_allclose(out[: len(tau), : len(tau)], chain(G, dt), atol=1e-12)
    assert np.array_equal(out[len(tau) :], np.eye(size)[len(tau) :])
    # The states that are never left may be left out.
    short = np.empty((size, size))
    transition_by_modes(by_modes.rate[: len(tau)], by_modes.left, by_modes.right, dt, short, work)
    np.testing.assert_allclose(short[: len(tau), : len(tau)], chain(G, dt), atol=1e-12)


def test_the_chains_of_the_named_filters_have_modes() -> None:
    assert TVIMM.has_modes.tolist() == [1, 1]
    assert MODELS.has_modes.tolist() == [1]


def test_a_chain_that_turns_round_or_lacks_eigenvectors_has_none() -> None:
    tau = np.full(3, 10.0)
    ring = generator(tau, np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], float))
    assert not modes(ring, 3).usable, "complex eigenvalues"
    line = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 0.0]])
    assert not modes(line, 3).usable, "one eigenvector for two equal eigenvalues"
