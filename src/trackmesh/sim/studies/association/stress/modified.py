"""The modified method between tracks of multiple-model filters: a cross-covariance for each pair under test."""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.estimation.track_distances import (
    acceptance_limit,
    modified_covariance,
    squared_distances,
    weighted_covariance,
)
from trackmesh.services.fusion.association import Blur, Candidates, DeclaredPairs, LocalTracks, candidates
from trackmesh.services.fusion.pair_tests import one_to_one
from trackmesh.sim.studies.association.stress.local_tracks import Moment


class ModifiedTest:
    """Bar-Shalom's distance of each moment within chi-square, one to one; state: P_ab of every pair that was close.

    Attributes:
        repaired: pairs whose modified covariance was none for lack of digits, so that the weighted one was taken.
    """

    def __init__(self, alpha: float) -> None:
        self._limit = float(acceptance_limit(1, 4, alpha))
        self._key, self._Pab = np.empty(0, np.int64), np.empty((0, 4, 4))
        self.repaired = 0

    def cycle(self, moment: Moment, a: LocalTracks, b: LocalTracks, blur: Blur | None) -> DeclaredPairs:
        """As ``SequentialTest.cycle``, with what the updates since the last cycle left of errors."""
        found = candidates(a, b, self._key)
        self._key, self._Pab = found.key, self._crossed(moment, found)
        distance = self._distances(a, b, found, blur)
        declared = one_to_one(a, b, found, np.where(distance <= self._limit, 2.0 - distance / self._limit, 0.0))
        return DeclaredPairs(found.a[declared], found.b[declared], -0.5 * distance[declared])

    def _crossed(self, moment: Moment, found: Candidates) -> FloatArray:
        """P_ab of the candidates now; of new ones it is zero."""
        where = index_of(self._key, found.key)
        known = where >= 0
        i, j = found.a[known], found.b[known]
        Pab = np.zeros((len(found.key), 4, 4))
        carried = moment.a.A[i] @ self._Pab[where[known]] @ np.swapaxes(moment.b.A[j], 1, 2)
        Pab[known] = carried + moment.a.B[i] @ np.swapaxes(moment.b.B[j], 1, 2)
        return Pab

    def _distances(self, a: LocalTracks, b: LocalTracks, found: Candidates, blur: Blur | None) -> FloatArray:
        t = a.corrected()[found.a] - b.corrected()[found.b]
        unknown = np.zeros((len(t), 4, 4))
        if blur is not None:
            unknown[:, :2, :2] = blur(a.x[found.a], b.x[found.b])
        distance = squared_distances(t, modified_covariance(a.P[found.a], b.P[found.b], self._Pab) + unknown)
        none: IntArray = np.flatnonzero(np.isinf(distance))
        self.repaired += len(none)
        weighted = weighted_covariance(a.P[found.a[none]], b.P[found.b[none]])
        distance[none] = squared_distances(t[none], weighted + unknown[none])
        return distance
