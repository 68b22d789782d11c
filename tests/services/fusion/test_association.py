from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from tests.services.fusion.makers import FloatArray, IntArray

from trackmesh.services.estimation.pairs import PairRules
from trackmesh.services.fusion.association import DeclaredPairs, LocalTracks, SequentialTest

SIGMA = np.array([100.0, 100.0, 10.0, 10.0])
EAST = np.array([1.0, 0.0, 0.0, 0.0])


def tracks(number: list[int] | IntArray, x: FloatArray) -> LocalTracks:
    """Local tracks with honest and equal covariances."""
    n = len(x)
    return LocalTracks(
        np.asarray(number, np.int64), np.arange(n), np.asarray(x, float), np.tile(np.diag(SIGMA**2), (n, 1, 1)),
        np.zeros((n, 2)), np.zeros((n, 2, 2)),
    )  # fmt: skip


def sky(rng: np.random.Generator, n: int, span_m: float = 1e5) -> FloatArray:
    return np.concatenate([rng.uniform(0, span_m, (n, 2)), rng.normal(0, 150, (n, 2))], axis=1)


def wander(rng: np.random.Generator, error: FloatArray) -> FloatArray:
    """Errors of a local filter: those of two seconds ago count for half."""
    return np.asarray(0.5 * error + np.sqrt(0.75) * SIGMA * rng.standard_normal(error.shape))


def declared(pairs: DeclaredPairs, a: LocalTracks, b: LocalTracks) -> set[tuple[int, int]]:
    return set(zip(a.number[pairs.a].tolist(), b.number[pairs.b].tolist(), strict=True))


def run(test: SequentialTest, x: FloatArray, until_s: float, shift_m: float = 0.0) -> set[tuple[int, int]]:
    """Both sensors see all of x, which flies on; b numbers them from 1000. The pairs declared at the end."""
    rng, n = np.random.default_rng(5), len(x)
    errors = [SIGMA * rng.standard_normal((n, 4)) for _ in range(2)]
    pairs: set[tuple[int, int]] = set()
    for t in np.arange(0.0, until_s, 2.0).tolist():
        x = x + np.array([2.0, 2.0, 0.0, 0.0]) * np.concatenate([x[:, 2:], np.zeros((n, 2))], axis=1)
        errors = [wander(rng, e) for e in errors]
        a, b = tracks(np.arange(n), x + errors[0]), tracks(1000 + np.arange(n), x + errors[1] + shift_m * EAST)
        pairs = declared(test.cycle(a, b, t), a, b)
    return pairs


def test_tracks_of_one_target_are_found_and_no_others() -> None:
    x = sky(np.random.default_rng(1), 60)
    assert run(SequentialTest(PairRules()), x, 30.0) == {(k, 1000 + k) for k in range(60)}


def test_pairs_in_formation_are_told_apart_in_time() -> None:
    lead = sky(np.random.default_rng(2), 20)
    wing = lead + 400.0 * EAST
    pairs = run(SequentialTest(PairRules()), np.concatenate([lead, wing]), 40.0)
    right = {(k, 1000 + k) for k in range(40)}
    assert len(pairs & right) >= 38
    assert len(pairs - right) <= 2


def test_a_shift_that_the_errors_cannot_explain_bars_the_pair() -> None:
    x = sky(np.random.default_rng(3), 10)
    assert run(SequentialTest(PairRules()), x, 30.0, shift_m=200.0)
    assert not run(SequentialTest(PairRules()), x, 60.0, shift_m=1200.0)


def test_pairs_are_one_to_one() -> None:
    x = np.zeros((1, 4))
    test, a, b = SequentialTest(PairRules()), tracks([1], x), tracks([5, 6], np.concatenate([x, x + 30.0 * EAST]))
    for t in (0.0, 2.0, 4.0):
        pairs = test.cycle(a, b, t)
    assert declared(pairs, a, b) == {(1, 5)}


def test_the_sums_are_those_of_the_formulas() -> None:
    """One pair, cycle by cycle, written down in plain Python."""
    rules, rng = PairRules(), np.random.default_rng(4)
    test, ratio, before = SequentialTest(rules), 0.0, -np.inf
    for t in (0.0, 2.0, 3.0, 7.0, 20.0):
        d = SIGMA * rng.standard_normal(4)
        a, b = tracks([1], np.zeros((1, 4))), tracks([2], d[None])
        pairs = test.cycle(a, b, t)
        related = scipy.stats.multivariate_t(np.zeros(4), 2 * np.diag(SIGMA**2), df=rules.nu).logpdf(d)
        unrelated = -np.log(np.pi * rules.radius_m**2) - np.log(4 * np.pi * rules.speed_mps**2)
        weight = min(1.0, (t - before) / rules.correlation_s)
        ratio = np.exp(-(t - before) / rules.memory_s) * ratio + weight * min(related - unrelated, rules.high)
        before = t
        assert declared(pairs, a, b) == {(1, 2)}
        assert pairs.ratio[0] == pytest.approx(ratio, rel=1e-9)


def test_a_pair_that_parts_is_given_up() -> None:
    test, x = SequentialTest(PairRules()), np.zeros((1, 4))
    for t in np.arange(0.0, 20.0, 2.0).tolist():
        pairs = test.cycle(tracks([1], x), tracks([2], x), t)
    assert len(pairs.a) == 1
    for t in np.arange(20.0, 32.0, 2.0).tolist():
        pairs = test.cycle(tracks([1], x), tracks([2], x + 100.0 * (t - 18.0) * EAST), t)
    assert not len(pairs.a)


def test_the_evidence_dies_with_a_track() -> None:
    """A new track takes nothing over from one that stood where it stands."""
    test, x = SequentialTest(PairRules()), np.zeros((1, 4))
    for t in (0.0, 2.0, 4.0):
        old = test.cycle(tracks([1], x), tracks([2], x), t)
    fresh = SequentialTest(PairRules()).cycle(tracks([1], x), tracks([3], x), 6.0)
    new = test.cycle(tracks([1], x), tracks([3], x), 6.0)
    assert new.ratio.tolist() == fresh.ratio.tolist()
    assert new.ratio[0] < old.ratio[0]
    back = test.cycle(tracks([1], x), tracks([2], x), 8.0)
    assert back.ratio.tolist() == fresh.ratio.tolist()


def test_indices_are_of_the_present_order() -> None:
    rng, x = np.random.default_rng(6), sky(np.random.default_rng(7), 12)
    test, numbers = SequentialTest(PairRules()), np.arange(12)
    for t in (0.0, 2.0, 4.0, 6.0):
        p, q = rng.permutation(12), rng.permutation(12)
        a, b = tracks(numbers[p], x[p]), tracks(500 + numbers[q], x[q])
        pairs = test.cycle(a, b, t)
        assert declared(pairs, a, b) == {(k, 500 + k) for k in range(12)}


def test_numbers_may_be_as_great_as_the_mask() -> None:
    x, most = np.zeros((1, 4)), 2**31 - 1
    a, b = tracks([most], x), tracks([most - 1], x)
    test = SequentialTest(PairRules())
    for t in (0.0, 2.0):
        assert declared(test.cycle(a, b, t), a, b) == {(most, most - 1)}


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 2), (2, 0)])
def test_a_sensor_without_tracks(n: int, m: int) -> None:
    test, x = SequentialTest(PairRules()), sky(np.random.default_rng(8), 2)
    test.cycle(tracks([1, 2], x), tracks([1, 2], x), 0.0)
    pairs = test.cycle(tracks(np.arange(n), x[:n]), tracks(np.arange(m), x[:m]), 2.0)
    assert len(pairs.a) == len(pairs.b) == len(pairs.ratio) == 0
