"""How a service is: counters by reason, latencies, the health of its sensors."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from trackmesh.protocol.messages.base import BootId, Count, Finite, Id, Message, NonNegative, Seq, TopMessage, UnixNs


class SensorHealth(Message):
    """One sensor as a fusion unit sees it, or one network of readers as a tag service does: its plots are ranges."""

    sensor_id: Id
    alive: bool
    plots: Count
    batches: Count
    gaps: Count
    duplicates: Count
    refused: Count
    last_seq: Seq | None = None
    last_t_ns: UnixNs | None = None
    clutter_density: NonNegative | None = None
    silent_since_ns: UnixNs | None = None
    clock_offset_s: Finite | None = None
    clock_drift_ppm: Finite | None = None


class ServiceStatus(TopMessage):
    """One service's health, once a second.

    ``counters`` count since start, ``refused`` counts refused input by reason, ``latency_ms`` holds percentiles
    (``"p50"``, ``"p90"``, ``"p99"``) of the last minute, ``figures`` other present values by name, ``degraded`` a
    sentence for each thing that is missing or wrong now; it is empty when all is well.
    """

    most_bytes: ClassVar[int] = 4 * 2**20

    kind: Id
    unit_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: UnixNs
    state: Literal["starting", "compiling", "ready", "stopping"]
    uptime_s: NonNegative
    counters: dict[str, Count] = {}
    refused: dict[str, Count] = {}
    latency_ms: dict[str, NonNegative] = {}
    figures: dict[str, Finite] = {}
    sensors: Annotated[list[SensorHealth], Field(fail_fast=True)] = []
    routers: list[str] = []
    degraded: list[str] = []
