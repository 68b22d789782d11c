"""The association cycle: every other second the sequential test between the local tracks of each pair of sensors.

It gives three things: membership is brought up to date, duplicates among system tracks are removed unless their plots
contradict it, and the pairs teach the registration what is wrong with which sensor. It never overrules a system track
whose plots fit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.bias import Tracks
from trackmesh.services.estimation.bias_start import BiasStart, global_start
from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.estimation.pairs import state_distances
from trackmesh.services.fusion import membership
from trackmesh.services.fusion.association import NUMBER_MASK, Blur, DeclaredPairs, LocalTracks
from trackmesh.services.fusion.biases import Change
from trackmesh.services.fusion.layer import Layer
from trackmesh.services.fusion.pair_tests import PairTest
from trackmesh.services.fusion.registration import Registration

IntArray = npt.NDArray[np.int64]

_MERGE_GATE = 25.0
_HITS_FOR_TEST = 3
_MOST_BEFORE_LOCK = 300


class Declared(NamedTuple):
    """Pairs declared in one cycle, between sensors ``a`` and ``b``: rows of their local layers."""

    a: int
    b: int
    row_a: IntArray
    row_b: IntArray


class Reference(NamedTuple):
    """Tracks of a unit whose positions are taken to be right but for this error, one sigma per axis."""

    name: str
    tracks: LocalTracks
    error_m: float


class AssociationCycle:
    """The tests between all pairs of sensors, by their indices; ``locals_`` grows with the sensors.

    Attributes:
        declared: the pairs of the last cycle.
    """

    def __init__(
        self,
        system: Layer,
        locals_: list[Layer],
        registration: Registration | None,
        new_test: Callable[[], PairTest],
        counters: Counter[str],
        end: Callable[[int], None],
    ) -> None:
        self._system = system
        self._locals = locals_
        self._registration = registration
        self._new_test = new_test
        self._counters = counters
        self._end = end
        self._tests: dict[tuple[int, int], PairTest] = {}
        self._reference_tests: dict[tuple[str, str], PairTest] = {}
        self.declared: list[Declared] = []

    def run(self, sensors: list[str], now_s: float, references: Sequence[Reference] = ()) -> list[Change]:
        """One cycle at a time; what changed in the corrections that are applied to plots.

        The registration learns from the tracks of ``references`` as well.
        """
        for sensor, local in enumerate(self._locals):
            # The tracks of a sensor that fell silent end here: it steps no more.
            local.judge(now_s)
            membership.renew(self._system, local, sensor)
        seen = [self._local_tracks(local, name, now_s) for local, name in zip(self._locals, sensors, strict=True)]
        self.declared = []
        for b in range(len(seen)):
            for a in range(b):
                if (a, b) not in self._tests:
                    self._tests[a, b] = self._new_test()
                test = self._tests[a, b]
                pairs = test.cycle(seen[a], seen[b], now_s, self._blur(sensors[a], sensors[b]))
                self.declared.append(Declared(a, b, seen[a].row[pairs.a], seen[b].row[pairs.b]))
                self._teach(sensors[a], sensors[b], seen[a], seen[b], pairs, now_s)
                found = self._start_far_away(sensors[a], sensors[b], seen[a], seen[b], now_s)
                if found is not None:
                    self.declared.append(Declared(a, b, seen[a].row[found.a], seen[b].row[found.b]))
                self._join(a, b, seen[a].number[pairs.a], seen[b].number[pairs.b], now_s)
        if self._registration is not None:
            self._compare(sensors, seen, references, self._registration, now_s)
        return self._registration.settle(now_s) if self._registration else []

    def _compare(
        self,
        sensors: list[str],
        seen: list[LocalTracks],
        references: Sequence[Reference],
        known: Registration,
        now_s: float,
    ) -> None:
        for one in references:
            known.announce(one.name, "position", prior=(one.error_m, one.error_m, 0.0))
            for name, tracks in zip(sensors, seen, strict=True):
                test = self._reference_tests.setdefault((name, one.name), self._new_test())
                pairs = test.cycle(tracks, one.tracks, now_s, self._blur(name, one.name))
                self._teach(name, one.name, tracks, one.tracks, pairs, now_s)

    def _local_tracks(self, local: Layer, sensor_id: str, now_s: float) -> LocalTracks:
        rows = local.rows
        rows = rows[local.life.hits[rows] >= _HITS_FOR_TEST]
        known = self._registration
        if known is not None and not known.locked(sensor_id):
            # Gates are wide before the biases are known: a sample is enough to learn them.
            rows = rows[:_MOST_BEFORE_LOCK]
        x, P, _ = local.predict(rows, np.maximum(local.filters.t_s[rows], now_s))
        shift, blur = np.zeros((len(rows), 2)), np.zeros((len(rows), 2, 2))
        if known is not None and len(rows):
            shift, blur = known.shift(sensor_id, x, applied=False), known.covariance(sensor_id, x)
        return LocalTracks(local.life.uid[rows] & NUMBER_MASK, rows, x, P, shift, blur)

    def _blur(self, a: str, b: str) -> Blur | None:
        known = self._registration
        if known is None:
            return None
        return partial(known.difference_covariance, a, b)

    def _teach(self, a: str, b: str, of_a: LocalTracks, of_b: LocalTracks, pairs: DeclaredPairs, now_s: float) -> None:
        if self._registration is not None and len(pairs.a):
            self._registration.update(a, b, of_a.x[pairs.a], of_a.P[pairs.a], of_b.x[pairs.b], of_b.P[pairs.b], now_s)

    def _start_far_away(self, a: str, b: str, of_a: LocalTracks, of_b: LocalTracks, now_s: float) -> BiasStart | None:
        """Many tracks and no pairs for long: biases may be far beyond what is expected."""
        known = self._registration
        if known is None or not known.lost(a, b, len(of_a.x), len(of_b.x), now_s):
            return None
        found = global_start(Tracks(known.geometry(a), of_a.x, of_a.P), Tracks(known.geometry(b), of_b.x, of_b.P))
        self._counters["global_starts" if found.found else "global_starts_in_vain"] += 1
        if not found.found:
            return None
        i, j = found.a, found.b
        known.begin(a, b, (found.bias_a, found.bias_b), of_a.x[i], of_a.P[i], of_b.x[j], of_b.P[j], now_s)
        return found

    def _join(self, a: int, b: int, number_a: IntArray, number_b: IntArray, now_s: float) -> None:
        """Merge system tracks that a declared pair says are one, unless their plots contradict it."""
        rows = self._system.rows
        rows = rows[self._system.life.confirmed[rows]]
        member = self._system.life.member
        row_a = _member_rows(rows, member[rows, a], number_a)
        row_b = _member_rows(rows, member[rows, b], number_b)
        apart = (row_a >= 0) & (row_b >= 0) & (row_a != row_b)
        for one, other in zip(row_a[apart].tolist(), row_b[apart].tolist(), strict=True):
            self._merge(one, other, now_s)

    def _merge(self, one: int, other: int, now_s: float) -> None:
        known, filters = self._system.life, self._system.filters
        if not (known.alive[one] and known.alive[other]):
            return
        pair = np.array([one, other])
        x, P, _ = self._system.predict(pair, np.maximum(filters.t_s[pair], now_s))
        zero, first = np.zeros(1, np.int64), np.ones(1, np.int64)
        distance, _ = state_distances(x, P, x, P, zero, first, np.zeros((1, 2, 2)))
        both = ((known.member[one] >= 0) & (known.member[other] >= 0)).any()
        if both or distance[0] > _MERGE_GATE:
            self._counters["contradictions"] += 1
            return
        old, young = sorted((one, other), key=lambda row: int(known.link[row]))
        self._system.join(young, old)
        free = known.member[old] < 0
        known.member[old][free] = known.member[young][free]
        known.last_s[old] = max(known.last_s[old], known.last_s[young])
        for local in self._locals:
            local.life.link[local.life.link == known.uid[young]] = known.uid[old]
        self._end(young)
        self._counters["merged"] += 1


def _member_rows(rows: IntArray, members: IntArray, numbers: IntArray) -> IntArray:
    held = members >= 0
    place = index_of(members[held] & NUMBER_MASK, numbers)
    return np.where(place >= 0, rows[held][place] if held.any() else -1, -1)
