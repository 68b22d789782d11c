"""Prediction against dense matrices, mixing against the brute-force mixture."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.tags.makers import LAW, FloatArray, One, covariance, dense_singer, seeds

from trackmesh.services.tags.prediction import predict

SHARED = {"bias_sd_m": 1.0, "scale_sd": 0.1}


def random_state(one: One, seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    d = one.f.x.shape[1]
    x, P = rng.normal(size=d), covariance(rng, d)
    one.begin().set(x, P)
    return x, P


@pytest.mark.parametrize("more", [{}, SHARED])
@LAW
@given(seed=seeds, dt_s=st.floats(1e-4, 30.0))
def test_singer_is_the_dense_product(more: dict[str, float], seed: int, dt_s: float) -> None:
    one = One(alpha=0.7, acceleration_mps2=1.5, bias_drift=0.01, scale_drift=0.002, **more)
    x, P = random_state(one, seed)
    F, Q = dense_singer(0.7, 1.5**2, dt_s, len(x))
    if more:
        Q[6, 6], Q[7, 7] = 0.01 * dt_s, 0.002 * dt_s
    predict(one.rules[0], one.f, dt_s, one.work[0])
    np.testing.assert_allclose(one.f.x[0], F @ x, rtol=1e-9, atol=1e-9)
    want = F @ P @ F.T + Q
    np.testing.assert_allclose(one.f.P[0], want, rtol=1e-9, atol=1e-9 * np.abs(want).max())
    assert (one.f.P[0] == one.f.P[0].T).all()
    assert one.f.t_s == dt_s


def test_each_axis_may_have_its_own_acceleration() -> None:
    one = One()
    x, P = random_state(one, 3)
    one.f.alpha[:], one.f.variance[:] = (0.3, 2.0), (4.0, 0.25)
    predict(one.rules[0], one.f, 0.8, one.work[0])
    F, Q = np.eye(6), np.zeros((6, 6))
    for axis, (alpha, variance) in enumerate(((0.3, 4.0), (2.0, 0.25))):
        Fa, Qa = dense_singer(alpha, variance, 0.8)
        own = np.ix_([axis, axis + 2, axis + 4], [axis, axis + 2, axis + 4])
        F[own], Q[own] = Fa[own], Qa[own]
    np.testing.assert_allclose(one.f.x[0], F @ x, rtol=1e-12)
    np.testing.assert_allclose(one.f.P[0], F @ P @ F.T + Q, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("motion", ["singer", "tvimm"])
def test_no_time_changes_nothing(motion: str) -> None:
    one = One(motion=motion)
    random_state(one, 1)
    before = one.filters.copy()
    for t_s in (0.0, -1.0):
        predict(one.rules[0], one.f, t_s, one.work[0])
    assert (one.filters == before).all()


def dense_models(one: One, x: FloatArray, P: FloatArray, dt_s: float) -> list[tuple[FloatArray, FloatArray]]:
    """Random walk, constant velocity and Singer of (3, 6), (3, 6, 6), by whole matrices."""
    rules = one.rules[0]
    prior = np.diag([0, 0, 0, 0, rules.variance, rules.variance])
    walk, velocity = np.diag([1.0, 1, 0, 0, 0, 0]), np.diag([1.0, 1, 1, 1, 0, 0])
    velocity[0, 2] = velocity[1, 3] = dt_s
    Qw = prior + np.diag([rules.walk * dt_s] * 2 + [rules.speed_variance] * 2 + [0, 0])
    Qv = prior.copy()
    for i in range(2):
        Qv[i, i], Qv[i + 2, i + 2] = rules.velocity * dt_s**3 / 3, rules.velocity * dt_s
        Qv[i, i + 2] = Qv[i + 2, i] = rules.velocity * dt_s**2 / 2
    flows = [(walk, Qw), (velocity, Qv), dense_singer(rules.alpha, rules.variance, dt_s)]
    return [(F @ x[j], F @ P[j] @ F.T + Q) for j, (F, Q) in enumerate(flows)]


@LAW
@given(seed=seeds, dt_s=st.floats(1e-3, 60.0))
def test_models_are_mixed_and_moved_as_the_chain_says(seed: int, dt_s: float) -> None:
    one = One(motion="tvimm", sojourn_s=4.0).begin()
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=(3, 6)), np.array([covariance(rng, 6) for _ in range(3)])
    mu = rng.dirichlet(np.ones(3))
    one.f.x[:], one.f.P[:], one.f.mu[:] = x, P, mu
    generator = (np.ones((3, 3)) / 2 - 1.5 * np.eye(3)) / 4.0
    values, vectors = np.linalg.eigh(generator)
    chain = vectors @ np.diag(np.exp(values * dt_s)) @ vectors.T
    c = mu @ chain
    weight = mu[:, None] * chain / c
    mean = weight.T @ x
    spread = [sum(weight[a, j] * (P[a] + np.outer(x[a] - mean[j], x[a] - mean[j])) for a in range(3)) for j in range(3)]
    predict(one.rules[0], one.f, dt_s, one.work[0])
    np.testing.assert_allclose(one.f.mu, c, rtol=1e-10)
    for j, (xj, Pj) in enumerate(dense_models(one, mean, np.array(spread), dt_s)):
        np.testing.assert_allclose(one.f.x[j], xj, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(one.f.P[j], Pj, rtol=1e-8, atol=1e-8 * max(1.0, np.abs(Pj).max()))
        assert (one.f.P[j] == one.f.P[j].T).all()
    assert math.isclose(one.f.mu.sum(), 1.0)


def test_a_tag_unheard_for_long_may_be_anywhere_but_not_at_any_speed() -> None:
    one = One(motion="tvimm", speed_mps=2.0).begin(sigma=1.0)
    predict(one.rules[0], one.f, 60.0, one.work[0])
    assert math.sqrt(one.f.P[1, 0, 0]) > 20.0
    assert math.sqrt(one.f.P[0, 2, 2]) == pytest.approx(2.0)
