"""Biased sensors: the engine learns what is wrong with them and corrects their plots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from benchmarks import peer_scenario
from benchmarks.fusion import run
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    START_NS,
    Fleet,
    FloatArray,
    drive,
    engine,
    in_time_order,
    nearest,
    peers_folder,
    scans,
)

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RegistrationRecord, read_records, replace_with
from trackmesh.protocol.messages import PlotBatch, Registration, TrackFrame
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings

BIAS = np.array([150.0, np.deg2rad(0.4)])


def biased(batches: list[PlotBatch], bias: FloatArray = BIAS, from_s: float = 0.0) -> list[PlotBatch]:
    """The batches of a radar that measures wrongly, from some time after the first on."""
    start_ns = batches[0].t_ns.min()
    out = []
    for batch in batches:
        late = (batch.t_ns - start_ns) / 1e9 >= from_s
        values = batch.values.copy()
        values[late, :2] += bias
        values[:, 1] %= 2.0 * np.pi
        out.append(batch.model_copy(update={"values": values}))
    return out


def grid(n: int = 5) -> Fleet:
    """n x n targets 12 km apart, flying in all directions."""
    rng = np.random.default_rng(3)
    east, north = np.meshgrid(12e3 * np.arange(n), 12e3 * np.arange(n) + 15e3)
    angle = rng.uniform(0, 2 * np.pi, n * n)
    return Fleet(
        np.stack([east.ravel(), north.ravel()], axis=1), 150.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    )


def both(seconds: float, change: Callable[[list[PlotBatch]], list[PlotBatch]]) -> list[PlotBatch]:
    east = change(list(scans(EAST, grid(), seconds, offset_s=0.7, seed=2)))
    return in_time_order(scans(NORTH, grid(), seconds), east)


def errors_m(frame: TrackFrame) -> FloatArray:
    """Distance of the nearest track from each target."""
    at = grid().at((frame.t_ns - START_NS) / 1e9)
    return np.array([nearest(frame, place)[1] for place in at])


def test_a_biased_radar_is_found_out_and_its_plots_are_corrected() -> None:
    batches = both(100.0, biased)
    plain, corrected = engine(NORTH, EAST, registration=False), engine(NORTH, EAST)
    wrong, right = drive(plain, batches)[-1], drive(corrected, batches)[-1]
    told = corrected.registration()
    assert told is not None
    assert decode(encode(told), Registration) == told
    north, east = told.sensors
    # Only two radars: what one measures too much may be what the other measures too little, within the prior.
    difference = east.bias - north.bias
    assert abs(difference[0] - BIAS[0]) < 40.0
    assert abs(np.rad2deg(difference[1] - BIAS[1])) < 0.08
    assert north.locked and east.locked
    assert np.median(errors_m(right)) < 0.6 * np.median(errors_m(wrong))
    assert plain.registration() is None


def test_nothing_is_corrected_before_it_is_known() -> None:
    batches = both(8.0, biased)
    plain, careful = engine(NORTH, EAST, registration=False), engine(NORTH, EAST, lock_m=1e-3)
    for one, other in zip(drive(plain, batches), drive(careful, batches), strict=True):
        assert np.array_equal(one.state, other.state)
    told = careful.registration()
    assert told is not None and not any(sensor.locked for sensor in told.sensors)


def test_a_bias_that_appears_later_is_noticed() -> None:
    tracker = engine(NORTH, EAST)
    drive(tracker, both(220.0, lambda batches: biased(batches, 2.0 * BIAS, from_s=100.0)))
    told = tracker.registration()
    assert told is not None
    assert sum(sensor.jumps for sensor in told.sensors) >= 1
    difference = told.sensors[1].bias - told.sensors[0].bias
    assert abs(difference[0] - 2.0 * BIAS[0]) < 80.0


def test_a_large_first_correction_makes_the_picture_anew() -> None:
    """Under a large bias each radar makes tracks of its own; afterwards every target has one again."""
    bias = np.array([300.0, np.deg2rad(0.8)])
    tracker = engine(NORTH, EAST)
    last = drive(tracker, both(60.0, lambda batches: biased(batches, bias)))[-1]
    assert tracker.counters["registration_locked"] >= 1
    assert tracker.counters["ended"] > 0
    live = last.status != 3
    assert live.sum() == len(grid().start)
    assert errors_m(last).max() < 1000.0
    assert (last.members[live] >= 0).all(), "both radars' local tracks are members"


def test_biases_far_beyond_the_expected_ones_are_found() -> None:
    bias = np.array([1500.0, np.deg2rad(1.8)])
    tracker = engine(NORTH, EAST, bias_range_m=100.0, bias_azimuth_deg=0.2)
    last = drive(tracker, both(80.0, lambda batches: biased(batches, bias)))[-1]
    assert tracker.counters["global_starts"] == 1
    told = tracker.registration()
    assert told is not None
    difference = told.sensors[1].bias - told.sensors[0].bias
    assert abs(difference[0] - bias[0]) < 150.0
    assert abs(np.rad2deg(difference[1]) - 1.8) < 0.2
    assert (last.status != 3).sum() == len(grid().start)


def test_a_lone_sensor_says_that_nothing_can_be_told() -> None:
    tracker = engine(NORTH)
    drive(tracker, list(scans(NORTH, FAR_APART, 30.0)))
    told = tracker.registration()
    assert told is not None
    (north,) = told.sensors
    assert not north.locked
    assert len(north.notes) == 2 and "no pairs" in north.notes[0]


def test_what_was_learnt_is_kept_over_a_restart(tmp_path: Path) -> None:
    first = engine(NORTH, EAST)
    batches = both(60.0, biased)
    drive(first, batches)
    assert first.now_ns is not None
    record = first.corrections.record(first.now_ns)
    assert record is not None
    path = tmp_path / "biases.jsonl"
    replace_with(path, record)
    (kept,) = read_records(path, RegistrationRecord)
    assert isinstance(kept, RegistrationRecord)
    assert kept == record

    second = FusionEngine(first.settings, Unit())
    second.corrections.restore(kept, first.now_ns)
    for info in (NORTH, EAST):
        second.sensor(info)
    drive(second, batches[:4])
    told, before = second.registration(), first.registration()
    assert told is not None and before is not None
    for one, other in zip(told.sensors, before.sensors, strict=True):
        assert one.locked
        np.testing.assert_allclose(one.bias, other.bias, rtol=0.2, atol=1e-3)


def test_a_record_that_is_none_is_refused() -> None:
    with pytest.raises(TrackmeshError, match="cannot be used"):
        engine().corrections.restore(RegistrationRecord(t_ns=0, state={"sensors": ["north"]}), 0)


def peers_biased(case: peer_scenario.Case, bias: FloatArray) -> peer_scenario.Case:
    """The peers' scenario with its second radar biased."""
    radar = case.sensors[1].sensor_id
    wrong = iter(biased([b for b in case.batches if b.sensor_id == radar], bias))
    return case._replace(batches=[next(wrong) if b.sensor_id == radar else b for b in case.batches])


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_the_peers_scenario_is_as_good_with_a_bias_as_without(factor: float) -> None:
    peers_folder()
    case = peer_scenario.make(5, duration_s=150.0)
    nominal = run(case, EngineSettings()).score["gospa_m"]
    wrong = peers_biased(case, factor * BIAS)
    assert run(wrong, EngineSettings()).score["gospa_m"] <= 1.02 * nominal
    assert run(wrong, EngineSettings(registration=False)).score["gospa_m"] > 1000.0
