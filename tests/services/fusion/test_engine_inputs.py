"""What the engine is given: batches that are refused or harmless, sensors that come and change."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.services.fusion.makers import (
    EAST,
    ENDED,
    FAR_APART,
    GEODETIC,
    NORTH,
    ONE,
    POLAR,
    batch,
    drive,
    engine,
    ids,
    in_time_order,
    live,
    nearest,
    ns,
    position_sensor,
    radar,
    scans,
)

from trackmesh.protocol.codec import encode
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import SensorInfo, TrackQuery
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings


@pytest.mark.parametrize(
    ("reason", "info", "columns"),
    [
        ("unknown_sensor", position_sensor("other"), ["east_m", "north_m"]),
        ("no_variance", position_sensor(sigma={"up_m": 3.0}), ["east_m", "north_m"]),
        ("no_site", position_sensor(sigma={"range_m": 1.0, "azimuth_rad": 0.1}), POLAR),
        ("no_origin", position_sensor(sigma={"latitude_deg": 1.0, "longitude_deg": 1.0}), GEODETIC),
    ],
)
def test_a_batch_that_cannot_be_placed_is_refused_whole(reason: str, info: SensorInfo, columns: list[str]) -> None:
    tracker = engine(NORTH, info)
    drive(tracker, scans(NORTH, FAR_APART, 20.0))
    before, counters = encode(tracker.query(TrackQuery())), dict(tracker.counters)
    with pytest.raises(RefusedMessage) as error:
        tracker.plots(batch("ais", 30.0, np.zeros((2, 2)), columns))
    assert error.value.reason == reason
    assert encode(tracker.query(TrackQuery())) == before
    assert dict(tracker.counters) == counters


def test_an_empty_batch_is_harmless() -> None:
    tracker = engine(NORTH)
    nothing = batch("north", 0.0, np.empty((0, 2)), POLAR)
    assert tracker.plots(nothing) is None
    last = drive(tracker, scans(NORTH, FAR_APART, 20.0))[-1]
    [again] = drive(tracker, [nothing])
    assert again.model_copy(update={"seq": last.seq}) == last


def test_a_query_before_any_data_is_answered() -> None:
    frame = engine(NORTH).query(TrackQuery())
    assert frame.track_id.tolist() == []
    assert encode(frame)


def test_a_sensor_may_come_later() -> None:
    tracker = engine(NORTH)
    drive(tracker, scans(NORTH, FAR_APART, 40.0))
    known = ids(tracker.query(TrackQuery()))
    tracker.sensor(EAST)
    both = scans(NORTH, FAR_APART, 80.0, offset_s=40.0), scans(EAST, FAR_APART, 80.0, offset_s=40.7)
    last = drive(tracker, in_time_order(*both))[-1]
    assert live(last) == known
    assert last.sensors == ["north", "east"]
    assert -1 not in last.members


def test_a_sensor_that_ended_tracks_before_another_came_is_told_well() -> None:
    tracker = engine(NORTH, frame_period_s=60.0)
    drive(tracker, scans(NORTH, ONE, 30.0))
    tracker.tick(ns(50.0))
    tracker.sensor(EAST)
    frame = tracker.tick(ns(100.0))
    assert frame is not None
    assert frame.status.tolist() == [ENDED]
    assert frame.members.shape == (1, 2)


def test_a_sensor_may_say_anew_who_it_is() -> None:
    tracker = engine(NORTH)
    drive(tracker, scans(NORTH, FAR_APART, 40.0))
    known = ids(tracker.query(TrackQuery()))
    moved = radar("north", 10e3, -5e3, period_s=2.0)
    tracker.sensor(moved)
    last = drive(tracker, scans(moved, FAR_APART, 60.0, offset_s=40.0))[-1]
    assert live(last) == known
    assert last.sensors == ["north"]
    assert max(nearest(last, place)[1] for place in FAR_APART.at(58.0)) < 150


@pytest.mark.parametrize(
    ("change", "keeps"),
    [
        ({"sigma": {"range_m": 60.0, "azimuth_rad": 1e-3}}, True),
        ({"site_enu_m": [500.0, 0.0, 0.0]}, True),
        ({"max_range_m": 90e3}, False),
        ({"clutter_density": 1e-9}, False),
    ],
)
def test_what_is_known_of_its_clutter_stays_with_a_sensor_that_looks_as_far_as_before(
    change: dict[str, Any], keeps: bool
) -> None:
    tracker = engine(NORTH)
    drive(tracker, scans(NORTH, FAR_APART, 40.0))
    before = [c.whole() for c in (tracker.sensors["north"].local_clutter, tracker.sensors["north"].system_clutter)]
    assert before != [c.whole() for c in (engine(NORTH).sensors["north"].local_clutter,) * 2]
    tracker.sensor(NORTH.model_copy(update=change))
    after = [c.whole() for c in (tracker.sensors["north"].local_clutter, tracker.sensors["north"].system_clutter)]
    assert (after == before) is keeps


def test_units_do_not_share_numbers() -> None:
    seen_by = [FusionEngine(EngineSettings(), Unit("main", k, "test", 1)) for k in (0, 4095)]
    found = []
    for tracker in seen_by:
        tracker.sensor(NORTH)
        found.append(ids(drive(tracker, scans(NORTH, FAR_APART, 40.0))[-1]))
    assert len(found[0] | found[1]) == 8
    assert max(found[1]) < 2**53
