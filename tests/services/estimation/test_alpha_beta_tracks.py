from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    LAW,
    FloatArray,
    H,
    IntArray,
    Plot,
    assert_covariance,
    batch,
    covariance,
    flow,
    packed,
    random_walk,
    seeds,
    unpacked,
)

from trackmesh.services.estimation import alpha_beta as ab
from trackmesh.services.estimation import gating
from trackmesh.services.estimation.alpha_beta_tracks import AlphaBetaTracks
from trackmesh.services.estimation.plots import Plots, make_plots

SIGMA_V, ACCELERATION = 150.0, 5.0
ROW = np.array([0])


def begun(first: Plot, rows: int = 1, acceleration: float = ACCELERATION) -> AlphaBetaTracks:
    out = AlphaBetaTracks(rows, SIGMA_V, acceleration)
    out.begin(ROW, batch(first))
    return out


def now(tracks: AlphaBetaTracks, row: int = 0) -> tuple[FloatArray, FloatArray]:
    """State (4,) and covariance (4, 4) of a row at its last plot."""
    mixture, known = tracks.predict(np.array([row]), tracks.t_s[[row]])
    assert known.all()
    x, P = tracks.estimates(mixture)
    return x[0], P[0]


def noise(dt_s: float, acceleration: float) -> FloatArray:
    """An acceleration that is constant over the interval."""
    G = np.kron([[dt_s**2 / 2.0], [dt_s]], np.eye(2))
    return np.asarray(acceleration**2 * G @ G.T)


@LAW
@given(seeds)
def test_the_covariance_is_that_of_the_gains(seed: int) -> None:
    """(I - K H) P (I - K H)^T + K R K^T, with plots as oblong and as irregular as they like."""
    rng = np.random.default_rng(seed)
    plots = random_walk(rng, 25, 10 ** rng.uniform(0, 3))
    tracks = begun(plots[0])
    x, P = np.array([*plots[0].z, 0.0, 0.0]), np.zeros((4, 4))
    P[:2, :2], P[2:, 2:], t_s = unpacked(plots[0].R), SIGMA_V**2 * np.eye(2), plots[0].t_s
    for k, plot in enumerate(plots[1:], start=2):
        dt, t_s = plot.t_s - t_s, plot.t_s
        sigma_m = np.sqrt(np.trace(unpacked(plot.R)) / 2.0)
        alpha, beta = ab.combined_gains(k, ab.manoeuvring_index(dt, ACCELERATION, sigma_m))
        K = np.kron([[alpha], [beta / dt]], np.eye(2))
        left = np.eye(4) - K @ H
        x = flow(dt) @ x
        x = x + K @ (plot.z - H @ x)
        P = flow(dt) @ P @ flow(dt).T + noise(dt, ACCELERATION)
        P = left @ P @ left.T + K @ unpacked(plot.R) @ K.T
        assert tracks.feed(ROW, batch(plot)).all()
        got_x, got_P = now(tracks)
        scale = np.sqrt(np.diag(P))
        np.testing.assert_allclose(got_x / scale, x / scale, rtol=1e-11, atol=1e-9)
        np.testing.assert_allclose(got_P / np.outer(scale, scale), P / np.outer(scale, scale), rtol=0, atol=1e-9)
        assert_covariance(got_P)


@LAW
@given(seeds, st.floats(0.0, 60.0))
def test_a_prediction_is_constant_velocity_and_changes_nothing(seed: int, dt: float) -> None:
    plots = random_walk(np.random.default_rng(seed), 6)
    tracks = begun(plots[0])
    for plot in plots[1:]:
        tracks.feed(ROW, batch(plot))
    x, P = now(tracks)
    mixture, known = tracks.predict(ROW, tracks.t_s + dt)
    assert known.all()
    assert mixture.mu.tolist() == [[1.0]]
    np.testing.assert_allclose(mixture.x[0, 0], flow(dt) @ x, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(mixture.P[0, 0], flow(dt) @ P @ flow(dt).T + noise(dt, ACCELERATION), rtol=1e-9)
    assert_covariance(mixture.P[0, 0])
    for got, want in zip(now(tracks), (x, P), strict=True):
        assert np.array_equal(got, want)


@LAW
@given(seeds, st.integers(2, 60), st.floats(0.1, 20.0))
def test_without_manoeuvres_it_draws_the_least_squares_line(seed: int, n: int, dt: float) -> None:
    rng = np.random.default_rng(seed)
    t, z = dt * np.arange(n), rng.normal(0.0, 100.0, (n, 2))
    tracks = begun(Plot(z[0], np.array([400.0, 0.0, 400.0]), 0.0), acceleration=0.0)
    for k in range(1, n):
        tracks.feed(ROW, make_plots(z[k], [400.0, 0.0, 400.0], t[k]))
    x, P = now(tracks)
    slope, offset = np.polyfit(t - t[-1], z, 1)
    np.testing.assert_allclose(x[:2], offset, atol=1e-8)
    np.testing.assert_allclose(x[2:] * dt, slope * dt, atol=1e-8)
    # And its covariance is that of the line: sigma^2 (A^T A)^-1, the same in both coordinates.
    A = np.stack([np.ones(n), (t - t[-1]) / dt], axis=1)
    line = 400.0 * np.linalg.inv(A.T @ A)
    unit = np.diag([1.0, 1.0, dt, dt])
    np.testing.assert_allclose(unit @ P @ unit, np.kron(line, np.eye(2)), rtol=1e-7, atol=1e-6)


@LAW
@given(seeds)
def test_it_is_the_plain_filter(seed: int) -> None:
    """The numbers of ``alpha_beta.step``, for many tracks at once."""
    rng, n, sigma_m = np.random.default_rng(seed), 5, 30.0
    rows, R = np.arange(n), np.array([sigma_m**2, 0.0, sigma_m**2])
    z, t_s = rng.uniform(-1e4, 1e4, (n, 2)), rng.uniform(0.0, 2.0, n)
    tracks = AlphaBetaTracks(n, SIGMA_V, ACCELERATION)
    tracks.begin(rows, make_plots(z, R, t_s))
    x = np.concatenate([z, np.zeros((n, 2))], axis=1)
    for k in range(2, 20):
        z, dt = z + rng.normal(0.0, 300.0, (n, 2)), rng.uniform(1.0, 3.0, n)
        t_s = t_s + dt
        count = np.full(n, k)
        gains = ab.combined_gains(count, ab.manoeuvring_index(dt, ACCELERATION, sigma_m))
        x = ab.step(x, z, dt, count, *gains)
        assert tracks.feed(rows, make_plots(z, R, t_s)).all()
        np.testing.assert_allclose(tracks.mean, x, rtol=1e-9, atol=1e-9)
        assert tracks.t_s.tolist() == t_s.tolist()


def test_late_plots_are_refused_and_change_nothing() -> None:
    plots = random_walk(np.random.default_rng(1), 8)
    tracks = begun(plots[0])
    for plot in (*plots[1:6], plots[7]):
        assert tracks.feed(ROW, batch(plot)).all()
    before = now(tracks)
    assert not tracks.feed(ROW, batch(plots[6])).any()
    for got, want in zip(now(tracks), before, strict=True):
        assert np.array_equal(got, want)
    assert tracks.t_s.tolist() == tracks.oldest_s.tolist() == [plots[7].t_s]
    _, known = tracks.predict(np.array([0, 0]), np.array([plots[7].t_s - 1e-6, plots[7].t_s]))
    assert known.tolist() == [False, True]


def test_of_one_batch_only_the_late_plots_are_refused() -> None:
    tracks = AlphaBetaTracks(3, SIGMA_V, ACCELERATION)
    R = [100.0, 0.0, 100.0]
    tracks.begin(np.arange(3), make_plots(np.zeros((3, 2)), R, [0.0, 5.0, 0.0]))
    taken = tracks.feed(np.array([2, 1, 0]), make_plots(np.ones((3, 2)), R, 4.0))
    assert taken.tolist() == [True, False, True]
    assert tracks.mean[:, 0].tolist() == [1.0, 0.0, 1.0]


def test_a_second_plot_of_one_time_is_weighed_by_what_is_known() -> None:
    """It leaves the velocity, and is not counted."""
    plots = random_walk(np.random.default_rng(2), 12, every_s=(2.0, 2.0))
    # Of a target without manoeuvres, whose gains fall with every plot that counts.
    one, other = (begun(plots[0], acceleration=0.0) for _ in range(2))
    for plot in plots[1:11]:
        one.feed(ROW, batch(plot))
        other.feed(ROW, batch(plot))
    (x, P), R = now(one), 900.0
    plot = Plot(x[:2] + np.array([50.0, -20.0]), np.array([R, 0.0, R]), plots[10].t_s)
    assert one.feed(ROW, batch(plot)).all()
    got_x, got_P = now(one)
    weight = np.trace(P[:2, :2]) / (np.trace(P[:2, :2]) + 2.0 * R)
    np.testing.assert_allclose(got_x, x + weight * np.array([50.0, -20.0, 0.0, 0.0]), atol=1e-9)
    left = np.diag([1.0 - weight, 1.0 - weight, 1.0, 1.0])
    want = left @ P @ left.T + np.diag([weight**2 * R, weight**2 * R, 0.0, 0.0])
    np.testing.assert_allclose(got_P, want, rtol=1e-10, atol=1e-9)
    assert np.trace(got_P[:2, :2]) < np.trace(P[:2, :2])
    assert_covariance(got_P)
    one.feed(ROW, batch(plots[11]))
    other.feed(ROW, batch(plots[11]))
    # The gains of the next plot are those of the other: the same share of what came.
    gain = [
        (now(t)[0][:2] - a[:2] - 2.0 * a[2:]) / (plots[11].z - a[:2] - 2.0 * a[2:])
        for t, a in ((one, got_x), (other, x))
    ]
    np.testing.assert_allclose(gain[0], gain[1], rtol=1e-9)


def test_a_row_used_again_remembers_nothing() -> None:
    rng = np.random.default_rng(3)
    old, new = random_walk(rng, 20), random_walk(rng, 8)
    used, fresh = begun(old[0]), begun(new[0])
    for plot in old[1:]:
        used.feed(ROW, batch(plot))
    used.begin(ROW, batch(new[0]))
    for plot in new[1:]:
        used.feed(ROW, batch(plot))
        fresh.feed(ROW, batch(plot))
    for got, want in zip(now(used), now(fresh), strict=True):
        assert np.array_equal(got, want)


def test_rows_are_added_behind_those_that_are_there() -> None:
    plots = random_walk(np.random.default_rng(4), 5)
    tracks = begun(plots[0], rows=2)
    tracks.feed(ROW, batch(plots[1]))
    before = now(tracks)
    tracks.grow(3)
    assert tracks.mean.shape == (5, 4)
    assert tracks.t_s.shape == (5,)
    tracks.begin(np.array([4]), batch(plots[2]))
    assert tracks.mean[4].tolist() == [*plots[2].z, 0.0, 0.0]
    for got, want in zip(now(tracks), before, strict=True):
        assert np.array_equal(got, want)


def _near(tracks: AlphaBetaTracks, rows: IntArray, plots: Plots, limit: float) -> IntArray:
    own = tracks._rows
    return gating.near(own.x, own.spread, own.t_s, rows, plots, limit, tracks._strength)


@LAW
@given(seeds, st.floats(0.0, 20.0))
def test_no_track_with_a_plot_in_its_gate_is_left_out(seed: int, wait: float) -> None:
    rng, limit = np.random.default_rng(seed), 16.0
    tracks = AlphaBetaTracks(6, SIGMA_V, ACCELERATION)
    rows = np.arange(6)
    for row in rows.tolist():
        walk = random_walk(rng, int(rng.integers(1, 8)), 10 ** rng.uniform(1, 3))
        tracks.begin(np.array([row]), batch(walk[0]))
        for plot in walk[1:]:
            tracks.feed(np.array([row]), batch(plot))
    t_s = np.full(6, tracks.t_s.max() + wait)
    ahead, _ = tracks.predict(rows, t_s)
    R = covariance(rng, 2, 10 ** rng.uniform(1, 5))
    row, angle = int(rng.integers(6)), rng.uniform(0, 2 * np.pi)
    edge = np.linalg.cholesky(ahead.P[row, 0, :2, :2] + R) @ [np.cos(angle), np.sin(angle)] * np.sqrt(limit) * 0.9999
    plots = make_plots(ahead.x[row, 0, :2] + edge, packed(R), t_s[0])
    inside, _, _ = gating.gate(ahead, t_s, plots, limit)
    assert row in inside
    assert set(inside.tolist()) <= set(_near(tracks, rows, plots, limit).tolist())


def test_a_target_that_flies_as_supposed_is_followed_as_well_as_said() -> None:
    """NEES of plots with errors twice as great to the north, by simulation."""
    rng, n, dt = np.random.default_rng(5), 400, 2.0
    rows, sigma = np.arange(n), np.array([20.0, 40.0])
    truth = np.concatenate([np.zeros((n, 2)), rng.normal(0.0, SIGMA_V, (n, 2))], axis=1)
    tracks, nees = AlphaBetaTracks(n, SIGMA_V, ACCELERATION), []
    for k in range(30):
        z = truth[:, :2] + sigma * rng.normal(size=(n, 2))
        plots = make_plots(z, [sigma[0] ** 2, 0.0, sigma[1] ** 2], k * dt)
        if k == 0:
            tracks.begin(rows, plots)
        else:
            tracks.feed(rows, plots)
        x, P = tracks.estimates(tracks.predict(rows, tracks.t_s)[0])
        nees.append(float(np.einsum("na,na->n", x - truth, np.linalg.solve(P, (x - truth)[..., None])[..., 0]).mean()))
        push = rng.normal(0.0, ACCELERATION, (n, 2))
        truth = truth @ flow(dt).T + np.concatenate([dt**2 / 2.0 * push, dt * push], axis=1)
    assert np.mean(nees) / 4.0 == pytest.approx(1.0, abs=0.05)
    assert np.max(nees[1:]) / 4.0 < 1.25


def test_no_lag_is_kept() -> None:
    with pytest.raises(NotImplementedError):
        begun(Plot(np.zeros(2), np.array([1.0, 0.0, 1.0]), 0.0)).refined(ROW, 1)
