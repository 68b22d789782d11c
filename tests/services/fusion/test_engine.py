from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from tests.services.estimation.makers import plain_python
from tests.services.fusion.makers import (
    COASTING,
    CONFIRMED,
    EAST,
    ENDED,
    FAR_APART,
    NORTH,
    ONE,
    TENTATIVE,
    Fleet,
    drive,
    engine,
    fleet,
    ids,
    in_time_order,
    live,
    nearest,
    ns,
    position_sensor,
    radar,
    scans,
    sector_scans,
    seen,
    short_run,
)

from trackmesh.protocol.codec import encode
from trackmesh.protocol.messages import PlotBatch, TrackFrame, TrackQuery
from trackmesh.services.fusion.association import Blur, DeclaredPairs, LocalTracks, SequentialTest


def two_radars(targets: Fleet = FAR_APART, until_s: float = 40.0, p_detect: float = 0.9) -> list[PlotBatch]:
    return in_time_order(
        scans(NORTH, targets, until_s, p_detect=p_detect),
        scans(EAST, targets, until_s, offset_s=0.7, seed=2, p_detect=p_detect),
    )


def with_clutter(batches: list[PlotBatch], per_scan: int = 20) -> list[PlotBatch]:
    rng, out = np.random.default_rng(9), []
    for b in batches:
        false = np.stack([120e3 * np.sqrt(rng.random(per_scan)), rng.uniform(0, 2 * np.pi, per_scan)], axis=1)
        both = np.concatenate([b.values, false])
        t_ns = np.full(len(both), b.t_ns.max())
        out.append(b.model_copy(update={"values": both, "t_ns": t_ns}))
    return out


# --- the same inputs give the same frames ---


def test_the_same_inputs_give_the_same_bytes() -> None:
    batches = with_clutter(two_radars(until_s=60.0))
    runs = [[encode(f) for f in drive(engine(NORTH, EAST), batches)] for _ in range(2)]
    assert len(runs[0]) == len(batches)
    assert runs[0] == runs[1]


def test_asking_changes_nothing() -> None:
    batches = with_clutter(two_radars())
    asked, left_alone = engine(NORTH, EAST), engine(NORTH, EAST)
    for b in batches:
        frame, want = asked.plots(b), left_alone.plots(b)
        assert frame is not None
        assert want is not None
        assert encode(frame) == encode(want)
        asked.query(TrackQuery(status=[0, 1, 2], at_t_ns=frame.t_ns + 10**10))
        asked.query(TrackQuery(at_t_ns=frame.t_ns - 10**10))
        asked.figures()


def test_compiled_and_plain_python_give_the_same_pictures() -> None:
    """To 1e-10, on states of 1e4 m."""
    compiled, plain = short_run(), plain_python("short_run()", "tests.services.fusion.makers")
    assert len(compiled) == len(plain) > 8
    for ours, theirs in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


# --- the life of tracks in the picture ---


def test_two_radars_make_one_track_a_target() -> None:
    frames = drive(engine(NORTH, EAST), two_radars(until_s=60.0))
    last = frames[-1]
    assert len(last.track_id) == 4
    assert last.status.tolist() == [CONFIRMED] * 4
    t_s = (last.t_ns - ns(0.0)) / 1e9
    matched = [nearest(last, place) for place in FAR_APART.at(t_s)]
    assert sorted(k for k, _ in matched) == [0, 1, 2, 3]
    assert max(d for _, d in matched) < 150
    np.testing.assert_allclose(last.state[[k for k, _ in matched], 2:4], FAR_APART.velocity, atol=12)
    whole = last.covariance_matrices()[:, :4, :4]
    assert np.all(np.linalg.eigvalsh(whole) > 0)
    np.testing.assert_allclose(last.model_probability.sum(axis=1), 1.0)


def test_frames_count_up_and_name_who_made_them() -> None:
    frames = drive(engine(NORTH, EAST), two_radars(until_s=20.0))
    assert [f.seq for f in frames] == list(range(len(frames)))
    assert all(a.t_ns <= b.t_ns for a, b in pairwise(frames))
    last = frames[-1]
    assert (last.unit_id, last.boot_id, last.sensors) == ("main", "test", ["north", "east"])
    manoeuvre = ["cv", "turn-left", "turn-right", "speed-change", "singer"]
    assert last.models == [*manoeuvre, "generic-cv", "generic-singer", "generic-rough"]
    assert set((last.track_id >> 41).tolist()) == {3}


def test_a_lost_track_coasts_and_ends_once() -> None:
    tracker = engine(NORTH)
    drive(tracker, scans(NORTH, FAR_APART, 40.0))
    picture = tracker.query(TrackQuery())
    lost = picture.track_id[nearest(picture, FAR_APART.at(36.0)[1])[0]]
    some = Fleet(FAR_APART.start[[0, 2, 3]], FAR_APART.velocity[[0, 2, 3]])
    told = []
    for t in np.arange(40.0, 80.0, 4.0).tolist():
        frame = tracker.plots(seen(NORTH, t, some.at(t), np.zeros((3, 2))))
        assert frame is not None
        told += frame.status[frame.track_id == lost].tolist()
    # The last plot came at 36 s; coasting is told after one and a half periods, the end after 15 s.
    assert told == [CONFIRMED, COASTING, COASTING, ENDED]
    assert tracker.counters["ended"] == 1
    assert len(live(tracker.query(TrackQuery()))) == 3


def test_ids_are_never_used_again() -> None:
    """Every 12 s the targets are elsewhere: in one and the same batch tracks end and new ones begin."""
    info = radar(period_s=2.0)
    tracker = engine(info, coast_s=3.0, stitch_s=0.0, publish_tentative=True)
    over: set[int] = set()
    known: set[int] = set()
    for k, t in enumerate(np.arange(0.0, 120.0, 2.0).tolist()):
        places = np.array([[20e3, 20e3], [-30e3, 10e3], [0.0, -50e3]]) * (1.0 + 0.6 * (k // 6 % 2)) + 1e3 * (k // 6)
        [frame] = drive(tracker, [seen(info, t, places, np.zeros((3, 2)))])
        assert not ids(frame) & over
        assert len(ids(frame)) == len(frame.track_id)
        known |= ids(frame, CONFIRMED)
        over |= ids(frame, ENDED)
    assert len(over) >= 24
    assert over <= known
    assert tracker.counters["confirmed"] == len(known)


def test_only_confirmed_tracks_are_shown_unless_told() -> None:
    shy, open_minded = engine(NORTH), engine(NORTH, publish_tentative=True)
    first = next(iter(scans(NORTH, FAR_APART, 4.0)))
    [hidden], [shown] = drive(shy, [first]), drive(open_minded, [first])
    assert not len(hidden.track_id)
    assert shown.status.tolist() == [TENTATIVE] * 4
    assert ids(shy.query(TrackQuery(status=[TENTATIVE]))) == ids(shown)
    frames = drive(open_minded, scans(NORTH, FAR_APART, 40.0, offset_s=4.0))
    assert not ids(frames[-1], CONFIRMED) & ids(shown), "the number of a tentative track is not that of the confirmed"


@pytest.mark.parametrize("kind", ["imm", "tvimm-dirichlet", "tvimm-paper"])
@pytest.mark.parametrize("models", [1, 2, 4])
def test_every_filter_can_be_chosen(kind: str, models: int) -> None:
    change = {"q_m2ps3": [1.0, 10.0, 50.0, 500.0][:models], "sojourn_s": [30.0] * models}
    frames = drive(engine(NORTH, filter=kind, **change), scans(NORTH, FAR_APART, 40.0))
    assert len(live(frames[-1])) == 4
    assert frames[-1].model_probability.shape == (4, models)


# --- what happened where ---


def local_members(frame: TrackFrame) -> dict[str, list[int]]:
    return {s: frame.members[:, k].tolist() for k, s in enumerate(frame.sensors)}


def test_members_are_the_local_tracks_that_took_the_same_plots() -> None:
    both = fleet((30e3, 20e3, 100, 40), (-20e3, 45e3, -60, 120))
    tracker = engine(NORTH, EAST)
    # The second target is seen by one radar alone; local tracks are numbered in the order of their first plots.
    only_first = Fleet(both.start[:1], both.velocity[:1])
    batches = in_time_order(scans(NORTH, both, 50.0), scans(EAST, only_first, 50.0, offset_s=0.7))
    last = drive(tracker, batches)[-1]
    first, second = (nearest(last, place)[0] for place in both.at(50.0))
    assert last.members[[first, second]].tolist() == [[0, 0], [1, -1]]


def test_a_member_leaves_when_its_sensor_falls_silent() -> None:
    tracker = engine(NORTH, EAST)
    drive(tracker, two_radars(until_s=40.0, p_detect=1.0))
    last = drive(tracker, scans(NORTH, FAR_APART, 80.0, offset_s=40.0))[-1]
    members = local_members(last)
    assert members["east"] == [-1] * 4
    assert -1 not in members["north"]


def test_duplicates_that_a_declared_pair_joins_become_one() -> None:
    """One target, told of by two sensors at first 4 km apart and then ever nearer, at last within their errors."""
    one, two = position_sensor("one", period_s=5.0), position_sensor("two", period_s=5.0)
    tracker = engine(one, two, cycle_s=0.2)
    frames = []
    for t in np.arange(0.0, 300.0, 5.0).tolist():
        for info, later, apart in ((one, 0.0, 0.0), (two, 2.5, 60.0 + 4000.0 * np.exp(-t / 20.0))):
            place = np.array([apart, 100.0 * (t + later)])
            frames += drive(tracker, [seen(info, t + later, place, np.zeros((1, 2)))])
            # Association cycles between batches, too.
            frames += [f for wait in (0.25, 1.25, 2.25) if (f := tracker.tick(ns(t + later + wait))) is not None]
    two_tracks = next(ids(f) for f in frames if len(live(f)) == 2)
    assert tracker.counters["merged"] == 1
    ended = [f for f in frames if ids(f, ENDED)]
    assert len(ended) == 1
    assert ids(ended[0], ENDED) == {max(two_tracks)}, "the older track lives on"
    assert live(ended[0]) == live(frames[-1]) == {min(two_tracks)}
    after = frames[frames.index(ended[0]) + 1 :]
    assert all(-1 not in f.members for f in after), "the members of both are members now"
    assert tracker.figures()["pairs"] == 1


@pytest.mark.parametrize("seen_by_both", [True, False])
def test_a_declared_pair_does_not_overrule_the_plots(seen_by_both: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrong pair of two targets: both sensors hold a member in each, or the two are far apart."""

    def wrong(_: SequentialTest, a: LocalTracks, b: LocalTracks, t_s: float, blur: Blur | None) -> DeclaredPairs:
        found = int(len(a.number) > 0 and len(b.number) > 0)
        return DeclaredPairs(np.zeros(found, np.int64), np.full(found, len(b.number) - 1), np.ones(found))

    monkeypatch.setattr(SequentialTest, "cycle", wrong)
    pair = fleet((30e3, 20e3, 100, 40), (30.6e3 if seen_by_both else 60e3, 20e3, 100, 40))
    first, second = (Fleet(pair.start[k : k + 1], pair.velocity[k : k + 1]) for k in (0, 1))
    if seen_by_both:
        first = second = pair
    tracker = engine(NORTH, EAST, registration=False)  # the wrong pairs would teach it wrong biases
    frames = drive(tracker, in_time_order(scans(NORTH, first, 60.0), scans(EAST, second, 60.0, offset_s=0.7)))
    assert tracker.counters["merged"] == 0
    assert tracker.counters["contradictions"] > 5
    assert len(live(frames[-1])) == 2


def test_two_targets_in_formation_are_not_merged() -> None:
    pair = fleet((30e3, 20e3, 100, 40), (30.6e3, 20e3, 100, 40))
    tracker = engine(NORTH, EAST)
    frames = drive(tracker, two_radars(pair, until_s=100.0))
    assert tracker.counters["merged"] == 0
    assert len(live(frames[-1])) == 2


def test_a_position_sensor_is_blamed_only_for_what_it_has_seen() -> None:
    """A fast sensor that looks elsewhere must not kill the new tracks of a slow one."""
    fast = position_sensor(period_s=0.5)
    elsewhere = scans(fast, fleet((-60e3, -60e3, 0, 0)), 40.0, offset_s=0.1)
    tracker = engine(NORTH, fast)
    last = drive(tracker, in_time_order(scans(NORTH, ONE, 40.0), elsewhere))[-1]
    assert nearest(last, ONE.at(40.0)[0])[1] < 500
    assert tracker.counters["confirmed"] == 2


def test_a_track_through_north_stays_one(sectors: int = 32) -> None:
    """Tracks to and fro over azimuth zero, where a turn begins and ends."""
    crossing = fleet((-6e3, 40e3, 200, 0), (8e3, 60e3, -220, 0), (-4e3, 25e3, 150, -50))
    tracker = engine(NORTH)
    frames = drive(tracker, sector_scans(NORTH, crossing, 80.0, sectors))
    settled = [f for f in frames if f.t_ns > ns(20.0)]
    assert {len(live(f)) for f in settled} == {3}
    assert len(set.union(*(live(f) for f in settled))) == 3
    assert tracker.counters["confirmed"] == 3
    assert all(set(f.status.tolist()) == {CONFIRMED} for f in settled)


def test_whole_turns_and_sectors_give_one_picture() -> None:
    whole = drive(engine(NORTH), sector_scans(NORTH, FAR_APART, 60.0, 1))[-1]
    parts = drive(engine(NORTH), sector_scans(NORTH, FAR_APART, 60.0, 16))[-1]
    assert len(whole.track_id) == len(parts.track_id) == 4
    for place in FAR_APART.at(60.0):
        (i, _), (j, _) = nearest(whole, place), nearest(parts, place)
        assert np.linalg.norm(whole.state[i, :2] - parts.state[j, :2]) < 30


# --- late plots ---


def test_a_late_batch_gives_what_it_would_have_given_in_time() -> None:
    batches = two_radars(until_s=40.0, p_detect=1.0)
    late = [*batches[:10], *batches[11:13], batches[10], *batches[13:]]
    in_time, swapped = (engine(NORTH, EAST, registration=False) for _ in range(2))
    last, other = drive(in_time, batches)[-1], drive(swapped, late)[-1]
    assert in_time.counters == swapped.counters
    assert np.array_equal(last.state, other.state)
    assert np.array_equal(last.track_id, other.track_id)


@pytest.mark.parametrize(("late_s", "dropped"), [(9.9, 0), (10.1, 4)])
def test_plots_beyond_the_lateness_bound_are_dropped_and_counted(late_s: float, dropped: int) -> None:
    tracker = engine(NORTH, EAST, max_lateness_s=10.0)
    drive(tracker, scans(NORTH, FAR_APART, 41.0))
    before = tracker.query(TrackQuery())
    taken = tracker.counters["plots"]
    [after] = drive(tracker, [seen(EAST, 40.0 - late_s, FAR_APART.at(40.0 - late_s), np.zeros((4, 2)))])
    assert tracker.counters["too_late_plots"] == dropped
    assert tracker.counters["plots"] == taken + 4
    assert after.t_ns == before.t_ns
    assert np.array_equal(after.state, before.state) == bool(dropped)


def test_of_a_batch_only_the_plots_that_are_too_late_are_dropped() -> None:
    tracker = engine(NORTH)
    drive(tracker, scans(NORTH, FAR_APART, 41.0))
    t = np.array([25.0, 29.0, 39.0, 41.0])
    drive(tracker, [seen(NORTH, t, FAR_APART.at(t), np.zeros((4, 2)))])
    # Time goes on to 41 s by the batch itself.
    assert tracker.counters["too_late_plots"] == 2


# --- time without plots ---


def test_ticks_alone_make_tracks_coast_and_end() -> None:
    tracker = engine(NORTH, EAST, idle_frame_s=1.0, stitch_s=0.0)
    drive(tracker, two_radars(until_s=40.0, p_detect=1.0))
    told: list[tuple[int, ...]] = []
    for t in np.arange(40.0, 70.0, 0.25).tolist():
        frame = tracker.tick(ns(t))
        if frame is not None:
            told.append(tuple(sorted(set(frame.status.tolist()))))
    assert len(told) == 30, "a frame a second"
    assert [*dict.fromkeys(told)] == [(CONFIRMED,), (COASTING,), (ENDED,), ()]
    assert told.count((ENDED,)) == 1
    assert not any(tracker.figures().values())


def test_time_never_runs_back() -> None:
    tracker = engine(NORTH)
    assert tracker.now_ns is None
    tracker.tick(ns(50.0))
    tracker.tick(ns(20.0))
    assert tracker.now_ns == ns(50.0)
    drive(tracker, scans(NORTH, FAR_APART, 61.0, offset_s=44.0))
    assert tracker.now_ns == ns(60.0)


def test_frames_are_no_closer_than_asked() -> None:
    tracker = engine(NORTH, EAST, frame_period_s=3.0)
    times = [f.t_ns for f in drive(tracker, two_radars(until_s=60.0))]
    assert min(b - a for a, b in pairwise(times)) >= 3 * 10**9
    assert len(times) >= 12


def test_an_end_between_two_frames_is_told_in_the_next() -> None:
    tracker = engine(NORTH, frame_period_s=30.0, idle_frame_s=30.0)
    drive(tracker, scans(NORTH, ONE, 25.0))
    shown = ids(tracker.query(TrackQuery()))
    frames = [f for t in range(25, 130) if (f := tracker.tick(ns(t))) is not None]
    assert [ids(f, ENDED) for f in frames if len(f.track_id)][-1] == shown
    assert sum(len(ids(f, ENDED)) for f in frames) == 1
