from __future__ import annotations

import threading
import time
from collections.abc import Callable
from itertools import islice, pairwise

import pytest

from trackmesh.protocol.codec import decode, open_envelope
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import PlotBatch, SensorInfo, TruthFrame
from trackmesh.sim.live import run_radar, run_truth, wait_until
from trackmesh.sim.radar import radar_batches, sensor_info
from trackmesh.sim.scenario import Scenario, ScenarioError
from trackmesh.sim.truth import World, truth_frame

KEYS = Keys("test")


def fast(scenario: Scenario) -> Scenario:
    """The same scenario with radars that turn ten times as fast."""
    radars = tuple(r.model_copy(update={"period_s": r.period_s / 10, "offset_s": 0.0}) for r in scenario.radars)
    return scenario.model_copy(update={"radars": radars})


class Running:
    """A loop in a thread, stopped and joined at the end."""

    def __init__(self, loop: Callable[[threading.Event], object]) -> None:
        self.stop = threading.Event()
        self.result: list[object] = []
        self.thread = threading.Thread(target=lambda: self.result.append(loop(self.stop)))

    def __enter__(self) -> Running:
        self.thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop.set()
        self.thread.join(10.0)
        assert not self.thread.is_alive()


def test_a_radar_publishes_what_the_recording_holds(two_radars: Scenario) -> None:
    scenario, hub, start_ns = fast(two_radars), MemoryHub(), time.time_ns()
    received: list[tuple[int, PlotBatch]] = []
    with MemoryBus(hub) as bus, MemoryBus(hub) as listener:
        plots = listener.subscribe(KEYS.plots("*"), capacity=1000)
        loop = Running(lambda stop: run_radar(bus, scenario, "north", 1, start_ns, stop, keys=KEYS, boot_id="b"))
        with loop:
            while len(received) < 40:
                sample = plots.receive(10.0)
                assert sample is not None
                assert sample.key == "test/@v1/plots/north"
                received.append((time.time_ns(), decode(sample.payload, PlotBatch, sample.encoding)))
            assert listener.alive(KEYS.live("sensor", "*")) == [KEYS.live("sensor", "north")]
        assert listener.alive(KEYS.live("sensor", "*")) == []
    sent = loop.result[0]
    assert isinstance(sent, int)
    assert sent >= 40
    first = received[0][1].scan
    assert first is not None
    world = World(scenario, 1)
    every = radar_batches(world, scenario.radar("north"), boot_id="b", start_ns=start_ns)
    begin = first.index * 32 + first.sector
    expected = list(islice(every, begin, begin + 40))
    for (arrived_ns, got), (due_ns, batch) in zip(received, expected, strict=True):
        assert got == batch.model_copy(update={"seq": got.seq})
        assert arrived_ns >= due_ns
    assert [batch.seq for _, batch in received] == list(range(40))


def test_a_radar_says_who_it_is_to_those_who_listen_and_those_who_ask(two_radars: Scenario) -> None:
    hub, info = MemoryHub(), sensor_info(two_radars, two_radars.radar("east"))
    with MemoryBus(hub) as bus, MemoryBus(hub) as listener:
        tokens = listener.watch_alive(KEYS.live("sensor", "*"))
        with Running(lambda stop: run_radar(bus, two_radars, "east", 1, time.time_ns(), stop, keys=KEYS)):
            event = tokens.receive(10.0)
            assert event is not None
            assert event.alive
            late = listener.subscribe(KEYS.sensor("*"), history=True).receive(10.0)
            assert late is not None
            assert decode(late.payload, SensorInfo, late.encoding) == info
            for parameters in ("", "fmt=json"):
                replies = list(listener.query(KEYS.sensor("*"), parameters=parameters, timeout_s=10.0))
                opened = [open_envelope(r.payload, r.encoding, SensorInfo) for r in replies]
                assert opened == [info, 1]


def test_the_truth_is_published_at_its_time(two_radars: Scenario) -> None:
    hub, start_ns = MemoryHub(), time.time_ns() - 400 * 10**9
    with MemoryBus(hub) as bus, MemoryBus(hub) as listener:
        truth = listener.subscribe(KEYS.truth("*"))
        with Running(lambda stop: run_truth(bus, two_radars, 1, start_ns, stop, keys=KEYS, period_s=0.05)):
            frames = []
            for _ in range(5):
                sample = truth.receive(10.0)
                assert sample is not None
                frames.append(decode(sample.payload, TruthFrame, sample.encoding))
    world = World(two_radars, 1)
    for frame in frames:
        assert frame == truth_frame(world, (frame.t_ns - start_ns) * 1e-9, start_ns)
    assert {b.t_ns - a.t_ns for a, b in pairwise(frames)} == {50_000_000}
    assert frames[0].t_ns >= start_ns + 400 * 10**9


def test_a_radar_that_fell_behind_goes_on_with_the_present(two_radars: Scenario) -> None:
    """The clock jumps by an hour in the middle: nothing of that hour is sent, and the numbering has no gap."""
    hub, start_ns, jumped = MemoryHub(), time.time_ns(), threading.Event()

    def clock() -> int:
        return time.time_ns() + (3600 * 10**9 if jumped.is_set() else 0)

    scenario, received = fast(two_radars), list[PlotBatch]()
    with MemoryBus(hub) as bus, MemoryBus(hub) as listener:
        plots = listener.subscribe(KEYS.plots("north"), capacity=1000)
        with Running(lambda stop: run_radar(bus, scenario, "north", 1, start_ns, stop, keys=KEYS, clock=clock)):
            while len(received) < 20:
                if len(received) == 5:
                    jumped.set()
                sample = plots.receive(20.0)
                assert sample is not None
                received.append(decode(sample.payload, PlotBatch, sample.encoding))
    turns = [batch.scan.index for batch in received if batch.scan is not None]
    assert [batch.seq for batch in received] == list(range(20))
    assert turns[0] < 10
    assert turns[-1] >= 9000
    assert not [turn for turn in turns if 20 < turn < 8900]


def test_an_unknown_radar_is_refused(two_radars: Scenario) -> None:
    with MemoryBus() as bus, pytest.raises(ScenarioError, match="no radar 'west'"):
        run_radar(bus, two_radars, "west", 1, 0, threading.Event())


def test_waiting_ends_at_once_when_stopped() -> None:
    stop = threading.Event()
    stop.set()
    assert not wait_until(time.time_ns() + 10**15, stop)
    assert wait_until(time.time_ns() - 1, threading.Event())
