"""Bad input to the tag engine, reading by reading: left out, counted, and nothing else is lost."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tests.services.tags.worlds import SIGMA, Hall, place_of, status_of

from trackmesh.protocol.messages import GONE, LOCATED, UNSURE

PLACE = (10.0, 15.0)
Row = tuple[float, str, str, float]


def at(t_s: float, reader: str, metres: float) -> Row:
    return (t_s, "a", reader, metres)


CASES: dict[str, tuple[str, Callable[[float], Row]]] = {
    "an unknown reader": ("unknown_reader", lambda t: at(t, "nobody", 5.0)),
    "a range below nought": ("negative_ranges", lambda t: at(t, "sw", -20.0)),
    "a range beyond what the reader hears": ("absurd_ranges", lambda t: at(t, "sw", 500.0)),
    "a range beyond the earth": ("absurd_ranges", lambda t: at(t, "ne", 999_999.0)),
    "a late range": ("late_ranges", lambda t: at(t - 1.5, "sw", 18.0)),
    "a reading that is repeated": ("duplicate_ranges", lambda t: at(t - 0.1, "sw", 3.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_a_bad_reading_is_counted_and_spoils_no_other(case: str) -> None:
    reason, make = CASES[case]
    clean, soiled = Hall(), Hall()
    for hall in (clean, soiled):
        hall.stand("a", PLACE, 0.0, 3.0)
    rows = clean.rows(3.0, "a", PLACE)
    want = clean.put(rows)
    got = soiled.put([make(3.0), *rows])
    assert soiled.count(reason) == 1
    assert sum(soiled.engine.counts().values()) == sum(clean.engine.counts().values()) + 1 + (
        reason in ("late_ranges", "duplicate_ranges")
    )
    assert want is not None and got is not None
    np.testing.assert_array_equal(got.state, want.state)


def test_a_little_below_nought_is_noise() -> None:
    hall = Hall()
    hall.stand("a", (0.2, 0.1), 0.0, 3.0)
    frame = hall.put([at(3.0, "sw", -0.4), *hall.rows(3.0, "a", (0.2, 0.1), ["se", "nw"])])
    assert hall.count("negative_ranges") == 0
    assert math.dist(place_of(frame, "a"), (0.2, 0.1)) < 3 * SIGMA


def test_a_range_that_is_far_too_short_does_little() -> None:
    hall = Hall()
    hall.stand("a", PLACE, 0.0, 3.0)
    frame = hall.put([at(3.0, "ne", 0.0), *hall.rows(3.0, "a", PLACE, ["sw", "se"])])
    assert math.dist(place_of(frame, "a"), PLACE) < 1.0


def test_readers_on_one_line_are_said_to_leave_two_places() -> None:
    hall = Hall(readers={"a": (0.0, 0.0), "b": (20.0, 0.0), "c": (45.0, 0.0)})
    frame = hall.stand("t", (15.0, 12.0), 0.0, 3.0)
    assert status_of(frame, "t") == UNSURE
    assert frame.certainty[0] == pytest.approx(0.5, abs=0.2)
    assert sorted([frame.state[0, 1], frame.other[0, 1]]) == pytest.approx([-12.0, 12.0], abs=1.0)
    assert hall.engine.figures()["unsure"] == 1
    # Where tags can be is known to the one who put the readers up.
    walled = Hall(readers=hall.places, area_enu_m=[-5.0, 0.0, 50.0, 30.0])
    frame = walled.stand("t", (15.0, 12.0), 0.0, 3.0)
    assert status_of(frame, "t") == LOCATED and frame.certainty[0] == 1.0
    assert math.dist(place_of(frame, "t"), (15.0, 12.0)) < 3 * SIGMA


@pytest.mark.parametrize("jump_s", [-3600.0, -120.0])
def test_a_clock_that_is_set_back_begins_time_anew(jump_s: float) -> None:
    hall = Hall()
    hall.stand("a", PLACE, 0.0, 3.0)
    frame = hall.put(hall.rows(jump_s, "a", (30.0, 30.0)))
    assert hall.count("clock_set_back") == 1
    assert frame is not None and frame.tag_id == ["a", "a"]
    assert frame.status.tolist() == [LOCATED, GONE]
    frame = hall.stand("a", (30.0, 30.0), jump_s + 0.1, jump_s + 2.0)
    assert math.dist(place_of(frame, "a"), (30.0, 30.0)) < 3 * SIGMA
    assert hall.count("starts") == 2


def test_a_clock_that_is_a_little_behind_loses_its_ranges_only() -> None:
    hall = Hall()
    hall.stand("a", PLACE, 0.0, 3.0)
    for k in range(20):
        hall.put(hall.rows(1.0 + 0.01 * k, "a", PLACE), network_id="slow")
    assert hall.count("late_ranges") == 80 and hall.count("clock_set_back") == 0
    frame = hall.stand("a", PLACE, 3.0, 4.0)
    assert status_of(frame, "a") == LOCATED


def test_a_clock_that_jumps_ahead_is_a_long_silence() -> None:
    hall = Hall(lost_s=30.0)
    hall.stand("a", PLACE, 0.0, 3.0)
    frame = hall.stand("a", (30.0, 30.0), 7203.0, 7205.0)
    assert status_of(frame, "a") == LOCATED
    assert math.dist(place_of(frame, "a"), (30.0, 30.0)) < 3 * SIGMA


def test_no_more_tags_than_there_may_be() -> None:
    hall = Hall(max_tags=2)
    frame = hall.put([row for tag in ("a", "b", "c", "d") for row in hall.rows(0.0, tag, PLACE)])
    assert frame is not None and frame.tag_id == ["a", "b"]
    assert hall.count("too_many_tags") == 8


def test_a_tag_that_only_unknown_readers_hear_takes_no_room() -> None:
    hall = Hall(max_tags=1)
    hall.put([(0.0, "ghost", "nobody", 5.0)])
    frame = hall.put(hall.rows(0.1, "a", PLACE))
    assert frame is not None and frame.tag_id == ["a"]


def test_variances_of_the_batch_count() -> None:
    spread = []
    for variance in (0.01, 9.0):
        hall = Hall()
        for k in range(10):
            rows = hall.rows(0.1 * k, "a", PLACE, noise=0.0)
            frame = hall.put(rows, variance_m2=np.full(len(rows), variance))
        assert frame is not None
        spread.append(float(frame.covariance[0, 0]))
    assert spread[0] < 0.1 * spread[1]


def rssi(d: float, noise: float, power: float = -45.0, exponent: float = 2.5) -> float:
    return power - 10.0 * exponent * math.log10(max(d, 0.1)) + noise


def strengths(hall: Hall, t_s: float, tag: str, place: tuple[float, float], **law: Any) -> list[Row]:
    return [
        (t, name, reader, rssi(d, hall.rng.normal(), **law))
        for t, name, reader, d in hall.rows(t_s, tag, place, (), 0.0)
    ]


def put_rssi(hall: Hall, rows: list[Row]) -> Any:
    return hall.put(rows, range_m=None, rssi_dbm=np.array([row[3] for row in rows]))


@pytest.mark.parametrize("update", ["ut", "ekf"])
def test_signal_strengths_locate_too(update: str) -> None:
    hall = Hall(update=update, motion="singer", rssi_noise_db=1.0)
    for k in range(60):
        frame = put_rssi(hall, strengths(hall, 0.1 * k, "a", PLACE))
    assert status_of(frame, "a") == LOCATED
    assert math.dist(place_of(frame, "a"), PLACE) < 2.0
    sigma = math.sqrt(frame.covariance[0, 0] + frame.covariance[0, 6])
    assert 0.2 < sigma < 4.0


def test_reference_tags_teach_the_law_and_are_not_tracked() -> None:
    law, error = {"power": -40.0, "exponent": 3.2}, []
    for references in ({"ref-1": [5.0, 5.0], "ref-2": [30.0, 12.0], "ref-3": [18.0, 33.0]}, {}):
        hall = Hall(rssi_noise_db=1.0, references=references)
        for k in range(60):
            rows = strengths(hall, 0.1 * k, "a", PLACE, **law)
            for name, place in references.items():
                rows += strengths(hall, 0.1 * k, name, (place[0], place[1]), **law)
            frame = put_rssi(hall, rows)
        assert frame.tag_id == ["a"]
        error.append(math.dist(place_of(frame, "a"), PLACE))
        if references:
            assert hall.engine.figures()["rssi_exponent.hall"] == pytest.approx(3.2, abs=0.1)
            assert hall.count("reference_readings") == 60 * 3 * 4
    assert error[0] < 2.0 < error[1]
