"""The tests between the local tracks of two sensors that a unit can choose from, with one contract.

* ``seqllr``: the sequential log-likelihood ratio with registration and forgetting (``association``); the default;
* ``gnn``: the nearest partner of this moment, one to one, without memory;
* ``paper-sequential``: the sum of squared distances of Long, Cai, Li and Qiu (2022), eq. (28), against chi-square. It
  forgets nothing: what the covariances do not know, such as a bias, adds up until true pairs are rejected.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import assignment
from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.estimation.pairs import PairRules, state_distances
from trackmesh.services.estimation.track_distances import acceptance_limit, sequential_statistic
from trackmesh.services.fusion.association import (
    Blur,
    Candidates,
    DeclaredPairs,
    LocalTracks,
    SequentialTest,
    candidates,
)

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

TestName = Literal["seqllr", "paper-sequential", "gnn"]

_STATES = 4
_LEAST_SCORE = 1e-6
_NONE = np.empty(0, np.int64)


class PairTest(Protocol):
    """A test between two sensors: see ``SequentialTest.cycle``."""

    def cycle(self, a: LocalTracks, b: LocalTracks, t_s: float, blur: Blur | None = None) -> DeclaredPairs: ...  # noqa: D102


def make_test(name: TestName, rules: PairRules, alpha: float) -> PairTest:
    """The test of this name.

    Args:
        name: see above.
        rules: of ``seqllr``.
        alpha: of the others, share of true pairs that chi-square would reject.
    """
    if name == "seqllr":
        return SequentialTest(rules)
    return NearestTest(alpha) if name == "gnn" else SumTest(alpha)


def distances(a: LocalTracks, b: LocalTracks, found: Candidates, blur: Blur | None) -> tuple[FloatArray, FloatArray]:
    """D = d^T S^-1 d and ln|S| of candidates, with what is not known of the sensors' biases in S."""
    unknown = blur(a.x[found.a], b.x[found.b]) if blur else np.zeros((len(found.a), 2, 2))
    return state_distances(a.corrected(), a.P, b.corrected(), b.P, found.a, found.b, unknown)


def one_to_one(a: LocalTracks, b: LocalTracks, found: Candidates, score: FloatArray) -> BoolArray:
    """Which candidates are chosen: those with the greatest sum of scores; without a positive score none is."""
    usable = np.flatnonzero(score > 0.0)
    chosen = assignment.assign(found.a[usable], found.b[usable], score[usable], len(a.number), len(b.number))
    return np.asarray((chosen[found.b] == found.a) & (score > 0.0))


class NearestTest:
    """Global nearest neighbour: each moment for itself, least sum of D + ln|S| within the gate."""

    def __init__(self, alpha: float) -> None:
        self._gate = float(acceptance_limit(1, _STATES, alpha))

    def cycle(self, a: LocalTracks, b: LocalTracks, t_s: float, blur: Blur | None = None) -> DeclaredPairs:
        """Declare the pairs of this moment; ``ratio`` is -D / 2. Arguments as of ``SequentialTest.cycle``."""
        found = candidates(a, b, _NONE)
        distance, logdet = distances(a, b, found, blur)
        spread = logdet.max(initial=-np.inf) - logdet
        score = np.where(distance <= self._gate, self._gate - distance + spread + _LEAST_SCORE, 0.0)
        declared = one_to_one(a, b, found, score)
        return DeclaredPairs(found.a[declared], found.b[declared], -0.5 * distance[declared])


class _Sums(NamedTuple):
    """Statistics of pairs, sorted by key as in ``association``: lambda, and how many looks were added."""

    key: IntArray
    statistic: FloatArray
    looks: IntArray


class SumTest:
    """The test of eq. (28) between two sensors; a pair's sum begins when it is first close, and dies with a track."""

    def __init__(self, alpha: float) -> None:
        self._alpha = alpha
        self._limits = np.empty(0)
        self.forget()

    def forget(self) -> None:
        """Begin all sums anew."""
        self._sums = _Sums(_NONE, np.empty(0), _NONE)

    def cycle(self, a: LocalTracks, b: LocalTracks, t_s: float, blur: Blur | None = None) -> DeclaredPairs:
        """Add the distances of this moment and declare pairs within chi-square, one to one.

        Of the accepted pairs those are chosen that use least of their limits. ``ratio`` is that of eq. (27) without its
        constant, -lambda / 2. Arguments as of ``SequentialTest.cycle``.
        """
        found = candidates(a, b, self._sums.key)
        distance, _ = distances(a, b, found, blur)
        before, looks = self._recall(found.key)
        statistic = sequential_statistic(before, distance)
        limit = self._limit(looks + 1)
        self._sums = _Sums(found.key, statistic, looks + 1)
        declared = one_to_one(a, b, found, np.where(statistic <= limit, 2.0 - statistic / limit, 0.0))
        return DeclaredPairs(found.a[declared], found.b[declared], -0.5 * statistic[declared])

    def _limit(self, looks: IntArray) -> FloatArray:
        """Chi-square after so many looks, out of a table."""
        most = int(looks.max(initial=0))
        if most > len(self._limits):
            self._limits = acceptance_limit(np.arange(1, 2 * most + 1), _STATES, self._alpha)
        return self._limits[looks - 1]

    def _recall(self, key: IntArray) -> tuple[FloatArray, IntArray]:
        """Sums and looks of these keys, zeros for new pairs."""
        where = index_of(self._sums.key, key)
        known = where >= 0
        statistic, looks = np.zeros(len(key)), np.zeros(len(key), np.int64)
        statistic[known], looks[known] = self._sums.statistic[where[known]], self._sums.looks[where[known]]
        return statistic, looks
