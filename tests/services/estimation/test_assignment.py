from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from tests.services.estimation.makers import LAW, FloatArray, IntArray, seeds

from trackmesh.services.estimation.assignment import GREEDY_ABOVE_CELLS, assign, cheapest

Sparse = tuple[IntArray, IntArray, FloatArray]


def sparse(rng: np.random.Generator, n: int, m: int, share: float) -> Sparse:
    """A random table as (row, column, score), its pairs in no order; scores repeat now and then."""
    row, column = np.nonzero(rng.random((n, m)) < share)
    order = rng.permutation(len(row))
    return row[order], column[order], np.round(rng.uniform(0.01, 10.0, len(row)), 1) + 0.01


def dense(pairs: Sparse, n: int, m: int) -> FloatArray:
    table = np.zeros((n, m))
    table[pairs[0], pairs[1]] = pairs[2]
    return table


def checked_total(pairs: Sparse, chosen: IntArray, n: int, m: int) -> float:
    """The total score of an assignment, which must be one to one and of listed pairs."""
    columns = np.flatnonzero(chosen >= 0)
    rows = chosen[columns]
    assert len(np.unique(rows)) == len(rows)
    scores = dense(pairs, n, m)[rows, columns]
    assert np.all(scores > 0), "a pair that was not listed"
    return float(scores.sum())


@LAW
@given(seeds, st.integers(1, 5), st.integers(1, 5), st.floats(0.1, 1.0))
def test_as_good_as_every_other_assignment(seed: int, n: int, m: int, share: float) -> None:
    pairs = sparse(np.random.default_rng(seed), n, m, share)
    table = dense(pairs, n, m)
    if n > m:
        table = table.T
    a, b = table.shape
    best = max(table[range(a), p].sum() for p in itertools.permutations(range(b), a))
    assert checked_total(pairs, assign(*pairs, n, m), n, m) == pytest.approx(best)


@LAW
@given(seeds, st.integers(1, 40), st.integers(1, 40), st.floats(0.02, 1.0))
def test_as_good_as_scipy(seed: int, n: int, m: int, share: float) -> None:
    pairs = sparse(np.random.default_rng(seed), n, m, share)
    table = dense(pairs, n, m)
    best = table[linear_sum_assignment(table, maximize=True)].sum()
    assert checked_total(pairs, assign(*pairs, n, m), n, m) == pytest.approx(best)


@LAW
@given(seeds, st.integers(1, 20), st.integers(0, 20), st.booleans())
def test_the_cheapest_full_assignment_is_that_of_scipy(seed: int, n: int, more: int, negative: bool) -> None:
    cost = np.random.default_rng(seed).uniform(-5.0 if negative else 0.0, 5.0, (n, n + more))
    columns = cheapest(cost)
    assert len(set(columns.tolist())) == n
    assert cost[np.arange(n), columns].sum() == pytest.approx(cost[linear_sum_assignment(cost)].sum())


def test_a_giant_component_is_solved_greedily() -> None:
    rng, n = np.random.default_rng(1), 201
    assert n * n > GREEDY_ABOVE_CELLS
    row, column = (a.ravel() for a in np.indices((n, n)))
    pairs = row, column, rng.uniform(0.1, 1.0, n * n)
    want, used = np.full(n, -1), set()
    for e in np.argsort(-pairs[2]).tolist():
        if want[column[e]] < 0 and row[e] not in used:
            want[column[e]] = row[e]
            used.add(row[e])
    got = assign(*pairs, n, n)
    assert got.tolist() == want.tolist()
    # One small component beside it is still solved exactly: greed would take the 3 and be left with the 0.1.
    extra = np.array([n, n, n + 1, n + 1]), np.array([n, n + 1, n, n + 1]), np.array([3.0, 2.5, 2.5, 0.1])
    rows, columns, scores = (np.concatenate(p) for p in zip(pairs, extra, strict=True))
    got = assign(rows, columns, scores, n + 2, n + 2)
    assert got[:n].tolist() == want.tolist()
    assert got[n:].tolist() == [n + 1, n]


def test_nothing_listed_assigns_nothing() -> None:
    none = np.empty(0, np.int64)
    assert assign(none, none, np.empty(0), 3, 2).tolist() == [-1, -1]


def test_components_do_not_touch_each_other() -> None:
    rng = np.random.default_rng(2)
    blocks = [sparse(rng, 6, 5, 0.6) for _ in range(8)]
    together = (
        np.concatenate([b[0] + 6 * k for k, b in enumerate(blocks)]),
        np.concatenate([b[1] + 5 * k for k, b in enumerate(blocks)]),
        np.concatenate([b[2] for b in blocks]),
    )
    chosen = assign(*together, 48, 40)
    total = sum(checked_total(b, assign(*b, 6, 5), 6, 5) for b in blocks)
    assert checked_total(together, chosen, 48, 40) == pytest.approx(total)
