"""Heights: the scalar filter against textbooks, and late heights against heights in order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from trackmesh.services.estimation.heights import NOBODY, RING, Heights, HeightTracks, estimate, feed, make_heights
from trackmesh.services.estimation.plots import Plots, make_plots

FloatArray = npt.NDArray[np.float64]
LAW = settings(max_examples=60, deadline=None)
Q, CLIMB = 1.5, 25.0
seeds = st.integers(0, 2**32 - 1)


def told(t_s: FloatArray, height_m: FloatArray, variance_m2: FloatArray) -> Plots:
    plots = make_plots(np.zeros((len(t_s), 2)), [1.0, 0.0, 1.0], t_s)
    plots["height_m"], plots["height_variance_m2"] = height_m, variance_m2
    return plots


def any_heights(seed: int, n: int) -> Plots:
    """Of one target, in order of time, some at one time."""
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(rng.choice([0.0, 0.5, 4.0, 11.0], n))
    return told(t_s, rng.normal(5e3, 500.0, n), 10.0 ** rng.uniform(0.0, 6.0, n))


def fed(plots: Plots, k: int = RING) -> Heights:
    h = make_heights(1, k)
    taken = feed(h, np.zeros(len(plots), np.int64), np.full(len(plots), 7), plots, Q, CLIMB)
    assert taken.all()
    return h


def transition(dt: float) -> tuple[FloatArray, FloatArray]:
    F = np.array([[1.0, dt], [0.0, 1.0]])
    return F, Q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def by_filterpy(plots: Plots, t_s: float) -> tuple[FloatArray, FloatArray]:
    """Mean (2,) and covariance (2, 2) of height and climb at a time, after all plots."""
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.x = np.array([plots[0].height_m, 0.0])
    kf.P = np.diag([plots[0].height_variance_m2, CLIMB**2])
    kf.H = np.array([[1.0, 0.0]])
    last = plots[0].t_s
    for plot in plots[1:]:
        kf.F, kf.Q = transition(plot.t_s - last)
        kf.predict()
        kf.update(np.array([plot.height_m]), R=np.array([[plot.height_variance_m2]]))
        last = plot.t_s
    F, noise = transition(t_s - last)
    return F @ kf.x, F @ kf.P @ F.T + noise


def head(h: Heights) -> tuple[FloatArray, FloatArray]:
    _, height, climb, hh, hc, cc = h.head[0]
    return np.array([height, climb]), np.array([[hh, hc], [hc, cc]])


# --- the filter ---


@LAW
@given(seed=seeds, n=st.integers(1, 40), ahead_s=st.floats(0.0, 100.0))
def test_it_is_the_kalman_filter_of_the_textbook(seed: int, n: int, ahead_s: float) -> None:
    plots = any_heights(seed, n)
    h = fed(plots)
    x, P = head(h)
    want_x, want_P = by_filterpy(plots, plots[-1].t_s)
    np.testing.assert_allclose(x, want_x, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(P, want_P, rtol=1e-8, atol=1e-9)
    at = plots[-1].t_s + ahead_s
    height, variance = estimate(h, np.zeros(1, np.int64), np.array([7]), np.array([at]), Q)
    want_x, want_P = by_filterpy(plots, at)
    assert height[0] == pytest.approx(want_x[0], rel=1e-9)
    assert variance[0] == pytest.approx(want_P[0, 0], rel=1e-9)


@LAW
@given(seed=seeds, n=st.integers(2, 60), exponents=st.tuples(st.floats(-6.0, 18.0), st.floats(-6.0, 18.0)))
def test_covariances_stay_covariances(seed: int, n: int, exponents: tuple[float, float]) -> None:
    plots = any_heights(seed, n)
    plots["height_variance_m2"] = 10.0 ** np.random.default_rng(seed).uniform(min(exponents), max(exponents), n)
    x, P = head(fed(plots))
    assert np.isfinite(x).all() and np.isfinite(P).all()
    assert P[0, 0] > 0.0 and P[1, 1] > 0.0
    assert P[0, 1] ** 2 <= P[0, 0] * P[1, 1] * (1.0 + 1e-9)


# --- late heights ---


@LAW
@given(seed=seeds, n=st.integers(2, RING - 1))
def test_late_heights_give_what_order_would_have_given(seed: int, n: int) -> None:
    plots = any_heights(seed, n)
    mixed = plots[np.concatenate([[0], np.random.default_rng(seed).permutation(np.arange(1, n))])]
    assert head_of(mixed) == pytest.approx(head_of(plots), rel=1e-7, abs=1e-6)


def head_of(plots: Plots) -> list[float]:
    return [float(v) for v in fed(plots).head[0]]


@LAW
@given(seed=seeds, n=st.integers(RING + 1, 50), back=st.integers(1, RING - 2))
def test_so_do_late_ones_of_an_old_track(seed: int, n: int, back: int) -> None:
    """The last plot but ``back`` comes last of all; the ring is full then."""
    plots = any_heights(seed, n)
    order = [k for k in range(n) if k != n - 1 - back]
    assert head_of(plots[[*order, n - 1 - back]]) == pytest.approx(head_of(plots), rel=1e-7, abs=1e-6)


def test_what_is_older_than_the_ring_is_refused() -> None:
    plots = any_heights(3, 40)
    plots["t_s"] = np.arange(40.0)
    h = fed(plots)
    before = h.head.copy()
    old = told(np.array([20.0]), np.array([0.0]), np.array([1.0]))
    assert not feed(h, np.zeros(1, np.int64), np.array([7]), old, Q, CLIMB)[0]
    np.testing.assert_array_equal(h.head, before)


def test_the_past_is_answered_from_the_ring_and_nothing_changes() -> None:
    plots = told(np.arange(10.0), 1e3 + 10.0 * np.arange(10.0), np.full(10, 25.0))
    h = fed(plots)
    before = [part.copy() for part in h]
    rows, uid = np.zeros(3, np.int64), np.full(3, 7)
    height, variance = estimate(h, rows, uid, np.array([-1.0, 4.5, 9.0]), Q)
    assert np.isinf(variance[0])
    want_x, want_P = by_filterpy(plots[:5], 4.5)
    assert (height[1], variance[1]) == pytest.approx((want_x[0], want_P[0, 0]))
    assert (height[2], variance[2]) == pytest.approx((h.head[0, 1], h.head[0, 3]))
    for one, other in zip(before, h, strict=True):
        np.testing.assert_array_equal(one, other)


# --- rows ---


def tracks() -> HeightTracks:
    return HeightTracks(Q, CLIMB)


def rows(*numbers: int) -> npt.NDArray[np.int64]:
    return np.array(numbers, np.int64)


def test_a_row_of_another_track_begins_anew() -> None:
    h, plots = tracks(), any_heights(1, 3)
    h.feed(rows(5, 5), rows(1, 1), plots[:2])
    h.feed(rows(5), rows(2), plots[2:])
    height, variance = h.estimate(rows(5, 5), rows(1, 2), float(plots[2].t_s))
    assert np.isinf(variance[0])
    assert (height[1], variance[1]) == (plots[2].height_m, plots[2].height_variance_m2)


def test_plots_without_height_and_without_row_are_passed_over() -> None:
    h, plots = tracks(), any_heights(2, 3)
    plots["height_variance_m2"][1] = np.inf
    h.feed(rows(0, 1, -1), rows(10, 11, 12), plots)
    assert h.rows.uid[:2].tolist() == [10, NOBODY]
    _, variance = h.estimate(rows(0, 1, 70), rows(10, 11, 12), 1e3)
    assert np.isfinite(variance).tolist() == [True, False, False]


def test_nothing_is_kept_where_nobody_tells_heights() -> None:
    h, plots = tracks(), make_plots(np.zeros((2, 2)), [1.0, 0.0, 1.0], 0.0)
    h.feed(rows(3, 4), rows(1, 2), plots)
    assert len(h.rows.uid) == 0
    assert np.isinf(h.estimate(rows(3, 4), rows(1, 2), 0.0)[1]).all()
    assert len(h.rows.uid) == 0


def test_a_merged_track_takes_over_what_the_other_remembers() -> None:
    plots = any_heights(4, 12)
    h = tracks()
    h.feed(rows(*[0] * 6), rows(*[1] * 6), plots[[0, 2, 4, 6, 8, 10]])
    h.feed(rows(*[9] * 6), rows(*[2] * 6), plots[[1, 3, 5, 7, 9, 11]])
    first = h.rows.base[9].copy()
    h.feed_from(9, 0, 2, 1)
    # The first height of the other is in its base, and not remembered.
    assert first[0] == plots[1].t_s
    np.testing.assert_allclose(h.rows.head[0], fed(np.delete(plots, 1)).head[0], rtol=1e-8)


def test_a_merged_track_without_heights_takes_all_of_the_others() -> None:
    plots, h = any_heights(5, 4), tracks()
    h.feed(rows(*[3] * 4), rows(*[2] * 4), plots)
    h.feed_from(3, 8, 2, 1)
    np.testing.assert_array_equal(h.estimate(rows(8), rows(1), 1e3), h.estimate(rows(3), rows(2), 1e3))
    # Neither a row that was never used nor one of another track has anything to give.
    h.feed_from(50, 8, 2, 1)
    h.feed_from(3, 8, 77, 1)
    np.testing.assert_array_equal(h.estimate(rows(8), rows(1), 1e3), h.estimate(rows(3), rows(2), 1e3))
