"""Position and velocity some plots ago, against filters of the augmented state [x_k, x_k-1, x_k-2]."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from tests.services.estimation.makers import (
    LAGGED,
    LAW,
    MODELS,
    TVIMM,
    TVIMM_LAGGED,
    FloatArray,
    Plot,
    assert_covariance,
    assert_scaled,
    assert_sound,
    batch,
    begun,
    chain_matrix,
    copied_state,
    feed_row,
    filtered,
    flow,
    fresh_filters,
    mixture_moments,
    noise,
    random_state,
    random_walk,
    same_present,
    seeds,
    unpacked,
    velocities,
)

from trackmesh.services.estimation import imm, tracks
from trackmesh.services.estimation import lags as lags_of
from trackmesh.services.estimation.bank import Models, State, make_work
from trackmesh.services.estimation.gating import make_mixture
from trackmesh.services.estimation.plots import Plots

LAGS = 2
WHOLE = 4 + 4 * LAGS
ALIKE = velocities((10.0, 10.0, 10.0), lags=2)
"""Three models that are one."""


# --- the augmented state, dense ---


class Augmented(NamedTuple):
    """Models of the state with its past: means (r, 12), covariances (r, 12, 12), probabilities (r,)."""

    X: FloatArray
    S: FloatArray
    mu: FloatArray


def start(s: State) -> Augmented:
    """The past of a filter that has just begun is its present."""
    same_thrice = np.tile(np.eye(4), (LAGS + 1, 1))
    return Augmented(s.x @ same_thrice.T, same_thrice @ s.P @ same_thrice.T, s.mu.copy())


def shifted(a: Augmented) -> Augmented:
    """[x, y1, y2] becomes [x, x, y1]."""
    T = np.zeros((WHOLE, WHOLE))
    T[:4, :4] = T[4:8, :4] = np.eye(4)
    T[8:, 4:-4] = np.eye(WHOLE - 8)
    return a._replace(X=a.X @ T.T, S=T @ a.S @ T.T)


def stepped(models: Models, a: Augmented, plot: Plots, dt: float) -> Augmented:
    """One cycle: mix, predict the present, update all with the plot."""
    pi, r = chain_matrix(models, dt), len(a.mu)
    c = a.mu @ pi
    X, S, ll = np.empty_like(a.X), np.empty_like(a.S), np.empty(r)
    A, Q = np.eye(WHOLE), np.zeros((WHOLE, WHOLE))
    A[:4, :4] = flow(dt)
    for j in range(r):
        X[j], S[j] = mixture_moments(a.X, a.S, a.mu * pi[:, j] / c[j])
        Q[:4, :4] = noise(dt, models.numbers[j, 0])
        X[j], S[j], ll[j] = measured(A @ X[j], A @ S[j] @ A.T + Q, plot)
    likelihood = np.exp(ll - ll.max())
    mu = np.maximum(c * likelihood / (c @ likelihood), imm.MU_FLOOR)
    return Augmented(X, S, mu / mu.sum())


def measured(x: FloatArray, P: FloatArray, plot: Plots) -> tuple[FloatArray, FloatArray, float]:
    """Position, then the range rate where it is known."""
    x, P, value = corrected(x, P, np.eye(2, WHOLE), plot["z"] - x[:2], unpacked(plot["R"]))
    if not np.isfinite(plot["range_rate_variance"]):
        return x, P, value
    off = x[:2] - plot["site"]
    u = off / np.linalg.norm(off)
    H = np.zeros((1, WHOLE))
    H[0, :4] = np.concatenate([(x[2:4] - (x[2:4] @ u) * u) / np.linalg.norm(off), u]) * plot["level"]
    nu = np.array([plot["range_rate_mps"] - plot["level"] * (x[2:4] @ u)])
    x, P, more = corrected(x, P, H, nu, np.array([[plot["range_rate_variance"]]]))
    return x, P, value + more


def corrected(
    x: FloatArray, P: FloatArray, H: FloatArray, nu: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    left = np.eye(WHOLE) - K @ H
    log_likelihood = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
    return x + K @ nu, left @ P @ left.T + K @ R @ K.T, float(log_likelihood)


def assert_augmented(s: State, a: Augmented, tolerance: float) -> None:
    for j in range(len(a.mu)):
        scale = np.sqrt(np.diag(a.S[j]))
        assert_scaled(s.x[j], s.P[j], a.X[j, :4], a.S[j, :4, :4], tolerance)
        for lag in range(LAGS):
            part = slice(4 + 4 * lag, 8 + 4 * lag)
            assert_scaled(s.y[lag, j], s.Y[lag, j], a.X[j, part], a.S[j, part, part], tolerance)
            unit = np.outer(scale[:4], scale[part])
            np.testing.assert_allclose(s.C[lag, j] / unit, a.S[j, :4, part] / unit, rtol=0, atol=tolerance)
    np.testing.assert_allclose(s.mu, a.mu, rtol=0, atol=tolerance)


def with_range_rates(rng: np.random.Generator, plots: Plots) -> Plots:
    """Every second plot tells a range rate."""
    plots["site"], plots["level"] = [-3e3, 4e3], 0.8
    plots["range_rate_mps"] = rng.normal(0.0, 100.0, len(plots))
    plots["range_rate_variance"][::2] = 25.0
    return plots


@pytest.mark.parametrize("models", [ALIKE, LAGGED], ids=["one model", "several"])
@pytest.mark.parametrize("range_rates", [False, True], ids=["position", "range rate"])
@pytest.mark.parametrize("seed", range(5))
def test_the_lags_are_those_of_the_augmented_state(models: Models, range_rates: bool, seed: int) -> None:
    """Also with plots of one time, which move no lag."""
    rng = np.random.default_rng(seed)
    walk = random_walk(rng, 40)
    for k in (7, 8, 20):
        walk[k] = walk[k]._replace(t_s=walk[k - 1].t_s)
    plots = with_range_rates(rng, batch(*walk)) if range_rates else batch(*walk)
    s, w = begun(models, walk[0]), make_work(models)
    a = start(s)
    for before, plot in itertools.pairwise(plots):
        dt = float(plot["t_s"] - before["t_s"])
        imm.filter_plot(models, s, plot, w)
        a = stepped(models, shifted(a) if dt > 0 else a, plot, dt)
        assert_augmented(s, a, 1e-9)
        assert_sound(models, s)


# --- laws ---


def test_a_new_track_was_always_where_it_is() -> None:
    s = begun(TVIMM_LAGGED, Plot(np.array([100.0, -50.0]), np.array([4.0, 1.0, 9.0]), 3.0))
    for lag in range(LAGS):
        assert np.array_equal(s.y[lag], s.x[:, :4])
        assert np.array_equal(s.Y[lag], s.P[:, :4, :4])
        assert np.array_equal(s.C[lag], s.P[:, :, :4])
    assert s.y_t_s.tolist() == [3.0, 3.0]


def test_a_lag_is_a_plot_of_another_time() -> None:
    plots = random_walk(np.random.default_rng(1), 8)
    s = filtered(LAGGED, begun(LAGGED, plots[0]), plots[1:])
    assert s.y_t_s.tolist() == [plots[-2].t_s, plots[-3].t_s]
    twin = filtered(LAGGED, s, [plots[-1]._replace(z=plots[-1].z + 20.0)])
    assert twin.y_t_s.tolist() == s.y_t_s.tolist()
    assert not np.array_equal(twin.y, s.y), "it is refined all the same"
    assert np.all(twin.Y[:, :, 0, 0] < s.Y[:, :, 0, 0])


@pytest.mark.parametrize(("plain", "lagged"), [(MODELS, LAGGED), (TVIMM, TVIMM_LAGGED)], ids=["imm", "tvimm"])
@LAW
@given(seed=seeds)
def test_lags_do_not_touch_the_present(plain: Models, lagged: Models, seed: int) -> None:
    plots = random_walk(np.random.default_rng(seed), 12)
    without, s = (filtered(m, begun(m, plots[0]), plots[1:]) for m in (plain, lagged))
    for name in ("x", "P", "mu", "weight", "age_s"):
        assert np.array_equal(getattr(s, name), getattr(without, name)), name


@pytest.mark.parametrize("models", [LAGGED, TVIMM_LAGGED], ids=["imm", "tvimm"])
@LAW
@given(seed=seeds)
def test_present_and_past_have_one_covariance(models: Models, seed: int) -> None:
    """Of each lag with the present, model by model: symmetric and positive."""
    rng = np.random.default_rng(seed)
    plots = random_walk(rng, 15, 10 ** rng.uniform(0, 3), (0.01, 12.0))
    s = begun(models, plots[0])
    for plot in plots[1:]:
        s = filtered(models, s, [plot])
        assert_sound(models, s, slack=1e-10)
        for j, d in enumerate(models.states.tolist()):
            for lag in range(LAGS):
                C = s.C[lag, j, :d]
                assert_covariance(np.block([[s.P[j, :d, :d], C], [C.T, s.Y[lag, j]]]), slack=1e-9)


@pytest.mark.parametrize("models", [LAGGED, TVIMM_LAGGED], ids=["imm", "tvimm"])
@LAW
@given(seed=seeds)
def test_late_plots_give_the_lags_of_the_right_order(models: Models, seed: int) -> None:
    rng = np.random.default_rng(seed)
    plots = random_walk(rng, 14)
    in_order, late = (fresh_filters(models, plots[0], ring=12) for _ in range(2))
    order = list(range(1, 14))
    for _ in range(4):
        k = int(rng.integers(0, 9))
        order.insert(k + int(rng.integers(1, 3)), order.pop(k))
    for k in range(1, 14):
        assert feed_row(models, in_order, 0, plots[k])
        assert feed_row(models, late, 0, plots[order[k - 1]])
    assert same_present(late, in_order)
    assert late.head[0].y_t_s.tolist() == [plots[-2].t_s, plots[-3].t_s]


# --- models with parameters of their own ---


def mixed(models: Models, s: State, lag: int, pi: FloatArray, j: int, n: int) -> tuple[FloatArray, FloatArray]:
    """Model j of the first branch with one lag, mixed by definition: what comes from others has j's prior."""
    d = int(models.states[j])
    X, S = np.empty((n, d + 4)), np.zeros((n, d + 4, d + 4))
    for a in range(n):
        own = slice(0, d if a == j else 4)
        X[a, 4:d], S[a, 4:d, 4:d] = models.numbers[j, 1], models.numbers[j, 2] ** 2 * np.eye(d - 4)
        X[a, own], S[a, own, own] = s.x[a, own], s.P[a, own, own]
        X[a, d:], S[a, d:, d:] = s.y[lag, a], s.Y[lag, a]
        S[a, own, d:] = s.C[lag, a, own]
        S[a, d:, own] = s.C[lag, a, own].T
    weight = s.mu[:n] * pi[:, j]
    return mixture_moments(X, S, weight / weight.sum())


@LAW
@given(seeds)
def test_mixing_the_lags_is_the_definition(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 5
    plots = random_walk(rng, 6)
    s = filtered(TVIMM_LAGGED, begun(TVIMM_LAGGED, plots[0]), plots[1:])
    w, before = make_work(TVIMM_LAGGED), copied_state(s)
    w.pi[:n] = rng.dirichlet(np.ones(n), n)
    imm.mix(TVIMM_LAGGED, s, 0, n, 2.0, w)
    for j, lag in itertools.product(range(n), range(LAGS)):
        d = int(TVIMM_LAGGED.states[j])
        x, P = mixed(TVIMM_LAGGED, before, lag, w.pi[:n], j, n)
        scale = np.sqrt(np.diag(P))
        np.testing.assert_allclose(s.y[lag, j] / scale[d:], x[d:] / scale[d:], rtol=1e-11, atol=1e-10)
        unit = np.outer(scale, scale)
        np.testing.assert_allclose(s.Y[lag, j] / unit[d:, d:], P[d:, d:] / unit[d:, d:], rtol=0, atol=1e-10)
        np.testing.assert_allclose(s.C[lag, j, :d] / unit[:d, d:], P[:d, d:] / unit[:d, d:], rtol=0, atol=1e-10)


@LAW
@given(seeds)
def test_branches_do_not_mix_their_past(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s = random_state(rng, TVIMM_LAGGED)
    lags_of.shift(s)
    other = copied_state(s)
    other.y[:, 5:] += 500.0
    for one in (s, other):
        imm.interact(TVIMM_LAGGED, one, 2.0, make_work(TVIMM_LAGGED))
    assert np.array_equal(s.y[:, :5], other.y[:, :5])
    assert np.array_equal(s.Y[:, :5], other.Y[:, :5])


def test_what_a_row_was_is_told_with_its_time() -> None:
    plots = random_walk(np.random.default_rng(2), 9)
    f = fresh_filters(TVIMM_LAGGED, plots[0], rows=2)
    for plot in plots[1:]:
        feed_row(TVIMM_LAGGED, f, 0, plot)
    for lag in (1, 2):
        out = make_mixture(1, 8)
        t_s = tracks.refined(f, np.array([0]), lag, out)
        assert t_s.tolist() == [plots[-1 - lag].t_s]
        assert np.array_equal(out.x[0], f.head[0].y[lag - 1])
        assert np.array_equal(out.P[0], f.head[0].Y[lag - 1])
        assert out.mu.sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("dt", [0.01, 1.0, 10.0])
def test_sound_at_any_rate(dt: float) -> None:
    rng, R = np.random.default_rng(3), np.array([25.0, 0.0, 25.0])
    s = begun(TVIMM_LAGGED, Plot(np.zeros(2), R, 0.0))
    for k in range(60):
        s = filtered(TVIMM_LAGGED, s, [Plot(rng.normal(0.0, 5.0, 2) + 150.0 * dt * k, R, dt * (k + 1))])
        assert_sound(TVIMM_LAGGED, s)
