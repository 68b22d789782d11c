"""A running unit and sensors that fall silent, flood it, or have a wrong clock: counted, told, no harm done."""

from __future__ import annotations

import time

import pytest
from tests.network.processes import wait_until
from tests.services.fusion.running import KEYS, Running, plot_batch, radar

from trackmesh.protocol.messages import ServiceStatus
from trackmesh.services import sensor_watch

S = 1_000_000_000


def send(running: Running, name: str, seq: int, ahead_s: float = 0.0) -> None:
    running.plots(name, plot_batch(name, seq, time.time_ns() + round(ahead_s * S), [[1e4, 1.0]]))


def accounted(status: ServiceStatus, name: str) -> int:
    """Batches of a sensor that were taken, refused, or given up before that."""
    judged = sum(sensor.batches + sensor.refused for sensor in status.sensors if sensor.sensor_id == name)
    return judged + int(status.figures["batches_dropped_here"])


def test_a_flood_is_refused_and_costs_the_others_nothing() -> None:
    with Running("wall", max_batches_per_s=20.0) as running:
        for name in ("quiet", "loud"):
            running.sensor(radar(name))
        quiet = 0
        for seq in range(5000):
            send(running, "loud", seq)
            if seq % 100 == 0:
                send(running, "quiet", quiet)
                quiet += 1
        wait_until(lambda: accounted(running.status(), "loud") == 5000, "all of the loud one is judged")
        status = running.status()
    heard = {sensor.sensor_id: sensor for sensor in status.sensors}
    assert heard["quiet"].batches == quiet
    assert (heard["quiet"].gaps, heard["quiet"].refused) == (0, 0)
    assert status.refused["too_fast"] == heard["loud"].refused > 1000


def test_a_silent_sensor_is_told_until_it_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensor_watch, "SILENT_S", 0.3)
    monkeypatch.setattr(sensor_watch, "SILENT_PERIODS", 0.1)
    with Running("wall") as running:
        running.sensor(radar("a"))
        send(running, "a", 0)
        running.settle()
        token = running.bus.declare_alive(KEYS.live("sensor", "a"))
        wait_until(lambda: any("alive, but no batch" in line for line in running.status().degraded), "its silence")
        token.close()
        wait_until(lambda: any("a is silent" in line and "down" in line for line in running.status().degraded), "death")
        (health,) = running.status().sensors
        assert health.silent_since_ns is not None and health.silent_since_ns < time.time_ns()
        send(running, "a", 1)
        wait_until(lambda: running.status().degraded == [], "it is back")


def test_a_clock_that_is_ahead_explains_why_nothing_is_taken() -> None:
    with Running("wall") as running:
        running.sensor(radar("a"))
        for seq in range(10):
            send(running, "a", seq, 5.0)
        running.settle()
        status = running.status()
        assert status.refused == {"future": 10}
        assert any("The clock of sensor a is 5.0" in line and "ahead" in line for line in status.degraded)
        assert status.sensors[0].clock_offset_s == pytest.approx(5.0, abs=0.2)
