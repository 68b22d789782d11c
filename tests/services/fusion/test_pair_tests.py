from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, seeds
from tests.services.fusion.makers import FloatArray

from trackmesh.services.estimation.pairs import PairRules
from trackmesh.services.fusion.association import DeclaredPairs, LocalTracks, SequentialTest
from trackmesh.services.fusion.pair_tests import NearestTest, PairTest, SumTest, TestName, make_test

SIGMA = np.array([100.0, 100.0, 10.0, 10.0])
EAST = np.array([1.0, 0.0, 0.0, 0.0])
ALPHA = 0.001
NAMES: tuple[TestName, ...] = ("seqllr", "paper-sequential", "gnn")

every_test = pytest.mark.parametrize("name", NAMES)


def new_test(name: TestName) -> PairTest:
    return make_test(name, PairRules(), ALPHA)


def tracks(x: FloatArray, first: int = 0, scale: float = 1.0) -> LocalTracks:
    n = len(x)
    P = np.tile(np.diag((scale * SIGMA) ** 2), (n, 1, 1))
    return LocalTracks(
        first + np.arange(n), np.arange(n), np.asarray(x, float), P, np.zeros((n, 2)), np.zeros((n, 2, 2))
    )


def sky(rng: np.random.Generator, n: int, span_m: float = 1e5) -> FloatArray:
    return np.concatenate([rng.uniform(0, span_m, (n, 2)), rng.normal(0, 150, (n, 2))], axis=1)


def pairs_of(found: DeclaredPairs) -> dict[int, int]:
    return dict(zip(found.a.tolist(), found.b.tolist(), strict=True))


def noise(rng: np.random.Generator, n: int) -> FloatArray:
    return np.asarray(SIGMA * rng.standard_normal((n, 4)))


def test_each_name_is_another_test() -> None:
    assert [type(new_test(name)) for name in NAMES] == [SequentialTest, SumTest, NearestTest]


@every_test
def test_tracks_of_one_target_are_found_and_no_others(name: TestName) -> None:
    rng = np.random.default_rng(1)
    x, test = sky(rng, 60), new_test(name)
    for t_s in np.arange(0.0, 20.0, 2.0).tolist():
        found = test.cycle(tracks(x + noise(rng, 60)), tracks(x + noise(rng, 60), 1000), t_s)
    wrong = {a: b for a, b in pairs_of(found).items() if a != b}
    assert not wrong
    assert len(found.a) >= 59


@every_test
def test_pairs_are_one_to_one_and_of_the_present_order(name: TestName) -> None:
    rng, x, test = np.random.default_rng(2), np.zeros((3, 4)), new_test(name)
    for t_s in (0.0, 2.0, 4.0, 6.0):
        p = rng.permutation(12)
        wide = sky(np.random.default_rng(7), 12)
        a, b = tracks(wide), tracks(wide[p])
        b = b._replace(number=1000 + p)
        assert {i: int(p[j]) for i, j in pairs_of(test.cycle(a, b, t_s)).items()} == {k: k for k in range(12)}
    crowd = new_test(name)
    for t_s in (0.0, 2.0, 4.0):
        found = crowd.cycle(tracks(x[:1]), tracks(x + 30.0 * np.arange(3)[:, None] * EAST, 10), t_s)
    assert pairs_of(found) == {0: 0}


@every_test
@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 2), (2, 0)])
def test_a_sensor_without_tracks(name: TestName, n: int, m: int) -> None:
    test, x = new_test(name), sky(np.random.default_rng(8), 2)
    test.cycle(tracks(x), tracks(x, 10), 0.0)
    found = test.cycle(tracks(x[:n]), tracks(x[:m], 10), 2.0)
    assert len(found.a) == len(found.b) == len(found.ratio) == 0


@every_test
def test_what_is_not_known_of_the_biases_widens_the_test(name: TestName) -> None:
    x, narrow, wide = sky(np.random.default_rng(9), 5), new_test(name), new_test(name)
    unknown = np.array([[1500.0**2, 0.0], [0.0, 1500.0**2]])
    for t_s in (0.0, 2.0, 4.0):
        a, b = tracks(x), tracks(x + 1000.0 * EAST, 10)
        near = narrow.cycle(a, b, t_s)
        blurred = [s._replace(blur=np.tile(unknown / 2.0, (5, 1, 1))) for s in (a, b)]
        found = wide.cycle(blurred[0], blurred[1], t_s, lambda xa, xb: np.tile(unknown, (len(xa), 1, 1)))
    assert not len(near.a)
    assert pairs_of(found) == {k: k for k in range(5)}


@LAW
@given(seeds, st.integers(1, 4), st.integers(1, 4))
def test_the_nearest_partners_are_those_of_brute_force(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = tracks(2.0 * noise(rng, n)), tracks(2.0 * noise(rng, m), 10, scale=2.0)
    found = NearestTest(0.05).cycle(a, b, 0.0)
    # All tracks of a sensor have the same covariance here, so ln|S| decides nothing.
    d = a.x[:, None] - b.x[None]
    D = (d * d / (5.0 * SIGMA**2)).sum(axis=2)
    gate = scipy.stats.chi2.isf(0.05, 4)
    worth = np.maximum(gate - D, 0.0)
    small, large = min(n, m), max(n, m)
    table = worth if n <= m else worth.T
    best = max(sum(table[i, p[i]] for i in range(small)) for p in permutations(range(large), small))
    assert worth[found.a, found.b].sum() == pytest.approx(best, abs=1e-4)
    assert (D[found.a, found.b] <= gate).all()
    np.testing.assert_allclose(found.ratio, -0.5 * D[found.a, found.b])


def test_of_two_equally_far_the_surer_one_is_nearer() -> None:
    a, b = tracks(np.zeros((1, 4))), tracks(np.zeros((2, 4)), 10)
    b.P[0] *= 9.0
    assert pairs_of(NearestTest(ALPHA).cycle(a, b, 0.0)) == {0: 1}


def test_the_sum_is_that_of_equation_28_against_chi_square() -> None:
    """One pair in plain Python: it is declared exactly while the sum is within the quantile."""
    rng, test, total, seen = np.random.default_rng(4), SumTest(0.3), 0.0, set()
    for k in range(1, 60):
        d = 1.4 * noise(rng, 1)
        total += float((d * d / (2.0 * SIGMA**2)).sum())
        found = test.cycle(tracks(np.zeros((1, 4))), tracks(d, 10), 2.0 * k)
        within = total <= scipy.stats.chi2.isf(0.3, 4 * k)
        assert len(found.a) == within
        seen.add(within)
        if within:
            assert found.ratio[0] == pytest.approx(-total / 2.0)
    assert seen == {True, False}


def test_the_sum_remembers_five_bad_looks_for_minutes() -> None:
    """Differences of just the right size, T = 4 at every look, but for ten seconds."""
    x, honest, bad = np.zeros((1, 4)), SIGMA * np.sqrt(2.0), 700.0 * EAST
    tests = [new_test("paper-sequential"), new_test("seqllr")]
    declared = {}
    for t_s in np.arange(0.0, 700.0, 2.0).tolist():
        d = bad if 20.0 <= t_s < 30.0 else honest
        declared[t_s] = [len(test.cycle(tracks(x), tracks(x + d, 10), t_s).a) for test in tests]
    assert declared[18.0] == [1, 1]
    assert declared[28.0][0] == 0
    assert declared[60.0] == declared[180.0] == [0, 1]
    assert declared[698.0] == [1, 1]


def test_a_pair_that_went_far_away_is_still_remembered() -> None:
    x, test = np.zeros((1, 4)), SumTest(ALPHA)
    for t_s, gap_m in ((0.0, 600.0), (2.0, 50e3), (4.0, 0.0)):
        found = test.cycle(tracks(x), tracks(x + gap_m * EAST, 10), t_s)
    assert not len(found.a)
    fresh = test.cycle(tracks(x), tracks(x, 11), 6.0)
    assert pairs_of(fresh) == {0: 0}
    test.forget()
    assert len(test.cycle(tracks(x), tracks(x, 10), 8.0).a) == 1


def test_a_covariance_that_is_none_rejects_for_good() -> None:
    x, test = np.zeros((1, 4)), SumTest(ALPHA)
    bad = tracks(x, 10)._replace(P=np.diag([1e4, 1e4, 100.0, -1e3])[None])
    for t_s in (0.0, 2.0):
        assert not len(test.cycle(tracks(x), bad, t_s).a)
    assert not len(test.cycle(tracks(x), tracks(x, 10), 4.0).a)
