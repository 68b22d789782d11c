"""The search: laws of what is tried, and known optima."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trackmesh.services.fusion.search import Axis, Trial, search

FloatArray = npt.NDArray[np.float64]

FOUR = [
    Axis(1.0, 1e-3, 1e3, 10.0, "noise"),
    Axis(50.0, 1e-2, 1e4, 10.0, "noise"),
    Axis(20.0, 1.0, 1e3, 3.0, "time"),
    Axis(6.0, 0.1, 60.0, 4.0, "turn"),
]


def quadratic(optimum: FloatArray) -> Callable[[FloatArray], float]:
    """A bowl in the logarithms, its axes of unequal width and not along the coordinates."""
    mix = np.array([[1.0, 0.5, 0.0, 0.0], [0.0, 1.0, 0.3, 0.0], [0.0, 0.0, 1.5, 0.3], [0.2, 0.0, 0.0, 0.7]])

    def score(values: FloatArray) -> float:
        return float(((mix @ np.log(values / optimum)) ** 2).sum())

    return score


def trials_of(axes: list[Axis], score: Callable[[FloatArray], float], evaluations: int, seed: int = 1) -> list[Trial]:
    return list(search(axes, score, evaluations, seed))


@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("optimum", [[0.2, 8.0, 40.0, 3.0], [6.0, 400.0, 12.0, 20.0], [0.01, 0.5, 60.0, 6.0]])
def test_the_optimum_of_a_quadratic_is_found_within_five_per_cent(optimum: list[float], seed: int) -> None:
    trials = trials_of(FOUR, quadratic(np.array(optimum)), 250, seed)
    np.testing.assert_allclose(trials[-1].best, optimum, rtol=0.05)


@pytest.mark.parametrize("seed", range(1, 6))
def test_forty_evaluations_find_most_of_what_there_is(seed: int) -> None:
    trials = trials_of(FOUR, quadratic(np.array([0.2, 8.0, 40.0, 3.0])), 40, seed)
    assert trials[-1].best_score < 0.1 * trials[0].score


def test_equal_seeds_give_equal_trials_and_others_do_not() -> None:
    score = quadratic(np.array([0.2, 8.0, 40.0, 3.0]))
    once, again, other = (trials_of(FOUR, score, 60, seed) for seed in (7, 7, 8))
    assert [(t.values.tolist(), t.score) for t in once] == [(t.values.tolist(), t.score) for t in again]
    assert [t.values.tolist() for t in once] != [t.values.tolist() for t in other]


@settings(max_examples=60, deadline=None)
@given(
    noise=st.lists(st.sampled_from([math.nan, math.inf, -1.0, 0.0, 1.0, 2.0]), min_size=1, max_size=50),
    evaluations=st.integers(1, 50),
    seed=st.integers(0, 1000),
)
def test_whatever_the_scores_the_start_comes_first_and_nothing_worse_is_best(
    noise: list[float], evaluations: int, seed: int
) -> None:
    seen: list[FloatArray] = []

    def score(values: FloatArray) -> float:
        seen.append(values)
        return noise[(len(seen) - 1) % len(noise)]

    trials = trials_of(FOUR, score, evaluations, seed)
    assert seen[0].tolist() == [axis.start for axis in FOUR]
    assert [t.number for t in trials] == list(range(1, len(trials) + 1))
    assert len(seen) == len(trials) <= evaluations
    assert len({values.tobytes() for values in seen}) == len(seen)
    for k, trial in enumerate(trials):
        heard = [math.inf if math.isnan(noise[i % len(noise)]) else noise[i % len(noise)] for i in range(k + 1)]
        assert (trial.score, trial.best_score) == (heard[-1], min(heard))
        if math.isfinite(trial.best_score):
            assert trial.best.tolist() == seen[heard.index(min(heard))].tolist()
        else:
            assert trial.best.tolist() == seen[0].tolist()


@settings(max_examples=30, deadline=None)
@given(pull=st.lists(st.sampled_from([-1.0, 1.0]), min_size=4, max_size=4), seed=st.integers(0, 100))
def test_nothing_is_tried_out_of_bounds_and_the_bound_itself_is_reached(pull: list[float], seed: int) -> None:
    trials = trials_of(FOUR, lambda values: float(np.array(pull) @ np.log(values)), 150, seed)
    low, high = np.array([a.low for a in FOUR]), np.array([a.high for a in FOUR])
    for trial in trials:
        assert (low <= trial.values).all() and (trial.values <= high).all()
    np.testing.assert_allclose(trials[-1].best, np.where(np.array(pull) > 0, low, high), rtol=1e-3)


@pytest.mark.parametrize(("start", "sign"), [(5000.0, -1.0), (0.5, 1.0)])
def test_a_start_out_of_bounds_is_a_bound_itself(start: float, sign: float) -> None:
    trials = trials_of([Axis(start, 1.0, 3600.0, 3.0, "time")], lambda values: sign * float(values[0]), 60)
    tried = [trial.values[0] for trial in trials]
    assert trials[-1].best.tolist() == [start]
    assert min(tried) == start or max(tried) == start
    assert any(start < value < 1.0 or 3600.0 < value < start for value in tried)
    assert any(1.0 < value < 3600.0 for value in tried)


def test_what_is_tried_is_in_order_and_has_few_digits() -> None:
    axes = [Axis(value, 1e-3, 1e3, 10.0, "noise") for value in (1.0, 2.0, 3.0)]
    trials = list(search(axes, lambda values: float(values[0] - values[2]), 40, 1, np.sort))
    assert len(trials) == 40
    for trial in trials:
        assert trial.values.tolist() == sorted(trial.values.tolist())
        assert all(value == float(f"{value:.4g}") for value in trial.values.tolist())


def test_groups_are_explored_together_over_their_whole_reach() -> None:
    axes = [Axis(1.0, 1e-9, 1e9, 100.0, "noise") for _ in range(3)]
    trials = trials_of(axes, lambda _: 1.0, 91)
    explored = np.log([t.values for t in trials[1:31]]) / np.log(100.0)
    together = explored.mean(axis=1)
    assert together.min() < -0.7 and together.max() > 0.7
    assert explored.std(axis=1).mean() < 0.4


def test_it_ends_when_all_steps_are_small() -> None:
    assert len(trials_of(FOUR, quadratic(np.array([0.2, 8.0, 40.0, 3.0])), 3000)) < 1500


@pytest.mark.parametrize("start", [0.0, -1.0, math.nan, math.inf])
def test_an_axis_without_a_logarithm_is_refused(start: float) -> None:
    with pytest.raises(ValueError, match="positive number"):
        next(search([Axis(start, 1.0, 2.0, 2.0, "noise")], lambda _: 0.0, 3))
    with pytest.raises(ValueError, match="axis"):
        next(search([], lambda _: 0.0, 3))
