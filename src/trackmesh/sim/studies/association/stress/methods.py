"""The methods that are compared, and one run of each over the tracks of a case."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.services.estimation.pairs import PairRules
from trackmesh.services.fusion.association import Blur, DeclaredPairs, LocalTracks, SequentialTest
from trackmesh.services.fusion.pair_tests import NearestTest, PairTest, SumTest
from trackmesh.services.fusion.registration import Registration
from trackmesh.sim.studies.association.stress.local_tracks import Moment, Recording, Seen
from trackmesh.sim.studies.association.stress.modified import ModifiedTest

Cycle = Callable[[Moment, LocalTracks, LocalTracks, Blur | None], DeclaredPairs]

ALPHA = 0.001
LOOSE_ALPHA = 0.05

_NAMES = ("first", "second")


class WeightedTest(SumTest):
    """The weighted distance of each moment within chi-square: a sum of one look."""

    def cycle(self, a: LocalTracks, b: LocalTracks, t_s: float, blur: Blur | None = None) -> DeclaredPairs:
        """As ``SumTest.cycle``, of this moment alone."""
        self.forget()
        return super().cycle(a, b, t_s, blur)


def _plain(test: PairTest) -> Cycle:
    return lambda moment, a, b, blur: test.cycle(a, b, moment.t_s, blur)


METHODS: dict[str, Callable[[], Cycle]] = {
    "gnn": lambda: _plain(NearestTest(ALPHA)),
    "weighted": lambda: _plain(WeightedTest(ALPHA)),
    "modified": lambda: ModifiedTest(ALPHA).cycle,
    "sequential .05": lambda: _plain(SumTest(LOOSE_ALPHA)),
    "sequential": lambda: _plain(SumTest(ALPHA)),
    "seqllr": lambda: _plain(SequentialTest(PairRules())),
}
"""A new test each, by name; chi-square at ``ALPHA`` where the name does not say otherwise."""

REGISTERED = "+reg"
COLUMNS = (*METHODS, *(name + REGISTERED for name in METHODS))
"""Every method without and with registration."""


class Decided(NamedTuple):
    """What a method declared at one moment: targets of the two tracks of each pair."""

    t_s: float
    a: IntArray
    b: IntArray


def run(recording: Recording, column: str) -> list[Decided]:
    """Everything that a method declares, moment by moment."""
    name = column.removesuffix(REGISTERED)
    return decide(recording, METHODS[name](), registration(recording) if name != column else None)


def decide(recording: Recording, cycle: Cycle, known: Registration | None) -> list[Decided]:
    """As ``run``, with a registration that learns from what is declared, or none."""
    blur = partial(known.difference_covariance, *_NAMES) if known is not None else None
    decided = []
    for moment in recording.moments:
        a, b = (raw_tracks(seen, known, sensor) for seen, sensor in zip((moment.a, moment.b), _NAMES, strict=True))
        pairs = cycle(moment, a, b, blur)
        decided.append(Decided(moment.t_s, moment.a.target[pairs.a], moment.b.target[pairs.b]))
        if known is not None:
            if len(pairs.a):
                known.update(*_NAMES, a.x[pairs.a], a.P[pairs.a], b.x[pairs.b], b.P[pairs.b], moment.t_s)
            known.settle(moment.t_s)
    return decided


def registration(recording: Recording) -> Registration:
    """Of both radars, before any data."""
    known = Registration()
    for sensor, site_m in zip(_NAMES, recording.sites_m, strict=True):
        known.announce(sensor, "polar", site_m)
    return known


def raw_tracks(seen: Seen, known: Registration | None, sensor: str) -> LocalTracks:
    """The tracks as a test wants them, with what is known of the radar's bias."""
    n = len(seen.number)
    shift: FloatArray = np.zeros((n, 2))
    blur: FloatArray = np.zeros((n, 2, 2))
    if known is not None and n:
        shift, blur = known.shift(sensor, seen.x, applied=False), known.covariance(sensor, seen.x)
    return LocalTracks(seen.number, seen.target, seen.x, seen.P, shift, blur)
