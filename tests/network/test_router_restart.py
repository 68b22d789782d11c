"""The only router is killed and started again while plots flow: what the picture loses, which should be nothing."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from tests.network.processes import Processes, RouterProcess, wait_until
from tests.network.realm import Realm, confirmed, next_where

from trackmesh.protocol.client import Client, SensorPublisher, Watch
from trackmesh.protocol.messages import COASTING, ENDED, SensorHealth, SensorInfo, ServiceStatus, TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus

RATE_HZ = 25.0
SIGMA_M = 2.0
START_M = np.array([[0.0, 0.0], [3000.0, 0.0], [0.0, 3000.0], [3000.0, 3000.0]])
VELOCITY_MPS = np.array([[20.0, 0.0], [0.0, 20.0], [-15.0, 5.0], [5.0, -15.0]])
SENSORS = ("a", "b")


class FastSensor:
    """A position sensor that sees four targets 25 times a second, in a session and a thread of its own."""

    def __init__(self, endpoint: str, name: str, history: int | None) -> None:
        self.sent = 0
        self.name = name
        info = SensorInfo(
            sensor_id=name, kind="position", site_enu_m=[0.0, 0.0, 0.0], period_s=1.0 / RATE_HZ, p_detect=1.0,
            max_range_m=1e4, sigma={"east_m": SIGMA_M, "north_m": SIGMA_M}, clutter_density=1e-9,
        )  # fmt: skip
        self._bus = ZenohBus.open([endpoint], timeout_s=10.0)
        self._publisher = SensorPublisher(self._bus, "trackmesh", info, history=history)
        self._random = np.random.default_rng(ord(name))
        self._began_ns = time.time_ns()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(1.0 / RATE_HZ):
            now_ns = time.time_ns()
            truth_m = START_M + VELOCITY_MPS * (now_ns - self._began_ns) / 1e9
            seen_m = truth_m + self._random.normal(0.0, SIGMA_M, truth_m.shape)
            self._publisher.publish([now_ns] * len(seen_m), ["east_m", "north_m"], seen_m)
            self.sent += 1

    def silence(self) -> None:
        """Publish no more, but stay."""
        self._stop.set()
        self._thread.join()

    def close(self) -> None:
        self.silence()
        self._publisher.close()
        self._bus.close()


class Scene:
    """A unit and two fast sensors at a router of their own."""

    def __init__(self, stack: ExitStack, processes: Processes, folder: Path) -> None:
        self._stack = stack
        self.router: RouterProcess = processes.router()
        self.realm = Realm(processes, self.router, folder)
        bus = stack.enter_context(ZenohBus.open([self.realm.endpoint], timeout_s=10.0))
        self.client = Client(bus)
        self.unit, _ = self.realm.fusion(self.client)
        self.frames: list[TrackFrame] = []
        self._watch = stack.enter_context(self.client.watch_tracks(capacity=100_000))
        self.statuses: Watch[ServiceStatus] = stack.enter_context(self.client.watch_statuses("fusion"))
        self.sensors: list[FastSensor] = []

    def start(self, history: int | None = None) -> set[int]:
        """Start the sensors; the ids of the tracks."""
        for name in SENSORS:
            sensor = FastSensor(self.realm.endpoint, name, history)
            self._stack.callback(sensor.close)
            self.sensors.append(sensor)
        return confirmed(self.next_frame(lambda f: len(confirmed(f)) == len(START_M)))

    def next_frame(self, condition: Callable[[TrackFrame], object]) -> TrackFrame:
        """The next frame for which the condition holds; all on the way to it are kept."""

        def kept(frame: TrackFrame) -> bool:
            self.frames.append(frame)
            return bool(condition(frame))

        return next_where(self._watch, kept, "a frame", 30.0)

    def ids_fed_from_now_on(self) -> set[int]:
        """The ids in the first frame in which every track has a plot from after this call."""
        now_ns = time.time_ns()
        fed = self.next_frame(lambda f: f.updated_t_ns.size and f.updated_t_ns.min() > now_ns)
        return set(fed.track_id[fed.status != ENDED].tolist())

    def send(self, n: int) -> None:
        """Wait until each sensor has sent ``n`` more."""
        goals = [sensor.sent + n for sensor in self.sensors]
        wait_until(lambda: all(s.sent >= goal for s, goal in zip(self.sensors, goals, strict=True)), "plots are sent")

    def silence(self) -> list[SensorHealth]:
        """End the plots; how the unit finds its sensors once it has the last of them."""
        for sensor in self.sensors:
            sensor.silence()
        sent = [sensor.sent for sensor in self.sensors]

        def whole(status: ServiceStatus) -> bool:
            return [(s.last_seq or 0) + 1 for s in status.sensors] == sent

        return next_where(self.statuses, whole, f"the last of {sent} batches has come", 15.0).sensors


@pytest.fixture
def scene(processes: Processes, tmp_path: Path) -> Iterator[Scene]:
    with ExitStack() as stack:
        yield Scene(stack, processes, tmp_path)


def test_a_killed_router_costs_no_plot_no_track_and_no_frame(scene: Scene) -> None:
    ids = scene.start()
    for _ in range(2):
        scene.router.process.kill()
        scene.send(60)
        scene.router.restart()
        assert scene.ids_fed_from_now_on() == ids
        scene.send(20)
    heard = scene.silence()
    assert [(s.gaps, s.duplicates, s.refused) for s in heard] == [(0, 0, 0)] * 2
    assert [s.batches for s in heard] == [sensor.sent for sensor in scene.sensors]
    last = scene.next_frame(lambda f: f.status.size and (f.status == COASTING).all())
    numbers = [frame.seq for frame in scene.frames]
    assert numbers == list(range(numbers[0], last.seq + 1))
    assert set().union(*(set(frame.track_id.tolist()) for frame in scene.frames)) == ids


def test_of_an_outage_longer_than_the_cache_the_last_plots_are_recovered(scene: Scene) -> None:
    kept, unheard = 10, 100
    ids = scene.start(history=kept)
    scene.router.process.kill()
    scene.send(unheard)
    scene.router.restart()
    scene.send(50)
    assert scene.ids_fed_from_now_on() == ids
    heard = scene.silence()
    for health, sensor in zip(heard, scene.sensors, strict=True):
        # What is lost is told, to the batch.
        assert health.batches + health.gaps == sensor.sent
        assert unheard - 2 * kept < health.gaps <= sensor.sent - kept
    assert [(s.duplicates, s.refused) for s in heard] == [(0, 0)] * 2
    assert not any(b.seq <= a.seq for a, b in itertools.pairwise(scene.frames))
