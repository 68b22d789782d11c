"""Tuning: which settings are sought, what of a recording is scored, and how clutter is held fixed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    batch,
    in_time_order,
    ns,
    radar,
    scans,
    seen,
)

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import Tick, UnitRecord
from trackmesh.protocol.messages import Message, PlotBatch, SensorInfo, TrackFrame
from trackmesh.services.estimation.filters import FilterName
from trackmesh.services.fusion import tuning
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.tuning import Candidate, Evidence

QUIET = EngineSettings(filter="imm", q_m2ps3=[0.1, 10.0], sojourn_s=[60.0, 15.0])


def scene(until_s: float = 60.0) -> list[Message]:
    """Two radars and four targets on straight lines."""
    batches = in_time_order(scans(NORTH, FAR_APART, until_s), scans(EAST, FAR_APART, until_s, offset_s=0.7, seed=2))
    return [NORTH, EAST, *batches]


def all_frames(frames: Iterator[TrackFrame], kept: list[TrackFrame]) -> float:
    kept += frames
    return 0.0


def distance(settings: EngineSettings) -> float:
    """How far the models are from two that are known to be right."""
    right = np.log([0.5, 200.0, 80.0, 12.0])
    return float(((np.log([*settings.q_m2ps3, *settings.sojourn_s]) - right) ** 2).sum())


# --- which settings


@pytest.mark.parametrize("name", get_args(FilterName))
def test_the_numbers_of_the_settings_give_them_again(name: FilterName) -> None:
    start = EngineSettings(filter=name, gate=9.0, local_filter="imm")
    values = np.array([axis.start for axis in tuning.axes_of(start)])
    assert tuning.settings_with(start, values) == start
    changed = tuning.settings_with(start, 2.0 * values)
    assert changed.gate == 9.0 and changed != start
    assert [axis.start for axis in tuning.axes_of(changed)] == (2.0 * values).tolist()


def test_what_is_sought_is_what_the_filter_is_made_of() -> None:
    words = ["turn_rate_max_degps", "acceleration_max_mps2", "manoeuvre_s", "quiet_s", "q_quiet"]
    assert list(tuning.ranges_of(EngineSettings(filter="tvimm"))) == words
    assert list(tuning.ranges_of(QUIET)) == ["q_m2ps3", "sojourn_s"]
    for name in get_args(FilterName):
        for axis in tuning.axes_of(EngineSettings(filter=name)):
            assert axis.low < axis.start < axis.high and axis.reach > 1.0


def test_models_are_found_and_their_noise_ascends() -> None:
    tried: list[EngineSettings] = []

    def score(settings: EngineSettings) -> float:
        tried.append(settings)
        return distance(settings)

    last = list(tuning.tune(QUIET, score, 250))[-1]
    assert tried[0] == QUIET
    np.testing.assert_allclose([*last.best.q_m2ps3, *last.best.sojourn_s], [0.5, 200.0, 80.0, 12.0], rtol=0.05)
    assert all(settings.q_m2ps3 == sorted(settings.q_m2ps3) for settings in tried)


def test_a_sojourn_time_stays_with_its_model_when_models_are_sorted() -> None:
    values = tuning.ascending(QUIET, np.array([10.0, 0.1, 15.0, 60.0]))
    assert values.tolist() == [0.1, 10.0, 60.0, 15.0]
    words = np.array([6.0, 10.0, 18.0, 45.0, 0.3])
    assert tuning.ascending(EngineSettings(filter="tvimm"), words).tolist() == words.tolist()


def test_the_start_is_evaluated_as_given_and_kept_where_nothing_is_better() -> None:
    start = EngineSettings(filter="imm", q_m2ps3=[500.12345, 1.0], sojourn_s=[15.0, 50.0])
    tried: list[EngineSettings] = []

    def score(settings: EngineSettings) -> float:
        tried.append(settings)
        return 0.0 if settings == start else 1.0

    candidates = list(tuning.tune(start, score, 20))
    assert tried[0] == start and len(tried) == len(candidates) == 20
    assert all(candidate.best == start and candidate.best_score == 0.0 for candidate in candidates)


def test_equal_seeds_give_equal_candidates() -> None:
    def run(seed: int) -> list[Candidate]:
        return list(tuning.tune(QUIET, distance, 30, seed))

    assert run(3) == run(3) != run(4)


def test_only_what_was_given_and_what_was_sought_is_set() -> None:
    start = EngineSettings(filter="tvimm", coast_s=8.0)
    best = list(tuning.tune(start, lambda s: s.quiet_s, 10))[-1].best
    assert best.model_fields_set == {"filter", "coast_s", *tuning.ranges_of(start)}
    assert best.coast_s == 8.0 and best.quiet_s < start.quiet_s


def test_settings_that_are_none_are_the_worst(monkeypatch: pytest.MonkeyPatch) -> None:
    make = tuning.settings_with

    def strict(settings: EngineSettings, values: Any) -> EngineSettings:
        made = make(settings, values)
        return made if made.quiet_s > 30.0 else EngineSettings.model_validate({"gate": -1.0})

    monkeypatch.setattr(tuning, "settings_with", strict)
    candidates = list(tuning.tune(EngineSettings(filter="tvimm"), lambda s: s.quiet_s, 60))
    assert any(candidate.score == math.inf for candidate in candidates)
    assert 30.0 < candidates[-1].best.quiet_s < 35.0


def test_bounds_that_were_reached_are_named() -> None:
    start = EngineSettings(filter="tvimm")
    found = start.model_copy(update={"q_quiet": 5e-3, "quiet_s": 3600.0})
    assert tuning.at_bounds(start, found) == ["quiet_s", "q_quiet"]
    assert tuning.at_bounds(found, found) == []


# --- which part of the recording


def test_a_recording_knows_its_plots_and_times() -> None:
    records = scene(20.0)
    recording = tuning.recording_of(iter(records))
    batches = [record for record in records if isinstance(record, PlotBatch)]
    assert recording.records == records and recording.settings is None
    assert recording.plots == sum(len(b.t_ns) for b in batches)
    assert recording.first_ns == ns(0.0) and recording.last_ns == max(int(b.t_ns.max()) for b in batches)
    empty = tuning.recording_of([NORTH, Tick(t_ns=5), batch("north", 1.0, np.zeros((0, 2)))])
    assert (empty.plots, empty.first_ns, empty.last_ns) == (0, 0, 0)


def test_the_settings_of_a_black_box_are_taken_out_of_it() -> None:
    unit = UnitRecord(
        unit_id="a", unit_number=1, boot_id="b", first_track_number=1, settings=QUIET.model_dump(mode="json")
    )
    recording = tuning.recording_of([unit, NORTH])
    assert recording.settings == QUIET and recording.records == [NORTH]
    with pytest.raises(TrackmeshError, match="another version"):
        tuning.recording_of([unit.model_copy(update={"settings": {"speed": 3}})])


def test_a_recording_is_split_at_the_first_record_that_is_later() -> None:
    records = [NORTH, batch("north", 1.0, np.zeros((1, 2))), Tick(t_ns=ns(2.0)), batch("north", 1.5, np.zeros((1, 2)))]
    assert tuning.split_at(records, ns(0.5)) == 1
    assert tuning.split_at(records, ns(1.0)) == 2
    assert tuning.split_at(records, ns(2.0)) == len(records)


def test_only_the_pictures_of_the_scored_part_are_scored() -> None:
    records = scene()
    middle = tuning.split_at(records, ns(30.0))
    every: list[TrackFrame] = []
    tail: list[TrackFrame] = []
    tuning.evaluate(records, QUIET, lambda frames, _: all_frames(frames, every))
    tuning.evaluate(records, QUIET, lambda frames, _: all_frames(frames, tail), begin=middle)
    assert tail and tail == [frame for frame in every if frame.t_ns > ns(30.0)]
    # The tracker is warm where the part begins.
    assert len(tail[0].track_id) == 4
    nothing: list[TrackFrame] = []
    tuning.evaluate(records, QUIET, lambda frames, _: all_frames(frames, nothing), begin=len(records))
    assert nothing == []


def test_fewer_pictures_are_pictures_of_the_same_tracks() -> None:
    records = scene()
    every: list[TrackFrame] = []
    some: list[TrackFrame] = []
    tuning.evaluate(records, QUIET, lambda frames, _: all_frames(frames, every))
    tuning.evaluate(records, QUIET, lambda frames, _: all_frames(frames, some), picture_s=5.0)
    assert np.diff([frame.t_ns for frame in some]).min() >= 5 * 10**9
    assert 0.1 * len(every) < len(some) < 0.7 * len(every)
    at = {frame.t_ns: frame for frame in every}
    for frame in some:
        assert frame.state.tobytes() == at[frame.t_ns].state.tobytes()


def test_a_picture_is_worth_its_cost_four_times_a_period() -> None:
    assert tuning.picture_period_s([EAST, NORTH]) == 1.0
    assert tuning.picture_period_s([]) == 0.0


def test_the_likelihoods_of_both_parts_make_that_of_the_whole() -> None:
    records = scene()
    middle = tuning.split_at(records, ns(30.0))
    sums: list[tuple[float, int]] = []

    def note(frames: Iterator[TrackFrame], evidence: Evidence) -> float:
        value = tuning.unlikelihood(frames, evidence)
        sums.append((evidence.log_likelihood, evidence.plots))
        return value

    whole = tuning.evaluate(records, QUIET, note)
    tuning.evaluate(records[:middle], QUIET, note)
    tuning.evaluate(records, QUIET, note, begin=middle)
    (all_nats, all_plots), (head_nats, head_plots), (tail_nats, tail_plots) = sums
    assert all_plots == head_plots + tail_plots and head_plots > 0 < tail_plots
    assert all_nats == pytest.approx(head_nats + tail_nats, rel=1e-12)
    assert whole == -all_nats / all_plots


def test_straight_flight_is_likelier_under_little_noise() -> None:
    records = tuning.with_clutter(scene(), {"north": 1e-10, "east": 1e-10})
    violent = EngineSettings(filter="imm", q_m2ps3=[2000.0, 5000.0], sojourn_s=[60.0, 15.0])
    quiet, wild = (
        tuning.evaluate(records, settings, tuning.unlikelihood, picture_s=tuning.NO_PICTURES_S)
        for settings in (QUIET, violent)
    )
    assert quiet < wild - 0.3


def test_what_took_no_plots_has_no_likelihood() -> None:
    assert math.isnan(tuning.evaluate([NORTH], QUIET, tuning.unlikelihood))
    assert math.isnan(tuning.evaluate([], QUIET, tuning.unlikelihood))


def test_evidence_is_of_its_part_alone() -> None:
    run: Any = SimpleNamespace(engine=None, plots=0)
    evidence = Evidence(run)
    assert not evidence.begun
    run.engine, run.plots = SimpleNamespace(log_likelihood=30.0), 10
    evidence.begin()
    run.engine.log_likelihood, run.plots = 50.0, 14
    assert evidence.begun and (evidence.log_likelihood, evidence.plots) == (20.0, 4)
    assert tuning.unlikelihood(iter([]), evidence) == -5.0


# --- clutter


def test_clutter_is_put_in_where_none_is_declared() -> None:
    declared = radar("south", clutter_density=3e-9)
    unheard = radar("west")
    records: list[Message] = [NORTH, declared, unheard, *scans(NORTH, FAR_APART, 5.0)]
    density = {"north": 2e-10, "south": 7e-10}
    found = tuning.with_clutter(records, density)
    infos = {r.sensor_id: r.clutter_density for r in found if isinstance(r, SensorInfo)}
    assert infos == {"north": 2e-10, "south": 3e-9, "west": None}
    assert found[3:] == records[3:] and NORTH.clutter_density is None
    (extreme,) = tuning.with_clutter([NORTH], {"north": 0.0})
    assert SensorInfo.model_validate(extreme.model_dump()).clutter_density == 1e-18


def test_clutter_is_measured_in_plots_a_look_and_square_metre() -> None:
    rng = np.random.default_rng(4)
    area = np.pi * NORTH.max_range_m**2
    records: list[Message] = [NORTH]
    for seq, t in enumerate(np.arange(0.0, 120.0, NORTH.period_s).tolist()):
        radius, angle = NORTH.max_range_m * np.sqrt(rng.random(30)), 2 * np.pi * rng.random(30)
        false = np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1)
        place = np.concatenate([FAR_APART.at(t), false])
        records.append(seen(NORTH, t, place, np.zeros((len(place), 2)), seq=seq))
    density = tuning.measured_clutter(records, QUIET)
    assert density.keys() == {"north"}
    assert density["north"] == pytest.approx(30 / area, rel=0.15)
