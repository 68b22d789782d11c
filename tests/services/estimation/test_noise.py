from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, FloatArray, covariance, noise

from trackmesh.services.estimation.noise import (
    SERIES_BELOW,
    add_along,
    add_white_acceleration,
    singer_noise,
    white_jerk,
)

_UPPER = np.triu_indices(3)


def singer(sd: float, time_s: float, dt_s: float) -> FloatArray:
    out = np.empty(6)
    singer_noise(sd, time_s, dt_s, out)
    return out


def full(block: FloatArray) -> FloatArray:
    Q = np.zeros((3, 3))
    Q[_UPPER] = block
    return np.asarray(Q + np.triu(Q, 1).T)


def response(time_s: float, s: float) -> FloatArray:
    """Position, velocity and acceleration s after a unit step of the acceleration."""
    u = s / time_s
    return np.array([time_s**2 * (u + np.expm1(-u)), -time_s * np.expm1(-u), np.exp(-u)])


@pytest.mark.parametrize(("time_s", "dt_s"), [(10.0, 0.6), (8.1, 4.0), (100.0, 10.0), (2.0, 10.0), (1.0, 60.0)])
def test_equals_the_integral_over_the_white_noise_that_drives_it(time_s: float, dt_s: float) -> None:
    sd = 3.0

    def of(i: int, j: int) -> float:
        value, _ = scipy.integrate.quad(
            lambda s: response(time_s, s)[i] * response(time_s, s)[j], 0.0, dt_s, epsabs=0.0, epsrel=1e-12, limit=200
        )
        return float(2.0 * sd * sd / time_s * value)

    want = [of(int(i), int(j)) for i, j in zip(*_UPPER, strict=True)]
    np.testing.assert_allclose(singer(sd, time_s, dt_s), want, rtol=1e-7)


def test_equals_the_matrix_exponential() -> None:
    # Van Loan: exp([[-A, G G'], [0, A']] dt) has F' and F^-1 Q as its right blocks.
    sd, time_s, dt = 2.0, 5.0, 4.0
    A, GG = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / time_s]]), np.zeros((3, 3))
    GG[2, 2] = 2.0 * sd * sd / time_s
    E = scipy.linalg.expm(np.block([[-A, GG], [np.zeros((3, 3)), A.T]]) * dt)
    np.testing.assert_allclose(full(singer(sd, time_s, dt)), E[3:, 3:].T @ E[:3, 3:], rtol=1e-9)


def test_the_series_meets_the_closed_form() -> None:
    below, above = (singer(1.0, 10.0, 10.0 * SERIES_BELOW * (1.0 + e)) for e in (-1e-9, 1e-9))
    np.testing.assert_allclose(below, above, rtol=2e-4)


@pytest.mark.parametrize("u", [1e-4, 0.01, 0.049])
def test_the_series_equals_the_integral(u: float) -> None:
    time_s, sd = 20.0, 2.0
    values, weights = np.polynomial.legendre.leggauss(12)
    s = 0.5 * u * time_s * (values + 1.0)
    x = s / time_s
    # u - 1 + e^-u by its own series.
    position = time_s**2 * x * x * (0.5 - x / 6 + x * x / 24 - x**3 / 120 + x**4 / 720)
    g = np.stack([position, -time_s * np.expm1(-x), np.exp(-x)])
    want = (g[:, None] * g[None] * weights).sum(-1) * 0.5 * u * time_s * 2.0 * sd * sd / time_s
    np.testing.assert_allclose(singer(sd, time_s, u * time_s), want[_UPPER], rtol=2e-4)


def test_a_long_memory_is_a_white_jerk() -> None:
    density, time_s, dt = 3.0, 1e7, 4.0
    want = np.empty(6)
    white_jerk(density, dt, want)
    np.testing.assert_allclose(singer(np.sqrt(density * time_s / 2.0), time_s, dt), want, rtol=1e-5)


def test_a_white_jerk_is_the_integral_of_white_acceleration() -> None:
    block = np.empty(6)
    white_jerk(5.0, 3.0, block)
    # What jerk is to velocity and acceleration is what acceleration is to position and velocity.
    np.testing.assert_allclose(full(block)[1:, 1:], noise(3.0, 5.0)[::2, ::2], rtol=1e-12)


@LAW
@given(st.floats(0.1, 1000.0), st.floats(1e-3, 60.0))
def test_noise_is_positive(time_s: float, dt: float) -> None:
    Q = full(singer(1.0, time_s, dt))
    scale = np.sqrt(np.diag(Q))
    assert np.linalg.eigvalsh(Q / np.outer(scale, scale))[0] > -1e-9


@LAW
@given(st.floats(0.0, 6.3), st.integers(4, 5))
def test_noise_along_a_direction(angle: float, own: int) -> None:
    block, u = singer(2.0, 5.0, 3.0), np.array([np.cos(angle), np.sin(angle)])
    # Columns: where position, velocity and the own parameter of the direction lie in the state.
    U = np.zeros((6, 3))
    U[:2, 0], U[2:4, 1], U[own, 2] = u, u, 1.0
    P = covariance(np.random.default_rng(1), 6)
    want = P + U @ full(block) @ U.T
    add_along(P, block, u[0], u[1], own)
    np.testing.assert_allclose(P, want, rtol=1e-12, atol=1e-12)


def test_white_acceleration_is_added() -> None:
    P = covariance(np.random.default_rng(2), 6)
    want = P.copy()
    want[:4, :4] += noise(3.0, 7.0)
    add_white_acceleration(P, 7.0, 3.0)
    np.testing.assert_allclose(P, want, rtol=1e-12)
