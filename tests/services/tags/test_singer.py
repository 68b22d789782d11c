"""Singer's matrices: against the matrix exponential, against exact arithmetic, and what the printed ones get wrong."""

from __future__ import annotations

from decimal import Decimal, getcontext

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.tags.makers import LAW, FloatArray

from trackmesh.services.tags import singer

_UPPER = np.triu_indices(3)


def noise(alpha: float, variance: float, dt_s: float) -> FloatArray:
    out = np.empty(6)
    singer.noise(alpha, variance, dt_s, out)
    full = np.zeros((3, 3))
    full[_UPPER] = out
    return np.asarray(full + np.triu(full, 1).T)


def transition(alpha: float, dt_s: float) -> FloatArray:
    out = np.empty(3)
    singer.transition(alpha, dt_s, out)
    return out


def van_loan(alpha: float, variance: float, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """exp([[-A, G G'], [0, A']] dt) has F' and F^-1 Q as its right blocks."""
    A, GG = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -alpha]]), np.zeros((3, 3))
    GG[2, 2] = 2.0 * alpha * variance
    E = scipy.linalg.expm(np.block([[-A, GG], [np.zeros((3, 3)), A.T]]) * dt_s)
    return E[3:, 3:].T, E[3:, 3:].T @ E[:3, 3:]


def exact(alpha: float, dt_s: float) -> tuple[FloatArray, float]:
    """Q for unit variance, and the acceleration's part in the position, from the closed forms in 80 digits."""
    getcontext().prec = 80
    a, t = Decimal(repr(alpha)), Decimal(repr(dt_s))
    u = a * t
    e, ee = (-u).exp(), (-2 * u).exp()
    q = [
        (1 - ee + 2 * u + 2 * u**3 / 3 - 2 * u * u - 4 * u * e) / a**4,
        (ee + 1 - 2 * e + 2 * u * e - 2 * u + u * u) / a**3,
        (1 - ee - 2 * u * e) / a**2,
        (4 * e - 3 - ee + 2 * u) / a**2,
        (ee + 1 - 2 * e) / a,
        1 - ee,
    ]
    return np.array([float(value) for value in q]), float((u - 1 + e) / a**2)


@pytest.mark.parametrize("alpha", [0.05, 0.5, 5.0])
@pytest.mark.parametrize("u", [0.01, 0.1, 0.399, 0.401, 1.0, 3.0])
def test_equals_van_loan(alpha: float, u: float) -> None:
    F, Q = van_loan(alpha, 3.0, u / alpha)
    scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))
    np.testing.assert_allclose(noise(alpha, 3.0, u / alpha) / scale, Q / scale, atol=1e-8)
    np.testing.assert_allclose(transition(alpha, u / alpha), F[:, 2], rtol=1e-9)


@pytest.mark.parametrize("u", [1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 0.3, 0.3999, 0.4001, 2.0, 20.0])
@pytest.mark.parametrize("alpha", [0.05, 2.0])
def test_has_twelve_right_digits_at_any_interval(alpha: float, u: float) -> None:
    Q, rise = exact(alpha, u / alpha)
    np.testing.assert_allclose(noise(alpha, 1.0, u / alpha)[_UPPER], Q, rtol=1e-12)
    np.testing.assert_allclose(transition(alpha, u / alpha)[0], rise, rtol=1e-12)


@LAW
@given(st.floats(-3, 1), st.floats(-6, 2), st.floats(-3, 3))
def test_the_noise_is_a_covariance(log_alpha: float, log_u: float, log_sd: float) -> None:
    alpha, variance = 10.0**log_alpha, 10.0 ** (2 * log_sd)
    Q = noise(alpha, variance, 10.0**log_u / alpha)
    scale = 1.0 / np.sqrt(np.diag(Q))
    assert np.linalg.eigvalsh(Q * np.outer(scale, scale)).min() > -1e-12


@LAW
@given(st.floats(-2, 1), st.floats(1e-4, 5.0), st.floats(1e-4, 5.0))
def test_two_steps_are_one(log_alpha: float, first: float, second: float) -> None:
    alpha = 10.0**log_alpha

    def whole(dt_s: float) -> FloatArray:
        step = transition(alpha, dt_s)
        return np.array([[1.0, dt_s, step[0]], [0.0, 1.0, step[1]], [0.0, 0.0, step[2]]])

    A, B = whole(first), whole(second)
    np.testing.assert_allclose(B @ A, whole(first + second), rtol=1e-9)
    Q = B @ noise(alpha, 2.0, first) @ B.T + noise(alpha, 2.0, second)
    np.testing.assert_allclose(noise(alpha, 2.0, first + second), Q, rtol=1e-9)


def test_nothing_happens_in_no_time() -> None:
    assert not noise(0.5, 4.0, 0.0).any()
    assert transition(0.5, 0.0).tolist() == [0.0, 0.0, 1.0]
