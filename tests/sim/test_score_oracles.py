"""OSPA, GOSPA with switching and SIAP against those of Stone Soup on the same data."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import pytest

from trackmesh.protocol.messages import TrackFrame, TruthFrame
from trackmesh.sim.metrics import Followers, gospa_with_switching, match, ospa
from trackmesh.sim.recording import START_NS
from trackmesh.sim.scoring import Scorer, score_run

pytest.importorskip("stonesoup")

from stonesoup.dataassociator.tracktotrack import TrackToTruth
from stonesoup.measures import Euclidean
from stonesoup.metricgenerator.manager import SimpleManager
from stonesoup.metricgenerator.ospametric import GOSPAMetric, OSPAMetric
from stonesoup.metricgenerator.tracktotruthmetrics import SIAPMetrics
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.state import State
from stonesoup.types.track import Track

C_M, SWITCH_M, STEP_S = 300.0, 120.0, 2.0
BEGIN = datetime(2030, 1, 1)
MakeFrame = Callable[..., TrackFrame]
Moment = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Ids and states (n, 4) of the targets, ids and states of the tracks."""


def when(step: int) -> datetime:
    return BEGIN + timedelta(seconds=STEP_S * step)


def crowd(seed: int, steps: int = 25) -> list[Moment]:
    """Targets close together that come and go, tracks that miss them, swap and are false."""
    rng, moments = np.random.default_rng(seed), []
    begin, end = rng.integers(0, 8, 9), rng.integers(15, steps + 1, 9)
    place, velocity = rng.uniform(-600, 600, (9, 2)), rng.uniform(-15, 15, (9, 2))
    for k in range(steps):
        there = np.flatnonzero((begin <= k) & (k < end))
        states = np.concatenate([place + STEP_S * k * velocity, velocity], axis=1)
        seen = there[rng.random(len(there)) < 0.85]
        ids = np.where((seen % 3 == 0) & (k > 12), seen + 20, seen)
        tracks = states[seen] + rng.normal(0, [90, 90, 4, 4], (len(seen), 4))
        false = rng.integers(0, 3)
        tracks = np.concatenate([tracks, rng.uniform(-600, 600, (false, 4))])
        moments.append((there, states[there], np.concatenate([ids, 90 + np.arange(false)]), tracks))
    return moments


def calm(seed: int, steps: int = 30) -> list[Moment]:
    """Targets far apart, each followed for a while by one track, another, two, or none; one track follows nobody."""
    follows = {
        0: [(0, 30, 10)], 1: [(2, 12, 11), (12, 30, 12)], 2: [(3, 20, 13), (14, 30, 14)],
        3: [(5, 11, 15), (18, 25, 16)], 4: [],
    }  # fmt: skip
    lives = {0: (0, 30), 1: (0, 30), 2: (0, 30), 3: (4, 27), 4: (10, 20)}
    rng, moments = np.random.default_rng(seed), []
    for k in range(steps):
        there = np.array([t for t, (a, b) in lives.items() if a <= k < b])
        states = np.stack([[5e3 * t + 20.0 * k, 40.0 * k, 10.0, 20.0] for t in there])
        ids, tracks = [77], [np.array([2e3 + 3.0 * k, -4e3, 1.0, 1.0])]
        for t, state in zip(there, states, strict=True):
            for a, b, track in follows[int(t)]:
                if a <= k < b:
                    ids.append(track)
                    tracks.append(state + rng.normal(0, [40, 40, 3, 3]))
        moments.append((there, states, np.array(ids), np.stack(tracks)))
    return moments


def paths_and_tracks(moments: list[Moment]) -> tuple[set[Any], set[Any]]:
    paths: dict[int, Any] = {}
    tracks: dict[int, Any] = {}
    for k, (ids, states, track_ids, found) in enumerate(moments):
        for target, state in zip(ids.tolist(), states, strict=True):
            paths.setdefault(target, GroundTruthPath()).append(GroundTruthState(state, timestamp=when(k)))
        for track, state in zip(track_ids.tolist(), found, strict=True):
            tracks.setdefault(track, Track()).append(State(state, timestamp=when(k)))
    return set(paths.values()), set(tracks.values())


def position(generator: type[Any], p: float, **words: Any) -> Any:
    return generator(c=C_M, p=p, measure=Euclidean(mapping=[0, 1]), **words)


@pytest.mark.parametrize("seed", range(4))
def test_ospa_and_gospa_with_switching(seed: int) -> None:
    moments, followers = crowd(seed), Followers()
    states = [State(s, timestamp=when(k)) for k, (_, _, _, every) in enumerate(moments) for s in every]
    truth = [State(s, timestamp=when(k)) for k, (_, every, _, _) in enumerate(moments) for s in every]
    ids = np.concatenate([m[2] for m in moments]).tolist()
    truth_ids = np.concatenate([m[0] for m in moments]).tolist()
    generator = position(GOSPAMetric, 2, switching_penalty=SWITCH_M)
    gospa = {m.timestamp: m.value for m in generator.compute_over_time(states, ids, truth, truth_ids).value}
    # For p = 2 it pairs by distances, not by their squares; then it is not the least.
    first, second = (position(OSPAMetric, p).compute_over_time(states, ids, truth, truth_ids).value for p in (1, 2))
    by_p = [{m.timestamp: m.value for m in every} for every in (first, second)]
    changes = 0.0
    for k, (target_ids, target_states, track_ids, tracks) in enumerate(moments):
        if not len(target_ids) and not len(track_ids):
            continue
        best = match(target_states[:, :2], tracks[:, :2], C_M)
        parts = best.gospa()
        switched = followers.step(target_ids, target_ids[best.target], track_ids[best.track]).assignments
        theirs = gospa[when(k)]
        assert gospa_with_switching(parts, switched, SWITCH_M) == pytest.approx(theirs["distance"], rel=1e-9)
        assert np.sqrt(switched) * SWITCH_M == pytest.approx(theirs["switching"])
        ours = (parts.localisation, parts.missed * C_M**2 / 2, parts.false * C_M**2 / 2)
        assert ours == pytest.approx((theirs["localisation"], theirs["missed"], theirs["false"]), rel=1e-9)
        assert ospa(target_states[:, :2], tracks[:, :2], C_M, 1.0) == pytest.approx(by_p[0][when(k)], rel=1e-9)
        assert best.ospa() <= by_p[1][when(k)] * (1.0 + 1e-9)
        changes += switched
    assert changes > 5.0


def scored(moments: list[Moment], frame: MakeFrame) -> Scorer:
    start_ns = START_NS
    frames = [frame(STEP_S * k, ids, states) for k, (_, _, ids, states) in enumerate(moments)]
    truth = [
        TruthFrame(scenario_id="s", t_ns=start_ns + round(STEP_S * k * 1e9), id=ids, state=states)
        for k, (ids, states, _, _) in enumerate(moments)
    ]
    return score_run(frames, truth, C_M, 0.0)


@pytest.mark.parametrize("moments", [calm(1), calm(2)], ids=["1", "2"])
def test_siap(moments: list[Moment], frame: MakeFrame) -> None:
    paths, tracks = paths_and_tracks(moments)
    places, velocities = Euclidean(mapping=[0, 1]), Euclidean(mapping=[2, 3])
    near = TrackToTruth(
        association_threshold=C_M, consec_pairs_confirm=1, consec_misses_end=1, measure=Euclidean(mapping=[0, 1])
    )
    manager = SimpleManager([SIAPMetrics(position_measure=places, velocity_measure=velocities)], associator=near)
    manager.add_data(paths, tracks)
    found = manager.generate_metrics()
    theirs = {metric.title: metric.value for metric in found.values()}
    scorer = scored(moments, frame)
    ours = scorer.summary()
    assert ours.siap_completeness == pytest.approx(theirs["SIAP Completeness"])
    assert ours.siap_ambiguity == pytest.approx(theirs["SIAP Ambiguity"])
    assert ours.siap_spuriousness == pytest.approx(theirs["SIAP Spuriousness"])
    assert ours.siap_position_m == pytest.approx(theirs["SIAP Position Accuracy"])
    assert ours.siap_velocity_mps == pytest.approx(theirs["SIAP Velocity Accuracy"])
    assert ours.siap_longest_segment == pytest.approx(theirs["SIAP Longest Track Segment"])
    assert ours.siap_changes_per_h == pytest.approx(3600.0 * theirs["SIAP Rate of Track Number Change"])
    assert ours.siap_number_changes == 3
    at_times = {
        "Completeness": "siap_completeness", "Ambiguity": "siap_ambiguity", "Spuriousness": "siap_spuriousness",
        "Position Accuracy": "siap_position_m", "Velocity Accuracy": "siap_velocity_mps",
    }  # fmt: skip
    for title, name in at_times.items():
        values = [metric.value for metric in theirs[f"SIAP {title} at times"]]
        assert [getattr(score, name) for score in scorer.scores] == pytest.approx(values), name
