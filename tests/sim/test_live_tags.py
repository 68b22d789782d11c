from __future__ import annotations

import threading
import time

import pytest
from tests.sim.test_live import KEYS, Running

from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import RangeBatch
from trackmesh.sim.live import run_tags
from trackmesh.sim.scenario import Scenario, ScenarioError, load_scenario
from trackmesh.sim.tags import TagWorld

HOUR_NS = 3600 * 10**9


@pytest.fixture
def hall() -> Scenario:
    """The hall with a tick every twenty milliseconds."""
    scenario = load_scenario("rfid19")
    return scenario.model_copy(update={"tags": scenario.heard_tags().model_copy(update={"tick_s": 0.02})})


def test_readers_publish_what_the_recording_holds_when_it_is_due(hall: Scenario) -> None:
    hub, start_ns = MemoryHub(), time.time_ns()
    received: list[tuple[int, RangeBatch]] = []
    with MemoryBus(hub) as bus, MemoryBus(hub) as listener:
        ranges = listener.subscribe(KEYS.ranges("*"), capacity=1000)
        with Running(lambda stop: run_tags(bus, hall, 1, start_ns, stop, keys=KEYS, boot_id="b")):
            while len(received) < 30:
                sample = ranges.receive(10.0)
                assert sample is not None
                received.append((time.time_ns(), decode(sample.payload, RangeBatch, sample.encoding)))
            client = Client(listener, KEYS.realm)
            assert len(client.sensors()) == 19 == len(client.alive("sensor"))
        assert client.alive("sensor") == []
    world = TagWorld(hall, 1)
    assert [batch.seq for _, batch in received] == list(range(30))
    for arrived_ns, got in received:
        if len(got.t_ns):
            tick = round((int(got.t_ns[0]) - start_ns) / 2e7)
            assert got == world.batch(tick, boot_id="b", seq=got.seq, start_ns=start_ns)
            assert arrived_ns >= got.t_ns[0]


def test_who_fell_behind_goes_on_with_the_present_and_silent_readers_stay_silent(hall: Scenario) -> None:
    hub, start_ns, jumped = MemoryHub(), time.time_ns(), threading.Event()

    def clock() -> int:
        return time.time_ns() + (HOUR_NS if jumped.is_set() else 0)

    times: list[int] = []
    with MemoryBus(hub) as bus, MemoryBus(hub) as listener:
        ranges = listener.subscribe(KEYS.ranges("*"), capacity=1000)
        with Running(lambda stop: run_tags(bus, hall, 1, start_ns, stop, keys=KEYS, announce=False, clock=clock)):
            while len(times) < 20:
                if len(times) == 5:
                    jumped.set()
                sample = ranges.receive(20.0)
                assert sample is not None
                batch = decode(sample.payload, RangeBatch, sample.encoding)
                times += batch.t_ns[:1].tolist()
            assert Client(listener, KEYS.realm).sensors() == []
    assert times[0] < start_ns + HOUR_NS / 2 and times[-1] >= start_ns + HOUR_NS
    assert not [t for t in times if start_ns + 60 * 10**9 < t < start_ns + HOUR_NS]


def test_a_scenario_without_tags_is_refused() -> None:
    with MemoryBus() as bus, pytest.raises(ScenarioError, match="no \\[tags\\] section"):
        run_tags(bus, load_scenario("many"), 1, 0, threading.Event())
