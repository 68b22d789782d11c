"""A fusion service in this process, on a bus in memory, and a hand on its inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from tests.network.processes import wait_until

from trackmesh.protocol.arrays import IntArray
from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import PlotBatch, SensorInfo, ServiceStatus
from trackmesh.services.fusion.service import FusionService
from trackmesh.services.fusion.settings import FusionSettings
from trackmesh.services.runtime import ServiceRuntime

KEYS = Keys("test")
PLOTS = encoding(PlotBatch)


class Running:
    """The service, and what it is sent: raw payloads at any key.

    Attributes:
        sent: batches put so far, whatever they were.
    """

    def __init__(self, clock: Literal["wall", "data"], *, hub: MemoryHub | None = None, **settings: Any) -> None:
        hub = hub or MemoryHub()
        given = FusionSettings(realm="test", clock=clock, **settings)
        self.bus = MemoryBus(hub)
        self.client = Client(self.bus, "test")
        self.statuses = self.client.watch_statuses()
        self.frames = self.client.watch_tracks(capacity=100_000)
        self.runtime = ServiceRuntime("fusion", given, bus=MemoryBus(hub))
        self.service = FusionService(self.runtime, given)
        self.sent = 0
        self._publishers: dict[str, Any] = {}

    def put(self, key: str, payload: bytes, kind: str) -> None:
        if key not in self._publishers:
            self._publishers[key] = self.bus.publisher(key)
        self._publishers[key].put(payload, kind)

    def plots(self, sensor_id: str, payload: bytes | PlotBatch, kind: str = PLOTS) -> None:
        """Plots, or what is taken for them, at the key of a sensor."""
        self.sent += 1
        self.put(KEYS.plots(sensor_id), payload if isinstance(payload, bytes) else encode(payload), kind)

    def sensor(self, info: SensorInfo) -> None:
        self.put(KEYS.sensor(info.sensor_id), encode(info), encoding(info))
        wait_until(lambda: info.sensor_id in self.service.engine.sensors, f"{info.sensor_id} is known")

    @property
    def accepted(self) -> int:
        return self.runtime.counters.counts().get("batches", 0)

    @property
    def refused(self) -> dict[str, int]:
        return self.runtime.counters.refused()

    def settle(self, unjudged: int = 0) -> None:
        """Wait until everything sent but ``unjudged`` is accepted or refused."""

        def judged() -> bool:
            assert self.runtime.exit_code == 0, "the service has failed"
            return self.accepted + sum(self.refused.values()) >= self.sent - unjudged

        wait_until(judged, f"{self.sent} batches are judged", 30.0)

    def status(self) -> ServiceStatus:
        """The status as published now."""
        self.runtime.set_state("ready")
        latest = None
        while (status := self.statuses.receive(0.0)) is not None:
            latest = status
        assert latest is not None and latest.state == "ready"
        return latest

    def __enter__(self) -> Running:
        self.runtime.start()
        self.service.start()
        return self

    def __exit__(self, *exc: object) -> None:
        assert self.runtime.close(), "the service did not stop"
        assert self.runtime.exit_code == 0


def plot_batch(
    sensor_id: str, seq: int, t_ns: int | IntArray, values: Sequence[Sequence[float]], **change: Any
) -> PlotBatch:
    """Polar plots, all at one time or a time each."""
    fields: dict[str, Any] = {
        "sensor_id": sensor_id,
        "boot_id": "boot",
        "seq": seq,
        "t_ns": np.broadcast_to(t_ns, len(values)).copy(),
        "columns": ["range_m", "azimuth_rad"],
        "values": np.array(values, float).reshape(-1, 2),
    }
    return PlotBatch(**fields | change)


def radar(sensor_id: str) -> SensorInfo:
    return SensorInfo(
        sensor_id=sensor_id,
        kind="radar",
        site_enu_m=[0.0, 0.0, 0.0],
        period_s=2.0,
        p_detect=0.9,
        max_range_m=1e5,
        sigma={"range_m": 20.0, "azimuth_rad": 1e-3},
    )
