"""The least score over some positive numbers, found in few evaluations: exploration at random, then step by step.

All moves are made in the logarithm of the numbers: what matters of a noise level is its order of magnitude.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_EXPLORED_SHARE = 1.0 / 3.0
_APART_SHARE = 0.25
_FIRST_STEP = 1.0 / 3.0
_SMALLEST_STEP = math.log(1.01)
_DIGITS = 4


class Axis(NamedTuple):
    """One positive number to be found.

    Attributes:
        start: where the search begins.
        low, high: what it may become; a start outside is a bound itself.
        reach: exploration goes up to this factor either way.
        group: axes of one name are also moved together.
    """

    start: float
    low: float
    high: float
    reach: float
    group: str


class Trial(NamedTuple):
    """One evaluation, and the best so far: values (d,) and score; the first trial is that of the start."""

    number: int
    values: FloatArray
    score: float
    best: FloatArray
    best_score: float


def search(
    axes: list[Axis],
    score: Callable[[FloatArray], float],
    evaluations: int,
    seed: int = 1,
    tidy: Callable[[FloatArray], FloatArray] = lambda values: values,
) -> Iterator[Trial]:
    """Evaluate ``score`` at the start, then at up to ``evaluations - 1`` other points; lower is better.

    A third of the evaluations explore around the start: the common factor of each group is stratified over its reach
    (a Latin hypercube: M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21, 1979), the axes of a group differ
    by a quarter of that. The others refine the best: a step along one axis, or along one group, that succeeds is
    doubled for the next time, one that fails is halved and turned round (after H. H. Rosenbrock, The Computer
    Journal 3, 1960, without his rotation of axes). It ends early when all steps are below one per cent. Values are
    rounded to four digits, ``tidy`` brings them into order; the same seed gives the same trials. A score that is not
    a number is the worst.

    Raises:
        ValueError: there is no axis, or an axis does not start at a positive finite number.
    """
    if not axes or not all(0.0 < axis.start < math.inf for axis in axes):
        raise ValueError("Every axis must start at a positive number.")
    rng = np.random.default_rng(seed)
    trials = _Trials(axes, score, evaluations, tidy)
    yield trials.begin()
    for at in _explored(axes, int((evaluations - 1) * _EXPLORED_SHARE), rng):
        trial = trials.take(at)
        if trial is not None:
            yield trial
    yield from _refined(axes, trials, rng)


class _Trials:
    """What was tried: no point twice, none out of bounds, no more than ``most``."""

    def __init__(
        self,
        axes: list[Axis],
        score: Callable[[FloatArray], float],
        most: int,
        tidy: Callable[[FloatArray], FloatArray],
    ) -> None:
        self._score, self._tidy, self._most = score, tidy, most
        self._seen: set[bytes] = set()
        self._start = np.array([axis.start for axis in axes])
        self._low = np.minimum([axis.low for axis in axes], self._start)
        self._high = np.maximum([axis.high for axis in axes], self._start)
        self.best, self.best_score = self._start, math.inf

    @property
    def spent(self) -> bool:
        return len(self._seen) >= self._most

    def begin(self) -> Trial:
        return self._evaluate(self._start)

    def take(self, log_values: FloatArray) -> Trial | None:
        """Evaluate a point, brought within bounds; None if it was tried already or nothing may be tried any more."""
        # Clipped first: a step without end must not overflow; and again, as rounding may leave the bounds.
        rounded = [float(f"{value:.{_DIGITS}g}") for value in np.exp(np.clip(log_values, -500.0, 500.0))]
        values = self._tidy(np.clip(rounded, self._low, self._high))
        if self.spent or values.tobytes() in self._seen:
            return None
        return self._evaluate(values)

    def _evaluate(self, values: FloatArray) -> Trial:
        self._seen.add(values.tobytes())
        score = self._score(values)
        score = math.inf if math.isnan(score) else score
        if score < self.best_score:
            self.best, self.best_score = values, score
        return Trial(len(self._seen), values, score, self.best, self.best_score)


def _explored(axes: list[Axis], count: int, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Points in the logarithm around the start."""
    start = np.log([axis.start for axis in axes])
    reach = np.log([axis.reach for axis in axes])
    groups = _groups(axes)
    strata = [(rng.permutation(count) + rng.random(count)) / max(count, 1) for _ in groups]
    for k in range(count):
        together = sum(mask * (2.0 * stratum[k] - 1.0) for mask, stratum in zip(groups, strata, strict=True))
        yield start + reach * (together + _APART_SHARE * rng.standard_normal(len(axes)))


def _refined(axes: list[Axis], trials: _Trials, rng: np.random.Generator) -> Iterator[Trial]:
    """Steps from the best, until they are small or nothing may be tried any more."""
    directions = [*(mask for mask in _groups(axes) if mask.sum() > 1), *np.eye(len(axes))]
    reach = np.log([axis.reach for axis in axes])
    steps = np.array([_FIRST_STEP * float((reach * along).max()) for along in directions])
    steps *= rng.choice([-1.0, 1.0], len(steps))
    while (np.abs(steps) > _SMALLEST_STEP).any():
        for k in rng.permutation(len(directions)).tolist():
            if trials.spent:
                return
            before = trials.best_score
            trial = trials.take(np.log(trials.best) + steps[k] * directions[k])
            steps[k] *= 2.0 if trials.best_score < before else -0.5
            if trial is not None:
                yield trial


def _groups(axes: list[Axis]) -> list[FloatArray]:
    """For each group, which axes (d,) are in it: 1 or 0."""
    names = dict.fromkeys(axis.group for axis in axes)
    return [np.array([float(axis.group == name) for axis in axes]) for name in names]
