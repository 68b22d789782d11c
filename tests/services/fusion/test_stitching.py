"""Identity through gaps: who may take over whose number, and when a lost track has ended for good."""

from __future__ import annotations

import numpy as np
import pytest
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    ONE,
    Fleet,
    FloatArray,
    drive,
    engine,
    ids,
    in_time_order,
    live,
    ns,
    scans,
    seen,
)

from trackmesh.protocol.messages import ENDED, PlotBatch, TrackFrame
from trackmesh.services.fusion.engine import FusionEngine

GAP = (40.0, 58.0)


def through_a_gap(tracker: FusionEngine) -> tuple[set[int], list[TrackFrame]]:
    """Two radars are silent for a while, in which the clock goes on: the tracks before it, and the frames after it."""
    until_s = 90.0
    batches = in_time_order(scans(NORTH, FAR_APART, until_s), scans(EAST, FAR_APART, until_s, offset_s=0.7, seed=2))
    before = drive(tracker, (b for b in batches if b.t_ns[0] < ns(GAP[0])))
    told = [frame for t in np.arange(*GAP).tolist() if (frame := tracker.tick(ns(t))) is not None]
    return live(before[-1]), told + drive(tracker, (b for b in batches if b.t_ns[0] >= ns(GAP[1])))


def ended(frames: list[TrackFrame]) -> list[int]:
    return [int(k) for f in frames for k in f.track_id[f.status == ENDED].tolist()]


def test_targets_keep_their_numbers_through_a_silence_of_all_sensors() -> None:
    tracker = engine(NORTH, EAST)
    before, frames = through_a_gap(tracker)
    assert len(before) == 4
    assert live(frames[-1]) == before
    assert not ended(frames)
    assert tracker.counters["stitched"] == 4
    # Frames tell when each track began, gap or not.
    assert (frames[-1].first_t_ns < ns(GAP[0])).all()


def test_stitching_can_be_switched_off() -> None:
    tracker = engine(NORTH, EAST, stitch_s=0.0)
    before, frames = through_a_gap(tracker)
    assert live(frames[-1]).isdisjoint(before)
    assert set(ended(frames)) == before


def test_what_is_not_found_again_is_told_to_have_ended_once_and_its_number_is_gone() -> None:
    tracker = engine(NORTH, coast_s=15.0, stitch_s=40.0)
    frames = drive(tracker, scans(NORTH, ONE, 40.0))
    (number,) = live(frames[-1])
    told = [frame for t in range(41, 120) if (frame := tracker.tick(ns(t))) is not None]
    last = {s: [f.t_ns for f in told if number in ids(f, s)] for s in (1, 2, 3)}
    assert ns(50.0) <= max(last[1] + last[2]) <= ns(53.0), "it leaves the picture after coast_s"
    assert len(last[3]) == 1
    assert ns(75.0) <= last[3][0] <= ns(79.0), "and has ended after stitch_s"
    assert tracker.counters["ended"] == 1


def returning(place: FloatArray, velocity: FloatArray, t_s: FloatArray) -> list[PlotBatch]:
    rng = np.random.default_rng(9)
    return [
        seen(NORTH, t, (place + (t - t_s[0]) * velocity)[None], rng.standard_normal((1, 2)), seq=1000 + k)
        for k, t in enumerate(t_s.tolist())
    ]


@pytest.mark.parametrize(
    ("aside_m", "backwards", "same"), [(0.0, False, True), (12e3, False, False), (0.0, True, False)]
)
def test_who_comes_back_elsewhere_or_flies_the_other_way_is_another(
    aside_m: float, backwards: bool, same: bool
) -> None:
    tracker = engine(NORTH)
    (number,) = live(drive(tracker, scans(NORTH, ONE, 41.0))[-1])
    t_s = np.arange(60.0, 90.0, 4.0)
    place = ONE.at(60.0)[0] + [0.0, aside_m]
    frames = drive(tracker, returning(place, ONE.velocity[0] * (-1.0 if backwards else 1.0), t_s))
    assert (number in live(frames[-1])) == same


def test_a_new_track_beside_one_that_is_seen_takes_nothing() -> None:
    """The old one must have been without plots since before the new one began."""
    tracker = engine(NORTH)
    drive(tracker, scans(NORTH, ONE, 60.0))
    both = Fleet(np.vstack([ONE.start, ONE.start + np.array([0.0, 1500.0])]), np.vstack([ONE.velocity] * 2))
    frames = drive(tracker, (b for b in scans(NORTH, both, 120.0, seed=5) if b.t_ns[0] >= ns(60.0)))
    assert len(live(frames[-1])) == 2
    assert tracker.counters["stitched"] == 0


def test_a_coasting_track_hands_its_number_to_the_one_that_goes_on_from_it() -> None:
    """It turned so hard that its plots fell out of the gate: a new track, and no second one for the same target."""
    tracker = engine(NORTH, coast_s=60.0, gate=4.0, stitch_s=60.0, end_fall=1000.0)
    (number,) = live(drive(tracker, scans(NORTH, ONE, 41.0))[-1])
    t_s = np.arange(44.0, 72.0, 4.0)
    frames = drive(tracker, returning(ONE.at(44.0)[0] + [400.0, 300.0], ONE.velocity[0], t_s))
    assert live(frames[-1]) == {number}
    assert not ended(frames)
