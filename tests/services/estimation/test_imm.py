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
    FloatArray,
    H,
    Plot,
    Track,
    covariance,
    dense_update,
    filtered,
    flow,
    mixture_moments,
    noise,
    packed,
    random_track,
    random_walk,
    scratch,
    seeds,
    unpacked,
)

from trackmesh.services.estimation.imm import (
    MU_FLOOR,
    Models,
    interact,
    make_models,
    mix,
    moment_match,
    reweigh,
    step_matrix,
    update_position,
)
from trackmesh.services.estimation.transition import transition_matrix

ONE_MODEL = make_models(np.array([10.0]), np.array([30.0]))
TWO_MODELS = make_models(np.array([10.0, 500.0]), np.array([30.0, 15.0]))


def chain_matrix(models: Models, dt_s: float) -> FloatArray:
    Pi = np.empty((len(models.q),) * 2)
    transition_matrix(models.chain, dt_s, Pi)
    return Pi


def begun(models: Models, plot: Plot, sigma_v_mps: float = 150.0) -> Track:
    r = len(models.q)
    P = np.zeros((4, 4))
    P[:2, :2], P[2:, 2:] = unpacked(plot.R), sigma_v_mps**2 * np.eye(2)
    x = np.concatenate([plot.z, [0.0, 0.0]])
    return Track(np.tile(x, (r, 1)), np.tile(P, (r, 1, 1)), models.mu0.copy(), np.zeros((r, r)))


def output(track: Track) -> tuple[FloatArray, FloatArray]:
    x, P = np.empty(4), np.empty((4, 4))
    moment_match(track.x, track.P, track.mu, x, P)
    return x, P


def predicted(models: Models, track: Track, dt_s: float) -> Track:
    out = track.copy()
    interact(models, *out, dt_s, *scratch(len(out.mu)))
    return out


# --- oracles ---


def test_one_model_is_a_kalman_filter() -> None:
    plots = random_walk(np.random.default_rng(1), 30)
    track, t = begun(ONE_MODEL, plots[0]), plots[0].t_s
    x, P = track.x[0].copy(), track.P[0].copy()
    for plot in plots[1:]:
        F = flow(plot.t_s - t)
        x, P, _ = dense_update(F @ x, F @ P @ F.T + noise(plot.t_s - t, 10.0), plot)
        track, t = filtered(ONE_MODEL, track, [plot], t), plot.t_s
        np.testing.assert_allclose(track.x[0], x, atol=1e-9)
        np.testing.assert_allclose(track.P[0], P, rtol=1e-9)


def test_the_fixed_matrix_form_is_that_of_filterpy() -> None:
    # The interval is the same in every step, as FilterPy's matrix is; its M[i, j] is from i to j, like ours.
    rng, dt = np.random.default_rng(2), 4.0
    plots = random_walk(rng, 40, every_s=(dt, dt))
    track = begun(MODELS, plots[0])
    bank = []
    for q in MODELS.q:
        kf = KalmanFilter(4, 2)
        kf.x, kf.P, kf.F, kf.H, kf.Q = track.x[0].copy(), track.P[0].copy(), flow(dt), H, noise(dt, q)
        bank.append(kf)
    imm = IMMEstimator(bank, MODELS.mu0, chain_matrix(MODELS, dt))
    for plot in plots[1:]:
        for kf in bank:
            kf.R = unpacked(plot.R)
        imm.predict()
        imm.update(plot.z)
        track = filtered(MODELS, track, [plot], plot.t_s - dt)
        x, P = output(track)
        np.testing.assert_allclose(x, imm.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(P, imm.P, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(track.mu, imm.mu, atol=1e-9)
        assert track.mu.min() > 10 * MU_FLOOR, "FilterPy has no floor: this walk must not reach ours"


class Branch:
    """One sequence of models: its log weight and its Kalman filter."""

    def __init__(self, log_weight: float, model: int, x: FloatArray, P: FloatArray) -> None:
        self.log_weight, self.model, self.x, self.P = log_weight, model, x, P

    def next(self, models: Models, model: int, dt_s: float) -> Branch:
        F, w = flow(dt_s), np.log(chain_matrix(models, dt_s)[self.model, model])
        return Branch(self.log_weight + w, model, F @ self.x, F @ self.P @ F.T + noise(dt_s, models.q[model]))

    def updated(self, plot: Plot) -> Branch:
        x, P, log_likelihood = dense_update(self.x, self.P, plot)
        return Branch(self.log_weight + log_likelihood, self.model, x, P)


def exact_moments(branches: list[Branch], r: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    log_weight = np.array([b.log_weight for b in branches])
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean, covariance = mixture_moments(np.array([b.x for b in branches]), np.array([b.P for b in branches]), weight)
    return mean, covariance, weight @ np.eye(r)[[b.model for b in branches]]


@pytest.mark.parametrize("models", [TWO_MODELS, MODELS], ids=["two", "three"])
def test_three_steps_against_all_sequences_of_models(models: Models) -> None:
    """The IMM is exact in the first step and in the prediction over the second, then a close approximation."""
    plots = random_walk(np.random.default_rng(3), 4)
    track, t, r = begun(models, plots[0]), plots[0].t_s, len(models.q)
    branches = [Branch(float(np.log(models.mu0[j])), j, track.x[0], track.P[0]) for j in range(r)]
    for step, plot in enumerate(plots[1:]):
        dt, t = plot.t_s - t, plot.t_s
        branches = [b.next(models, j, dt) for b, j in itertools.product(branches, range(r))]
        if step <= 1:
            ahead = predicted(models, track, dt)
            for got, want in zip((*output(ahead), ahead.mu), exact_moments(branches, r), strict=True):
                np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)
        branches = [b.updated(plot) for b in branches]
        track = filtered(models, track, [plot], t - dt)
        mean, P, mu = exact_moments(branches, r)
        x, _ = output(track)
        if step == 0:
            np.testing.assert_allclose(x, mean, atol=1e-9)
            np.testing.assert_allclose(track.mu, mu, atol=1e-12)
        off = x - mean
        assert off @ np.linalg.solve(P, off) < 0.02
        np.testing.assert_allclose(track.mu, mu, atol=0.03)
    assert len(branches) == r**4


def test_an_infinite_prior_is_the_fixed_matrix() -> None:
    plots = random_walk(np.random.default_rng(4), 25)
    heavy = DIRICHLET._replace(prior_count=1e16)
    start = begun(MODELS, plots[0])
    fixed, infinite, almost = (
        filtered(m, start, plots[1:], plots[0].t_s) for m in (MODELS, DIRICHLET._replace(prior_count=np.inf), heavy)
    )
    for a, b, c in zip(fixed[:3], infinite[:3], almost[:3], strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-12)
        np.testing.assert_allclose(c, a, rtol=1e-9, atol=1e-9)
    assert not infinite.counts.any()


def dirichlet_step(models: Models, track: Track, plot: Plot, dt: float) -> Track:
    """One cycle of the quasi-Bayes form, written down as matrices."""
    alpha = models.prior_count * chain_matrix(models, dt) + track.counts
    pi = alpha / alpha.sum(axis=1, keepdims=True)
    c = track.mu @ pi
    r, F = len(c), flow(dt)
    x, P, ll = np.empty((r, 4)), np.empty((r, 4, 4)), np.empty(r)
    for j in range(r):
        x0, P0 = mixture_moments(track.x, track.P, track.mu * pi[:, j] / c[j])
        x[j], P[j], ll[j] = dense_update(F @ x0, F @ P0 @ F.T + noise(dt, models.q[j]), plot)
    likelihood = np.exp(ll - ll.max())
    mu = np.maximum(c * likelihood / (c @ likelihood), MU_FLOOR)
    xi = track.mu[:, None] * pi * likelihood
    weight = min(dt / models.reference_s, 1.0)
    counts = np.exp(-dt / models.memory_s) * track.counts + weight * xi / xi.sum()
    return Track(x, P, mu / mu.sum(), counts)


def test_the_learning_form_step_by_step() -> None:
    plots = random_walk(np.random.default_rng(5), 40)
    got = want = begun(DIRICHLET, plots[0])
    for before, plot in itertools.pairwise(plots):
        got = filtered(DIRICHLET, got, [plot], before.t_s)
        want = dirichlet_step(DIRICHLET, want, plot, plot.t_s - before.t_s)
        np.testing.assert_allclose(got.mu, want.mu, atol=1e-9)
        np.testing.assert_allclose(got.counts, want.counts, atol=1e-9)
        np.testing.assert_allclose(got.x, want.x, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(got.P, want.P, rtol=1e-8, atol=1e-6)
    assert got.counts.sum() > 5.0


@LAW
@given(seeds)
def test_the_update_equals_the_joseph_form_and_its_density_is_normal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=4) * 100, covariance(rng, 4, 400.0)
    plot = Plot(rng.normal(size=2) * 100, packed(covariance(rng, 2, 100.0)), 0.0)
    want_x, want_P, _ = dense_update(x, P, plot)
    density = scipy.stats.multivariate_normal(x[:2].copy(), P[:2, :2] + unpacked(plot.R))
    assert update_position(x, P, plot.z, plot.R) == pytest.approx(density.logpdf(plot.z), abs=1e-9)
    np.testing.assert_allclose(x, want_x, atol=1e-8)
    np.testing.assert_allclose(P, want_P, atol=1e-8)


# --- laws ---


@LAW
@given(seeds, st.integers(1, 4))
def test_moment_matching_is_the_definition(seed: int, r: int) -> None:
    track = random_track(np.random.default_rng(seed), r)
    for got, want in zip(output(track), mixture_moments(track.x, track.P, track.mu), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-6)


@LAW
@given(seeds, st.integers(1, 4))
def test_mixing_changes_no_moment_of_the_whole(seed: int, r: int) -> None:
    rng = np.random.default_rng(seed)
    track = random_track(rng, r)
    before = output(track)
    pi = rng.dirichlet(np.ones(r), r)
    want_mu = track.mu @ pi
    mix(track.x, track.P, track.mu, pi, np.empty((r, 4)), np.empty((r, 4, 4)))
    np.testing.assert_allclose(track.mu, want_mu, atol=1e-14)
    for got, want in zip(output(track), before, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-6)
    assert np.array_equal(track.P, np.swapaxes(track.P, -1, -2))


@LAW
@given(seeds, st.floats(-3.0, 12.0), st.floats(0.0, 1e4))
def test_covariances_stay_symmetric_and_positive(seed: int, log_ratio: float, dt: float) -> None:
    """P0 up to 1e12 R, measured again and again, also after long gaps."""
    rng = np.random.default_rng(seed)
    r_m2 = 25.0
    track = Track(
        np.zeros((3, 4)), np.tile(np.eye(4) * r_m2 * 10**log_ratio, (3, 1, 1)), MODELS.mu0.copy(), np.zeros((3, 3))
    )
    plots = [Plot(rng.normal(size=2) * 5, np.array([r_m2, 0.0, r_m2]), 0.1 * k) for k in range(1, 30)]
    plots.append(plots[-1]._replace(t_s=plots[-1].t_s + dt))
    track = filtered(DIRICHLET, track, plots, 0.0)
    assert np.array_equal(track.P, np.swapaxes(track.P, -1, -2))
    assert all(np.isfinite(a).all() for a in track)
    least, most = np.linalg.eigvalsh(track.P)[:, [0, -1]].T
    assert np.all(least >= -1e-12 * most)
    assert np.all(np.diagonal(track.P, axis1=1, axis2=2) > 0)
    assert track.mu.sum() == pytest.approx(1.0)
    assert track.mu.min() >= 0.9 * MU_FLOOR


def test_no_time_changes_nothing() -> None:
    track = random_track(np.random.default_rng(6), 3)
    track.counts[:] = 2.0
    for models in (MODELS, DIRICHLET):
        for got, want in zip(predicted(models, track, 0.0), track, strict=True):
            assert np.array_equal(got, want)


@LAW
@given(seeds)
def test_two_plots_of_one_time_may_come_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    track = random_track(rng, 3)
    plots = [Plot(rng.normal(size=2) * 100, packed(covariance(rng, 2, 1e4)), 0.0) for _ in range(2)]
    # Where a model falls to its floor in between, what is floored first matters.
    assume(all(filtered(MODELS, track, [plot], 0.0).mu.min() > 10 * MU_FLOOR for plot in plots))
    one, other = filtered(MODELS, track, plots, 0.0), filtered(MODELS, track, plots[::-1], 0.0)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-7)


@LAW
@given(seeds, st.floats(0.01, 100.0))
def test_a_step_matrix_has_rows_of_probabilities(seed: int, dt: float) -> None:
    counts, pi = np.random.default_rng(seed).uniform(0, 20, (3, 3)), np.empty((3, 3))
    step_matrix(DIRICHLET, counts, dt, pi)
    np.testing.assert_allclose(pi.sum(axis=1), 1.0, atol=1e-14)
    assert np.all(pi >= 0)


def test_observed_transitions_draw_the_matrix_to_themselves() -> None:
    counts, pi = np.zeros((3, 3)), np.empty((3, 3))
    counts[0, 2] = 1e9
    step_matrix(DIRICHLET, counts, 4.0, pi)
    np.testing.assert_allclose(pi[0], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(pi[1:], chain_matrix(DIRICHLET, 4.0)[1:], atol=1e-14)


# --- what must not break it ---


def test_a_covariance_that_is_not_positive_skips_the_plot() -> None:
    x, P = np.zeros(4), np.zeros((4, 4))
    P[0, 0] = -100.0
    before = P.copy()
    assert update_position(x, P, np.ones(2), np.array([1.0, 0.0, 1.0])) == -np.inf
    assert not x.any()
    assert np.array_equal(P, before)


def test_without_any_likelihood_the_probabilities_stay() -> None:
    mu = np.array([0.2, 0.3, 0.5])
    reweigh(mu, np.full(3, -np.inf))
    assert mu.tolist() == [0.2, 0.3, 0.5]


def test_a_wild_plot_neither_breaks_nor_locks_the_filter() -> None:
    plots = random_walk(np.random.default_rng(7), 20)
    wild = Plot(plots[10].z + 1e7, plots[10].R, plots[10].t_s)
    track = filtered(DIRICHLET, begun(DIRICHLET, plots[0]), [*plots[1:10], wild], plots[0].t_s)
    assert all(np.isfinite(a).all() for a in track)
    assert track.mu.min() >= 0.9 * MU_FLOOR
    assert track.mu.sum() == pytest.approx(1.0, abs=1e-12)


def test_the_likely_model_wins_by_bayes() -> None:
    mu = np.array([0.5, 0.25, 0.25])
    reweigh(mu, np.log([1.0, 2.0, 4.0]) - 1000.0)
    np.testing.assert_allclose(mu, [0.25, 0.25, 0.5], atol=1e-12)


@pytest.mark.parametrize(
    ("q", "tau", "extra"),
    [
        ([1.0], [1.0, 2.0], {}),
        ([0.0], [1.0], {}),
        ([1.0], [0.0], {}),
        ([[1.0]], [[1.0]], {}),
        ([1.0], [1.0], {"prior_count": 0.0}),
        ([1.0], [1.0], {"memory_s": -1.0}),
        ([1.0], [1.0], {"reference_s": 0.0}),
    ],
)
def test_models_that_make_no_sense_are_refused(q: list[float], tau: list[float], extra: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="positive"):
        make_models(np.array(q), np.array(tau), **extra)
