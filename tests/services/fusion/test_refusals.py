"""Every kind of bad input to a running fusion service is refused for its reason, and counted in the status."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from tests.network.processes import wait_until
from tests.services.fusion.running import KEYS, PLOTS, Running, plot_batch, radar

from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackFrame

S = 1_000_000_000
GOOD_SEQ = 10
VALUES = [[1e4, 0.5], [2e4, 1.5]]


@pytest.fixture
def running() -> Iterator[Running]:
    """A service that knows the sensors north and east, and has accepted batch 10 of north."""
    with Running("wall", max_batch_bytes=50_000) as service:
        for name in ("north", "east"):
            service.sensor(radar(name))
        service.plots("north", good())
        service.settle()
        assert (service.accepted, service.refused) == (1, {})
        yield service


def good(**change: Any) -> PlotBatch:
    values = change.pop("values", VALUES)
    return plot_batch("north", change.pop("seq", GOOD_SEQ), change.pop("t_ns", time.time_ns()), values, **change)


def fields(**change: Any) -> bytes:
    """The next batch of north with some fields replaced."""
    return bytes(msgpack.packb(good(seq=GOOD_SEQ + 1).model_dump() | change))


def table(*values: float) -> dict[str, Any]:
    return {"dtype": "<f8", "shape": [2, 2], "data": np.array(values).tobytes()}


def at(seconds: float) -> bytes:
    return encode(good(seq=GOOD_SEQ + 1, t_ns=time.time_ns() + int(seconds * S)))


CASES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "truncated bytes": ("malformed", lambda: encode(good(seq=GOOD_SEQ + 1))[:-5]),
    "no bytes": ("malformed", lambda: b""),
    "random bytes": ("malformed", lambda: b"\xc1" + os.urandom(100)),
    "a whole other message": ("missing_field", lambda: encode(radar("north"))),
    "not a map": ("invalid", lambda: bytes(msgpack.packb([1, 2, 3]))),
    "another version": ("wrong_version", lambda: fields(schema_version=2)),
    "an unknown field": ("unknown_field", lambda: fields(speed=1.0)),
    "no seq": ("missing_field", lambda: bytes(msgpack.packb({"sensor_id": "north", "boot_id": "boot"}))),
    "bytes that are not the shape": ("wrong_length", lambda: fields(values=table(1e4, 0.5))),
    "fewer times than plots": ("wrong_length", lambda: fields(t_ns=[time.time_ns()])),
    "another dtype": ("wrong_dtype", lambda: fields(values=table(1e4, 0.5, 2e4, 1.5) | {"dtype": "<f4"})),
    "text for an array": ("wrong_type", lambda: fields(values="1e4")),
    "NaN": ("not_finite", lambda: fields(values=table(1e4, np.nan, 2e4, 1.5))),
    "infinity": ("not_finite", lambda: fields(values=table(np.inf, 0.5, 2e4, 1.5))),
    "an azimuth out of range": ("out_of_bounds", lambda: fields(values=table(1e4, 7.0, 2e4, 1.5))),
    "a negative range": ("out_of_bounds", lambda: fields(values=table(-1.0, 0.5, 2e4, 1.5))),
    "unknown columns": ("invalid", lambda: fields(columns=["range_m", "speed"])),
    "far in the future": ("future", lambda: at(60.0)),
    "far in the past": ("past", lambda: at(-3600.0)),
    "the beginning of time": ("past", lambda: encode(good(seq=GOOD_SEQ + 1, t_ns=0))),
    "the end of time": ("future", lambda: encode(good(seq=GOOD_SEQ + 1, t_ns=2**63 - 1))),
    "a duplicate": ("duplicate_seq", lambda: encode(good())),
    "an old batch": ("out_of_order_seq", lambda: encode(good(seq=GOOD_SEQ - 1))),
    "another sensor's id": ("wrong_sensor", lambda: encode(plot_batch("east", 1, time.time_ns(), VALUES))),
    "an invalid sensor id": ("invalid_id", lambda: fields(sensor_id="../north")),
    "a batch over the limit": ("too_large", lambda: encode(plot_batch("north", 11, time.time_ns(), VALUES * 1100))),
    "too many plots": ("too_large", lambda: bytes(50_001)),
    "geodetic plots without an origin": (
        "no_origin",
        lambda: encode(good(seq=GOOD_SEQ + 1, columns=["latitude_deg", "longitude_deg"],
                            variances=np.ones((2, 2)), values=np.zeros((2, 2)))),
    ),
    "columns without sigma": (
        "no_variance", lambda: encode(good(seq=GOOD_SEQ + 1, columns=["east_m", "north_m"])),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_bad_plots_are_refused_and_counted(running: Running, case: str) -> None:
    reason, make = CASES[case]
    running.plots("north", make())
    running.settle()
    status = running.status()
    assert status.refused == {reason: 1}
    (north,) = [sensor for sensor in status.sensors if sensor.sensor_id == "north"]
    assert (north.refused, north.duplicates) == (1, int(reason == "duplicate_seq"))
    # And the next good one is welcome.
    running.plots("north", good(seq=GOOD_SEQ + 2))
    running.settle()
    assert (running.accepted, running.refused) == (2, {reason: 1})


def test_another_schema_is_refused(running: Running) -> None:
    running.plots("north", encode(good(seq=GOOD_SEQ + 1)), encoding(TrackFrame))
    running.settle()
    assert running.status().refused == {"wrong_schema": 1}


def test_json_is_as_good_and_as_strictly_judged(running: Running) -> None:
    running.plots("north", encode(good(seq=GOOD_SEQ + 1), "json"), encoding(PlotBatch, "json"))
    running.plots("north", encode(good(seq=GOOD_SEQ + 1), "json"), encoding(PlotBatch, "json"))
    running.settle()
    assert (running.accepted, running.status().refused) == (2, {"duplicate_seq": 1})


def test_an_old_boot_is_over_once_another_one_came(running: Running) -> None:
    running.plots("north", good(seq=0, boot_id="second"))
    running.plots("north", good(seq=GOOD_SEQ + 1))
    running.plots("north", good(seq=1, boot_id="second"))
    running.settle()
    assert (running.accepted, running.status().refused) == (3, {"old_boot": 1})


def test_gaps_are_counted_and_nothing_is_refused(running: Running) -> None:
    running.plots("north", good(seq=GOOD_SEQ + 5))
    running.settle()
    (north,) = [sensor for sensor in running.status().sensors if sensor.sensor_id == "north"]
    assert (north.gaps, north.last_seq, running.refused) == (4, GOOD_SEQ + 5, {})


def test_a_flood_of_one_unknown_sensor_is_held_to_a_limit_and_refused(running: Running) -> None:
    for seq in range(200):
        running.plots("ghost", plot_batch("ghost", seq, time.time_ns(), VALUES))
    running.settle(unjudged=64)
    wait_until(lambda: running.refused == {"unknown_sensor": 200 - 64}, "the surplus is refused")
    assert running.status().refused == {"unknown_sensor": 136}
    # Once it says who it is, what was held is taken.
    running.sensor(radar("ghost"))
    running.settle()
    assert running.accepted == 1 + 64


def test_a_flood_of_many_unknown_sensors_is_refused(running: Running) -> None:
    for k in range(1000):
        running.plots(f"ghost{k}", plot_batch(f"ghost{k}", 0, time.time_ns(), VALUES))
    running.settle(unjudged=256)
    wait_until(lambda: running.refused == {"too_many_sensors": 1000 - 256}, "the surplus is refused")
    running.plots("north", good(seq=GOOD_SEQ + 1))
    wait_until(lambda: running.accepted == 2, "the known sensor is heard")
    assert len(running.status().sensors) <= 256 + 2


def test_a_sensor_that_speaks_for_another_or_nonsense_is_refused(running: Running) -> None:
    kind = encoding(SensorInfo)
    wild = radar("north").model_dump() | {"max_range_m": 1e300}
    for payload in (encode(radar("east")), b"\xc1", msgpack.packb(wild)):
        running.put(KEYS.sensor("north"), payload, kind)
    expected = {"wrong_sensor": 1, "malformed": 1, "out_of_bounds": 1}
    wait_until(lambda: running.refused == expected, "all are refused")
    assert running.status().refused == expected
    running.plots("north", good(seq=GOOD_SEQ + 1))
    wait_until(lambda: running.accepted == 2, "the sensor is heard as before")


def test_a_message_with_four_megabytes_of_errors_does_not_hold_up_the_service() -> None:
    with Running("wall") as service:
        service.sensor(radar("north"))
        fields = good().model_dump() | {"labels": [1] * 4_000_000}
        service.plots("north", msgpack.packb(fields), PLOTS)
        service.plots("north", good())
        service.settle()
        assert (service.accepted, service.refused) == (1, {"invalid": 1})
