"""Tracks that took the same plots are one; whatever else they have in common does not matter."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trackmesh.services.fusion.partition.pairing import KEPT, NO_KEY, SENT, pair, plot_keys

rows = st.lists(st.lists(st.integers(0, 30), min_size=SENT, max_size=SENT, unique=True), min_size=1, max_size=6)


def pairs(ours: list[list[int]], theirs: list[list[int]]) -> set[tuple[int, int]]:
    i, j = pair(np.array(ours), np.array(theirs))
    return set(zip(i.tolist(), j.tolist(), strict=True))


def test_keys_tell_sensor_run_batch_and_plot_apart() -> None:
    every = [
        plot_keys(sensor, boot, seq, 3).tolist()
        for sensor, boot, seq in itertools.product(("north", "east"), ("one", "two"), (0, 1, 2**24 - 1))
    ]
    keys = [key for some in every for key in some]
    assert len(set(keys)) == len(keys)
    assert min(keys) > 0
    assert plot_keys("north", "one", 5, 9)[7] == plot_keys("north", "one", 5 + 2**24, 8)[7]


def test_two_plots_in_common_are_enough_and_one_is_not() -> None:
    ours = [[1, 2, 3, 4, 5, 6, 7, 8], [11, 12, 13, 14, 15, 16, 17, 18]]
    assert pairs(ours, [[50, 51, 52, 53, 8, 7]]) == {(0, 0)}
    assert pairs(ours, [[50, 51, 52, 53, 54, 7]]) == set()


def test_what_is_no_key_is_in_common_with_nothing() -> None:
    assert pairs([[NO_KEY] * KEPT], [[NO_KEY] * SENT]) == set()
    assert pairs([[NO_KEY] * KEPT], np.empty((0, SENT), np.int64).tolist() or [[NO_KEY] * SENT]) == set()


def test_nobody_is_paired_with_nobody() -> None:
    i, j = pair(np.empty((0, KEPT), np.int64), np.ones((2, SENT), np.int64))
    assert len(i) == len(j) == 0
    i, j = pair(np.ones((2, KEPT), np.int64), np.empty((0, SENT), np.int64))
    assert len(i) == len(j) == 0


def test_most_in_common_first_then_the_younger() -> None:
    assert pairs([[1, 2, 3, 4, 5, 6, 20, 21]], [[1, 2, 3, 90, 91, 92], [20, 21, 93, 94, 95, 96]]) == {(0, 0)}
    assert pairs([[1, 2, 3, 4, 5, 6, 20, 21]], [[1, 2, 97, 90, 91, 92], [20, 21, 93, 94, 95, 96]]) == {(0, 1)}


@given(rows, rows)
def test_pairs_are_one_to_one_and_share_plots(ours: list[list[int]], theirs: list[list[int]]) -> None:
    # A plot is taken by one track of a unit.
    mine, others = unique(ours), unique(theirs)
    found = pairs(mine, others)
    assert len({i for i, _ in found}) == len({j for _, j in found}) == len(found)
    for i, j in found:
        assert len(set(mine[i]) & set(others[j]) - {NO_KEY}) >= 2
    if not found:
        assert all(len(set(a) & set(b) - {NO_KEY}) < 2 for a in mine for b in others)


def unique(rows: list[list[int]]) -> list[list[int]]:
    seen: set[int] = set()
    out = []
    for row in rows:
        out.append([key if key not in seen else NO_KEY for key in row])
        seen |= set(row)
    return out
