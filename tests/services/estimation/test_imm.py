from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.stats
from filterpy.kalman import IMMEstimator, KalmanFilter
from hypothesis import assume, given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    DIRICHLET,
    LAW,
    MODELS,
    TVIMM,
    FloatArray,
    H,
    Plot,
    assert_sound,
    begun,
    covariance,
    dense_update,
    filtered,
    flow,
    interacted,
    mixture_moments,
    noise,
    output,
    packed,
    random_state,
    random_walk,
    seeds,
    unpacked,
    velocities,
    work,
)

from trackmesh.services.estimation.bank import Models, State, make_state
from trackmesh.services.estimation.imm import MU_FLOOR, mix, reweigh, step_matrix, update_position
from trackmesh.services.estimation.transition import transition_matrix

ONE_MODEL = velocities((10.0,), (30.0,))
TWO_MODELS = velocities((10.0, 500.0), (30.0, 15.0))


def chain_matrix(models: Models, dt_s: float) -> FloatArray:
    Pi = np.empty((len(models.kind),) * 2)
    transition_matrix(models.generator, dt_s, Pi)
    return Pi


def densities(models: Models) -> list[float]:
    return [float(q) for q in models.numbers[:, 0]]


def row_matrix(models: Models, s: State, dt_s: float) -> FloatArray:
    """Transition matrix of a step of row 0, of the first branch."""
    w = work(models)
    step_matrix(models, s, 0, 0, dt_s, w.pi)
    return np.asarray(w.pi)


# --- oracles ---


def test_one_model_is_a_kalman_filter() -> None:
    plots = random_walk(np.random.default_rng(1), 30)
    track, t = begun(ONE_MODEL, plots[0]), plots[0].t_s
    x, P = track.x[0, 0].copy(), track.P[0, 0].copy()
    for plot in plots[1:]:
        F = flow(plot.t_s - t)
        x, P, _ = dense_update(F @ x, F @ P @ F.T + noise(plot.t_s - t, 10.0), plot)
        track, t = filtered(ONE_MODEL, track, [plot]), plot.t_s
        np.testing.assert_allclose(track.x[0, 0], x, atol=1e-9)
        np.testing.assert_allclose(track.P[0, 0], P, rtol=1e-9)


def test_the_fixed_matrix_form_is_that_of_filterpy() -> None:
    # The interval is the same in every step, as FilterPy's matrix is; its M[i, j] is from i to j, like ours.
    rng, dt = np.random.default_rng(2), 4.0
    plots = random_walk(rng, 40, every_s=(dt, dt))
    track = begun(MODELS, plots[0])
    bank = []
    for q in densities(MODELS):
        kf = KalmanFilter(4, 2)
        kf.x, kf.P, kf.F, kf.H, kf.Q = track.x[0, 0].copy(), track.P[0, 0].copy(), flow(dt), H, noise(dt, q)
        bank.append(kf)
    imm = IMMEstimator(bank, MODELS.start, chain_matrix(MODELS, dt))
    for plot in plots[1:]:
        for kf in bank:
            kf.R = unpacked(plot.R)
        imm.predict()
        imm.update(plot.z)
        track = filtered(MODELS, track, [plot])
        x, P = output(MODELS, track)
        np.testing.assert_allclose(x, imm.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(P, imm.P, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(track.mu[0], imm.mu, atol=1e-9)
        assert track.mu.min() > 10 * MU_FLOOR, "FilterPy has no floor: this walk must not reach ours"


class Sequence:
    """One sequence of models: its log weight and its Kalman filter."""

    def __init__(self, log_weight: float, model: int, x: FloatArray, P: FloatArray) -> None:
        self.log_weight, self.model, self.x, self.P = log_weight, model, x, P

    def next(self, models: Models, model: int, dt_s: float) -> Sequence:
        F, w = flow(dt_s), np.log(chain_matrix(models, dt_s)[self.model, model])
        return Sequence(
            self.log_weight + w, model, F @ self.x, F @ self.P @ F.T + noise(dt_s, densities(models)[model])
        )

    def updated(self, plot: Plot) -> Sequence:
        x, P, log_likelihood = dense_update(self.x, self.P, plot)
        return Sequence(self.log_weight + log_likelihood, self.model, x, P)


def exact_moments(sequences: list[Sequence], r: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    log_weight = np.array([b.log_weight for b in sequences])
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean, covariance = mixture_moments(np.array([b.x for b in sequences]), np.array([b.P for b in sequences]), weight)
    return mean, covariance, weight @ np.eye(r)[[b.model for b in sequences]]


@pytest.mark.parametrize("models", [TWO_MODELS, MODELS], ids=["two", "three"])
def test_three_steps_against_all_sequences_of_models(models: Models) -> None:
    """The IMM is exact in the first step and in the prediction over the second, then a close approximation."""
    plots = random_walk(np.random.default_rng(3), 4)
    track, t, r = begun(models, plots[0]), plots[0].t_s, len(models.kind)
    sequences = [Sequence(float(np.log(models.start[j])), j, track.x[0, 0], track.P[0, 0]) for j in range(r)]
    for step, plot in enumerate(plots[1:]):
        dt, t = plot.t_s - t, plot.t_s
        sequences = [b.next(models, j, dt) for b, j in itertools.product(sequences, range(r))]
        if step <= 1:
            ahead = interacted(models, track, t)
            for got, want in zip((*output(models, ahead), ahead.mu[0]), exact_moments(sequences, r), strict=True):
                np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)
        sequences = [b.updated(plot) for b in sequences]
        track = filtered(models, track, [plot])
        mean, P, mu = exact_moments(sequences, r)
        x, _ = output(models, track)
        if step == 0:
            np.testing.assert_allclose(x, mean, atol=1e-9)
            np.testing.assert_allclose(track.mu[0], mu, atol=1e-12)
        off = x - mean
        assert off @ np.linalg.solve(P, off) < 0.02
        np.testing.assert_allclose(track.mu[0], mu, atol=0.03)
    assert len(sequences) == r**4


def test_an_infinite_prior_is_the_fixed_matrix() -> None:
    plots = random_walk(np.random.default_rng(4), 25)
    start = begun(MODELS, plots[0])
    fixed, infinite, almost = (
        filtered(m, start, plots[1:])
        for m in (MODELS, DIRICHLET._replace(prior_count=np.array([np.inf])), velocities(prior_count=1e16))
    )
    for name in ("x", "P", "mu"):
        a, b, c = (getattr(s, name) for s in (fixed, infinite, almost))
        np.testing.assert_allclose(b, a, rtol=1e-12)
        np.testing.assert_allclose(c, a, rtol=1e-9, atol=1e-9)
    assert not infinite.counts.any()


def dirichlet_step(models: Models, track: State, plot: Plot, dt: float) -> State:
    """One cycle of the quasi-Bayes form, written down as matrices."""
    before, counts = track.mu[0], track.counts[0]
    alpha = models.prior_count[0] * chain_matrix(models, dt) + counts
    pi = alpha / alpha.sum(axis=1, keepdims=True)
    c = before @ pi
    r, F = len(c), flow(dt)
    x, P, ll = np.empty((r, 4)), np.empty((r, 4, 4)), np.empty(r)
    for j in range(r):
        x0, P0 = mixture_moments(track.x[0], track.P[0], before * pi[:, j] / c[j])
        x[j], P[j], ll[j] = dense_update(F @ x0, F @ P0 @ F.T + noise(dt, densities(models)[j]), plot)
    likelihood = np.exp(ll - ll.max())
    mu = np.maximum(c * likelihood / (c @ likelihood), MU_FLOOR)
    xi = before[:, None] * pi * likelihood
    weight = min(dt / models.reference_s, 1.0)
    counts = np.exp(-dt / models.memory_s) * counts + weight * xi / xi.sum()
    return track._replace(x=x[None], P=P[None], mu=(mu / mu.sum())[None], counts=counts[None])


def test_the_learning_form_step_by_step() -> None:
    plots = random_walk(np.random.default_rng(5), 40)
    got = want = begun(DIRICHLET, plots[0])
    for before, plot in itertools.pairwise(plots):
        got = filtered(DIRICHLET, got, [plot])
        want = dirichlet_step(DIRICHLET, want, plot, plot.t_s - before.t_s)
        np.testing.assert_allclose(got.mu, want.mu, atol=1e-9)
        np.testing.assert_allclose(got.counts, want.counts, atol=1e-9)
        np.testing.assert_allclose(got.x, want.x, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(got.P, want.P, rtol=1e-8, atol=1e-6)
    assert got.counts.sum() > 5.0


@LAW
@given(seeds, st.integers(4, 6))
def test_the_update_equals_the_joseph_form_and_its_density_is_normal(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=d) * 100, covariance(rng, d, 400.0)
    plot = Plot(rng.normal(size=2) * 100, packed(covariance(rng, 2, 100.0)), 0.0)
    want_x, want_P, _ = dense_update(x, P, plot)
    density = scipy.stats.multivariate_normal(x[:2].copy(), P[:2, :2] + unpacked(plot.R))
    log_likelihood = update_position(x, P, d, plot.z, plot.R, np.empty((6, 2)))
    assert log_likelihood == pytest.approx(density.logpdf(plot.z), abs=1e-9)
    np.testing.assert_allclose(x, want_x, atol=1e-8)
    np.testing.assert_allclose(P, want_P, atol=1e-8)


# --- laws ---


def some_models(r: int) -> Models:
    return velocities((1.0, 10.0, 50.0, 500.0)[:r], (50.0, 30.0, 15.0, 15.0)[:r])


@LAW
@given(seeds, st.integers(1, 4))
def test_moment_matching_is_the_definition(seed: int, r: int) -> None:
    s = random_state(np.random.default_rng(seed), some_models(r))
    for got, want in zip(output(some_models(r), s), mixture_moments(s.x[0], s.P[0], s.mu[0]), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-6)


@LAW
@given(seeds, st.integers(1, 4))
def test_mixing_changes_no_moment_of_the_whole(seed: int, r: int) -> None:
    rng, models = np.random.default_rng(seed), some_models(r)
    s, w = random_state(rng, models), work(models)
    before = output(models, s)
    w.pi[:] = rng.dirichlet(np.ones(r), r)
    want_mu = s.mu[0] @ w.pi
    mix(models, s, 0, 0, r, 4.0, w)
    np.testing.assert_allclose(s.mu[0], want_mu, atol=1e-14)
    for got, want in zip(output(models, s), before, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-6)
    assert np.array_equal(s.P, np.swapaxes(s.P, -1, -2))


@LAW
@given(seeds, st.floats(-3.0, 12.0), st.floats(0.0, 1e4))
def test_covariances_stay_symmetric_and_positive(seed: int, log_ratio: float, dt: float) -> None:
    """P0 up to 1e12 R, measured again and again, also after long gaps."""
    rng = np.random.default_rng(seed)
    r_m2 = 25.0
    s = begun(DIRICHLET, Plot(np.zeros(2), np.array([r_m2, 0.0, r_m2]), 0.0))
    s.P[:] = np.eye(4) * r_m2 * 10**log_ratio
    plots = [Plot(rng.normal(size=2) * 5, np.array([r_m2, 0.0, r_m2]), 0.1 * k) for k in range(1, 30)]
    plots.append(plots[-1]._replace(t_s=plots[-1].t_s + dt))
    s = filtered(DIRICHLET, s, plots)
    assert_sound(DIRICHLET, s)
    least, most = np.linalg.eigvalsh(s.P[0])[:, [0, -1]].T
    assert np.all(least >= -1e-12 * most)
    assert np.all(np.diagonal(s.P[0], axis1=1, axis2=2) > 0)
    assert s.mu.min() >= 0.9 * MU_FLOOR


def test_no_time_changes_nothing() -> None:
    for models in (MODELS, DIRICHLET, TVIMM):
        track = random_state(np.random.default_rng(6), models)
        track.counts[:] = 2.0
        for got, want in zip(interacted(models, track, 0.0), track, strict=True):
            assert np.array_equal(got, want)


@LAW
@given(seeds)
def test_two_plots_of_one_time_may_come_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    track = random_state(rng, MODELS)
    plots = [Plot(rng.normal(size=2) * 100, packed(covariance(rng, 2, 1e4)), 0.0) for _ in range(2)]
    # Where a model falls to its floor in between, what is floored first matters.
    assume(all(filtered(MODELS, track, [plot]).mu.min() > 10 * MU_FLOOR for plot in plots))
    one, other = filtered(MODELS, track, plots), filtered(MODELS, track, plots[::-1])
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-7)


@LAW
@given(seeds, st.floats(0.01, 100.0))
def test_a_step_matrix_has_rows_of_probabilities(seed: int, dt: float) -> None:
    s = make_state(DIRICHLET, 1)
    s.counts[0] = np.random.default_rng(seed).uniform(0, 20, (3, 3))
    pi = row_matrix(DIRICHLET, s, dt)
    np.testing.assert_allclose(pi.sum(axis=1), 1.0, atol=1e-14)
    assert np.all(pi >= 0)


def test_observed_transitions_draw_the_matrix_to_themselves() -> None:
    s = make_state(DIRICHLET, 1)
    s.counts[0, 0, 2] = 1e9
    pi = row_matrix(DIRICHLET, s, 4.0)
    np.testing.assert_allclose(pi[0], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(pi[1:], chain_matrix(DIRICHLET, 4.0)[1:], atol=1e-14)


# --- what must not break it ---


def test_a_covariance_that_is_not_positive_skips_the_plot() -> None:
    x, P = np.zeros(4), np.zeros((4, 4))
    P[0, 0] = -100.0
    before = P.copy()
    assert update_position(x, P, 4, np.ones(2), np.array([1.0, 0.0, 1.0]), np.empty((4, 2))) == -np.inf
    assert not x.any()
    assert np.array_equal(P, before)


def test_without_any_likelihood_the_probabilities_stay() -> None:
    mu = np.array([0.2, 0.3, 0.5])
    assert reweigh(mu, np.full(3, -np.inf), 0, 3) == -np.inf
    assert mu.tolist() == [0.2, 0.3, 0.5]


def test_a_wild_plot_neither_breaks_nor_locks_the_filter() -> None:
    plots = random_walk(np.random.default_rng(7), 20)
    wild = Plot(plots[10].z + 1e7, plots[10].R, plots[10].t_s)
    for models in (DIRICHLET, TVIMM):
        track = filtered(models, begun(models, plots[0]), [*plots[1:10], wild])
        assert all(np.isfinite(a).all() for a in track)
        assert track.mu.min() >= 0.9 * MU_FLOOR
        for low, high in itertools.pairwise(models.first):
            assert track.mu[0, low:high].sum() == pytest.approx(1.0, abs=1e-12)


def test_the_likely_model_wins_by_bayes() -> None:
    mu = np.array([0.5, 0.25, 0.25])
    evidence = reweigh(mu, np.log([1.0, 2.0, 4.0]) - 1000.0, 0, 3)
    assert evidence == pytest.approx(np.log(2.0) - 1000.0, abs=1e-12)
    np.testing.assert_allclose(mu, [0.25, 0.25, 0.5], atol=1e-12)
