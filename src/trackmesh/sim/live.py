"""Simulated sensors in real time: a radar and the truth, published as they happen.

Every instant is counted from ``start_ns``, the moment at which the scenario began, so that nothing drifts and
processes that share scenario, seed and start show one world.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from trackmesh.protocol.bus import Bus
from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.ranging import RangePublisher
from trackmesh.protocol.sensor import SensorPublisher, plot_history
from trackmesh.sim.radar import radar_batches, sensor_info
from trackmesh.sim.recording import TRUTH_PERIOD_S
from trackmesh.sim.scenario import Scenario
from trackmesh.sim.tags import TagWorld, reader_infos
from trackmesh.sim.truth import World, truth_frame

LATEST_NS = 1_000_000_000
"""Tags that fell behind by more go on with the present."""

LONGEST_WAIT_S = 1.0
"""The wall clock may be set while we wait; it is looked at again after this time."""

Clock = Callable[[], int]


def run_radar(
    bus: Bus,
    scenario: Scenario,
    radar_id: str,
    seed: int,
    start_ns: int,
    stop: threading.Event,
    *,
    keys: Keys | None = None,
    boot_id: str | None = None,
    clock: Clock = time.time_ns,
) -> int:
    """Publish a radar's sectors, each when the beam has left it, until ``stop`` is set; returns how many.

    It begins with the sector that the beam is in now. Who fell behind by more than a turn, such as a machine that
    slept, goes on with the present and does not send what is past.

    Raises:
        ScenarioError: the scenario has no such radar.
    """
    radar, keys = scenario.radar(radar_id), keys or Keys()
    world, sent, info = World(scenario, seed), 0, sensor_info(scenario, radar)
    history = plot_history(radar.sectors / radar.period_s)
    with SensorPublisher(bus, keys.realm, info, history=history, boot_id=boot_id) as sensor:
        while not stop.is_set():
            after_s = max(0.0, (clock() - start_ns) * 1e-9)
            batches = radar_batches(
                world, radar, boot_id=sensor.boot_id, start_ns=start_ns, after_s=after_s, first_seq=sent
            )
            for due_ns, batch in batches:
                if not wait_until(due_ns, stop, clock) or clock() - due_ns > radar.period_s * 1e9:
                    break
                sensor.publish_batch(batch)
                sent += 1
    return sent


def run_tags(
    bus: Bus,
    scenario: Scenario,
    seed: int,
    start_ns: int,
    stop: threading.Event,
    *,
    announce: bool = True,
    keys: Keys | None = None,
    boot_id: str | None = None,
    clock: Clock = time.time_ns,
) -> int:
    """Publish what the readers of a scenario hear of its tags, tick by tick, until ``stop`` is set; how many batches.

    Who fell behind by more than a second goes on with the present. Without ``announce`` the readers do not say where
    they stand: a tag service has to know it from its file.

    Raises:
        ScenarioError: the scenario has no tags.
    """
    world, sent = TagWorld(scenario, seed), 0
    tick_ns = round(world.tags.tick_s * 1e9)
    infos = reader_infos(scenario) if announce else []
    realm = (keys or Keys()).realm
    tick = max(0, -((start_ns - clock()) // tick_ns))
    with RangePublisher(bus, realm, world.tags.network_id, infos, boot_id=boot_id) as network:
        while wait_until(start_ns + tick * tick_ns, stop, clock):
            network.publish_batch(world.batch(tick, boot_id=network.boot_id, seq=sent, start_ns=start_ns))
            sent += 1
            behind = (clock() - start_ns) // tick_ns - tick
            tick += behind if behind * tick_ns > LATEST_NS else 1
    return sent


def run_truth(
    bus: Bus,
    scenario: Scenario,
    seed: int,
    start_ns: int,
    stop: threading.Event,
    *,
    keys: Keys | None = None,
    period_s: float = TRUTH_PERIOD_S,
    clock: Clock = time.time_ns,
) -> int:
    """Publish the truth every ``period_s`` until ``stop`` is set, leaving out what is past; returns how many frames."""
    world, sent = World(scenario, seed), 0
    publisher = bus.publisher((keys or Keys()).truth(scenario.name))
    period_ns = round(period_s * 1e9)
    k = max(0, -((start_ns - clock()) // period_ns))
    while wait_until(start_ns + k * period_ns, stop, clock):
        frame = truth_frame(world, k * period_s, start_ns)
        publisher.put(encode(frame), encoding(frame))
        sent += 1
        k = max(k + 1, (clock() - start_ns) // period_ns)
    publisher.close()
    return sent


def wait_until(due_ns: int, stop: threading.Event, clock: Clock = time.time_ns) -> bool:
    """Wait for a time of the wall clock: True when it has come, False when ``stop`` was set first."""
    while not stop.is_set():
        left_s = (due_ns - clock()) * 1e-9
        if left_s <= 0.0:
            return True
        stop.wait(min(left_s, LONGEST_WAIT_S))
    return False
