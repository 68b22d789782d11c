"""A small deployment of real processes: a router, fusion units, two quickly turning radars."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from tests.network.processes import Process, Processes, RouterProcess

from trackmesh.protocol.client import Client, Watch
from trackmesh.protocol.messages import CONFIRMED, ServiceStatus, TrackFrame
from trackmesh.protocol.messages.base import TopMessage

TARGETS = 8
RADARS = ("north", "east")
READY_S = 150.0
"""A unit that starts on changed sources compiles its numerics."""

_SCENARIO = """
description = "Eight aircraft in straight flight, two radars that turn quickly"
duration_s = 600.0

[origin]
latitude_deg = 48.35
longitude_deg = 11.78

[targets]
count = 8
quiet_count = 8
area_enu_m = [-60e3, -60e3, 60e3, 60e3]
speed_mps = [100.0, 200.0]

[[radars]]
id = "north"
site_enu_m = [0.0, 0.0, 0.0]
period_s = 1.0
sigma_range_m = 30.0
sigma_azimuth_deg = 0.05
clutter_per_scan = 2.0
max_range_m = 120e3
sectors = 8

[[radars]]
id = "east"
site_enu_m = [10e3, 5e3, 0.0]
period_s = 1.25
offset_s = 0.3
sigma_range_m = 30.0
sigma_azimuth_deg = 0.05
clutter_per_scan = 2.0
max_range_m = 120e3
sectors = 8
"""


M = TypeVar("M", bound=TopMessage)


def next_where(watch: Watch[M], condition: Callable[[M], object], what: str, timeout_s: float) -> M:
    """The next message for which the condition holds; fails with ``what`` if none comes in time."""
    deadline = time.monotonic() + timeout_s
    while (left_s := deadline - time.monotonic()) > 0:
        message = watch.receive(left_s)
        if message is not None and condition(message):
            return message
    pytest.fail(f"{what}: not within {timeout_s:g} s")


def confirmed(frame: TrackFrame) -> set[int]:
    """Ids of the confirmed tracks."""
    return set(frame.track_id[frame.status == CONFIRMED].tolist())


def write_scenario(folder: Path) -> Path:
    """The scenario as a file."""
    path = folder / "quick.toml"
    path.write_text(_SCENARIO)
    return path


class Realm:
    """One key space at one router; what runs in it is kept by whoever starts it."""

    main: Process
    sensors: dict[str, Process]

    def __init__(self, processes: Processes, router: RouterProcess, folder: Path) -> None:
        self._processes = processes
        self._start_ns = time.time_ns()
        self.endpoint = router.endpoint
        self.scenario = write_scenario(folder)

    def trackmesh(self, *arguments: str) -> Process:
        """Start a command that joins the network."""
        return self._processes.start("-m", "trackmesh.services.cli.main", *arguments, "--connect", self.endpoint)

    def fusion(self, client: Client, unit: str = "main", number: int = 0, *more: str) -> tuple[Process, ServiceStatus]:
        """Start a unit; it, and its status once it is ready."""
        with client.watch_statuses("fusion", unit) as watch:
            process = self.trackmesh("fusion", "--unit-id", unit, "--unit-number", str(number), *more)
            ready = next_where(watch, lambda s: s.state == "ready", f"the unit {unit} is ready", READY_S)
        return process, ready

    def radar(self, name: str, seed: int = 1) -> Process:
        """Start a radar; all of one realm show one world."""
        return self.trackmesh(
            *("sim", "radar", "--radar", name, "--scenario", str(self.scenario)),
            *("--seed", str(seed), "--start-ns", str(self._start_ns)),
        )

    def radars(self) -> dict[str, Process]:
        return {name: self.radar(name) for name in RADARS}


def wait_for_tracks(client: Client, unit: str = "main", timeout_s: float = 40.0) -> TrackFrame:
    """The next frame with all targets confirmed."""
    with client.watch_tracks(unit) as watch:
        return next_where(watch, lambda f: len(confirmed(f)) == TARGETS, f"{unit} has all tracks", timeout_s)
