"""Covariance intersection: against the definition, and what must hold whatever two estimates have in common."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trackmesh.services.estimation.extrapolation import extrapolate
from trackmesh.services.estimation.intersection import intersect

FloatArray = npt.NDArray[np.float64]

SCALE = np.array([80.0, 80.0, 8.0, 8.0])


def covariances(rng: np.random.Generator, n: int, d: int = 4, stretch: float = 2.0) -> FloatArray:
    """Of any direction, with axes of quite different length."""
    turn = np.linalg.qr(rng.normal(size=(n, d, d)))[0]
    axes = np.exp(stretch * rng.normal(size=(n, 1, d)))
    scale = SCALE[:d] if d <= 4 else np.ones(d)
    P = (turn * axes) @ np.swapaxes(turn, 1, 2) * np.outer(scale, scale)
    return np.asarray(0.5 * (P + np.swapaxes(P, 1, 2)))


def one(x: FloatArray, P: FloatArray, y: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    got, cov, w = intersect(x[None], P[None], y[None], R[None])
    return got[0], cov[0], float(w[0])


def by_definition(
    w: float, x: FloatArray, P: FloatArray, y: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    A, B = np.linalg.inv(P), np.linalg.inv(R)
    cov = np.linalg.inv(w * A + (1.0 - w) * B)
    return cov @ (w * A @ x + (1.0 - w) * B @ y), cov


def volume(P: FloatArray) -> float:
    return float(np.linalg.slogdet(P)[1])


# --- oracle ---


@pytest.mark.parametrize("d", [2, 4, 6])
def test_the_weight_is_the_best_of_all_and_the_estimate_that_of_the_definition(d: int) -> None:
    rng = np.random.default_rng(1)
    P, R = covariances(rng, 40, d), covariances(rng, 40, d)
    x, y = rng.normal(size=(40, d)), rng.normal(size=(40, d))
    got, cov, weight = intersect(x, P, y, R)
    every = np.linspace(1e-9, 1.0 - 1e-9, 4001)
    inner = 0
    for k in range(40):
        volumes = [volume(by_definition(w, x[k], P[k], y[k], R[k])[1]) for w in every[:: 1 if k < 4 else 40].tolist()]
        assert volume(cov[k]) <= min(volumes) + 1e-9
        assert 0.0 <= weight[k] <= 1.0
        inner += 0.0 < weight[k] < 1.0
        mean, P_k = by_definition(float(weight[k]), x[k], P[k], y[k], R[k])
        np.testing.assert_allclose(got[k], mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(cov[k], P_k, rtol=1e-7, atol=1e-9)
    assert inner > 10, "the scene must have pairs that both say something"


# --- laws ---

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.floats(0.0, 2.5))
@settings(max_examples=150, deadline=None)
def test_it_is_never_surer_than_the_errors_allow_whatever_they_have_in_common(seed: int, stretch: float) -> None:
    rng = np.random.default_rng(seed)
    P, R = covariances(rng, 1, stretch=stretch)[0], covariances(rng, 1, stretch=stretch)[0]
    _, cov, w = one(np.zeros(4), P, np.zeros(4), R)
    # Any correlation: P^1/2 K R^1/2 with a contraction K.
    K = np.linalg.qr(rng.normal(size=(4, 4)))[0] * rng.uniform(-1.0, 1.0, 4)
    C = np.linalg.cholesky(P) @ K @ np.linalg.cholesky(R).T
    S = w * R + (1.0 - w) * P
    G = (1.0 - w) * P @ np.linalg.inv(S) if 0.0 < w < 1.0 else (1.0 - w) * np.eye(4)
    J = np.eye(4) - G
    true = J @ P @ J.T + J @ C @ G.T + G @ C.T @ J.T + G @ R @ G.T
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    assert np.linalg.eigvalsh(whiten @ true @ whiten.T).max() <= 1.0 + 1e-6


@given(seeds)
@settings(max_examples=100, deadline=None)
def test_it_lies_between_its_inputs_and_is_no_larger_than_either(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, R = covariances(rng, 2)
    _, cov, _ = one(np.zeros(4), P, np.zeros(4), R)
    assert volume(cov) <= min(volume(P), volume(R)) + 1e-9
    np.testing.assert_array_equal(cov, cov.T)
    # Of information in any direction there is never more than the better of the two has.
    u = np.linalg.inv(np.linalg.cholesky(P)) if volume(P) < volume(R) else np.linalg.inv(np.linalg.cholesky(R))
    for v in [*np.eye(4), *rng.normal(size=(6, 4)), *u]:
        best = max(v @ np.linalg.solve(M, v) for M in (P, R))
        assert v @ np.linalg.solve(cov, v) <= best * (1.0 + 1e-6)


@given(seeds)
@settings(max_examples=100, deadline=None)
def test_it_does_not_matter_who_comes_first_nor_in_which_units(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, R = covariances(rng, 2)
    x, y = rng.normal(size=(2, 4)) * SCALE
    got, cov, w = one(x, P, y, R)
    other, other_cov, v = one(y, R, x, P)
    assert v == pytest.approx(1.0 - w, abs=1e-6)
    np.testing.assert_allclose(cov, other_cov, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(got, other, rtol=1e-4, atol=1e-4)
    T = np.diag([1e-3, 1e-3, 3.6, 3.6])
    scaled, scaled_cov, u = one(T @ x, T @ P @ T, T @ y, T @ R @ T)
    assert u == pytest.approx(w, abs=1e-6)
    np.testing.assert_allclose(scaled_cov, T @ cov @ T, rtol=1e-5)
    np.testing.assert_allclose(scaled, T @ got, rtol=1e-4, atol=1e-4)


@given(seeds, st.floats(1.001, 1e9))
@settings(max_examples=100, deadline=None)
def test_who_knows_nothing_more_changes_nothing(seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    P, more = covariances(rng, 2)
    R = factor * P + more * rng.integers(0, 2)
    x, y = rng.normal(size=(2, 4))
    got, cov, w = one(x, P, y, R)
    assert w == 1.0
    np.testing.assert_array_equal(got, x)
    np.testing.assert_array_equal(cov, P)
    got, cov, w = one(y, R, x, P)
    assert w == 0.0
    np.testing.assert_array_equal(got, x)
    np.testing.assert_array_equal(cov, P)


def test_each_gives_what_it_knows_well() -> None:
    x, P = np.array([1.0, 0.0]), np.diag([1.0, 100.0])
    y, R = np.array([0.0, 1.0]), np.diag([100.0, 1.0])
    got, cov, w = one(x, P, y, R)
    assert w == pytest.approx(0.5)
    np.testing.assert_allclose(cov, np.eye(2) * 2.0 / 1.01, rtol=1e-9)
    np.testing.assert_allclose(got, [1.0 / 1.01, 1.0 / 1.01])


@pytest.mark.parametrize(
    "wrong", [np.full((4, 4), np.nan), np.diag([1.0, -1.0, 1.0, 1.0]), np.zeros((4, 4)), np.diag([np.inf] * 4)]
)
def test_a_covariance_that_is_none_leaves_the_first_estimate(wrong: FloatArray) -> None:
    x, P, y = np.ones(4), np.eye(4), np.zeros(4)
    got, cov, w = one(x, P, y, wrong)
    assert w == 1.0
    np.testing.assert_array_equal(got, x)
    np.testing.assert_array_equal(cov, P)


def test_of_no_pairs_there_is_nothing() -> None:
    none = np.empty((0, 4)), np.empty((0, 4, 4))
    x, P, w = intersect(*none, *none)
    assert x.shape == (0, 4) and P.shape == (0, 4, 4) and w.shape == (0,)


# --- extrapolation ---


def test_extrapolation_is_constant_velocity_with_white_acceleration_noise_in_both_directions() -> None:
    rng = np.random.default_rng(2)
    x, P = rng.normal(size=(5, 4)), covariances(rng, 5)
    t_s, q = np.array([0.0, 1.0, 2.5, 4.0, 7.0]), 3.0
    got, cov = extrapolate(x, P, t_s, 2.5, q)
    for k, dt in enumerate((2.5 - t_s).tolist()):
        F = np.eye(4)
        F[0, 2] = F[1, 3] = dt
        # The noise is that of the way, wherever it is begun: G(s) = [(dt - s) I, I], s from 0 to dt.
        s = (np.arange(4000) + 0.5) / 4000 * dt
        Q = np.zeros((4, 4))
        pp, pv, vv = ((dt - s) ** 2).mean() * abs(dt), (dt - s).mean() * abs(dt), abs(dt)
        for a in range(2):
            Q[a, a], Q[a, a + 2], Q[a + 2, a], Q[a + 2, a + 2] = q * pp, q * pv, q * pv, q * vv
        np.testing.assert_allclose(got[k], F @ x[k], rtol=1e-12)
        np.testing.assert_allclose(cov[k], F @ P[k] @ F.T + Q, rtol=1e-6)
    np.testing.assert_array_equal(got[2], x[2])
    np.testing.assert_array_equal(cov[2], P[2])


@given(seeds, st.floats(-50.0, 50.0))
@settings(max_examples=60, deadline=None)
def test_an_extrapolated_covariance_is_one_and_the_input_is_left_alone(seed: int, to_s: float) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=(3, 4)), covariances(rng, 3)
    x_before, P_before = x.copy(), P.copy()
    _, cov = extrapolate(x, P, np.zeros(3), to_s, 10.0)
    np.linalg.cholesky(cov)
    np.testing.assert_array_equal(cov, np.swapaxes(cov, 1, 2))
    np.testing.assert_array_equal(x, x_before)
    np.testing.assert_array_equal(P, P_before)
