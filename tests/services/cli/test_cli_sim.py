"""When a simulated world begins and ends."""

from __future__ import annotations

import time

import pytest
import typer
from tests.network.processes import Processes, RouterProcess, processes, router, wait_until

from trackmesh.services.cli.services import world_time_ns

__all__ = ["processes", "router"]


def test_a_world_begins_now_or_when_it_is_said() -> None:
    before_ns = time.time_ns()
    begin_ns, end_ns = world_time_ns(None, None)
    assert before_ns <= begin_ns <= time.time_ns()
    assert end_ns is None
    assert world_time_ns(5, None) == (5, None)


def test_sensors_that_are_started_apart_see_one_world(monkeypatch: pytest.MonkeyPatch) -> None:
    second_ns = 10**9
    for now_s, begin_s in ((600.0, 600), (899.999, 600), (900.0, 900)):
        monkeypatch.setattr(time, "time_ns", lambda now_s=now_s: int(now_s * 1e9))
        assert world_time_ns(None, 300.0) == (begin_s * second_ns, (begin_s + 300) * second_ns)


def test_both_beginnings_are_one_too_many() -> None:
    with pytest.raises(typer.BadParameter, match="--start-ns or --start-every"):
        world_time_ns(5, 300.0)


@pytest.mark.process
def test_a_sensor_ends_with_its_world(processes: Processes, router: RouterProcess) -> None:
    command = ("sim", "radar", "--radar", "north", "--start-every", "2", "--connect", router.endpoint)
    process = processes.start("-m", "trackmesh.services.cli.main", *command)
    wait_until(lambda: not process.running, "the sensor ends")
    assert process.stop() == 0
    assert "the scenario has ended" in process.output
