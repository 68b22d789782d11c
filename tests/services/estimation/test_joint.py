from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    LAW,
    MODELS,
    TVIMM,
    FloatArray,
    IntArray,
    covariance,
    covariances,
    packed,
    seeds,
    unpacked,
)

from trackmesh.services.estimation import tracks
from trackmesh.services.estimation.bank import Models
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.estimation.joint import MOST_EVENTS, MOST_PLOTS, MOST_TRACKS, Odds, marginals, write_mean
from trackmesh.services.estimation.plots import Plots, make_plots

MISSED = float(np.log(0.1))

Table = tuple[FloatArray, float]


# --- marginals, against the sum over all events ---


def table(rng: np.random.Generator, n: int, m: int, share: float = 0.7) -> Table:
    """Random scores, some pairs outside the gate, and ln(1 - Pd)."""
    score = rng.normal(0.0, 3.0, (n, m))
    score[rng.random((n, m)) > share] = -np.inf
    return score, float(np.log(rng.uniform(0.01, 0.9)))


def all_events(given_table: Table, permute: bool) -> FloatArray:
    """The marginals by their definition: every choice of a plot or none for every track, those with a plot twice left
    out, and of those with the same tracks and the same plots the best alone, unless ``permute``."""
    score, missed = given_table
    n, m = score.shape
    events: dict[tuple[int, ...], float] = {}
    for choice in itertools.product(range(m + 1), repeat=n):
        used = [c for c in choice if c]
        if len(set(used)) == len(used):
            log_weight = sum(score[i, c - 1] if c else missed for i, c in enumerate(choice))
            events[choice] = float(np.exp(log_weight))
    best: dict[tuple[frozenset[int], frozenset[int]], float] = {}
    for choice, weight in events.items():
        best[parts(choice)] = max(best.get(parts(choice), 0.0), weight)
    beta = np.zeros((n, m + 1))
    for choice, weight in events.items():
        if permute or weight >= best[parts(choice)] * (1 - 1e-9):
            beta[range(n), choice] += weight
    return np.asarray(beta / beta[0].sum())


def parts(choice: tuple[int, ...]) -> tuple[frozenset[int], frozenset[int]]:
    """Which tracks have a plot, and which plots are of a track."""
    return frozenset(i for i, c in enumerate(choice) if c), frozenset(c for c in choice if c)


@LAW
@given(seeds, st.integers(1, 4), st.integers(1, 5), st.booleans())
def test_marginals_are_those_of_all_events(seed: int, n: int, m: int, permute: bool) -> None:
    given_table = table(np.random.default_rng(seed), n, m)
    got = marginals(*given_table, MOST_EVENTS, permute)
    np.testing.assert_allclose(got, all_events(given_table, permute), atol=1e-12)


@LAW
@given(seeds, st.integers(1, 5), st.integers(1, 6), st.booleans())
def test_rows_sum_to_one_and_a_plot_is_given_once(seed: int, n: int, m: int, permute: bool) -> None:
    score, missed = table(np.random.default_rng(seed), n, m)
    beta = marginals(score, missed, MOST_EVENTS, permute)
    np.testing.assert_allclose(beta.sum(axis=1), 1.0)
    assert beta[:, 1:].sum(axis=0).max() <= 1 + 1e-12
    assert np.all(beta[:, 1:][np.isinf(score)] == 0.0)


@LAW
@given(seeds, st.integers(1, 4), st.integers(1, 5), st.booleans())
def test_the_order_of_tracks_and_plots_does_not_matter(seed: int, n: int, m: int, permute: bool) -> None:
    rng = np.random.default_rng(seed)
    score, missed = table(rng, n, m)
    a, b = rng.permutation(n), rng.permutation(m)
    got = marginals(score[a][:, b], missed, MOST_EVENTS, permute)
    want = marginals(score, missed, MOST_EVENTS, permute)
    np.testing.assert_allclose(got, want[a][:, np.concatenate(([0], b + 1))], atol=1e-12)


@pytest.mark.parametrize("permute", [False, True])
def test_two_symmetric_tracks_get_the_only_plot_by_half(permute: bool) -> None:
    beta = marginals(np.array([[12.0], [12.0]]), MISSED, MOST_EVENTS, permute)
    np.testing.assert_allclose(beta, [[0.5, 0.5], [0.5, 0.5]], atol=1e-5)


def test_two_tracks_with_a_plot_each_are_drawn_together_only_where_all_permutations_count() -> None:
    score = np.array([[12.0, 11.0], [11.0, 12.0]])
    kept, drawn = (marginals(score, MISSED, MOST_EVENTS, permute) for permute in (False, True))
    np.testing.assert_allclose(kept[:, 1:], np.eye(2), atol=1e-4)
    # The other permutation weighs exp(-2) of the first.
    assert drawn[0, 2] == pytest.approx(1.0 / (1.0 + np.e**2), abs=1e-4)


def test_a_plot_that_hardly_fits_has_no_say() -> None:
    near = marginals(np.array([[10.0], [9.0]]), MISSED, MOST_EVENTS, False)
    both = marginals(np.array([[10.0, -30.0], [9.0, -30.0]]), MISSED, MOST_EVENTS, False)
    np.testing.assert_allclose(both[:, :2], near, atol=1e-12)
    assert both[:, 2].max() < 1e-12


def test_scores_far_apart_neither_overflow_nor_vanish() -> None:
    for shift in (-900.0, 900.0):
        beta = marginals(np.array([[shift, shift], [shift, -np.inf]]), MISSED, MOST_EVENTS, False)
        assert np.isfinite(beta).all()
        np.testing.assert_allclose(beta.sum(axis=1), 1.0)


def test_no_more_events_than_allowed() -> None:
    """Two tracks and two plots: 1 + 4 + 2 events."""
    assert len(marginals(np.ones((2, 2)), MISSED, 7, False)) == 2
    assert marginals(np.ones((2, 2)), MISSED, 6, False).shape == (0, 3)


# --- the plot that stands for several ---


@LAW
@given(seeds, st.integers(1, 4))
def test_the_gain_is_that_of_probabilistic_data_association(seed: int, m: int) -> None:
    """One model, plots in one place: x + (1 - beta_0) K nu, and a covariance between those of a hit and of a miss."""
    rng = np.random.default_rng(seed)
    x, P = rng.normal(0.0, 100.0, 4), covariance(rng, 4, 1e4)
    R, beta_0 = covariance(rng, 2, 2e3), rng.uniform(0.0, 0.95)
    beta = np.concatenate(([beta_0], np.full(m, (1.0 - beta_0) / m)))
    # Where it was expected, so that the spread that a miss would add is none.
    near = make_plots(np.tile(x[:2], (m, 1)), packed(R), 5.0)
    out = near[:1].copy()
    write_mean(beta, near, x[None], P[None], np.ones(1), 0.0, out, 0)
    S = P[:2, :2] + R
    np.testing.assert_allclose(P[:2, :2] + unpacked(out["R"][0]), S / (1.0 - beta_0), rtol=1e-9)


@LAW
@given(seeds, st.integers(2, 5))
def test_the_mean_has_the_moments_of_its_plots(seed: int, m: int) -> None:
    """With no doubt that it was seen: mean, and covariance with the spread between plots, of the mixture."""
    rng = np.random.default_rng(seed)
    z, R = rng.normal(0.0, 200.0, (m, 2)), covariances(rng, (m,), 2, 900.0)
    w = rng.dirichlet(np.ones(m))
    near = make_plots(z, packed(R), 3.0)
    out = near[:1].copy()
    write_mean(np.concatenate(([0.0], w)), near, np.zeros((1, 4)), np.zeros((1, 4, 4)), np.ones(1), 0.0, out, 0)
    mean = w @ z
    spread = np.einsum("k,kij->ij", w, R + np.einsum("ki,kj->kij", z - mean, z - mean))
    np.testing.assert_allclose(out["z"][0], mean, atol=1e-9)
    np.testing.assert_allclose(unpacked(out["R"][0]), spread, rtol=1e-9, atol=1e-6)


def test_plots_are_moved_to_the_time_of_the_one_that_stands_there() -> None:
    near = make_plots([(0.0, 0.0), (50.0, -20.0)], [100.0, 0.0, 100.0], [2.0, 2.5])
    out = near[:1].copy()
    x = np.array([[0.0, 0.0, 100.0, -40.0]])
    write_mean(np.array([0.0, 0.3, 0.7]), near, x, np.zeros((1, 4, 4)), np.ones(1), 0.0, out, 0)
    np.testing.assert_allclose(out["z"][0], 0.0, atol=1e-12)
    np.testing.assert_allclose(out["R"][0], [100.0, 0.0, 100.0], atol=1e-9)
    assert out["t_s"][0] == 2.0


def test_a_range_rate_only_where_one_plot_has_nearly_all_the_weight() -> None:
    near = make_plots([(0.0, 0.0), (0.0, 0.0)], [100.0, 0.0, 100.0], 0.0)
    near["range_rate_mps"], near["range_rate_variance"] = [10.0, 20.0], 4.0
    near["site"] = [(1.0, 2.0), (3.0, 4.0)]
    out = near[:1].copy()
    for second, variance in ((0.4, np.inf), (0.776, 5.0)):
        beta = np.array([0.2, 0.8 - second, second])
        write_mean(beta, near, np.zeros((1, 4)), np.zeros((1, 4, 4)), np.ones(1), 0.0, out, 0)
        assert out["range_rate_variance"][0] == pytest.approx(variance)
    assert out["range_rate_mps"][0] == 20.0
    assert out["site"][0].tolist() == [3.0, 4.0]


# --- tracks ---

DENSITY = 1e-8


def odds(plots: Plots, density: float = DENSITY, p_detect: float = 0.9) -> Odds:
    return Odds(np.full(len(plots), np.log(p_detect / (2 * np.pi * density))), float(np.log(1 - p_detect)))


def at(t_s: float, *place: tuple[float, float], sigma_m: float = 50.0) -> Plots:
    return make_plots(np.array(place), [sigma_m**2, 0.0, sigma_m**2], t_s)


def bank(*place: tuple[float, float], joint: bool = True, models: Models = MODELS, ring: int = 8) -> ImmTracks:
    """Tracks that stood still at these places for four looks."""
    out = ImmTracks(models, len(place) + 1, ring, 50.0, joint)
    rows = np.arange(len(place))
    out.begin(rows, at(0.0, *place))
    for t in (4.0, 8.0, 12.0):
        out.feed(rows, at(t, *place))
    return out


def associate(tracks: ImmTracks, plots: Plots, given_odds: Odds | None = None, first: int = 99) -> IntArray:
    """Rows of the plots; ``first`` rows are confirmed."""
    n = len(tracks.t_s) - 1
    row, _, fed = tracks.associate(
        np.arange(n), np.arange(n + 1) < first, plots, 16.0, odds(plots) if given_odds is None else given_odds
    )
    assert fed[row >= 0].all()
    return np.asarray(row)


def last(tracks: ImmTracks, row: int) -> Plots:
    return tracks.remembered(row)[-1:]


def test_a_track_alone_with_its_plot_takes_it_as_it_is() -> None:
    joint, nearest = bank((0, 0), (9e3, 0)), bank((0, 0), (9e3, 0), joint=False)
    plots = at(16.0, (40, 10), (9.05e3, 0))
    assert associate(joint, plots).tolist() == associate(nearest, plots).tolist() == [0, 1]
    assert joint.filters.head.tobytes() == nearest.filters.head.tobytes()
    assert joint.figures() == {"joint_clusters": 0, "joint_too_large": 0}
    assert nearest.figures() == {}


def test_a_plot_in_little_clutter_is_nearly_the_plot_itself() -> None:
    """A second plot at the rim of the gate makes a cluster, and hardly counts."""
    joint, nearest = bank((0, 0)), bank((0, 0), joint=False)
    plots = at(16.0, (40, 10), (330, 0))
    assert associate(joint, plots).tolist() == associate(nearest, plots).tolist() == [0, -1]
    assert joint.figures()["joint_clusters"] == 1
    moved = last(joint, 0)["z"][0] - [40, 10]
    assert 0 < np.abs(moved).max() < 2.0
    np.testing.assert_allclose(joint.mean[0], nearest.mean[0], atol=2.0)


def test_two_tracks_share_the_only_plot() -> None:
    """It stands between them: the one that takes it believes it by half, and the other has none, as one to one."""
    joint = bank((-150, 0), (150, 0))
    row = associate(joint, at(16.0, (0, 0)))
    assert row[0] in (0, 1)
    plot = last(joint, row[0])
    assert plot["z"][0].tolist() == [0.0, 0.0]
    assert plot["R"][0][0] > 2 * 2500.0
    assert len(joint.remembered(1 - row[0])) == 3


def test_two_tracks_with_a_plot_each_take_their_own() -> None:
    joint = bank((-150, 0), (150, 0))
    assert associate(joint, at(16.0, (170, 0), (-130, 0))).tolist() == [1, 0]
    for row, east_m in ((0, -130.0), (1, 170.0)):
        np.testing.assert_allclose(last(joint, row)["z"][0], [east_m, 0.0], atol=1.0)


def test_two_plots_of_one_track_are_averaged() -> None:
    joint = bank((0, 0))
    assert sorted(associate(joint, at(16.0, (60, 0), (-60, 0))).tolist()) == [-1, 0]
    plot = last(joint, 0)
    assert abs(plot["z"][0]).max() < 1e-6
    assert plot["R"][0][0] == pytest.approx(2500 + 3600, rel=0.01)
    assert plot["R"][0][2] == pytest.approx(2500, rel=0.01)


def test_only_confirmed_tracks_are_associated_jointly() -> None:
    joint, nearest = bank((-100, 0), (100, 0)), bank((-100, 0), (100, 0), joint=False)
    plots = at(16.0, (-20, 0), (30, 0))
    associate(joint, plots, first=0)
    associate(nearest, plots, first=0)
    assert joint.filters.head.tobytes() == nearest.filters.head.tobytes()


def test_dense_clutter_makes_a_track_doubt_its_plots() -> None:
    little, much = (bank((0, 0)) for _ in range(2))
    plots = at(16.0, (60, 0), (-60, 0))
    associate(little, plots, odds(plots, 1e-9))
    associate(much, plots, odds(plots, 3e-4))
    assert last(much, 0)["R"][0][2] > 1.5 * last(little, 0)["R"][0][2]


@pytest.mark.parametrize("what", ["tracks", "plots", "events"])
def test_a_cluster_that_is_too_large_stays_one_to_one(what: str) -> None:
    tracks_n = MOST_TRACKS + 1 if what == "tracks" else MOST_TRACKS if what == "events" else 2
    plots_n = MOST_PLOTS + 1 if what == "plots" else MOST_PLOTS if what == "events" else 3
    places = [(10.0 * k, 0.0) for k in range(tracks_n)]
    joint, nearest = bank(*places), bank(*places, joint=False)
    plots = at(16.0, *((8.0 * k, 30.0) for k in range(plots_n)))
    assert associate(joint, plots).tolist() == associate(nearest, plots).tolist()
    assert joint.filters.head.tobytes() == nearest.filters.head.tobytes()
    assert joint.figures() == {"joint_clusters": 0, "joint_too_large": 1}


@pytest.mark.parametrize("models", [MODELS, TVIMM], ids=["imm", "tvimm"])
def test_late_plots_replay_exactly(models: Models) -> None:
    """After late looks at two close tracks, each is what its remembered plots give in order, bit for bit."""
    rng = np.random.default_rng(4)
    joint = bank((-120, 0), (120, 0), models=models, ring=32)
    base = joint.filters.base.copy()
    for t in (16.0, 24.0, 20.0, 28.0, 36.0, 32.0, 26.0):
        associate(joint, at(t, *rng.normal([(-120, 0), (120, 0)], 60.0).tolist()))
    assert joint.figures()["joint_clusters"] == 7
    for row in (0, 1):
        plots = joint.remembered(row)
        assert len(plots) == 10 and np.all(np.diff(plots["t_s"]) > 0)
        assert np.any(plots["R"][3:, 0] != 2500.0)
        again = tracks.make_filters(models, 1, 32)
        again.head[0] = again.base[0] = base[row]
        tracks.feed(again, np.zeros(len(plots), np.int64), plots)
        assert again.head[0].tobytes() == joint.filters.head[row].tobytes()


def test_the_rows_are_those_of_the_one_to_one_assignment() -> None:
    rng = np.random.default_rng(7)
    places = [(float(e), 0.0) for e in (-200, 0, 200)]
    for _ in range(10):
        plots = at(16.0, *rng.normal(places, 80.0).tolist(), *rng.uniform(-400, 400, (2, 2)).tolist())
        joint, nearest = bank(*places), bank(*places, joint=False)
        assert associate(joint, plots).tolist() == associate(nearest, plots).tolist()
