from __future__ import annotations

import importlib.util
from itertools import permutations
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from trackmesh.sim.metrics import (
    Pairs,
    continuity,
    gospa,
    identity_switches,
    lasting,
    match,
    nearest_distance,
    nees,
    ospa,
    purity,
    rmse,
    tracked_once,
)

C_M = 100.0
points = st.integers(0, 5).flatmap(lambda n: arrays(np.float64, (n, 2), elements=st.integers(-120, 120).map(float)))


@pytest.fixture
def score(peers: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("peers_score", peers / "score.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def brute_force(x: np.ndarray, y: np.ndarray, c: float, p: float) -> tuple[float, float]:
    """GOSPA and OSPA by their definitions: the least over all ways to pair."""
    if len(x) > len(y):
        return brute_force(y, x, c, p)
    n, m = len(x), len(y)
    if m == 0:
        return 0.0, 0.0
    costs = [
        sum(min(float(np.hypot(*(x[i] - y[j]))), c) ** p for i, j in enumerate(chosen))
        for chosen in permutations(range(m), n)
    ]
    # A pair at the cut-off costs c^p, as much as one missed and one false.
    total = (min(costs) + (m - n) * c**p / 2) ** (1 / p)
    return total, ((min(costs) + (m - n) * c**p) / m) ** (1 / p)


@settings(max_examples=150, deadline=None)
@given(points, points, st.sampled_from([1.0, 2.0]))
def test_gospa_and_ospa_are_the_least_over_all_pairings(x: np.ndarray, y: np.ndarray, p: float) -> None:
    expected = brute_force(x, y, C_M, p)
    got = gospa(x, y, C_M, p)
    assert (got.total_m, ospa(x, y, C_M, p)) == pytest.approx(expected, abs=1e-7)
    assert got.total_m**p == pytest.approx(got.localisation + (got.missed + got.false) * C_M**p / 2, abs=1e-6)
    assert len(x) - got.missed == len(y) - got.false


@settings(max_examples=80, deadline=None)
@given(points, points, points)
def test_both_are_metrics(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
    def gospa_m(a: np.ndarray, b: np.ndarray) -> float:
        return gospa(a, b, C_M).total_m

    def ospa_m(a: np.ndarray, b: np.ndarray) -> float:
        return ospa(a, b, C_M)

    for metric in (gospa_m, ospa_m):
        assert metric(x, x) == 0.0
        assert metric(x, y) == pytest.approx(metric(y, x))
        assert metric(x, z) <= metric(x, y) + metric(y, z) + 1e-9


@pytest.mark.parametrize("spread_m", [2e3, 5e4])
def test_the_same_numbers_as_the_peers_were_measured_with(score: ModuleType, spread_m: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(60):
        x = rng.uniform(0, spread_m, (rng.integers(0, 40), 2))
        y = np.concatenate([x[rng.random(len(x)) < 0.8], rng.uniform(0, spread_m, (rng.integers(0, 9), 2))])
        y = rng.permutation(y + rng.normal(0, 150.0, y.shape))
        assert tuple(gospa(x, y)) == pytest.approx(score.gospa(x, y), rel=1e-12)
        assert ospa(x, y) == pytest.approx(score.ospa(x, y), rel=1e-12)


def test_a_crowd_of_links_is_matched_as_a_whole() -> None:
    # The nearest pairs first would leave the outer two unmatched.
    x = np.array([[0.0, 0.0], [60.0, 0.0]])
    y = np.array([[50.0, 0.0], [125.0, 0.0]])
    best = match(x, y, C_M)
    assert best.target.tolist() == [0, 1]
    assert best.track.tolist() == [0, 1]
    assert best.distance_m == pytest.approx([50.0, 65.0])


def test_a_pair_at_the_cut_off_is_no_pair() -> None:
    parts = gospa(np.array([[0.0, 0.0]]), np.array([[C_M, 0.0]]), C_M)
    assert parts == pytest.approx((C_M, 0.0, 1, 1))


@settings(deadline=None)
@given(arrays(np.float64, (4, 2), elements=st.floats(-50, 50)), st.integers(0, 99))
def test_nees_is_the_quadratic_form(errors: np.ndarray, seed: int) -> None:
    root = np.random.default_rng(seed).normal(size=(4, 2, 2)) + 3 * np.eye(2)
    covariances = root @ np.swapaxes(root, 1, 2)
    expected = [e @ np.linalg.solve(p, e) for e, p in zip(errors, covariances, strict=True)]
    np.testing.assert_allclose(nees(errors, covariances), expected, rtol=1e-9, atol=1e-12)


def test_nees_of_a_singular_covariance_is_infinite() -> None:
    singular = np.array([[[1.0, 0.0], [0.0, 0.0]]] * 2)
    assert nees(np.array([[2.0, 0.0], [0.0, 1.0]]), singular).tolist() == [4.0, np.inf]


def test_rmse() -> None:
    assert rmse(np.array([3.0, 4.0])) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(rmse(np.zeros(0)))


def pairs(*rows: tuple[int, int, int]) -> Pairs:
    frame, target, track = np.array(rows, np.int64).reshape(-1, 3).T
    return Pairs(frame, target, track, np.zeros(len(rows)))


def test_identity_switches_are_counted_over_gaps_and_per_target() -> None:
    followed = pairs((0, 1, 7), (1, 1, 7), (3, 1, 8), (4, 1, 7), (0, 2, 9), (4, 2, 9))
    assert identity_switches(followed) == 2
    assert identity_switches(followed, np.array([1, 1, 1, 0, 1], bool)) == 1
    assert identity_switches(pairs()) == 0


def test_what_does_not_last_is_left_out() -> None:
    flipped = pairs((0, 1, 7), (1, 1, 7), (2, 1, 8), (3, 1, 7), (4, 1, 7), (5, 1, 9), (6, 1, 9), (0, 2, 9), (1, 2, 9))
    assert identity_switches(flipped) == 3
    kept = lasting(flipped, 2)
    assert sorted(kept.frame.tolist()) == [0, 0, 1, 1, 3, 4, 5, 6]
    assert identity_switches(kept) == 1
    assert len(lasting(pairs(), 2).frame) == 0


def test_purity_and_continuity() -> None:
    # Track 7 follows target 1 three times and 2 once; target 1 is followed by 8 once.
    followed = pairs((0, 1, 7), (1, 1, 7), (2, 1, 7), (3, 2, 7), (3, 1, 8))
    assert purity(followed) == pytest.approx(4 / 5)
    assert continuity(followed) == pytest.approx(4 / 5)
    assert purity(pairs((0, 1, 7), (1, 1, 8))) == 1.0
    assert continuity(pairs((0, 1, 7), (1, 1, 8))) == 0.5
    assert np.isnan(purity(pairs()))


def test_a_target_is_tracked_once_where_one_track_is_its_own() -> None:
    targets = np.array([[0.0, 0.0], [50.0, 0.0], [1e4, 0.0], [2e4, 0.0]])
    tracks = np.array([[10.0, 0.0], [45.0, 0.0], [1e4, 20.0], [1e4, -20.0], [2e4, 101.0]])
    assert tracked_once(targets, tracks, C_M).tolist() == [True, True, False, False]
    assert tracked_once(targets, np.zeros((0, 2)), C_M).tolist() == [False] * 4
    assert nearest_distance(targets, tracks) == pytest.approx([10.0, 5.0, 20.0, 101.0])
    assert np.isinf(nearest_distance(targets, np.zeros((0, 2)))).all()
