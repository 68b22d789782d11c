"""Tracks of other units in our picture: what is shown of a target, and under which number."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.services.fusion.makers import (
    COASTING,
    CONFIRMED,
    EAST,
    ENDED,
    FAR_APART,
    NORTH,
    ONE,
    Fleet,
    FloatArray,
    engine,
    fleet,
    in_time_order,
    live,
    nearest,
    ns,
    scans,
)
from tests.services.fusion.units import IDENT, SIGMA_M, Sender, events, frame, run, take, unit

from trackmesh.protocol.messages import Geodetic, TrackFrame, TrackQuery
from trackmesh.services.estimation.extrapolation import extrapolate
from trackmesh.services.estimation.intersection import intersect
from trackmesh.services.fusion.engine import FusionEngine
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.snapshot import from_bytes, to_bytes

OURS = 1 << 41
"""Where the ids of ``main`` begin."""

FAR = fleet((-60e3, 10e3, 0.0, 100.0))
SHORT = NORTH.model_copy(update={"max_range_m": 50e3})
"""A radar that does not reach there."""


def main(*sensors: Any, **settings: Any) -> FusionEngine:
    return unit("main", 1, *sensors, **settings)


def ended(frames: list[TrackFrame]) -> list[int]:
    return [int(k) for f in frames for k in f.track_id[f.status == ENDED].tolist()]


def whole(frame: TrackFrame) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) of a frame."""
    return frame.state[:, :4], frame.covariance_matrices()[:, :4, :4]


def told_by(sender: Sender, *t_s: float, **change: Any) -> list[TrackFrame]:
    return [sender.at(t, **change) for t in t_s]


def every(first_s: float, last_s: float, step_s: float = 1.0) -> list[float]:
    return np.arange(first_s, last_s + 1e-9, step_s).tolist()


# --- a target that both have ---


def test_one_target_is_shown_once_as_the_intersection_of_both_estimates() -> None:
    tracker, alone = main(NORTH), engine(NORTH)
    distant = fleet((90e3, 30e3, -100.0, 40.0))
    sender = Sender(distant)
    batches = list(scans(NORTH, distant, 41.0))
    told = told_by(sender, *every(0.5, 39.5))
    run(tracker, events(batches[:-1], told))
    got = take(tracker, batches[-1])
    for batch in batches:
        plain = alone.plots(batch)
    assert got is not None and plain is not None
    last = told[-1]
    x, P = extrapolate(
        np.ascontiguousarray(last.state[:, :4]), last.covariance_matrices()[:, :4, :4], np.array([39.5]), 40.0, 100.0
    )
    own, own_P = (np.ascontiguousarray(values) for values in whole(plain))
    x, P, w = intersect(own, own_P, x, P)
    assert 0.0 < w[0] < 1.0
    assert got.track_id.tolist() == [OURS + 1]
    np.testing.assert_allclose(got.state[:, :4], x, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(whole(got)[1], P, rtol=1e-3, atol=1e-2)
    assert got.sensors == ["other", "north"]
    assert got.members[0, 0] == IDENT and got.members[0, 1] >= 0
    assert got.updated_t_ns[0] == ns(40.0) and got.first_t_ns[0] == ns(0.0)


def test_our_filter_stays_free_of_it() -> None:
    tracker, alone = main(NORTH), engine(NORTH)
    batches = list(scans(NORTH, ONE, 61.0))
    told = told_by(Sender(ONE), *every(0.5, 29.5))
    told.append(frame(30.5, np.ones((1, 4)), status=np.array([ENDED], np.uint8)))
    frames = run(tracker, events(batches, told))
    for batch in batches:
        plain = alone.plots(batch)
    assert plain is not None
    np.testing.assert_array_equal(frames[-1].state, plain.state)
    np.testing.assert_array_equal(frames[-1].covariance, plain.covariance)
    assert frames[-1].members[0, 0] == -1


def test_without_inputs_frames_are_the_same_byte_for_byte() -> None:
    plain, asked = engine(NORTH, EAST), unit("main", 3, NORTH, EAST, inputs=())
    for batch in in_time_order(scans(NORTH, FAR_APART, 30.0), scans(EAST, FAR_APART, 30.0, offset_s=0.7, seed=2)):
        one, other = plain.plots(batch), asked.plots(batch)
        assert one is not None and other is not None
        assert one == other.model_copy(update={"boot_id": "test"})


def test_a_pair_of_which_we_coast_is_confirmed_and_as_fresh_as_the_other() -> None:
    tracker = main(NORTH)
    run(tracker, events(scans(NORTH, ONE, 21.0), told_by(Sender(ONE), *every(0.5, 29.5))))
    got = take(tracker, Sender(ONE).at(30.5))
    assert got is None or got.status.tolist() == [CONFIRMED]
    assert tracker.query(TrackQuery()).updated_t_ns.tolist() == [ns(30.5)]
    # Both coast.
    for t in (31.5, 32.5):
        got = take(tracker, Sender(ONE).at(t, status=np.array([COASTING], np.uint8), updated_t_ns=np.array([ns(30.5)])))
    assert got is not None
    assert got.status.tolist() == [COASTING] and got.updated_t_ns.tolist() == [ns(30.5)]


# --- a target that only they have ---


def test_a_track_without_a_partner_is_shown_as_ours_after_some_cycles() -> None:
    tracker = main(SHORT)
    frames = run(tracker, events(scans(SHORT, ONE, 31.0), told_by(Sender(FAR), *every(0.5, 30.5))))
    shown = [f for f in frames if (f.members[:, 0] == IDENT).any()]
    assert 4.0 <= (shown[0].t_ns - ns(0.5)) / 1e9 <= 8.0
    last = shown[-1]
    k = int(np.flatnonzero(last.members[:, 0] == IDENT)[0])
    assert int(last.track_id[k]) >> 41 == 1
    assert nearest(last, FAR.at((last.t_ns - ns(0.0)) / 1e9)[0])[1] < 4 * SIGMA_M
    assert last.members[k, 1] == -1
    assert last.status[k] == CONFIRMED
    assert (last.model_probability[k] == 0.0).all()
    assert last.first_t_ns[k] == ns(0.0)
    assert last.t_ns - last.updated_t_ns[k] < 1.1e9
    assert len(live(last)) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"status": np.array([0], np.uint8)},
        {"status": np.array([COASTING], np.uint8)},
        {"sensors": ["main"]},
    ],
)
def test_tentative_and_coasting_tracks_and_echoes_are_not_shown(change: dict[str, Any]) -> None:
    tracker = main(SHORT)
    frames = run(tracker, events(scans(SHORT, ONE, 31.0), told_by(Sender(FAR, **change), *every(0.5, 30.5))))
    assert all(len(f.track_id) <= 1 for f in frames)


def test_a_track_that_its_sender_ends_ends_here_at_once() -> None:
    tracker = main()
    told = told_by(Sender(FAR), *every(0.5, 20.5))
    told.append(Sender(FAR).at(21.5, status=np.array([ENDED], np.uint8)))
    frames = run(tracker, events(told=told))
    number = live(frames[-2])
    assert len(number) == 1
    assert ended(frames) == [*number]
    assert frames[-1].members.tolist() == [[IDENT]]
    assert tracker.tick(ns(22.5)) is not None and not live(tracker.query(TrackQuery()))


def test_a_silent_unit_s_tracks_coast_and_go_and_come_back_under_their_numbers() -> None:
    tracker = main(coast_s=15.0, stitch_s=45.0)
    frames = run(tracker, events(told=told_by(Sender(FAR), *every(0.5, 20.5))))
    number = live(frames[-1])
    statuses = {}
    for t in every(21.5, 50.5):
        got = tracker.tick(ns(t))
        assert got is not None
        frames.append(got)
        statuses[t] = got.status.tolist()
    assert statuses[22.5] == [CONFIRMED] and statuses[30.5] == [COASTING]
    assert statuses[35.5] == [COASTING] and statuses[36.5] == []
    frames += run(tracker, events(told=told_by(Sender(FAR), *every(51.5, 53.5))))
    assert live(frames[-1]) == number and not ended(frames)
    # And silence for good ends it once.
    frames += [got for t in every(54.5, 140.5) if (got := tracker.tick(ns(t))) is not None]
    assert ended(frames) == [*number]
    assert ended([f for f in frames if f.t_ns < ns(53.5 + 44.0)]) == []


def test_an_old_last_plot_does_not_count_however_often_it_is_told() -> None:
    tracker = main()
    told = told_by(Sender(FAR), *every(0.5, 10.5))
    told += told_by(Sender(FAR, updated_t_ns=np.array([ns(10.5)])), *every(11.5, 60.5))
    frames = run(tracker, events(told=told))
    last_seen = max(f.t_ns for f in frames if live(f))
    assert ns(10.5 + 14.0) <= last_seen <= ns(10.5 + 15.0)


# --- numbers ---


def test_a_target_that_comes_into_our_sight_keeps_the_number_that_it_had_from_them() -> None:
    tracker = main(NORTH)
    batches = [b for b in scans(NORTH, ONE, 81.0) if b.t_ns[0] >= ns(30.0)]
    frames = run(tracker, events(batches, told_by(Sender(ONE), *every(0.5, 80.5))))
    assert live(frames[-1]) == {OURS + 1}
    assert frames[-1].members.tolist()[0][0] == IDENT and frames[-1].members[0, 1] >= 0
    assert not ended(frames)
    assert {int(k) for f in frames for k in f.track_id} == {OURS + 1}
    assert max(len(live(f)) for f in frames) == 1


def test_a_target_that_leaves_our_sight_keeps_its_number() -> None:
    tracker = main(NORTH)
    frames = run(tracker, events(scans(NORTH, ONE, 41.0), told_by(Sender(ONE), *every(0.5, 119.5))))
    assert {int(k) for f in frames for k in f.track_id} == {OURS + 1}
    assert not ended(frames)
    assert frames[-1].members.tolist() == [[IDENT, -1]]
    assert tracker.counters["handed_over"] == 1
    # And comes back into it.
    again = [b for b in scans(NORTH, ONE, 181.0, seed=4) if b.t_ns[0] >= ns(120.0)]
    frames += run(tracker, events(again, told_by(Sender(ONE), *every(120.5, 180.5))))
    assert {int(k) for f in frames for k in f.track_id} == {OURS + 1}
    assert frames[-1].members[0, 1] >= 0


def test_of_two_numbers_of_one_target_the_older_one_lives_on() -> None:
    # Our track is there first, but the sender's is 2 km off until 40 s: two targets, as far as anybody knows.
    tracker = main(NORTH, stitch_s=0.0)
    beside = Fleet(ONE.start + np.array([0.0, 2000.0]), ONE.velocity)
    told = told_by(Sender(beside), *every(10.5, 39.5)) + told_by(Sender(ONE), *every(40.5, 80.5))
    frames = run(tracker, events(scans(NORTH, ONE, 81.0), told))
    both = [f for f in frames if len(live(f)) == 2]
    assert both
    assert live(both[0]) == {OURS + 1, OURS + 2}
    assert live(frames[-1]) == {OURS + 1}
    assert ended(frames) == [OURS + 2]
    assert tracker.counters["ids_united"] == 1


def test_it_may_be_theirs() -> None:
    # Theirs is there first, and 2 km off until 80 s.
    tracker = main(NORTH, stitch_s=0.0)
    beside = Fleet(ONE.start + np.array([0.0, 2000.0]), ONE.velocity)
    told = told_by(Sender(beside), *every(0.5, 79.5)) + told_by(Sender(ONE), *every(80.5, 120.5))
    frames = run(tracker, events((b for b in scans(NORTH, ONE, 121.0) if b.t_ns[0] >= ns(30.0)), told))
    both = next(f for f in frames if len(live(f)) == 2)
    (ours,) = both.track_id[both.members[:, 1] >= 0].tolist()
    assert ours == OURS + 2
    assert live(frames[-1]) == {OURS + 1} and frames[-1].members[0, 1] >= 0
    assert ended(frames) == [OURS + 2]


def test_numbers_are_never_used_twice() -> None:
    tracker = main(stitch_s=0.0)
    frames: list[TrackFrame] = []
    for k in range(4):
        begin = 40.0 * k
        sender = Sender(FAR, track_id=np.array([IDENT + k]))
        frames += run(tracker, events(told=told_by(sender, *every(begin + 0.5, begin + 10.5))))
        frames += [got for t in every(begin + 11.5, begin + 39.5) if (got := tracker.tick(ns(t))) is not None]
    assert ended(frames) == [OURS + 1, OURS + 2, OURS + 3, OURS + 4]


# --- several inputs ---


def two_inputs(*sensors: Any, until_s: float = 60.0, from_s: float = 0.0) -> tuple[FusionEngine, list[TrackFrame]]:
    tracker = unit("main", 1, *sensors, inputs=("other", "third"))
    third = Sender(ONE, seed=6, unit_id="third", track_id=np.array([9 << 41]))
    told = told_by(Sender(ONE), *every(0.5, until_s)) + told_by(third, *every(0.8, until_s))
    batches = [b for info in sensors for b in scans(info, ONE, until_s) if b.t_ns[0] >= ns(from_s)]
    return tracker, run(tracker, events(batches, told))


def test_two_units_that_tell_of_one_target_are_one_track() -> None:
    _, frames = two_inputs()
    assert {int(k) for f in frames for k in f.track_id} == {OURS + 1}
    assert frames[-1].members.tolist() == [[IDENT, 9 << 41]]
    one, both = (np.sqrt(np.linalg.det(whole(f)[1][0, :2, :2])) for f in (Sender(ONE).at(0.0), frames[-1]))
    assert both <= one * 1.3


def test_our_own_track_joins_the_two() -> None:
    _, frames = two_inputs(NORTH, from_s=20.0)
    assert {int(k) for f in frames for k in f.track_id} == {OURS + 1}
    assert frames[-1].sensors == ["other", "third", "north"]
    assert frames[-1].members[0, :2].tolist() == [IDENT, 9 << 41] and frames[-1].members[0, 2] >= 0


def test_the_number_stays_while_any_unit_tells_of_the_target() -> None:
    tracker, frames = two_inputs(until_s=40.0)
    third = Sender(ONE, seed=6, unit_id="third", track_id=np.array([9 << 41]))
    frames += run(tracker, events(told=told_by(third, *every(40.8, 79.8))))
    assert frames[-1].members.tolist() == [[-1, 9 << 41]]
    assert {int(k) for f in frames for k in f.track_id} == {OURS + 1} and not ended(frames)


# --- heights ---


def height_and_sigma(frame: TrackFrame) -> tuple[float, float]:
    """Of the only track."""
    assert frame.height_m is not None and frame.height_variance_m2 is not None
    return float(frame.height_m.item()), float(np.sqrt(frame.height_variance_m2.item()))


def test_a_height_is_that_of_who_knows_it_better() -> None:
    height: dict[str, Any] = {"height_m": np.array([9000.0]), "height_variance_m2": np.array([50.0**2])}
    tracker = main(NORTH)
    run(tracker, events(scans(NORTH, ONE, 41.0), told_by(Sender(ONE, **height), *every(0.5, 40.5))))
    assert height_and_sigma(tracker.query(TrackQuery())) == (9000.0, 50.0)
    later = tracker.query(TrackQuery(at_t_ns=ns(50.5)))
    assert height_and_sigma(later) == pytest.approx((9000.0, np.hypot(50.0, 100.0)))
    third = Sender(ONE, unit_id="third", height_m=np.array([9100.0]), height_variance_m2=np.array([20.0**2]))
    two = unit("main", 1, inputs=("other", "third"))
    frames = run(
        two, events(told=told_by(Sender(ONE, **height), *every(0.5, 20.5)) + told_by(third, *every(0.5, 20.5)))
    )
    assert height_and_sigma(frames[-1]) == pytest.approx((9100.0, 20.0), abs=10.0)


def test_where_nobody_knows_a_height_there_is_none() -> None:
    unknown: dict[str, Any] = {"height_m": np.array([0.0]), "height_variance_m2": np.array([1e18])}
    for change in ({}, unknown):
        frames = run(main(), events(told=told_by(Sender(FAR, **change), *every(0.5, 20.5))))
        assert len(live(frames[-1])) == 1 and frames[-1].height_m is None


# --- restarts ---


def test_a_restarted_unit_goes_on_with_their_tracks_and_its_numbers() -> None:
    both = fleet((30e3, 20e3, 100.0, 40.0), (-60e3, 10e3, 0.0, 100.0), (-60e3, 40e3, 0.0, 100.0))
    tracker = main(SHORT)
    run(tracker, events(scans(SHORT, ONE, 41.0), told_by(Sender(both), *every(0.5, 20.5))))
    # The third falls silent: its number waits for it.
    two = fleet((30e3, 20e3, 100.0, 40.0), (-60e3, 10e3, 0.0, 100.0))
    before = run(tracker, events(told=told_by(Sender(two), *every(41.5, 45.5))))[-1]
    kept = tracker.snapshot()
    assert kept is not None and len(live(before)) == 2
    again = main()
    again.restore(from_bytes(to_bytes(kept)))
    for one in (tracker, again):
        told = [Sender(both, boot_id="two").at(t) for t in every(46.5, 50.5)]
        after = run(one, events(told=told))[-1]
        assert live(after) > live(before) and len(live(after)) == 3
        assert max(live(after)) == OURS + 3
    # Of an input that is no more nothing is kept.
    other = unit("main", 1, inputs=("third",))
    other.restore(kept)
    assert other.figures()["input_tracks.third"] == 0


# --- questions, and the rhythm ---


def test_questions_about_other_times_see_their_tracks_as_well() -> None:
    tracker = main()
    run(tracker, events(told=told_by(Sender(FAR), *every(0.5, 20.5))))
    for t, near_m in ((20.5, 4 * SIGMA_M), (30.5, 600.0), (10.5, 600.0)):
        got = tracker.query(TrackQuery(at_t_ns=ns(t)))
        assert len(got.track_id) == 1
        assert nearest(got, FAR.at(t)[0])[1] < near_m
    assert not len(tracker.query(TrackQuery(at_t_ns=ns(-5.0))).track_id), "it was not there yet"
    assert tracker.query(TrackQuery(bbox_enu_m=[-70e3, 0.0, -50e3, 20e3])).members.tolist() == [[IDENT]]


def test_frames_of_others_make_no_more_frames_than_a_tick() -> None:
    tracker = main(idle_frame_s=1.0)
    frames = run(tracker, events(told=told_by(Sender(FAR), *every(0.1, 20.0, 0.1))))
    assert len(frames) <= 20
    assert (np.diff([f.t_ns for f in frames]) >= 1e9).all()


def test_units_with_other_origins_fit_together() -> None:
    here, there = (Geodetic(latitude_deg=a, longitude_deg=b) for a, b in ((48.0, 11.0), (48.5, 12.0)))
    first = unit("first", 1, NORTH.model_copy(update={"site_enu_m": None, "site": here}), inputs=())
    second = unit("second", 2, inputs=("first",))
    far = unit("far", 3, NORTH.model_copy(update={"site_enu_m": None, "site": there}), inputs=("first",))
    for batch in scans(NORTH, ONE, 31.0):
        told = first.plots(batch)
        assert told is not None
        take(second, told)
        take(far, told)
    # Who has no plane of his own takes theirs.
    assert second.origin == first.origin != far.origin
    box = [47.0, 10.0, 49.0, 13.0]
    states = []
    for one in (first, second, far):
        got = one.query(TrackQuery(bbox_deg=box, at_t_ns=ns(28.0)))
        assert len(got.track_id) == 1
        states.append(got.state[0, :4])
    np.testing.assert_allclose(states[1], states[0], atol=1.0)
    assert np.linalg.norm(states[2][:2] - states[0][:2]) > 50e3


def test_settings_of_inputs_have_bounds() -> None:
    with pytest.raises(ValueError, match="input_q_m2ps3"):
        EngineSettings(input_q_m2ps3=0.0)
    with pytest.raises(ValueError, match="input_error_m"):
        EngineSettings(input_error_m=-1.0)
