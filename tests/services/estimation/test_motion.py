from __future__ import annotations

import numpy as np
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, FloatArray, covariance, flow, noise, seeds

from trackmesh.services.estimation.motion import predict_constant_velocity

times_s = st.floats(0.0, 60.0)
densities = st.floats(1e-3, 1e3)


def predicted(x: FloatArray, P: FloatArray, dt_s: float, q: float) -> tuple[FloatArray, FloatArray]:
    x, P = x.copy(), P.copy()
    predict_constant_velocity(x, P, dt_s, q)
    return x, P


def start(seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=4) * [1e4, 1e4, 200, 200], covariance(rng, 4, 100.0)


@LAW
@given(seeds, times_s, densities)
def test_equals_the_matrix_form(seed: int, dt: float, q: float) -> None:
    x, P = start(seed)
    got_x, got_P = predicted(x, P, dt, q)
    F = flow(dt)
    np.testing.assert_allclose(got_x, F @ x, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(got_P, F @ P @ F.T + noise(dt, q), rtol=1e-11, atol=1e-8)
    assert np.array_equal(got_P, got_P.T)


@LAW
@given(seeds, times_s, times_s, densities)
def test_two_intervals_are_one(seed: int, a: float, b: float, q: float) -> None:
    x, P = start(seed)
    twice, once = predicted(*predicted(x, P, a, q), b, q), predicted(x, P, a + b, q)
    np.testing.assert_allclose(twice[0], once[0], rtol=1e-11, atol=1e-8)
    np.testing.assert_allclose(twice[1], once[1], rtol=1e-10, atol=1e-8)


def test_no_time_changes_nothing() -> None:
    x, P = start(1)
    got_x, got_P = predicted(x, P, 0.0, 10.0)
    assert np.array_equal(got_x, x)
    assert np.array_equal(got_P, P)


def test_the_noise_is_that_of_white_acceleration() -> None:
    # Van Loan: exp([[-A, q G G'], [0, A']] dt) has F' and F^-1 Q as its right blocks.
    dt, q = 3.7, 12.0
    A, GG = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2)), np.kron([[0.0, 0.0], [0.0, q]], np.eye(2))
    E = scipy.linalg.expm(np.block([[-A, GG], [np.zeros((4, 4)), A.T]]) * dt)
    _, P = predicted(np.zeros(4), np.zeros((4, 4)), dt, q)
    np.testing.assert_allclose(P, E[4:, 4:].T @ E[:4, 4:], atol=1e-10)
