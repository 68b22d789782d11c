from __future__ import annotations

import itertools

import numpy as np
import pytest
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
    assert_scaled,
    assert_sound,
    begun,
    chain_matrix,
    copied_state,
    covariance,
    dense_update,
    fields,
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
    step_matrix,
    unpacked,
    velocities,
)

from trackmesh.services.estimation.bank import Models, State, make_states, make_work
from trackmesh.services.estimation.imm import MU_FLOOR, mix, reweigh

ONE_MODEL = velocities((10.0,), (30.0,))
TWO_MODELS = velocities((10.0, 500.0), (30.0, 15.0))


def densities(models: Models) -> list[float]:
    return [float(q) for q in models.numbers[:, 0]]


# --- oracles ---


def test_one_model_is_a_kalman_filter() -> None:
    plots = random_walk(np.random.default_rng(1), 30)
    track, t = begun(ONE_MODEL, plots[0]), plots[0].t_s
    x, P = track.x[0].copy(), track.P[0].copy()
    for plot in plots[1:]:
        F = flow(plot.t_s - t)
        x, P, _ = dense_update(F @ x, F @ P @ F.T + noise(plot.t_s - t, 10.0), plot)
        track, t = filtered(ONE_MODEL, track, [plot]), plot.t_s
        assert_scaled(track.x[0], track.P[0], x, P, 1e-11)


def test_the_fixed_matrix_form_is_that_of_filterpy() -> None:
    """To 1e-12 standard deviations of the estimate."""
    # The interval is the same in every step, as FilterPy's matrix is; its M[i, j] is from i to j, like ours.
    rng, dt = np.random.default_rng(2), 4.0
    plots = random_walk(rng, 40, every_s=(dt, dt))
    track = begun(MODELS, plots[0])
    bank = []
    for q in densities(MODELS):
        kf = KalmanFilter(4, 2)
        kf.x, kf.P, kf.F, kf.H, kf.Q = track.x[0].copy(), track.P[0].copy(), flow(dt), H, noise(dt, q)
        bank.append(kf)
    imm = IMMEstimator(bank, MODELS.start, chain_matrix(MODELS, dt))
    for plot in plots[1:]:
        for kf in bank:
            kf.R = unpacked(plot.R)
        imm.predict()
        imm.update(plot.z)
        track = filtered(MODELS, track, [plot])
        assert_scaled(*output(MODELS, track), imm.x, imm.P, 1e-12)
        for j, kf in enumerate(bank):
            assert_scaled(track.x[j], track.P[j], kf.x, kf.P, 1e-12)
        np.testing.assert_allclose(track.mu, imm.mu, rtol=0, atol=1e-12)
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
    sequences = [Sequence(float(np.log(models.start[j])), j, track.x[0], track.P[0]) for j in range(r)]
    for step, plot in enumerate(plots[1:]):
        dt, t = plot.t_s - t, plot.t_s
        sequences = [b.next(models, j, dt) for b, j in itertools.product(sequences, range(r))]
        if step <= 1:
            ahead = interacted(models, track, t)
            for got, want in zip((*output(models, ahead), ahead.mu), exact_moments(sequences, r), strict=True):
                np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)
        sequences = [b.updated(plot) for b in sequences]
        track = filtered(models, track, [plot])
        mean, P, mu = exact_moments(sequences, r)
        x, _ = output(models, track)
        if step == 0:
            np.testing.assert_allclose(x, mean, atol=1e-9)
            np.testing.assert_allclose(track.mu, mu, atol=1e-12)
        off = x - mean
        assert off @ np.linalg.solve(P, off) < 0.02
        np.testing.assert_allclose(track.mu, mu, atol=0.03)
    assert len(sequences) == r**4


def test_an_infinite_prior_is_the_fixed_matrix() -> None:
    plots = random_walk(np.random.default_rng(4), 25)
    start = begun(MODELS, plots[0])
    # The first learns by the kernel's own branch with a prior that no count can move.
    almost = filtered(velocities(prior_count=1e18), start, plots[1:])
    fixed, infinite = (filtered(m, start, plots[1:]) for m in (MODELS, velocities(prior_count=np.inf)))
    assert almost.counts.sum() > 5.0
    assert not infinite.counts.any()
    for track in (almost, infinite):
        for j in range(3):
            assert_scaled(track.x[j], track.P[j], fixed.x[j], fixed.P[j], 1e-12)
        np.testing.assert_allclose(track.mu, fixed.mu, rtol=0, atol=1e-12)


def dirichlet_step(models: Models, track: State, plot: Plot, dt: float) -> State:
    """One cycle of the quasi-Bayes form, written down as matrices."""
    out = copied_state(track)
    alpha = models.prior_count[0] * chain_matrix(models, dt) + track.counts
    pi = alpha / alpha.sum(axis=1, keepdims=True)
    c = track.mu @ pi
    r, F = len(c), flow(dt)
    ll = np.empty(r)
    for j in range(r):
        x0, P0 = mixture_moments(track.x, track.P, track.mu * pi[:, j] / c[j])
        out.x[j], out.P[j], ll[j] = dense_update(F @ x0, F @ P0 @ F.T + noise(dt, densities(models)[j]), plot)
    likelihood = np.exp(ll - ll.max())
    mu = np.maximum(c * likelihood / (c @ likelihood), MU_FLOOR)
    xi = track.mu[:, None] * pi * likelihood
    out.mu[:] = mu / mu.sum()
    weight = min(dt / models.reference_s, 1.0)
    out.counts[:] = np.exp(-dt / models.memory_s) * track.counts + weight * xi / xi.sum()
    return out


def test_the_learning_form_step_by_step() -> None:
    plots = random_walk(np.random.default_rng(5), 40)
    got = want = begun(DIRICHLET, plots[0])
    for before, plot in itertools.pairwise(plots):
        got = filtered(DIRICHLET, got, [plot])
        want = dirichlet_step(DIRICHLET, want, plot, plot.t_s - before.t_s)
        np.testing.assert_allclose(got.mu, want.mu, rtol=0, atol=1e-11)
        np.testing.assert_allclose(got.counts, want.counts, rtol=0, atol=1e-11)
        for j in range(3):
            assert_scaled(got.x[j], got.P[j], want.x[j], want.P[j], 1e-11)
    assert got.counts.sum() > 5.0


# --- laws ---


def some_models(r: int) -> Models:
    return velocities((1.0, 10.0, 50.0, 500.0)[:r], (50.0, 30.0, 15.0, 15.0)[:r])


@LAW
@given(seeds, st.integers(1, 4))
def test_moment_matching_is_the_definition(seed: int, r: int) -> None:
    s = random_state(np.random.default_rng(seed), some_models(r))
    for got, want in zip(output(some_models(r), s), mixture_moments(s.x, s.P, s.mu), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-6)


@LAW
@given(seeds, st.integers(1, 4))
def test_mixing_changes_no_moment_of_the_whole(seed: int, r: int) -> None:
    rng, models = np.random.default_rng(seed), some_models(r)
    s, w = random_state(rng, models), make_work(models)
    before = output(models, s)
    w.pi[:] = rng.dirichlet(np.ones(r), r)
    want_mu = s.mu @ w.pi
    mix(models, s, 0, r, 4.0, w)
    np.testing.assert_allclose(s.mu, want_mu, atol=1e-14)
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
    least, most = np.linalg.eigvalsh(s.P)[:, [0, -1]].T
    assert np.all(least >= -1e-12 * most)
    assert np.all(np.diagonal(s.P, axis1=1, axis2=2) > 0)
    assert s.mu.min() >= 0.9 * MU_FLOOR


def test_no_time_changes_nothing() -> None:
    for models in (MODELS, DIRICHLET, TVIMM):
        track = random_state(np.random.default_rng(6), models)
        track.counts[:] = 2.0
        assert np.asarray(interacted(models, track, 0.0)).tobytes() == np.asarray(track).tobytes()


@LAW
@given(seeds)
def test_two_plots_of_one_time_may_come_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    track = random_state(rng, MODELS)
    plots = [Plot(rng.normal(size=2) * 100, packed(covariance(rng, 2, 1e4)), 0.0) for _ in range(2)]
    # Where a model falls to its floor in between, what is floored first matters.
    assume(all(filtered(MODELS, track, [plot]).mu.min() > 10 * MU_FLOOR for plot in plots))
    one, other = (fields(filtered(MODELS, track, order)) for order in (plots, plots[::-1]))
    for name, value in one.items():
        np.testing.assert_allclose(other[name], value, rtol=1e-9, atol=1e-7, err_msg=name)


@LAW
@given(seeds, st.floats(0.01, 100.0))
def test_a_step_matrix_has_rows_of_probabilities(seed: int, dt: float) -> None:
    s = make_states(DIRICHLET, 1)[0]
    s.counts[:] = np.random.default_rng(seed).uniform(0, 20, (3, 3))
    pi = step_matrix(DIRICHLET, s, dt)
    np.testing.assert_allclose(pi.sum(axis=1), 1.0, atol=1e-14)
    assert np.all(pi >= 0)


def test_observed_transitions_draw_the_matrix_to_themselves() -> None:
    s = make_states(DIRICHLET, 1)[0]
    s.counts[0, 2] = 1e9
    pi = step_matrix(DIRICHLET, s, 4.0)
    np.testing.assert_allclose(pi[0], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(pi[1:], chain_matrix(DIRICHLET, 4.0)[1:], atol=1e-14)


@LAW
@given(seeds, st.floats(0.1, 20.0))
def test_a_matrix_acts_in_the_step_that_it_is_given_for(seed: int, dt: float) -> None:
    """What is written into the counts before a step is in that step's prediction, and in its update."""
    rng = np.random.default_rng(seed)
    plain = random_state(rng, DIRICHLET)
    told = copied_state(plain)
    told.counts[:] = rng.uniform(0.0, 20.0, (3, 3))
    alpha = 20.0 * chain_matrix(DIRICHLET, dt) + told.counts
    pi = alpha / alpha.sum(axis=1, keepdims=True)
    ahead = interacted(DIRICHLET, told, dt)
    np.testing.assert_allclose(ahead.mu, told.mu @ pi, rtol=0, atol=1e-14)
    np.testing.assert_allclose(interacted(DIRICHLET, plain, dt).mu, plain.mu @ chain_matrix(DIRICHLET, dt), atol=1e-14)
    assert abs(ahead.mu - interacted(DIRICHLET, plain, dt).mu).max() > 1e-4
    for j, q in enumerate(densities(DIRICHLET)):
        x0, P0 = mixture_moments(told.x, told.P, told.mu * pi[:, j] / ahead.mu[j])
        assert_scaled(ahead.x[j], ahead.P[j], flow(dt) @ x0, flow(dt) @ P0 @ flow(dt).T + noise(dt, q), 1e-11)
    plot = Plot(rng.normal(size=2) * 100, packed(covariance(rng, 2, 1e4)), dt)
    assert abs(filtered(DIRICHLET, told, [plot]).mu - filtered(DIRICHLET, plain, [plot]).mu).max() > 1e-7


@pytest.mark.parametrize(("models", "branch"), [(MODELS, 0), (TVIMM, 1)], ids=["imm", "generic branch"])
@LAW
@given(seed=seeds, dt=st.lists(st.floats(0.01, 40.0), min_size=1, max_size=30))
def test_coasting_follows_the_chain(models: Models, branch: int, seed: int, dt: list[float]) -> None:
    """Without plots mu(t) = mu(0) expm(G t), however the time is divided."""
    s = random_state(np.random.default_rng(seed), models)
    low, high = models.first[branch], models.first[branch + 1]
    before = s.mu[low:high].copy()
    for t_s in np.cumsum(dt).tolist():
        s = interacted(models, s, t_s)
        np.testing.assert_allclose(s.mu[low:high], before @ chain_matrix(models, t_s, branch), rtol=0, atol=1e-12)
        assert_sound(models, s)


# --- what must not break it ---


def test_without_any_likelihood_the_probabilities_stay() -> None:
    mu = np.array([0.2, 0.3, 0.5])
    assert reweigh(mu, np.full(3, -np.inf), 0, 3) == -np.inf
    assert mu.tolist() == [0.2, 0.3, 0.5]


def test_a_wild_plot_neither_breaks_nor_locks_the_filter() -> None:
    plots = random_walk(np.random.default_rng(7), 20)
    wild = Plot(plots[10].z + 1e7, plots[10].R, plots[10].t_s)
    for models in (DIRICHLET, TVIMM):
        track = filtered(models, begun(models, plots[0]), [*plots[1:10], wild])
        assert all(np.isfinite(value).all() for value in fields(track).values())
        assert track.mu.min() >= 0.9 * MU_FLOOR
        for low, high in itertools.pairwise(models.first):
            assert track.mu[low:high].sum() == pytest.approx(1.0, abs=1e-12)


def test_the_likely_model_wins_by_bayes() -> None:
    mu = np.array([0.5, 0.25, 0.25])
    evidence = reweigh(mu, np.log([1.0, 2.0, 4.0]) - 1000.0, 0, 3)
    assert evidence == pytest.approx(np.log(2.0) - 1000.0, abs=1e-12)
    np.testing.assert_allclose(mu, [0.25, 0.25, 0.5], atol=1e-12)
