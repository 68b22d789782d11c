from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest
import scipy.linalg
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.alpha_beta_makers import filtered, held, scales, simulated
from tests.services.estimation.makers import LAW, FloatArray, seeds

from trackmesh.services.estimation import alpha_beta as ab

VARIANCES_V = np.array([0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 28.0, 35.0])
INTERVALS_S = np.array([0.5, 1.0, 2.0, 6.0, 10.0, 12.0])
LAMBDAS = ab.manoeuvring_index(INTERVALS_S, np.sqrt(VARIANCES_V)[:, None], np.array([5.0, 20.0])[:, None, None]).ravel()
"""The manoeuvring indices of the 120 cells of Qiu and Qiu (2016)."""

lambdas = st.floats(-4.0, 3.0).map(lambda e: 10.0**e)
counts = st.integers(1, 500)


def flow(dt_s: float) -> FloatArray:
    return np.array([[1.0, dt_s], [0.0, 1.0]])


def noise(dt_s: float, sigma_v: float) -> FloatArray:
    G = np.array([dt_s * dt_s / 2.0, dt_s])
    return np.asarray(sigma_v * sigma_v * np.outer(G, G))


def dense_kalman(dt_s: float, sigma_v: float, sigma_w: float, n: int) -> tuple[FloatArray, FloatArray]:
    """Textbook filter of one coordinate after a two-point start: gains (n - 2, 2) and covariances (n - 2, 2, 2)."""
    R, H, Q = sigma_w**2, np.array([1.0, 0.0]), noise(dt_s, sigma_v)
    P = R * np.array([[1.0, 1.0 / dt_s], [1.0 / dt_s, 2.0 / dt_s**2]])
    P[1, 1] += (dt_s * sigma_v / 2.0) ** 2
    gains, covariances = [], []
    for _ in range(n - 2):
        P = flow(dt_s) @ P @ flow(dt_s).T + Q
        K = P @ H / (H @ P @ H + R)
        left = np.eye(2) - np.outer(K, H)
        P = left @ P @ left.T + R * np.outer(K, K)
        gains.append(K)
        covariances.append(P)
    return np.array(gains), np.array(covariances)


def position_rms(gains: tuple[FloatArray, FloatArray], index: FloatArray) -> FloatArray:
    """Over plots 2 to n of gains (..., n), in units of sigma_w."""
    return np.asarray(np.sqrt(ab.error_covariances(*gains, 1.0, index, 1.0)[..., 1:, 0, 0].mean(axis=-1)))


# gains


@LAW
@given(lambdas)
def test_steady_gains_keep_kalatas_relations(index: float) -> None:
    alpha, beta = ab.steady_gains(index)
    root = np.sqrt(index * index + 8.0 * index)
    np.testing.assert_allclose(beta**2, index**2 * (1.0 - alpha), rtol=1e-9)
    np.testing.assert_allclose(beta, 2.0 * (2.0 - alpha) - 4.0 * np.sqrt(1.0 - alpha), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(alpha, -(index**2 + 8.0 * index - (index + 4.0) * root) / 8.0, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(beta, (index**2 + 4.0 * index - index * root) / 4.0, rtol=1e-6, atol=1e-9)


@LAW
@given(lambdas)
def test_steady_gains_are_where_the_kalman_filter_ends(index: float) -> None:
    # The Riccati equation of the predicted covariance, solved by other people.
    H, Q = np.array([[1.0], [0.0]]), noise(1.0, index)
    P = scipy.linalg.solve_discrete_are(flow(1.0).T, H, Q, np.eye(1))
    K = P[:, 0] / (P[0, 0] + 1.0)
    np.testing.assert_allclose(np.array(ab.steady_gains(index)), K, rtol=1e-5)


@pytest.mark.parametrize("index", ["1e-12", "1e-6", "1", "1e6"])
def test_steady_gains_lose_no_digits(index: str) -> None:
    with localcontext(prec=60):
        exact = Decimal(index)
        r = (4 + exact - (exact * exact + 8 * exact).sqrt()) / 4
        alpha, beta = float(1 - r * r), float(2 * (1 - r) ** 2)
    np.testing.assert_allclose(np.array(ab.steady_gains(float(index))), [alpha, beta], rtol=1e-14)


def test_without_manoeuvres_the_steady_gains_are_zero() -> None:
    np.testing.assert_array_equal(ab.steady_gains(0.0), [0.0, 0.0])


def test_decreasing_gains_are_the_kalman_filter_without_process_noise() -> None:
    dt_s, rng = 1.7, np.random.default_rng(3)
    z = np.cumsum(rng.normal(20.0, 5.0, 60))
    oracle = KalmanFilter(dim_x=2, dim_z=1)
    oracle.F, oracle.H, oracle.Q, oracle.R = flow(dt_s), np.array([[1.0, 0.0]]), np.zeros((2, 2)), np.array([[25.0]])
    oracle.x = np.array([[z[1]], [(z[1] - z[0]) / dt_s]])
    oracle.P = 25.0 * np.array([[1.0, 1.0 / dt_s], [1.0 / dt_s, 2.0 / dt_s**2]])
    x = filtered(np.stack([z, -z], -1)[:, None], np.full(60, dt_s), *held(np.array(1000), 60))[:, 0]
    for k in range(2, 60):
        oracle.predict()
        oracle.update(z[k])
        np.testing.assert_allclose(x[k, [0, 2]], oracle.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(x[k, [1, 3]], -oracle.x[:, 0], atol=1e-9)


@LAW
@given(seeds, st.integers(2, 80), scales)
def test_decreasing_gains_draw_the_least_squares_line(seed: int, n: int, dt_s: float) -> None:
    z = np.random.default_rng(seed).normal(0.0, 100.0, n)
    x = filtered(np.stack([z, z], -1)[:, None], np.full(n, dt_s), *held(np.array(1000), n))[-1, 0]
    slope, level = np.polyfit(np.arange(1 - n, 1), z, 1)
    np.testing.assert_allclose(x, [level, level, slope / dt_s, slope / dt_s], rtol=1e-8, atol=1e-8 / min(dt_s, 1.0))


def test_kalman_gains_are_those_of_the_textbook_filter() -> None:
    for index in (0.0, 0.01, 0.7, 30.0):
        alpha, beta = ab.kalman_gains(40, index)
        gains, _ = dense_kalman(2.0, index / 4.0, 1.0, 40)
        np.testing.assert_allclose(alpha[2:], gains[:, 0], rtol=1e-9)
        np.testing.assert_allclose(beta[2:], 2.0 * gains[:, 1], rtol=1e-9)
        np.testing.assert_array_equal([alpha[:2], beta[:2]], [[1.0, 1.0], [0.0, 1.0]])


@LAW
@given(counts, lambdas)
def test_combined_gains_are_the_greater_ones_after_the_start(k: int, index: float) -> None:
    combined, falling, steady = ab.combined_gains(k, index), ab.decreasing_gains(k), ab.steady_gains(index)
    np.testing.assert_array_equal(combined, np.maximum(falling, steady) if k > 2 else falling)


def test_combined_gains_lose_a_thousandth_to_the_kalman_filter() -> None:
    combined = ab.combined_gains(np.arange(1, 101), LAMBDAS[:, None])
    ratio = position_rms(combined, LAMBDAS) / position_rms(ab.kalman_gains(100, LAMBDAS), LAMBDAS)
    assert np.all(ratio >= 1.0 - 1e-12)
    assert ratio.mean() <= 1.001
    assert ratio.max() <= 1.001


def test_the_rule_finds_the_best_k_end() -> None:
    k_end = np.arange(2, 81)
    best = k_end[position_rms(held(k_end, 100), LAMBDAS[:, None]).argmin(axis=1)]
    off = np.abs(ab.k_end_rule(LAMBDAS) - best)
    assert np.sum(off == 0) >= 112
    assert off.max() <= 1


@LAW
@given(lambdas, lambdas)
def test_the_rule_falls_with_lambda(a: float, b: float) -> None:
    low, high = ab.k_end_rule(np.array([min(a, b), max(a, b)]))
    assert low >= high >= 2


def test_the_rule_tells_a_time_of_memory() -> None:
    for dt_s in (0.01, 0.02, 0.04):
        k_end = float(ab.k_end_rule(ab.manoeuvring_index(dt_s, 2.0, 50.0)))
        assert k_end * dt_s == pytest.approx(2.64 * np.sqrt(50.0 / 2.0), rel=0.01)


def test_without_manoeuvres_there_is_no_end() -> None:
    with pytest.raises(ValueError, match="positive"):
        ab.k_end_rule(np.array([0.1, 0.0]))


# the filter


@LAW
@given(seeds)
def test_a_step_is_the_textbook_for_each_track_and_coordinate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, z, dt_s = rng.normal(size=(5, 4)), rng.normal(size=(5, 2)), rng.uniform(0.1, 5.0, 5)
    k, alpha, beta = np.array([2, 3, 50, 7, 9]), rng.uniform(0.1, 1.0, 5), rng.uniform(0.01, 1.0, 5)
    before = x.copy()
    got = ab.step(x, z, dt_s, k, alpha, beta)
    assert np.array_equal(x, before)
    for i in range(5):
        for a in range(2):
            K = np.array([alpha[i], beta[i] / dt_s[i]])
            predicted = flow(dt_s[i]) @ x[i, [a, a + 2]]
            np.testing.assert_allclose(
                got[i, [a, a + 2]], predicted + K * (z[i, a] - predicted[0]), rtol=1e-12, atol=1e-12
            )


def test_a_first_plot_starts_the_track_whatever_was_there() -> None:
    alpha, beta = ab.decreasing_gains(np.array([1]))
    got = ab.step(np.full((1, 4), np.nan), np.array([[3.0, 4.0]]), np.array([0.0]), np.array([1]), alpha, beta)
    np.testing.assert_array_equal(got, [[3.0, 4.0, 0.0, 0.0]])


def test_two_plots_of_one_time_leave_the_velocity() -> None:
    x, z = np.array([[0.0, 0.0, 5.0, 6.0]]), np.array([[1.0, 2.0]])
    got = ab.step(x, z, np.array([0.0]), np.array([9]), np.array([0.5]), np.array([0.2]))
    np.testing.assert_array_equal(got, [[0.5, 1.0, 5.0, 6.0]])


@LAW
@given(seeds, lambdas, scales, scales)
def test_the_filter_depends_on_lambda_only(seed: int, index: float, metres: float, seconds: float) -> None:
    z = np.random.default_rng(seed).normal(size=(30, 2, 2))
    gains = ab.combined_gains(np.arange(1, 31), index)
    unit = filtered(z, np.ones(30), *gains)
    scaled = filtered(z * metres, np.full(30, seconds), *gains)
    factor = metres * np.array([1.0, 1.0, 1.0 / seconds, 1.0 / seconds])
    np.testing.assert_allclose(scaled, unit * factor, rtol=1e-8, atol=float(1e-9 * factor.max()))


# errors


@LAW
@given(lambdas, scales, scales)
def test_errors_depend_on_lambda_only(index: float, metres: float, seconds: float) -> None:
    gains = held(np.array([2, 7, 40]), 50)
    unit = ab.error_covariances(*gains, 1.0, index, 1.0)[:, 1:]
    scaled = ab.error_covariances(*gains, seconds, index * metres / seconds**2, metres)[:, 1:]
    np.testing.assert_allclose(
        scaled, unit * metres**2 * np.array([[1.0, 1.0 / seconds], [1.0 / seconds, 1.0 / seconds**2]])
    )


@LAW
@given(lambdas, st.integers(2, 40), scales)
def test_error_covariances_equal_the_matrix_form(index: float, k_end: int, dt_s: float) -> None:
    sigma_v, R = index * 3.0 / dt_s**2, 9.0
    alpha, beta = held(np.array(k_end), 60)
    got = ab.error_covariances(alpha, beta, dt_s, sigma_v, 3.0)
    assert np.isinf(got[0, 1, 1])
    P = np.diag([R, 0.0])
    for k in range(1, 60):
        K = np.array([alpha[k], beta[k] / dt_s])
        left = np.eye(2) - np.outer(K, [1.0, 0.0])
        P = left @ (flow(dt_s) @ P @ flow(dt_s).T + noise(dt_s, sigma_v)) @ left.T + R * np.outer(K, K)
        np.testing.assert_allclose(got[k], P, rtol=1e-9, atol=float(1e-12 * P.max()))
        assert np.all(np.linalg.eigvalsh(got[k]) >= -1e-12 * P.max())


def test_error_covariances_are_what_simulated_tracks_show() -> None:
    truth, z = simulated(0.3, 4000, 30, 1)
    gains = held(np.array(8), 30)
    error = filtered(z, np.ones(30), *gains) - truth
    P = ab.error_covariances(*gains, 1.0, 0.3, 1.0)
    for k in (1, 2, 7, 29):
        pairs = error[k].reshape(-1, 2, 2).swapaxes(1, 2).reshape(-1, 2)
        np.testing.assert_allclose(np.cov(pairs.T), P[k], rtol=0.05, atol=0.02)


def test_with_kalman_gains_they_are_those_of_the_kalman_filter() -> None:
    _, covariances = dense_kalman(2.0, 0.4, 3.0, 40)
    got = ab.error_covariances(*ab.kalman_gains(40, ab.manoeuvring_index(2.0, 0.4, 3.0)), 2.0, 0.4, 3.0)
    np.testing.assert_allclose(got[2:], covariances, rtol=1e-9)


def test_without_process_noise_they_are_those_of_the_line() -> None:
    k, dt_s, R = np.arange(2, 40), 3.0, 16.0
    P = ab.error_covariances(*held(np.array(1000), 39), dt_s, 0.0, 4.0)[1:]
    np.testing.assert_allclose(P[:, 0, 0], R * 2 * (2 * k - 1) / (k * (k + 1)))
    np.testing.assert_allclose(P[:, 0, 1], R * 6 / (k * (k + 1) * dt_s))
    np.testing.assert_allclose(P[:, 1, 1], R * 12 / (dt_s**2 * k * (k**2 - 1)))


def test_a_wrong_start_is_refused() -> None:
    alpha, beta = held(np.array(9), 10)
    for wrong in ((alpha[1:], beta[1:]), (alpha[:1], beta[:1])):
        with pytest.raises(ValueError, match="first two plots"):
            ab.error_covariances(*wrong, 1.0, 1.0, 1.0)


stable = st.tuples(st.floats(0.02, 1.0), st.floats(0.02, 0.9)).map(lambda v: (v[0], v[1] * (4.0 - 2.0 * v[0])))


@LAW
@given(stable, lambdas, scales)
def test_steady_covariance_solves_its_equation(gains: tuple[float, float], index: float, dt_s: float) -> None:
    sigma_v, R = index * 3.0 / dt_s**2, 9.0
    P = ab.steady_covariance(*gains, dt_s, sigma_v, 3.0)
    K = np.array([gains[0], gains[1] / dt_s])
    left = np.eye(2) - np.outer(K, [1.0, 0.0])
    scale = np.outer([1.0, dt_s], [1.0, dt_s])
    right = left @ (flow(dt_s) @ P @ flow(dt_s).T + noise(dt_s, sigma_v)) @ left.T + R * np.outer(K, K)
    np.testing.assert_allclose(P * scale, right * scale, rtol=1e-7, atol=float(1e-9 * (P * scale).max()))
    assert P[0, 1] == P[1, 0]
    assert np.all(np.linalg.eigvalsh(P * scale) > -1e-9 * (P * scale).max())


@LAW
@given(lambdas)
def test_steady_covariance_of_steady_gains_is_the_kalman_filters(index: float) -> None:
    alpha, beta = ab.steady_gains(index)
    P = ab.steady_covariance(alpha, beta, 2.0, index * 3.0 / 4.0, 3.0) / 9.0
    np.testing.assert_allclose(P[0, 0], alpha, rtol=1e-6)
    np.testing.assert_allclose(P[0, 1], beta / 2.0, rtol=1e-6)
    np.testing.assert_allclose(P[1, 1], beta * (alpha - beta / 2.0) / (1.0 - alpha) / 4.0, rtol=1e-5)


def test_steady_covariance_is_where_errors_end_and_broadcasts() -> None:
    index, k_end = np.array([0.05, 0.3, 2.0]), np.array([[4], [11]])
    ends = ab.error_covariances(*held(k_end, 400), 1.5, index, 2.0)[..., -1, :, :]
    got = ab.steady_covariance(*ab.decreasing_gains(k_end), 1.5, index, 2.0)
    assert got.shape == (2, 3, 2, 2)
    np.testing.assert_allclose(got, ends, rtol=1e-9)


@pytest.mark.parametrize(
    ("alpha", "beta", "dt_s"), [(0.0, 0.1, 1.0), (0.5, 0.0, 1.0), (0.5, 3.0, 1.0), (0.5, 0.1, 0.0), (1.0, np.nan, 1.0)]
)
def test_unstable_gains_have_no_steady_covariance(alpha: float, beta: float, dt_s: float) -> None:
    with pytest.raises(ValueError, match="needs alpha > 0"):
        ab.steady_covariance(alpha, beta, dt_s, 1.0, 1.0)
