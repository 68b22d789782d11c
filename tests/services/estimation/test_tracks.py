from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    DIRICHLET,
    LAW,
    MODELS,
    NAMED,
    TVIMM,
    FloatArray,
    IntArray,
    Plot,
    batch,
    begin_row,
    copied,
    covariances,
    feed_row,
    fields,
    filtered,
    fresh_filters,
    interacted,
    mixture,
    mixture_moments,
    packed,
    predicted,
    random_walk,
    same,
    same_present,
    seeds,
)

from trackmesh.services.estimation import gating, tracks
from trackmesh.services.estimation.bank import Models
from trackmesh.services.estimation.gating import Mixture
from trackmesh.services.estimation.imm_tracks import ImmTracks, strength
from trackmesh.services.estimation.plots import Plots, make_plots
from trackmesh.services.estimation.tracks import Filters, make_filters, with_more_rows

RING = 6
ROW = np.array([0])


def fed(models: Models, plots: list[Plot], ring: int = RING) -> Filters:
    f = fresh_filters(models, plots[0], ring=ring)
    for plot in plots[1:]:
        assert feed_row(models, f, 0, plot)
    return f


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


@pytest.mark.parametrize("models", NAMED.values(), ids=NAMED)
@LAW
@given(seed=seeds, n=st.integers(2, 25))
def test_any_order_within_the_ring_is_the_order_of_time(models: Models, seed: int, n: int) -> None:
    """Bit for bit: the replay runs the same kernel over the same plots in the same order."""
    rng = np.random.default_rng(seed)
    plots = random_walk(rng, n + 1)
    in_order = fed(models, plots)
    shuffled = fed(models, [plots[0]] + [plots[k + 1] for k in late_order(rng, n, RING // 2)])
    assert same_present(shuffled, in_order)


@pytest.mark.parametrize("models", [DIRICHLET, TVIMM], ids=["dirichlet", "tvimm"])
@LAW
@given(seed=seeds)
def test_the_head_is_what_the_filter_of_one_track_gives(models: Models, seed: int) -> None:
    plots = random_walk(np.random.default_rng(seed), 15)
    f = fed(models, plots)
    begun = fresh_filters(models, plots[0]).head[0]
    got, want = fields(f.head[0]), fields(filtered(models, begun, plots[1:]))
    for name, value in want.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("n", range(1, 25))
def test_base_and_mid_are_the_head_without_the_plots_behind_them(n: int) -> None:
    plots = random_walk(np.random.default_rng(1), n)
    f = fed(DIRICHLET, plots)
    behind, held = int(f.ring_n[0]), int(f.mid_n[0])
    assert behind >= min(n - 1, RING // 2)
    assert behind < RING
    assert f.base[0].tobytes() == fed(DIRICHLET, plots[: n - behind]).head[0].tobytes()
    assert f.ring["t_s"][0, :behind].tolist() == [plot.t_s for plot in plots[n - behind :]]
    assert (held > 0) == (n > RING // 2)
    if held:
        assert f.mid[0].tobytes() == fed(DIRICHLET, plots[: n - behind + held]).head[0].tobytes()


def test_a_plot_older_than_the_base_is_refused_and_changes_nothing() -> None:
    plots = random_walk(np.random.default_rng(2), 15)
    f = fed(MODELS, plots)
    before = copied(f)
    assert not feed_row(MODELS, f, 0, plots[3]._replace(t_s=float(f.base[0].t_s) - 1e-6))
    assert same(f, before)
    assert feed_row(MODELS, f, 0, plots[3]._replace(t_s=float(f.base[0].t_s)))


def test_a_plot_of_the_same_time_comes_after_those_that_are_there() -> None:
    plots = random_walk(np.random.default_rng(3), 5)
    twin = plots[2]._replace(z=plots[2].z + 10.0)
    f = fed(MODELS, [*plots, twin])
    assert f.ring["t_s"][0, :5].tolist() == [plots[k].t_s for k in (1, 2, 2, 3, 4)]
    assert f.ring["z"][0, 2].tolist() == twin.z.tolist()
    in_order = fed(MODELS, [*plots[:3], twin, *plots[3:]])
    assert same(f, in_order)


@pytest.mark.parametrize("hidden", range(7, 12))
def test_a_late_plot_renews_the_states_behind_it(hidden: int) -> None:
    plots = random_walk(np.random.default_rng(4), 12)
    f = fed(DIRICHLET, plots[:hidden] + plots[hidden + 1 :])
    assert f.base[0].t_s < plots[hidden].t_s
    assert feed_row(DIRICHLET, f, 0, plots[hidden])
    behind, held = int(f.ring_n[0]), int(f.mid_n[0])
    assert f.head[0].tobytes() == fed(DIRICHLET, plots).head[0].tobytes()
    assert f.mid[0].tobytes() == fed(DIRICHLET, plots[: len(plots) - behind + held]).head[0].tobytes()


def test_rows_keep_to_themselves() -> None:
    rng = np.random.default_rng(5)
    one, other = random_walk(rng, 10), random_walk(rng, 10)
    f = make_filters(MODELS, 3, RING)
    begin_row(MODELS, f, 0, one[0])
    begin_row(MODELS, f, 2, other[0])
    for a, b in zip(one[1:], other[1:], strict=True):
        both = batch(b, a)
        both["sensor"] = 7
        assert tracks.feed(f, np.array([2, 0]), both).all()
    for row, plots in ((0, one), (2, other)):
        assert f.head[row].tobytes() == fed(MODELS, plots).head[0].tobytes()
    assert not f.head["x"][1].any()
    assert set(f.ring["sensor"][[0, 2]].ravel().tolist()) == {7}


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
    layer = ImmTracks(MODELS, 2, RING, 150.0)
    layer.begin(np.array([0, 1]), batch(*plots[:2]))
    for row, k in ((0, 2), (0, 4), (0, 6), (1, 3), (1, 5)):
        assert layer.feed(np.array([row]), batch(plots[k])).all()
    layer.feed_from(1, 0)
    assert layer.filters.head[0].tobytes() == fed(MODELS, [plots[0], *plots[2:]]).head[0].tobytes()


def test_more_rows_leave_the_rows_there_are_and_are_as_good_as_new() -> None:
    plots = random_walk(np.random.default_rng(12), 10)
    one = fed(TVIMM, plots)
    whole = with_more_rows(one, 300)
    assert len(whole.head) == len(whole.ring) == len(one.head) + 300
    assert same(whole, one)
    begin_row(TVIMM, whole, 200, plots[3])
    for plot in plots[4:]:
        feed_row(TVIMM, whole, 200, plot)
    assert same(whole, fed(TVIMM, plots[3:]), 200, 0)
    assert same(whole, one)


# --- prediction ---


@pytest.mark.parametrize("models", [DIRICHLET, TVIMM], ids=["dirichlet", "tvimm"])
@LAW
@given(seed=seeds, dt=st.floats(0.0, 60.0))
def test_prediction_is_one_interaction_and_changes_nothing(models: Models, seed: int, dt: float) -> None:
    f = fed(models, random_walk(np.random.default_rng(seed), 10))
    before = copied(f)
    t = f.t_s + dt
    got, known = predicted(models, f, ROW, t)
    want = interacted(models, f.head[0], float(t[0]))
    assert known.all()
    for a, b in zip(got, mixture(models, want), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    branch = np.repeat(np.arange(len(models.split_s)), np.diff(models.first))
    np.testing.assert_allclose(got.mu[0], want.mu * want.weight[branch], rtol=1e-12)
    assert same(f, before)


@pytest.mark.parametrize("models", NAMED.values(), ids=NAMED)
@LAW
@given(seed=seeds, back=st.integers(0, RING // 2 - 1), share=st.floats(0.0, 0.99))
def test_the_past_is_what_filtering_up_to_then_gave(models: Models, seed: int, back: int, share: float) -> None:
    plots = random_walk(np.random.default_rng(seed), 15)
    f = fed(models, plots)
    upto = len(plots) - 2 - back
    t = plots[upto].t_s + share * (plots[upto + 1].t_s - plots[upto].t_s)
    before = copied(f)
    now, known = predicted(models, f, ROW, np.array([t]))
    then, _ = predicted(models, fed(models, plots[: upto + 1]), ROW, np.array([t]))
    assert known.all()
    assert same(f, before)
    for a, b in zip(now, then, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-9)


def test_before_the_base_there_is_no_answer() -> None:
    f = fed(MODELS, random_walk(np.random.default_rng(8), 15))
    _, known = predicted(MODELS, f, np.array([0, 0]), np.array([f.base[0].t_s - 1e-3, f.base[0].t_s]))
    assert known.tolist() == [False, True]


@LAW
@given(seeds)
def test_moments_are_those_of_each_mixture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P, mu = rng.normal(size=(3, 2, 4)), covariances(rng, (3, 2), 4), rng.dirichlet([1, 1], 3)
    mean, covariance = tracks.estimates(TVIMM, Mixture(x, P, mu))
    for k in range(3):
        for got, want in zip((mean[k], covariance[k]), mixture_moments(x[k], P[k], mu[k]), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-9)


def test_a_new_track_stands_at_its_plot() -> None:
    plot = Plot(np.array([100.0, -50.0]), np.array([4.0, 1.0, 9.0]), 3.0)
    f = fresh_filters(MODELS, plot)
    want = np.zeros((4, 4))
    want[:2, :2], want[2:, 2:] = [[4.0, 1.0], [1.0, 9.0]], 150.0**2 * np.eye(2)
    head = f.head[0]
    assert np.array_equal(head.x, np.tile([100.0, -50.0, 0.0, 0.0], (3, 1)))
    assert np.array_equal(head.P, np.tile(want, (3, 1, 1)))
    assert head.mu.tolist() == MODELS.start.tolist()
    assert (head.t_s, f.base[0].t_s, f.t_s[0], f.ring_n[0]) == (3.0, 3.0, 3.0, 0)


def test_a_new_track_has_its_own_parameters_at_their_prior() -> None:
    f = fresh_filters(TVIMM, Plot(np.array([100.0, -50.0]), np.array([4.0, 1.0, 9.0]), 3.0))
    w = np.deg2rad(6.0)
    head = f.head[0]
    np.testing.assert_allclose(head.x[:5, 4], [0.0, 0.55 * w, -0.55 * w, 0.0, 0.0])
    np.testing.assert_allclose(head.P[[1, 2, 3, 4], 4, 4], [(0.23 * w) ** 2, (0.23 * w) ** 2, 36.0, 100.0])
    assert head.P[4, 5, 5] == head.P[4, 4, 4]
    assert not head.P[:, :4, 4:].any()
    assert head.weight.tolist() == [0.5, 0.5]
    assert not head.age_s.any()


def test_what_a_target_can_do_is_two_sigma_of_each_model() -> None:
    w = np.deg2rad(6.0)
    assert strength(MODELS) == (500.0, 0.0, 0.0)
    # Of singer and speed change the stronger acceleration; of the noise densities that of the rough model.
    np.testing.assert_allclose(strength(TVIMM), [36.0, 20.0, 1.01 * w], rtol=1e-12)


# --- the quick bound before the gate ---


def many(models: Models, rng: np.random.Generator, n: int) -> tuple[Filters, FloatArray]:
    """n tracks of different ages in a square of 20 km, and the time of the newest."""
    f = make_filters(models, n, RING)
    newest = 0.0
    for row in range(n):
        shift = rng.uniform(0, 2e4, 2)
        plots = [p._replace(z=p.z + shift) for p in random_walk(rng, int(rng.integers(1, 8)), 10 ** rng.uniform(1, 3))]
        begin_row(models, f, row, plots[0])
        for plot in plots[1:]:
            feed_row(models, f, row, plot)
        newest = max(newest, plots[-1].t_s)
    return f, np.array(newest)


@pytest.mark.parametrize("models", [MODELS, TVIMM], ids=["imm", "tvimm"])
@LAW
@given(seed=seeds, m=st.integers(1, 8), wait=st.floats(0.0, 20.0), spread_s=st.sampled_from([0.0, 0.0, 3.0]))
def test_no_track_with_a_plot_in_its_gate_is_left_out(
    models: Models, seed: int, m: int, wait: float, spread_s: float
) -> None:
    rng, r = np.random.default_rng(seed), len(models.kind)
    f, newest = many(models, rng, 12)
    rows, limit = np.arange(12), 16.0
    t = newest + wait + rng.uniform(0, 1, m) * spread_s
    times = np.full(12, t.mean())
    # Plots at the very edge: on the ellipse of some model of some track.
    ahead, _ = predicted(models, f, rows, times)
    R = packed(covariances(rng, (m,), 2, 10 ** rng.uniform(1, 5)))
    z = np.empty((m, 2))
    for j in range(m):
        i, a = int(rng.integers(12)), int(rng.integers(r))
        S = ahead.P[i, a, :2, :2] + [[R[j, 0], R[j, 1]], [R[j, 1], R[j, 2]]]
        angle = rng.uniform(0, 2 * np.pi)
        out = np.linalg.cholesky(S) @ [np.cos(angle), np.sin(angle)] * np.sqrt(limit) * 0.9999
        z[j] = ahead.x[i, a, :2] + out + (t[j] - t.mean()) * ahead.x[i, a, 2:4]
    plots = make_plots(z, R, t)
    inside, _, _ = gating.gate(ahead, times, plots, limit)
    assert len(inside) >= m
    assert set(inside.tolist()) <= set(near(models, f, plots, limit).tolist())


def near(models: Models, f: Filters, plots: Plots, limit: float = 16.0) -> IntArray:
    """Of all rows those that may have a plot in their gate."""
    return gating.near(f.mean, f.spread, f.t_s, np.arange(len(f.t_s)), plots, limit, strength(models))


@pytest.mark.parametrize("models", [MODELS, TVIMM], ids=["imm", "tvimm"])
def test_tracks_far_from_all_plots_are_left_out(models: Models) -> None:
    f, newest = many(models, np.random.default_rng(9), 12)
    assert not len(near(models, f, make_plots([[5e5, 5e5]], [100.0, 0.0, 100.0], newest + 1.0)))


def test_each_row_gets_the_time_of_the_plot_nearest_to_it() -> None:
    mean, t_s = np.array([[1000.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]), np.zeros(2)
    plots = make_plots([[900.0, 50.0], [-300.0, 0.0], [5000.0, 0.0]], [1.0, 0.0, 1.0], [1.0, 2.0, 3.0])
    assert gating.nearest_times(mean, t_s, plots).tolist() == [1.0, 2.0]
    # A row that moves is taken along to the time of each plot.
    mean[1, 2] = 2000.0
    assert gating.nearest_times(mean[1:], t_s[1:], plots).tolist() == [3.0]
