from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    DIRICHLET,
    LAW,
    MODELS,
    FloatArray,
    Plot,
    begin_row,
    copied,
    covariances,
    feed_row,
    filtered,
    fresh_filters,
    head,
    mixture_moments,
    packed,
    predicted,
    random_walk,
    scratch,
    seeds,
)

from trackmesh.services.estimation import gating, tracks
from trackmesh.services.estimation.imm import Models, interact
from trackmesh.services.estimation.tracks import Filters, make_filters

RING = 6
ROW = np.array([0])


def fed(models: Models, plots: list[Plot], ring: int = RING) -> Filters:
    f = fresh_filters(models, plots[0], ring=ring)
    for plot in plots[1:]:
        assert feed_row(models, f, 0, plot)
    return f


def meaning(f: Filters, row: int) -> list[FloatArray]:
    """All that a row holds; of the ring only the entries in use."""
    n = f.ring_n[row]
    rings = {"ring_z", "ring_R", "ring_t_s", "ring_sensor"}
    return [a[row][:n] if name in rings else a[row] for name, a in zip(Filters._fields, f, strict=True)]


def same(one: Filters, other: Filters, row: int = 0) -> bool:
    """Equal bit for bit."""
    return all(np.array_equal(a, b) for a, b in zip(meaning(one, row), meaning(other, row), strict=True))


def late_order(rng: np.random.Generator, n: int, reach: int) -> list[int]:
    """An order of n plots in which none comes after more than ``reach`` younger ones."""
    waiting, out = list(range(n)), list[int]()
    while waiting:
        oldest = waiting[0]
        younger = len([k for k in out if k > oldest])
        pick = 0 if younger >= reach else int(rng.integers(0, min(len(waiting), reach + 1)))
        out.append(waiting.pop(pick))
    return out


# --- late plots ---


@pytest.mark.parametrize("models", [MODELS, DIRICHLET], ids=["imm", "dirichlet"])
@LAW
@given(seed=seeds, n=st.integers(2, 25))
def test_any_order_within_the_ring_is_the_order_of_time(models: Models, seed: int, n: int) -> None:
    """Bit for bit: the replay runs the same kernel over the same plots in the same order."""
    rng = np.random.default_rng(seed)
    plots = random_walk(rng, n + 1)
    in_order = fed(models, plots)
    shuffled = fed(models, [plots[0]] + [plots[k + 1] for k in late_order(rng, n, RING - 1)])
    assert same(shuffled, in_order)


@LAW
@given(seeds)
def test_the_head_is_what_the_filter_of_one_track_gives(seed: int) -> None:
    plots = random_walk(np.random.default_rng(seed), 15)
    f = fed(DIRICHLET, plots)
    begun = head(fresh_filters(DIRICHLET, plots[0]))
    for got, want in zip(head(f), filtered(DIRICHLET, begun, plots[1:], plots[0].t_s), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


def test_the_lagged_state_is_the_head_without_the_ring() -> None:
    plots = random_walk(np.random.default_rng(1), 20)
    f, short = fed(DIRICHLET, plots), fed(DIRICHLET, plots[:-RING])
    assert f.ring_n[0] == RING
    assert f.lag_t_s[0] == plots[-RING - 1].t_s
    np.testing.assert_allclose(f.lag_x[0], short.x[0], rtol=1e-12)
    np.testing.assert_allclose(f.lag_counts[0], short.counts[0], rtol=1e-12)


def test_a_plot_older_than_the_lagged_state_is_refused_and_changes_nothing() -> None:
    plots = random_walk(np.random.default_rng(2), 15)
    f = fed(MODELS, plots)
    before = copied(f)
    assert not feed_row(MODELS, f, 0, plots[3]._replace(t_s=float(f.lag_t_s[0]) - 1e-6))
    assert same(f, before)
    assert feed_row(MODELS, f, 0, plots[3]._replace(t_s=float(f.lag_t_s[0])))


def test_a_plot_of_the_same_time_comes_after_those_that_are_there() -> None:
    plots = random_walk(np.random.default_rng(3), 5)
    twin = plots[2]._replace(z=plots[2].z + 10.0)
    f = fed(MODELS, [*plots, twin])
    assert f.ring_t_s[0, :5].tolist() == [plots[k].t_s for k in (1, 2, 2, 3, 4)]
    assert f.ring_z[0, 2].tolist() == twin.z.tolist()
    in_order = fed(MODELS, [*plots[:3], twin, *plots[3:]])
    assert same(f, in_order)


def test_a_late_plot_into_a_full_ring_moves_straight_into_the_lagged_state() -> None:
    plots = random_walk(np.random.default_rng(4), 12)
    hidden = plots[5]
    f = fed(DIRICHLET, plots[:5] + plots[6:])
    assert f.ring_n[0] == RING
    assert f.lag_t_s[0] < hidden.t_s < f.ring_t_s[0, 0]
    assert feed_row(DIRICHLET, f, 0, hidden)
    assert f.ring_n[0] == RING
    assert f.lag_t_s[0] == hidden.t_s
    np.testing.assert_allclose(f.x[0], fed(DIRICHLET, plots).x[0], rtol=1e-12, atol=1e-9)


def test_rows_keep_to_themselves() -> None:
    rng = np.random.default_rng(5)
    one, other = random_walk(rng, 10), random_walk(rng, 10)
    f = make_filters(3, 3, RING)
    begin_row(MODELS, f, 0, one[0])
    begin_row(MODELS, f, 2, other[0])
    for a, b in zip(one[1:], other[1:], strict=True):
        z, R, t = np.stack([b.z, a.z]), np.stack([b.R, a.R]), np.array([b.t_s, a.t_s])
        assert tracks.feed(MODELS, f, np.array([2, 0]), z, R, t, 7).all()
    for row, plots in ((0, one), (2, other)):
        np.testing.assert_array_equal(f.x[row], fed(MODELS, plots).x[0])
    assert not f.x[1].any()
    assert set(f.ring_sensor[[0, 2]].ravel().tolist()) == {7}


def test_a_row_used_again_remembers_nothing() -> None:
    rng = np.random.default_rng(6)
    old, new = random_walk(rng, 20), random_walk(rng, 8)
    f = fed(DIRICHLET, old)
    begin_row(DIRICHLET, f, 0, new[0])
    for plot in new[1:]:
        feed_row(DIRICHLET, f, 0, plot)
    assert same(f, fed(DIRICHLET, new))


def test_the_ring_of_one_track_feeds_another() -> None:
    """Two tracks that shared the plots of one target become what one track of all plots is."""
    plots = random_walk(np.random.default_rng(7), 7)
    f = fresh_filters(MODELS, plots[0], rows=2, ring=RING)
    begin_row(MODELS, f, 1, plots[1])
    for k in (2, 4, 6):
        feed_row(MODELS, f, 0, plots[k])
    for k in (3, 5):
        feed_row(MODELS, f, 1, plots[k])
    tracks.feed_ring(MODELS, f, 1, 0)
    want = fed(MODELS, [plots[0], *plots[2:]])
    assert same(f, want)


# --- prediction ---


@LAW
@given(seeds, st.floats(0.0, 60.0))
def test_prediction_is_one_interaction_and_changes_nothing(seed: int, dt: float) -> None:
    f = fed(DIRICHLET, random_walk(np.random.default_rng(seed), 10))
    before = copied(f)
    t = f.t_s + dt
    got, known = predicted(DIRICHLET, f, ROW, t)
    want = head(f)
    interact(DIRICHLET, *want, float(t[0] - f.t_s[0]), *scratch(3))
    assert known.all()
    for a, b in zip(got[:3], want[:3], strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-12, atol=1e-12)
    assert same(f, before)


@LAW
@given(seeds, st.integers(0, RING - 1), st.floats(0.0, 0.99))
def test_the_past_is_what_filtering_up_to_then_gave(seed: int, back: int, share: float) -> None:
    plots = random_walk(np.random.default_rng(seed), 15)
    f = fed(DIRICHLET, plots)
    upto = len(plots) - 2 - back
    t = plots[upto].t_s + share * (plots[upto + 1].t_s - plots[upto].t_s)
    now, known = predicted(DIRICHLET, f, ROW, np.array([t]))
    then, _ = predicted(DIRICHLET, fed(DIRICHLET, plots[: upto + 1]), ROW, np.array([t]))
    assert known.all()
    for a, b in zip(now[:3], then[:3], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-9)


def test_before_the_lagged_state_there_is_no_answer() -> None:
    f = fed(MODELS, random_walk(np.random.default_rng(8), 15))
    _, known = predicted(MODELS, f, np.array([0, 0]), np.array([f.lag_t_s[0] - 1e-3, f.lag_t_s[0]]))
    assert known.tolist() == [False, True]


@LAW
@given(seeds)
def test_moments_are_those_of_each_mixture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P, mu = rng.normal(size=(3, 2, 4)), covariances(rng, (3, 2), 4), rng.dirichlet([1, 1], 3)
    mean, covariance = tracks.moments(x, P, mu)
    for k in range(3):
        for got, want in zip((mean[k], covariance[k]), mixture_moments(x[k], P[k], mu[k]), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-9)


def test_a_new_track_stands_at_its_plot() -> None:
    plot = Plot(np.array([100.0, -50.0]), np.array([4.0, 1.0, 9.0]), 3.0)
    f = fresh_filters(MODELS, plot)
    want = np.zeros((4, 4))
    want[:2, :2], want[2:, 2:] = [[4.0, 1.0], [1.0, 9.0]], 150.0**2 * np.eye(2)
    assert np.array_equal(f.x[0], np.tile([100.0, -50.0, 0.0, 0.0], (3, 1)))
    assert np.array_equal(f.P[0], np.tile(want, (3, 1, 1)))
    assert f.mu[0].tolist() == MODELS.mu0.tolist()
    assert (f.t_s[0], f.lag_t_s[0], f.ring_n[0]) == (3.0, 3.0, 0)


# --- the quick bound before the gate ---


def many(rng: np.random.Generator, n: int) -> tuple[Filters, FloatArray]:
    """n tracks of different ages in a square of 20 km, and the time of the newest."""
    f = make_filters(n, 3, RING)
    newest = 0.0
    for row in range(n):
        shift = rng.uniform(0, 2e4, 2)
        plots = [p._replace(z=p.z + shift) for p in random_walk(rng, int(rng.integers(1, 8)), 10 ** rng.uniform(1, 3))]
        begin_row(MODELS, f, row, plots[0])
        for plot in plots[1:]:
            feed_row(MODELS, f, row, plot)
        newest = max(newest, plots[-1].t_s)
    return f, np.array(newest)


@LAW
@given(seeds, st.integers(1, 8), st.floats(0.0, 20.0), st.sampled_from([0.0, 0.0, 3.0]))
def test_no_track_with_a_plot_in_its_gate_is_left_out(seed: int, m: int, wait: float, spread_s: float) -> None:
    rng = np.random.default_rng(seed)
    f, newest = many(rng, 12)
    rows, limit = np.arange(12), 16.0
    t = newest + wait + rng.uniform(0, 1, m) * spread_s
    # Plots at the very edge: on the ellipse of some model of some track.
    ahead, _ = predicted(MODELS, f, rows, np.full(12, t.mean()))
    R = packed(covariances(rng, (m,), 2, 10 ** rng.uniform(1, 5)))
    z = np.empty((m, 2))
    for j in range(m):
        i, a = int(rng.integers(12)), int(rng.integers(3))
        S = ahead.P[i, a, :2, :2] + [[R[j, 0], R[j, 1]], [R[j, 1], R[j, 2]]]
        angle = rng.uniform(0, 2 * np.pi)
        out = np.linalg.cholesky(S) @ [np.cos(angle), np.sin(angle)] * np.sqrt(limit) * 0.9999
        z[j] = ahead.x[i, a, :2] + out + (t[j] - t.mean()) * ahead.x[i, a, 2:]
    times = np.full(12, t.mean())
    inside, _, _ = gating.gate(ahead.x, ahead.P, ahead.mu, times, z, R, t, limit)
    assert len(inside) >= m
    near = tracks.near(f, rows, z, R, t, float(MODELS.q.max()), limit)
    assert set(inside.tolist()) <= set(near.tolist())


def test_tracks_far_from_all_plots_are_left_out() -> None:
    f, newest = many(np.random.default_rng(9), 12)
    z, R = np.array([[5e5, 5e5]]), np.array([[100.0, 0.0, 100.0]])
    assert not len(tracks.near(f, np.arange(12), z, R, np.array([newest + 1.0]), 500.0, 16.0))


def test_each_row_gets_the_time_of_the_plot_nearest_to_it() -> None:
    f = make_filters(2, 3, RING)
    begin_row(MODELS, f, 0, Plot(np.array([0.0, 0.0]), np.array([1.0, 0.0, 1.0]), 0.0))
    begin_row(MODELS, f, 1, Plot(np.array([1000.0, 0.0]), np.array([1.0, 0.0, 1.0]), 0.0))
    z, t = np.array([[900.0, 50.0], [-300.0, 0.0], [5000.0, 0.0]]), np.array([1.0, 2.0, 3.0])
    assert tracks.nearest_times(f, np.array([1, 0]), z, t).tolist() == [1.0, 2.0]
    # A row that moves is taken along to the time of each plot.
    f.mean[0, 2] = 2000.0
    assert tracks.nearest_times(f, np.array([0]), z, t).tolist() == [3.0]
