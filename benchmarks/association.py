"""The tests between local tracks: milliseconds an association cycle of two radars, without making the tracks.

python -m benchmarks.association       beside Stone Soup's TrackToTrackCounting, which takes whole tracks at once
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import numpy as np
import stonesoup
from stonesoup.dataassociator.tracktotrack import TrackToTrackCounting
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.pairs import PairRules
from trackmesh.services.fusion.association import LocalTracks
from trackmesh.services.fusion.pair_tests import TestName, make_test
from trackmesh.sim.studies.association.stress.cases import Case
from trackmesh.sim.studies.association.stress.local_tracks import Recording, Seen, record
from trackmesh.sim.studies.association.stress.methods import ALPHA, raw_tracks

SIZES = {20: 40.0, 80: 40.0, 500: 20.0, 2000: 20.0}
"""Seconds of each number of targets, after the warm-up of 20 s."""

NAMES: tuple[TestName, ...] = ("gnn", "paper-sequential", "seqllr")
REPEATS = 3
PEER_TARGETS = 20
NEAR_M = 1_000.0


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``: the median cycle, and the whole run of few targets beside the peer."""
    for targets, duration_s in SIZES.items():
        recording = record(Case("bench", targets, duration_s=duration_s), 1)
        moments = [
            (raw_tracks(m.a, None, ""), raw_tracks(m.b, None, ""), m.t_s) for m in recording.moments if len(m.a.number)
        ]
        peer_ms = _peer_ms(recording) if targets == PEER_TARGETS else None
        for name in NAMES:
            spent = np.array([_cycles_ms(name, moments) for _ in range(REPEATS + 1)][1:])
            middle = np.median(spent, axis=1)
            case = f"N={targets} {name}"
            spread = f"min {middle.min():.2f}, max {middle.max():.2f}"
            print(f"association {case}: {np.median(middle):.2f} ms a cycle ({spread})")
            yield _row(case, float(np.median(middle)), "ms/cycle", None)
            if peer_ms is not None:
                total = float(np.median(spent.sum(axis=1)))
                print(f"association {case}, {len(moments)} cycles: {total:.1f} ms, Stone Soup {peer_ms:.0f} ms")
                yield _row(f"{case}, {len(moments)} cycles", total, "ms", peer_ms)


def _cycles_ms(name: TestName, moments: list[tuple[LocalTracks, LocalTracks, float]]) -> FloatArray:
    """Milliseconds of each cycle."""
    test, spent = make_test(name, PairRules(), ALPHA), []
    for a, b, t_s in moments:
        started = time.perf_counter()
        test.cycle(a, b, t_s)
        spent.append(1e3 * (time.perf_counter() - started))
    return np.array(spent)


def _peer_ms(recording: Recording) -> float:
    """Milliseconds of Stone Soup's counting technique over the same tracks, positions within a kilometre."""
    first, second = (_peer_tracks(side) for side in _sides(recording))
    counting = TrackToTrackCounting(association_threshold=NEAR_M, pos_map=[0, 1], use_positional_only=True)
    spent = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        counting.associate_tracks(first, second)
        spent.append(1e3 * (time.perf_counter() - started))
    return float(np.median(spent))


def _sides(recording: Recording) -> tuple[list[tuple[float, Seen]], list[tuple[float, Seen]]]:
    return [(m.t_s, m.a) for m in recording.moments], [(m.t_s, m.b) for m in recording.moments]


def _peer_tracks(side: list[tuple[float, Seen]]) -> set[Track]:
    begin, states = datetime(2026, 1, 1, tzinfo=UTC), dict[int, list[GaussianState]]()
    for t_s, seen in side:
        at = begin + timedelta(seconds=t_s)
        for number, x, P in zip(seen.number.tolist(), seen.x, seen.P, strict=True):
            states.setdefault(number, []).append(GaussianState(x[:, None], P, timestamp=at))
    return {Track(known) for known in states.values()}


def _row(case: str, value: float, unit: str, peer_ms: float | None) -> dict[str, object]:
    known = peer_ms is not None
    return {
        "bench": "association", "case": case, "value": value, "unit": unit,
        "peer": f"Stone Soup {stonesoup.__version__} TrackToTrackCounting" if known else None,
        "peer_value": peer_ms, "ratio": value / peer_ms if peer_ms is not None else None,
    }  # fmt: skip


if __name__ == "__main__":
    for _ in rows():
        pass
