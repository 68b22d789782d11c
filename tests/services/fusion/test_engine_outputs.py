"""What the engine tells beside the picture: refined states, how well manoeuvres are modelled, its log-likelihood."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    ONE,
    Fleet,
    FloatArray,
    ImmLayer,
    confirm,
    drive,
    engine,
    fleet,
    in_time_order,
    layer,
    live,
    look,
    nearest,
    ns,
    plots,
    scans,
    seen,
)

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.messages import PlotBatch, RefinedFrame, TrackFrame, TrackQuery
from trackmesh.services.estimation.alpha_beta_tracks import AlphaBetaTracks
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.fusion.engine import FusionEngine
from trackmesh.services.fusion.settings import EngineSettings

LAG = 2

# --- refined states ---


def two_radars(targets: Fleet, until_s: float, p_detect: float = 1.0) -> list[PlotBatch]:
    return in_time_order(
        scans(NORTH, targets, until_s, p_detect=p_detect),
        scans(EAST, targets, until_s, offset_s=0.7, seed=2, p_detect=p_detect),
    )


def told(tracker: FusionEngine) -> RefinedFrame | None:
    """What is refined, checked by the rules of the protocol; and there is nothing more."""
    refined = tracker.refined()
    if refined is not None:
        assert decode(encode(refined), RefinedFrame) == refined
        assert tracker.refined() is None
    return refined


@pytest.mark.parametrize("kind", ["imm", "tvimm"])
def test_each_track_is_refined_once_a_plot_at_the_time_of_an_earlier_one(kind: str) -> None:
    tracker = engine(NORTH, EAST, filter=kind, lag=LAG)
    taken: dict[int, list[int]] = defaultdict(list)
    seen_at: dict[int, list[int]] = defaultdict(list)
    for batch in two_radars(FAR_APART, 60.0, p_detect=0.8):
        [frame] = drive(tracker, [batch])
        moved = set()
        for track, t_ns in zip(frame.track_id.tolist(), frame.updated_t_ns.tolist(), strict=True):
            if t_ns not in taken[track]:
                taken[track].append(t_ns)
                moved.add(track)
        refined = told(tracker)
        assert set(refined.track_id.tolist() if refined else ()) == moved
        if refined is None:
            continue
        assert (refined.unit_id, refined.boot_id, refined.lag, refined.t_ns) == ("main", "test", LAG, frame.t_ns)
        for track, t_ns in zip(refined.track_id.tolist(), refined.state_t_ns.tolist(), strict=True):
            if len(taken[track]) > LAG:
                assert t_ns == taken[track][-1 - LAG]
            seen_at[track].append(t_ns)
    assert len(seen_at) == 4
    for track, times in seen_at.items():
        assert len(times) == len(set(times)) == len(taken[track]) > 10


def test_ticks_and_questions_refine_nothing() -> None:
    tracker = engine(NORTH, lag=LAG)
    drive(tracker, scans(NORTH, FAR_APART, 30.0))
    assert told(tracker) is not None
    tracker.tick(ns(35.0))
    tracker.query(TrackQuery(at_t_ns=ns(20.0)))
    assert tracker.refined() is None


@pytest.mark.parametrize("kind", ["imm", "tvimm"])
def test_refined_states_are_nearer_to_the_truth_than_the_live_ones(kind: str) -> None:
    """At the same times; and their covariances hold."""
    tracker = engine(NORTH, EAST, filter=kind, lag=LAG, registration=False)
    live_off: dict[int, list[FloatArray]] = defaultdict(list)
    off: list[FloatArray] = []
    nees: list[float] = []
    for batch in two_radars(FAR_APART, 120.0):
        [frame] = drive(tracker, [batch])
        live_off[frame.t_ns] = [state[:4] - truth(state[:2], frame.t_ns) for state in frame.state]
        refined = told(tracker)
        for k, t_ns in enumerate([] if refined is None else refined.state_t_ns.tolist()):
            assert refined is not None
            if t_ns in live_off:
                off.append(refined.state[k, :4] - truth(refined.state[k, :2], t_ns))
                nees.append(float(off[-1] @ np.linalg.solve(refined.covariance_matrices()[k, :4, :4], off[-1])))
    told_of = np.array([e for t_ns, all_off in live_off.items() if t_ns < ns(117.0) for e in all_off])
    refined_off = np.array(off)
    assert abs(len(refined_off) - len(told_of)) < 20
    for part, share in ((slice(2), 0.8), (slice(2, 4), 0.93)):
        live_rms, rms = (np.sqrt((a[:, part] ** 2).sum(axis=1).mean()) for a in (told_of, refined_off))
        assert rms < share * live_rms
    assert 0.3 < np.mean(nees) / 4.0 < 1.1


def truth(place: FloatArray, t_ns: int) -> FloatArray:
    """The state of the target nearest to a place."""
    places = FAR_APART.at((t_ns - ns(0.0)) / 1e9)
    k = int(np.linalg.norm(places - place, axis=1).argmin())
    return np.concatenate([places[k], FAR_APART.velocity[k]])


def test_late_batches_refine_what_in_time_they_would_have() -> None:
    batches = two_radars(FAR_APART, 40.0)
    late = [*batches[:10], *batches[11:13], batches[10], *batches[13:]]
    ends = []
    for order in (batches, late):
        # A plot is corrected by the biases that are known when it comes: with registration the order counts.
        tracker = engine(NORTH, EAST, lag=LAG, registration=False)
        for batch in order[:-1]:
            drive(tracker, [batch])
            tracker.refined()
        drive(tracker, order[-1:])
        ends.append(told(tracker))
    assert ends[0] is not None
    assert ends[0] == ends[1]


def test_without_a_lag_nothing_is_refined() -> None:
    tracker = engine(NORTH)
    assert tracker.refined() is None
    drive(tracker, scans(NORTH, FAR_APART, 30.0))
    assert tracker.refined() is None
    assert engine(NORTH, lag=LAG).refined() is None, "and before any data neither"


@pytest.mark.parametrize("kind", ["alpha-beta", "tvimm-paper"])
def test_a_filter_that_keeps_no_lag_is_told_so_in_one_sentence(kind: str) -> None:
    EngineSettings.model_validate({"filter": kind, "lag": 0})
    with pytest.raises(ValidationError) as error:
        EngineSettings.model_validate({"filter": kind, "lag": 1})
    [only] = error.value.errors()
    assert only["msg"] == f"Value error, the filter {kind} keeps no lag: choose lag = 0 or another filter"


@pytest.mark.parametrize("lag", [-1, 5])
def test_lags_beyond_reason_are_refused(lag: int) -> None:
    with pytest.raises(ValidationError, match="lag"):
        EngineSettings(lag=lag)


def test_local_tracks_keep_no_lag() -> None:
    settings = EngineSettings(lag=LAG)
    system, local = settings.system_tracks(1), settings.local_tracks(1)
    assert isinstance(system, ImmTracks)
    assert isinstance(local, ImmTracks)
    assert (system.models.lags, local.models.lags) == (LAG, 0)


# --- how well manoeuvres are modelled ---


def test_the_weight_of_the_manoeuvre_models_is_told() -> None:
    for frame in drive(engine(NORTH), scans(NORTH, FAR_APART, 40.0)):
        assert frame.manoeuvre_fit is not None
        np.testing.assert_allclose(frame.manoeuvre_fit, frame.model_probability[:, :5].sum(axis=1), atol=1e-12)
    assert frame.manoeuvre_fit is not None
    assert frame.manoeuvre_fit.shape == (4,)
    assert len(set(frame.manoeuvre_fit.tolist())) == 4


def test_a_question_keeps_it_with_its_track() -> None:
    tracker = engine(NORTH)
    [*_, last] = drive(tracker, scans(NORTH, FAR_APART, 40.0))
    assert last.manoeuvre_fit is not None
    for k in (2, 0):
        one = tracker.query(TrackQuery(track_ids=[int(last.track_id[k])]))
        assert one.manoeuvre_fit is not None
        assert one.manoeuvre_fit.tolist() == [last.manoeuvre_fit[k]]


@pytest.mark.parametrize("kind", ["imm", "tvimm-dirichlet", "tvimm-paper", "alpha-beta"])
def test_filters_without_manoeuvre_models_tell_none(kind: str) -> None:
    [*_, last] = drive(engine(NORTH, filter=kind), scans(NORTH, FAR_APART, 40.0))
    assert len(live(last)) == 4
    assert last.manoeuvre_fit is None


def test_it_is_never_more_than_one() -> None:
    """Not even where rounding makes the sum of five probabilities so."""
    tracker = engine(NORTH)
    drive(tracker, scans(NORTH, ONE, 30.0))
    tracks = tracker._system.filters
    assert isinstance(tracks, ImmTracks)
    row, rng = int(tracker._system.rows[0]), np.random.default_rng(1)
    tracks.filters.head["weight"][row] = [1.0, 0.0]
    sums = []
    for _ in range(50):
        tracks.filters.head["mu"][row, :5] = rng.dirichlet(np.ones(5))
        frame = tracker.query(TrackQuery())
        assert decode(encode(frame), TrackFrame) == frame
        sums.append(float(frame.model_probability[0, :5].sum()))
    assert max(sums) > 1.0, "or this test proves nothing"


# --- alpha-beta ---


@pytest.mark.parametrize(
    "filters",
    [
        {"filter": "alpha-beta"},
        {"local_filter": "alpha-beta"},
        {"filter": "imm", "local_filter": "alpha-beta"},
        {"filter": "alpha-beta", "local_filter": "alpha-beta"},
    ],
    ids=["system", "local", "local beside imm", "both"],
)
def test_alpha_beta_keeps_targets_that_are_far_apart(filters: dict[str, Any]) -> None:
    tracker = engine(NORTH, EAST, **filters)
    kinds = {"filter": tracker._system, "local_filter": tracker._locals[0]}
    for name, bank in kinds.items():
        assert isinstance(bank.filters, AlphaBetaTracks) == (filters.get(name) == "alpha-beta")
    frames = drive(tracker, two_radars(FAR_APART, 60.0, p_detect=0.9))
    settled = [frame for frame in frames if frame.t_ns > ns(20.0)]
    assert {len(live(frame)) for frame in settled} == {4}
    assert len(set.union(*(live(frame) for frame in settled))) == 4
    last = frames[-1]
    t_s = (last.t_ns - ns(0.0)) / 1e9
    assert max(nearest(last, place)[1] for place in FAR_APART.at(t_s)) < 200
    assert tracker.counters["confirmed"] == 4
    assert -1 not in last.members


def test_alpha_beta_takes_no_late_plots_and_loses_no_track_by_them() -> None:
    batches = two_radars(FAR_APART, 60.0)
    late = [*batches[:10], *batches[11:13], batches[10], *batches[13:]]
    tracker = engine(NORTH, EAST, filter="alpha-beta", local_filter="alpha-beta")
    last = drive(tracker, late)[-1]
    assert len(live(last)) == 4
    assert tracker.counters["confirmed"] == 4


# --- the log-likelihood of the picture ---


def test_a_step_tells_what_its_hits_gain_and_its_misses_cost() -> None:
    bank: ImmLayer = layer()
    rows = confirm(bank, (0.0, 0.0), (2e4, 0.0), (0.0, 3e4))
    before = bank.life.score.copy()
    bank.life.score[rows] = before[rows] = 0.0
    # The second target is not seen.
    step = bank.step(plots(16.0, np.array([(60.0, 0.0), (0.0, 3e4)])), look(16.0), 16.0)
    gains = bank.life.score[rows] - before[rows]
    assert gains[1] == pytest.approx(np.log(0.1))
    assert gains[0] > 0 < gains[2]
    assert step.log_likelihood == pytest.approx(gains.sum(), rel=1e-12)
    silence = bank.step(plots(20.0, np.empty((0, 2))), look(20.0), 20.0)
    assert silence.log_likelihood == pytest.approx(3.0 * np.log(0.1), rel=1e-12)


def test_what_starts_a_track_adds_nothing() -> None:
    bank = layer()
    assert bank.step(plots(0.0, np.array([(0.0, 0.0), (2e4, 0.0)])), look(0.0), 0.0).log_likelihood == 0.0


def test_the_engine_adds_up_gains_and_misses() -> None:
    pair = fleet((30e3, 20e3, 100, 40), (-20e3, 45e3, -60, 120))
    one = Fleet(pair.start[:1], pair.velocity[:1])
    tracker = engine(NORTH, score_cap=1e9, clutter_areas=False)
    drive(tracker, scans(NORTH, pair, 21.0))
    life = tracker._system.life
    rows = tracker._system.rows
    assert len(rows) == 2
    for t_s, targets, falls in ((24.0, pair, 0), (28.0, one, 1), (32.0, pair, 0)):
        before, score = tracker.log_likelihood, life.score[rows].copy()
        drive(tracker, [seen(NORTH, t_s, targets.at(t_s), np.zeros((len(targets.start), 2)))])
        gains = life.score[rows] - score
        assert int((gains < 0).sum()) == falls
        assert tracker.log_likelihood - before == pytest.approx(gains.sum(), rel=1e-9)
    nowhere = seen(NORTH, 36.0, np.array([[60e3, -60e3]]), np.zeros((1, 2)))
    before = tracker.log_likelihood
    drive(tracker, [nowhere])
    assert tracker.log_likelihood - before == pytest.approx(2.0 * np.log(0.1), rel=1e-9)


def test_a_filter_that_fits_the_target_has_the_greater_likelihood() -> None:
    """Of two settings the one that knows how quietly targets fly."""
    logs = []
    for q in (1.0, 5000.0):
        tracker = engine(NORTH, filter="imm", q_m2ps3=[q, q, q], sojourn_s=[30.0] * 3)
        drive(tracker, scans(NORTH, FAR_APART, 120.0))
        logs.append(tracker.log_likelihood)
    assert logs[0] > logs[1] + 50.0
