"""A tag service in this process, on a bus in memory, and a hand on its inputs."""

from __future__ import annotations

from typing import Any, Literal

from tests.network.processes import wait_until

from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import RangeBatch, SensorInfo, ServiceStatus
from trackmesh.services.runtime import ServiceRuntime
from trackmesh.services.tags.service import TagService
from trackmesh.services.tags.settings import TagSettings

KEYS = Keys("test")
RANGES = encoding(RangeBatch)


class Running:
    """The service, and what it is sent: raw payloads at any key.

    Attributes:
        sent: batches put so far, whatever they were.
    """

    def __init__(self, clock: Literal["wall", "data"] = "data", **settings: Any) -> None:
        hub = MemoryHub()
        engine = {"frame_period_s": 0.0, "reorder_s": 0.0} | settings.pop("engine", {})
        given = TagSettings(realm="test", clock=clock, engine=engine, **settings)
        self.bus = MemoryBus(hub)
        self.client = Client(self.bus, "test")
        self.statuses = self.client.watch_statuses()
        self.frames = self.client.watch_tags(capacity=100_000)
        self.runtime = ServiceRuntime("tags", given, bus=MemoryBus(hub))
        self.service = TagService(self.runtime, given)
        self.sent = 0
        self._publishers: dict[str, Any] = {}

    def put(self, key: str, payload: bytes, kind: str) -> None:
        if key not in self._publishers:
            self._publishers[key] = self.bus.publisher(key)
        self._publishers[key].put(payload, kind)

    def ranges(self, payload: bytes | RangeBatch, network_id: str = "hall", kind: str = RANGES) -> None:
        """Ranges, or what is taken for them, at the key of a network."""
        self.sent += 1
        self.put(KEYS.ranges(network_id), payload if isinstance(payload, bytes) else encode(payload), kind)

    def reader(self, *infos: SensorInfo) -> None:
        for info in infos:
            self.put(KEYS.sensor(info.sensor_id), encode(info), encoding(info))
        wait_until(lambda: all(map(self.knows, infos)), "the readers are known")

    def knows(self, info: SensorInfo) -> bool:
        return self.service.engine.readers.infos.get(info.sensor_id) == info

    @property
    def accepted(self) -> int:
        return self.runtime.counters.counts().get("batches", 0)

    @property
    def refused(self) -> dict[str, int]:
        return self.runtime.counters.refused()

    def settle(self) -> None:
        """Wait until everything sent is accepted or refused."""

        def judged() -> bool:
            assert self.runtime.exit_code == 0, "the service has failed"
            return self.accepted + sum(self.refused.values()) >= self.sent

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
