"""Laws of what is measured over time: assignments, segments, SIAP, bands."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import chi2

from trackmesh.sim.metrics import (
    Cover,
    Followers,
    Pairs,
    covered_s,
    fewest_changes,
    gospa,
    gospa_with_switching,
    identity_switches,
    match,
    mean,
    nearest_target,
    nees_band,
    ospa,
    segments,
    siap,
    siap_count,
)

C_M = 100.0
points = st.integers(0, 6).flatmap(lambda n: arrays(np.float64, (n, 2), elements=st.floats(-120, 120)))
seeds = st.integers(0, 2**32 - 1)


def ids(*values: int) -> np.ndarray:
    return np.array(values, np.int64)


# --- GOSPA and OSPA


@settings(max_examples=100, deadline=None)
@given(points, points, seeds)
def test_order_and_place_do_not_matter(x: np.ndarray, y: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-1e3, 1e3, 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def moved(points: np.ndarray) -> np.ndarray:
        return np.asarray(rng.permutation(points) @ turn.T + shift)

    a, b = moved(x), moved(y)
    assert gospa(a, b, C_M).total_m == pytest.approx(gospa(x, y, C_M).total_m, abs=1e-5)
    assert ospa(a, b, C_M) == pytest.approx(ospa(x, y, C_M), abs=1e-5)


@settings(max_examples=100, deadline=None)
@given(points, points)
def test_a_false_track_far_away_costs_half_the_cut_off(x: np.ndarray, y: np.ndarray) -> None:
    before, after = gospa(x, y, C_M), gospa(x, np.concatenate([y, [[1e4, 1e4]]]), C_M)
    assert after.total_m**2 == pytest.approx(before.total_m**2 + C_M**2 / 2)
    assert after.false == before.false + 1 and after.missed == before.missed


@settings(max_examples=100, deadline=None)
@given(points, points)
def test_ospa_is_bounded_and_gospa_grows_with_the_cut_off(x: np.ndarray, y: np.ndarray) -> None:
    assert 0.0 <= ospa(x, y, C_M) <= C_M
    assert gospa(x, y, C_M).total_m <= gospa(x, y, 1.5 * C_M).total_m + 1e-9


# --- assignments from one moment to the next


def test_changes_of_assignment() -> None:
    followers = Followers()
    moments = [
        (ids(1, 2), ids(1), ids(7), 0.0, 0),  # found for the first time
        (ids(1, 2), ids(1), ids(7), 0.0, 0),
        (ids(1, 2), ids(1, 2), ids(8, 7), 1.0, 1),  # the first changes, the second is found for the first time
        (ids(1, 2), ids(2), ids(7), 0.5, 0),  # the first is lost
        (ids(1), ids(), ids(), 0.0, 0),  # the second is gone, which is no change
        (ids(1, 2), ids(1, 2), ids(8, 9), 1.5, 1),  # the first is found again, the second has another track
        (ids(1, 2), ids(1, 2), ids(9, 8), 2.0, 2),  # swapped
    ]
    for present, target, track, assignments, identities in moments:
        assert followers.step(present, target, track) == (assignments, identities)


moments = st.lists(st.dictionaries(st.integers(0, 3), st.integers(0, 3), max_size=4), min_size=1, max_size=12)


@settings(max_examples=150, deadline=None)
@given(moments)
def test_identities_step_by_step_are_those_of_the_whole(run: list[dict[int, int]]) -> None:
    followers, present = Followers(), ids(0, 1, 2, 3)
    steps = [followers.step(present, ids(*one), ids(*one.values())) for one in run]
    every = [(k, target, track) for k, one in enumerate(run) for target, track in one.items()]
    frame, target, track = np.array(every, np.int64).reshape(-1, 3).T
    assert sum(step.identities for step in steps) == identity_switches(
        Pairs(frame, target, track, np.zeros(len(frame)))
    )
    assert all(step.assignments >= 0.5 * step.identities for step in steps)


@settings(max_examples=60, deadline=None)
@given(points, points, st.floats(0, 10), st.floats(0, 500))
def test_switching_only_adds(x: np.ndarray, y: np.ndarray, switches: float, penalty_m: float) -> None:
    moment = gospa(x, y, C_M)
    total = gospa_with_switching(moment, switches, penalty_m)
    assert total >= moment.total_m * (1.0 - 1e-12)
    assert total**2 == pytest.approx(moment.total_m**2 + switches * penalty_m**2, abs=1e-6)
    assert gospa_with_switching(moment, 0.0, penalty_m) == pytest.approx(moment.total_m)


# --- segments

covers = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 2), st.integers(0, 3)), max_size=40, unique=True)


def cover(rows: list[tuple[int, int, int]]) -> Cover:
    frame, target, track = np.array(rows, np.int64).reshape(-1, 3).T
    return Cover(frame, target, track)


@settings(max_examples=150, deadline=None)
@given(covers)
def test_segments_are_the_cover_without_gaps(rows: list[tuple[int, int, int]]) -> None:
    found = segments(cover(rows))
    spread = [
        (frame, target, track)
        for target, track, first, last in zip(*(c.tolist() for c in found), strict=True)
        for frame in range(first, last + 1)
    ]
    assert sorted(spread) == sorted(rows) and len(spread) == len(rows)
    ends = {(target, track, last + 1) for target, track, _, last in zip(*(c.tolist() for c in found), strict=True)}
    begins = {(target, track, first) for target, track, first, _ in zip(*(c.tolist() for c in found), strict=True)}
    assert not ends & begins, "unbroken ones are one"


@settings(max_examples=150, deadline=None)
@given(st.lists(st.sets(st.integers(0, 3), max_size=3), max_size=7))
def test_no_way_to_follow_changes_less_often(tracks: list[set[int]]) -> None:
    choices = [sorted(some) for some in tracks if some]
    least = min(sum(a != b for a, b in pairwise(way)) for way in product(*choices)) if choices else 0
    assert fewest_changes(cover([(k, 0, t) for k, some in enumerate(tracks) for t in some])) == least


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 12)), max_size=8))
def test_the_union_of_intervals(spans: list[tuple[int, int]]) -> None:
    first = np.array([a for a, _ in spans], float)
    last = first + np.array([n for _, n in spans], float)
    covered = {s for a, n in spans for s in range(a, a + n)}
    assert covered_s(first, last) == len(covered)


# --- SIAP


@settings(max_examples=100, deadline=None)
@given(seeds)
def test_siap_keeps_its_bounds(seed: int) -> None:
    rng, counts, with_whom, there = np.random.default_rng(seed), [], [], []
    for k in range(6):
        targets, tracks = (
            rng.uniform(-150, 150, (rng.integers(0, 4), 2)),
            rng.uniform(-150, 150, (rng.integers(0, 5), 2)),
        )
        near, away = nearest_target(targets, tracks, 80.0)
        assert all(
            (away[j] == np.linalg.norm(targets - tracks[j], axis=1).min()) if near[j] >= 0 else
            not (np.linalg.norm(targets - tracks[j], axis=1) < 80.0).any()
            for j in range(len(tracks))
        )  # fmt: skip
        counts.append(siap_count(near, away, np.where(near >= 0, 1.0, 0.0), len(targets)))
        with_whom += [(k, int(t), j) for j, t in enumerate(near) if t >= 0]
        there += [(k, t, t) for t in range(len(targets))]
    got = siap(counts, cover(with_whom), np.arange(6.0), cover(there))
    for share in (got.completeness, got.spuriousness, got.longest_segment):
        assert np.isnan(share) or 0.0 <= share <= 1.0
    assert np.isnan(got.ambiguity) or got.ambiguity >= 1.0
    assert np.isnan(got.position_m) or 0.0 <= got.position_m < 80.0
    assert np.isnan(got.velocity_mps) or got.velocity_mps == pytest.approx(1.0)
    assert got.number_changes >= 0


def test_one_target_that_is_handed_over() -> None:
    # Followed by 7 from 1 to 4 s, by nobody at 5 s, by 7 and 8 at 6 s, by 8 until 9 s of its ten.
    rows = [(k, 0, 7) for k in (1, 2, 3, 4, 6)] + [(k, 0, 8) for k in (6, 7, 8, 9)]
    counts = [siap_count(ids(*[0] * n), np.full(n, 2.0), np.full(n, 3.0), 1) for n in (0, 1, 1, 1, 1, 0, 2, 1, 1, 1, 0)]
    got = siap(counts, cover(rows), np.arange(11.0), cover([(k, 0, 0) for k in range(11)]))
    assert got.completeness == pytest.approx(8 / 11)
    assert got.ambiguity == pytest.approx(9 / 8)
    assert (got.spuriousness, got.position_m, got.velocity_mps) == pytest.approx((0.0, 2.0, 3.0))
    assert got.number_changes == 1
    assert got.changes_per_h == pytest.approx(3600.0 / 6.0)
    assert got.longest_segment == pytest.approx(3.0 / 10.0)


# --- NEES


@pytest.mark.parametrize(("samples", "degrees"), [(1, 2), (50, 2), (7, 4)])
def test_the_band_of_a_mean_nees(samples: int, degrees: int) -> None:
    low, high = nees_band(samples, degrees)
    whole = chi2(samples * degrees)
    assert (low, high) == pytest.approx((whole.ppf(0.025) / samples, whole.ppf(0.975) / samples))
    means = np.random.default_rng(samples).chisquare(degrees, (4000, samples)).mean(axis=1)
    assert ((low < means) & (means < high)).mean() == pytest.approx(0.95, abs=0.012)


def test_no_errors_have_no_band_and_no_mean() -> None:
    low, high = nees_band([0, 3], 2, 0.9)
    assert np.isnan([low[0], high[0]]).all() and 0 < low[1] < 2 < high[1]
    assert np.isnan(mean([]))


# --- the pairing itself


@settings(max_examples=60, deadline=None)
@given(points, points)
def test_pairs_are_one_to_one_and_within_the_cut_off(x: np.ndarray, y: np.ndarray) -> None:
    best = match(x, y, C_M)
    assert len(set(best.target.tolist())) == len(best.target) == len(set(best.track.tolist()))
    assert (best.distance_m < C_M).all()
    assert np.linalg.norm(x[best.target] - y[best.track], axis=1) == pytest.approx(best.distance_m)
