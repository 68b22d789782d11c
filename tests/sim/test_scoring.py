from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import TrackFrame, TruthFrame
from trackmesh.sim.coverage import Coverage, picture_at_end
from trackmesh.sim.radar import sensor_info
from trackmesh.sim.recording import START_NS, recorded_truth
from trackmesh.sim.scenario import Scenario
from trackmesh.sim.scoring import Scorer, TruthTimeline, picture, score_nearest, score_tracks
from trackmesh.sim.truth import World, make_truth

MakeFrame = Callable[..., TrackFrame]


def truth_at(t_s: float, ids: list[int], states: object) -> TruthFrame:
    t_ns = START_NS + round(t_s * 1e9)
    return TruthFrame(scenario_id="s", t_ns=t_ns, id=np.array(ids), state=np.array(states, float).reshape(-1, 4))


def imperfect(scenario: Scenario, make: MakeFrame, duration_s: float) -> list[TrackFrame]:
    """Frames with noise, missed targets, false tracks and changes of identity."""
    truth, rng, frames = make_truth(scenario, 1), np.random.default_rng(3), []
    for t_s in np.arange(3.3, duration_s, 4.7):
        ids, states = truth.state_at(t_s)
        seen = rng.random(len(ids)) < 0.9
        tracks = np.where((ids % 5 == 0) & (t_s > 70.0), ids + 100, ids)[seen]
        moved = states[seen] + np.concatenate([rng.normal(0, 60, (2, seen.sum())), np.zeros((2, seen.sum()))]).T
        false = rng.integers(0, 3)
        moved = np.concatenate([moved, rng.uniform(-4e4, 4e4, (false, 4))])
        frames.append(make(t_s, np.concatenate([tracks, 900 + rng.integers(0, 50, false)]), moved, sigma_m=60.0))
    return frames


def test_the_same_scores_as_the_peers_were_measured_with(peers: Path, two_radars: Scenario, frame: MakeFrame) -> None:
    spec = importlib.util.spec_from_file_location("peers_score", peers / "score.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    truth = list(recorded_truth(two_radars, 1, duration_s=160.0))
    frames, timeline = imperfect(two_radars, frame, 150.0), TruthTimeline(truth)

    class Reference:
        """The scenario as the peers' scoring wants it: all targets, always there."""

        @staticmethod
        def truth_at(t_s: float) -> np.ndarray:
            found = timeline.at(START_NS + round(t_s * 1e9))
            assert found is not None
            return np.asarray(found[1][:, [0, 2, 1, 3]])

    triples = [((f.t_ns - START_NS) * 1e-9, f.track_id, f.state[:, :2]) for f in frames]
    assert {len(timeline.at(f.t_ns)[0]) for f in frames} == {40}  # type: ignore[index]
    expected = module.score(triples, Reference, warmup_s=40.0, c=1000.0)
    got = score_tracks(frames, truth, 1000.0, 40.0)
    for name in ("gospa_m", "ospa_m", "missed", "false", "rmse_m"):
        assert getattr(got, name) == pytest.approx(expected[name], rel=1e-10), name
    assert got.frames == expected["frames"]
    assert got.id_switches == expected["id_switches"] > 0


def test_a_consistent_filter_has_nees_two(two_radars: Scenario, frame: MakeFrame) -> None:
    frames = imperfect(two_radars, frame, 150.0)
    got = score_tracks(frames, recorded_truth(two_radars, 1, duration_s=160.0))
    assert got.nees == pytest.approx(2.0, abs=0.2)
    assert got.within_95 == pytest.approx(0.95, abs=0.02)
    assert got.coverage == pytest.approx(0.9, abs=0.03)
    assert got.rmse_velocity_mps < 1.5  # the truth's velocity, between its frames
    assert got.rmse_m == pytest.approx(np.sqrt(2) * 60.0, rel=0.05)
    assert got.gospa_m**2 == pytest.approx(got.localisation_m2 + (got.missed + got.false) * 1000.0**2 / 2, rel=0.1)


def test_between_its_frames_the_truth_is_a_cubic(two_radars: Scenario) -> None:
    world = World(two_radars, 1)
    timeline = TruthTimeline(recorded_truth(two_radars, 1, duration_s=60.0))
    for t_s in (0.0, 0.2, 7.77, 31.25, 60.0):
        found, exact = timeline.at(START_NS + round(t_s * 1e9)), world.truth(60.0).state_at(t_s)
        assert found is not None
        np.testing.assert_array_equal(found[0], exact.ids)
        np.testing.assert_allclose(found[1][:, :2], exact.states[:, :2], atol=0.5)
        np.testing.assert_allclose(found[1][:, 2:], exact.states[:, 2:], atol=3.5)
    assert timeline.at(START_NS - 1) is None
    assert timeline.at(START_NS + 60 * 10**9 + 1) is None


def test_a_target_that_is_in_one_frame_only_is_not_there_between() -> None:
    timeline = TruthTimeline([truth_at(1, [2, 3], [[0] * 4] * 2), truth_at(0, [1, 2], [[0] * 4] * 2)])
    between = timeline.at(START_NS + 5 * 10**8)
    assert between is not None
    assert between[0].tolist() == [2]


def test_tentative_and_ended_tracks_are_not_shown(frame: MakeFrame) -> None:
    shown = picture(frame(0.0, [1, 2, 3, 4], np.zeros((4, 4)), status=[0, 1, 2, 3]))
    assert shown.track_id.tolist() == [2, 3]
    assert shown.coasting.tolist() == [False, True]
    np.testing.assert_allclose(shown.covariance_m2, [np.eye(2) * 2500.0] * 2)


def test_frames_outside_the_truth_are_counted_and_left_out(frame: MakeFrame) -> None:
    truth = [truth_at(t, [1], [[0.0, 10.0 * t, 0.0, 10.0]]) for t in range(11)]
    done: list[int] = []
    frames = [frame(t, [5], [[0.0, 10.0 * t, 0.0, 10.0]]) for t in (-1, 2, 4.5, 9, 12)]
    got = score_tracks(frames, truth, warmup_s=3.0, progress=done.append)
    assert (got.frames, got.without_truth, got.tracks) == (2, 2, 1)
    assert got.rmse_m == pytest.approx(0.0, abs=1e-9)
    assert done == [1, 2, 3, 4, 5]
    assert got.as_dict()["gospa_m"] == got.gospa_m


def test_the_warm_up_tells_who_was_last(frame: MakeFrame) -> None:
    truth = [truth_at(t, [1], [[0.0] * 4]) for t in range(11)]
    frames = [frame(t, [track], [[0.0] * 4]) for t, track in ((1, 5), (2, 6), (4, 7), (5, 7))]
    assert score_tracks(frames, truth, warmup_s=3.0).id_switches == 1
    assert score_tracks(frames, truth, warmup_s=0.0).id_switches == 2


def test_nothing_to_score_gives_no_numbers_but_no_error(frame: MakeFrame) -> None:
    scorer = Scorer(TruthTimeline([truth_at(0, [], [])]), warmup_s=0.0)
    empty = scorer.summary()
    assert empty.frames == 0
    assert np.isnan(empty.gospa_m)
    assert np.isnan(empty.rmse_m)
    score = scorer.add(frame(0.0, [], np.zeros((0, 4))))
    assert score is not None
    assert score.gospa_m == 0.0
    with pytest.raises(TrackmeshError, match="no frame"):
        score_tracks([], [])


def test_the_nearest_score_lets_one_track_serve_two_targets(frame: MakeFrame) -> None:
    truth = [truth_at(t, [1, 2], [[0, 0, 0, 0], [20.0, 0, 0, 0]]) for t in (0, 1)]
    got = score_nearest([frame(0.4, [5], [[5.0, 0, 0, 0]]), frame(2.0, [], np.zeros((0, 4)))], truth, 30.0)
    assert (got.frames, got.tracks) == (2, 1)
    assert got.coverage == 0.5
    assert got.rmse_m == pytest.approx(np.sqrt((25 + 225) / 2))
    assert got.gospa_m == pytest.approx((np.sqrt(25 + 450) + np.sqrt(900)) / 2)
    assert got.false == 0.0


def test_the_picture_at_the_end(two_radars: Scenario, frame: MakeFrame) -> None:
    truth = TruthTimeline(recorded_truth(two_radars, 1, duration_s=60.0))
    coverage = Coverage.of(sensor_info(two_radars, radar) for radar in two_radars.radars)
    whole = make_truth(two_radars, 1, 60.0)
    quiet = whole.ids[whole.quiet].tolist()

    def frames(switch: int, drop: int, double: int) -> list[TrackFrame]:
        made = []
        for t_s in np.arange(20.0, 60.0, 0.5):
            ids, states = whole.state_at(t_s)
            tracks = np.where((ids == switch) & (t_s > 50.0), 500, ids)
            kept = ids != drop
            extra = states[ids == double] + [[30.0, 0.0, 0.0, 0.0]]
            tracks = np.concatenate([tracks[kept], np.full(len(extra), 600)])
            made.append(frame(t_s, tracks, np.concatenate([states[kept], extra])))
        return made

    good = picture_at_end(frames(0, 0, 0), truth, coverage, quiet)
    assert (good.targets, good.tracked_once, good.share, good.stray_tracks) == (40, 40, 1.0, 0)
    assert (good.quiet_targets, good.quiet_switches) == (10, 0)
    bad = picture_at_end(frames(quiet[0], 3, 5), truth, coverage, quiet)
    assert (bad.targets, bad.tracked_once, bad.quiet_switches) == (40, 38, 1)
    turning = picture_at_end(frames(1, 0, 0), truth, coverage, quiet)
    assert (turning.quiet_switches, turning.share) == (0, 1.0)
    blind = picture_at_end(frames(0, 0, 0), truth, Coverage(np.zeros((1, 2)), np.ones(1)), quiet)
    assert blind.targets == 0
    assert np.isnan(blind.share)
    with pytest.raises(TrackmeshError, match="within the time of the truth"):
        picture_at_end([frame(99.0, [1], np.zeros((1, 4)))], truth, coverage, quiet)


@pytest.mark.parametrize(("begin_m", "end_m", "targets"), [(0.0, 0.0, 1), (0.0, 2e3, 0), (2e3, 0.0, 0)])
def test_a_target_must_be_in_coverage_long_enough(frame: MakeFrame, begin_m: float, end_m: float, targets: int) -> None:
    truth = TruthTimeline([truth_at(t, [1], [[east, 0.0, 0.0, 0.0]]) for t, east in ((0, begin_m), (30, end_m))])
    seen = Coverage(np.zeros((1, 2)), np.array([1e3]))
    last = frame(30.0, [5], [[end_m, 0.0, 0.0, 0.0]])
    assert picture_at_end([last], truth, seen, [1], settle_s=30.0).targets == targets


def test_coverage_is_any_sensor_in_range(two_radars: Scenario) -> None:
    coverage = Coverage.of(sensor_info(two_radars, radar) for radar in two_radars.radars)
    assert coverage.sees(np.array([[-119e3, 0.0], [159e3, 10e3], [161e3, 10e3]])).tolist() == [True, True, False]
    assert not Coverage.of([]).sees(np.zeros((1, 2))).any()
