from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, FloatArray, covariance, flow, noise, seeds

from trackmesh.services.estimation.motion import (
    CONSTANT_ACCELERATION,
    CONSTANT_VELOCITY,
    RANDOM_WALK,
    SINGER,
    STATES,
    TANGENTIAL,
    TURN,
    acceleration_matrix,
    linear_flow,
    predict_constant_velocity,
    predict_model,
    tangential,
    turn,
)
from trackmesh.services.estimation.noise import white_jerk

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


# --- turns and speed changes ---

FOREVER_S = 1e300
"""A correlation time with which nothing decays."""

Move = Callable[[FloatArray, float, float, float, FloatArray], Any]


def moved(move: Move, x: FloatArray, dt_s: float, mean: float = 0.0, time_s: float = FOREVER_S) -> FloatArray:
    out = x.copy()
    move(out, mean, time_s, dt_s, np.empty((6, 6)))
    return out


def jacobian(f: Callable[[FloatArray], FloatArray], x: FloatArray, step: FloatArray) -> FloatArray:
    """Central differences of fourth order."""
    columns = []
    for k, h in enumerate(step):
        e = np.zeros(len(x))
        e[k] = h
        near, far = f(x + e) - f(x - e), f(x + 2 * e) - f(x - 2 * e)
        columns.append((8.0 * near - far) / (12.0 * h))
    return np.array(columns).T


def assert_jacobian(move: Move, x: FloatArray, dt_s: float, mean: float, step: FloatArray) -> None:
    """Each column to 1e-6 of its largest entry: that is how well differences know it."""
    F = np.empty((6, 6))
    move(x.copy(), mean, 30.0, dt_s, F)
    want = jacobian(lambda y: moved(move, y, dt_s, mean, 30.0), x, step)
    assert np.all(abs(F[:5, :5] - want) <= 1e-6 * abs(want).max(axis=0))


turn_rates = st.one_of(st.floats(-0.2, 0.2), st.floats(-1e-4, 1e-4), st.just(0.0))


@LAW
@given(seed=seeds, w=turn_rates, dt=st.floats(0.01, 10.0))
def test_the_jacobian_of_a_turn(seed: int, w: float, dt: float) -> None:
    x = np.array([*start(seed)[0], w])
    assert_jacobian(turn, x, dt, 0.05, np.array([1.0, 1.0, 1.0, 1.0, 1e-3 / dt]))


@LAW
@given(seed=seeds, a=st.floats(-15.0, 15.0), dt=st.floats(0.01, 10.0), speed=st.floats(1.5, 400.0))
def test_the_jacobian_of_a_speed_change(seed: int, a: float, dt: float, speed: float) -> None:
    heading = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    x = np.array([100.0, -50.0, speed * np.cos(heading), speed * np.sin(heading), a])
    # Differences in velocity small beside the speed; the direction is all that is not linear in it.
    assert_jacobian(tangential, x, dt, 0.3, np.array([1.0, 1.0, 2e-3 * speed, 2e-3 * speed, 0.1]))


@LAW
@given(kind=st.sampled_from([SINGER, CONSTANT_ACCELERATION]), time_s=st.floats(0.5, 1e5), dt=st.floats(1e-3, 30.0))
def test_the_matrix_of_an_acceleration(kind: int, time_s: float, dt: float) -> None:
    A = np.zeros((6, 6))
    A[:4, 2:] = np.eye(4)
    if kind == SINGER:
        A[4:, 4:] = -np.eye(2) / time_s
    F = np.empty((6, 6))
    acceleration_matrix(kind, time_s, dt, F)
    np.testing.assert_allclose(F, scipy.linalg.expm(A * dt), rtol=1e-9, atol=1e-12)


@LAW
@given(seed=seeds, w=turn_rates, a=st.floats(0.0, 20.0), b=st.floats(0.0, 20.0))
def test_two_turns_are_one(seed: int, w: float, a: float, b: float) -> None:
    x = np.array([*start(seed)[0], w])
    np.testing.assert_allclose(moved(turn, moved(turn, x, a), b), moved(turn, x, a + b), rtol=1e-9, atol=1e-6)


def test_a_turn_keeps_its_speed_and_comes_round() -> None:
    x = np.array([0.0, 0.0, 200.0, 0.0, 2 * np.pi / 60.0])
    quarter = moved(turn, x, 15.0)
    radius = 200.0 * 60.0 / (2 * np.pi)
    np.testing.assert_allclose(quarter, [radius, radius, 0.0, 200.0, x[4]], atol=1e-9)
    np.testing.assert_allclose(moved(turn, x, 60.0), x, atol=1e-9)


@LAW
@given(seeds, times_s)
def test_without_a_turn_rate_it_flies_straight(seed: int, dt: float) -> None:
    x, _ = start(seed)
    np.testing.assert_allclose(moved(turn, np.array([*x, 0.0]), dt)[:4], flow(dt) @ x, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(moved(tangential, np.array([*x, 0.0]), dt)[:4], flow(dt) @ x, rtol=1e-12, atol=1e-9)


def test_a_speed_change_is_along_the_velocity() -> None:
    x = np.array([0.0, 0.0, 30.0, 40.0, 5.0])
    np.testing.assert_allclose(moved(tangential, x, 2.0), [66.0, 88.0, 36.0, 48.0, 5.0], atol=1e-12)


@pytest.mark.parametrize("move", [turn, tangential])
def test_own_parameters_go_back_to_their_mean(move: Move) -> None:
    x = moved(move, np.array([0.0, 0.0, 100.0, 0.0, 0.3]), 10.0, mean=0.1, time_s=10.0)
    assert x[4] == pytest.approx(0.1 + 0.2 * np.exp(-1.0))


# --- one model, any kind ---


def run_model(
    kind: int, numbers: list[float], x: FloatArray, P: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    x, P = x.copy(), P.copy()
    predict_model(kind, np.array(numbers), x, P, dt_s, np.empty((6, 6)), np.empty((6, 6)), np.empty(6))
    return x, P


def longer_start(seed: int, d: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    unit = np.array([30.0, 30.0, 5.0, 5.0, 0.02 if d == 5 else 2.0, 2.0])[:d]
    x = np.array([1e4, -2e4, 150.0, 80.0, 0.05, -0.1])[:d]
    return x + unit * rng.normal(size=d), covariance(rng, d) * np.outer(unit, unit)


@pytest.mark.parametrize("kind", range(6))
def test_no_time_changes_no_model(kind: int) -> None:
    x, P = longer_start(1, STATES[kind])
    got = run_model(kind, [1.0, 0.1, 0.1, 10.0], x, P, 0.0)
    assert np.array_equal(got[0], x)
    assert np.array_equal(got[1], P)


@pytest.mark.parametrize("kind", range(6))
@LAW
@given(seed=seeds, dt=st.floats(1e-3, 30.0))
def test_every_prediction_is_symmetric_and_larger_than_none(kind: int, seed: int, dt: float) -> None:
    x, P = longer_start(seed, STATES[kind])
    _, got = run_model(kind, [1.0, 0.05, 0.02, 10.0], x, P, dt)
    assert np.array_equal(got, got.T)
    scale = np.sqrt(np.diag(got))
    assert np.linalg.eigvalsh(got / np.outer(scale, scale))[0] > 0


def test_a_random_walk_stands_still() -> None:
    x, P = longer_start(2, 4)
    got_x, got_P = run_model(RANDOM_WALK, [3.0, 0.0, 0.0, 1.0], x, P, 4.0)
    assert np.array_equal(got_x, x)
    np.testing.assert_allclose(got_P - P, np.diag([12.0, 12.0, 0.0, 0.0]), atol=1e-9)


@LAW
@given(seeds, st.floats(0.1, 20.0))
def test_singer_with_a_long_memory_is_constant_acceleration(seed: int, dt: float) -> None:
    """With sd^2 = density time/2 as the time grows; the Singer model adds white acceleration, here next to none."""
    (x, P), density, time_s = longer_start(seed, 6), 0.5, 1e9
    singer = run_model(SINGER, [1e-12, 0.0, np.sqrt(density * time_s / 2.0), time_s], x, P, dt)
    constant = run_model(CONSTANT_ACCELERATION, [density, 0.0, 0.0, 1.0], x, P, dt)
    np.testing.assert_allclose(singer[0], constant[0], rtol=1e-6, atol=1e-5)
    unit = np.sqrt(np.diag(constant[1]))
    np.testing.assert_allclose(singer[1] / np.outer(unit, unit), constant[1] / np.outer(unit, unit), atol=1e-7)


def test_the_noise_of_constant_acceleration_is_white_jerk() -> None:
    block = np.empty(6)
    white_jerk(0.5, 3.0, block)
    _, P = run_model(CONSTANT_ACCELERATION, [0.5, 0.0, 0.0, 1.0], np.zeros(6), np.zeros((6, 6)), 3.0)
    want = np.zeros((3, 3))
    want[np.triu_indices(3)] = block
    np.testing.assert_allclose(P, np.kron(want + np.triu(want, 1).T, np.eye(2)), atol=1e-12)


def test_constant_velocity_is_the_same_by_kind() -> None:
    x, P = longer_start(3, 4)
    for got, want in zip(
        run_model(CONSTANT_VELOCITY, [2.0, 0.0, 0.0, 1.0], x, P, 3.0), predicted(x, P, 3.0, 2.0), strict=True
    ):
        assert np.array_equal(got, want)


@pytest.mark.parametrize("kind", [TURN, TANGENTIAL])
def test_a_prediction_is_the_jacobian_and_the_noise_of_the_own_parameter(kind: int) -> None:
    """Against sampled paths: the noise of turn rate (or acceleration) and of white acceleration."""
    rng, dt, n, steps = np.random.default_rng(4), 1.0, 40_000, 40
    sd, time_s, q = (0.02, 20.0, 0.25) if kind == TURN else (2.0, 20.0, 0.25)
    x0 = np.array([0.0, 0.0, 120.0, 50.0, 0.03 if kind == TURN else 1.5])
    x, h = np.tile(x0, (n, 1)), dt / steps
    keep, mean = np.exp(-h / time_s), x0[4]
    for _ in range(steps):
        speed = np.hypot(x[:, 2], x[:, 3])
        along = x[:, 2:4] / speed[:, None]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        a = along * x[:, 4:] if kind == TANGENTIAL else across * (speed * x[:, 4])[:, None]
        pushed = h * a + rng.normal(0.0, np.sqrt(q * h), (n, 2))
        x[:, :2] += h * (x[:, 2:4] + 0.5 * pushed)
        x[:, 2:4] += pushed
        x[:, 4] = mean + keep * (x[:, 4] - mean) + rng.normal(0.0, sd * np.sqrt(1 - keep * keep), n)
    got, P = run_model(kind, [q, mean, sd, time_s], x0, np.zeros((5, 5)), dt)
    np.testing.assert_allclose(got[:4], x.mean(axis=0)[:4], atol=0.1)
    want = np.cov(x.T)
    scale = np.sqrt(np.diag(want))
    np.testing.assert_allclose(P / np.outer(scale, scale), want / np.outer(scale, scale), atol=0.04)


def test_the_noise_of_a_turn_rate_acts_across_the_way_at_half_time() -> None:
    dt, w = 2.0, 0.2
    _, P = run_model(TURN, [1e-12, w, 0.02, 20.0], np.array([0.0, 0.0, 120.0, 50.0, w]), np.zeros((5, 5)), dt)
    heading = np.arctan2(50.0, 120.0) + 0.5 * w * dt
    along = np.array([np.cos(heading), np.sin(heading)])
    for block in (P[:2, :2], P[2:4, 2:4]):
        assert along @ block @ along < 1e-9 * np.trace(block)


@pytest.mark.parametrize("kind", range(6))
@LAW
@given(seed=seeds, dt=st.floats(0.01, 10.0))
def test_the_flow_that_is_left_behind_is_the_jacobian(kind: int, seed: int, dt: float) -> None:
    """Of whatever model: what the lags are carried by. Differences know it to 1e-6 of each column."""
    d = STATES[kind]
    (x, P), F, numbers = longer_start(seed, d), np.full((6, 6), np.nan), np.array([1.0, 0.05, 0.02, 10.0])

    def predicted_mean(y: FloatArray) -> FloatArray:
        out = y.copy()
        predict_model(kind, numbers, out, P.copy(), dt, F, np.empty((6, 6)), np.empty(6))
        return out

    want = jacobian(predicted_mean, x, np.array([1.0, 1.0, 0.2, 0.2, 1e-3 / dt, 1e-3 / dt])[:d])
    predicted_mean(x)
    linear_flow(kind, dt, F)
    assert np.all(abs(F[:d, :d] - want) <= 1e-6 * abs(want).max(axis=0))
