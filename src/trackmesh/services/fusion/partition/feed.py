"""What units tell each other, on the bus: bands, pictures, registrations, who is alive."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from trackmesh.protocol.bus import Sample
from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.keys import last_chunk
from trackmesh.protocol.messages import BandFrame, Registration, TrackFrame
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.partition.band import Share
from trackmesh.services.fusion.partition.engine import PartitionedEngine
from trackmesh.services.fusion.partition.sensor_plots import SensorPlots
from trackmesh.services.fusion.settings import FusionSettings
from trackmesh.services.runtime import ServiceRuntime

M = TypeVar("M", BandFrame, TrackFrame, Registration)

_WAITING = 256
_SURE_S, _BACK_S = 0.3, 2.0
"""Who loses the network hears all units go, itself among them: so long it waits for the news of itself; and for that of
others when it is back, for they may need a moment more.
"""

_FOLLOW_EVERY_S = 0.5


def partitioned_engine(settings: FusionSettings, unit: Unit, started_t_ns: int) -> PartitionedEngine:
    """The engine of a unit with an area.

    Raises:
        ValueError: the settings have none, or none that is right.
    """
    if settings.partition is None:
        raise ValueError("the unit has no area")
    part = settings.partition
    share = Share(
        part.place(settings.origin),
        settings.band_width_m(),
        part.handover_m,
        part.confirm_s,
        part.standby,
        started_t_ns,
    )
    return PartitionedEngine(settings.engine, unit, share, settings.origin)


class PartitionFeed:
    """Takes what the other units tell to the engine, and tells them what it has to say.

    Its methods are of the thread that owns the engine; ``lock`` guards the engine against queries.

    Attributes:
        plots: of the sensors that the unit needs.
    """

    def __init__(self, runtime: ServiceRuntime, settings: FusionSettings, lock: threading.Lock, capacity: int) -> None:
        self._runtime = runtime
        self._unit_id = settings.unit_id
        self._sensors = frozenset(settings.sensors)
        self._lock = lock
        self._alive: set[str] = set()
        self._changed_s = self._here_s = -1e18
        self._told_alive = False
        self._follow_due_s = 0.0
        self._owned, self._inherited = False, 0
        keys, bus = runtime.keys, runtime.bus
        self._publisher = bus.publisher(keys.band(settings.unit_id), history=1)
        runtime.on_exit(self._publisher.close)
        self._bands = runtime.closing(bus.subscribe(keys.band("*"), history=True, capacity=_WAITING))
        self._tracks = runtime.closing(bus.subscribe(keys.tracks("*"), capacity=_WAITING))
        self._registrations = runtime.closing(bus.subscribe(keys.registration("*"), history=True, capacity=_WAITING))
        self.plots = runtime.closing(SensorPlots(runtime, capacity))

    def note_alive(self, unit: str, alive: bool) -> None:
        """Take note of a unit that came or went; of ourselves too."""
        (self._alive.add if alive else self._alive.discard)(unit)
        self._changed_s = time.monotonic()
        self._told_alive = False
        if unit == self._unit_id:
            self._here_s = self._changed_s
        if unit != self._unit_id:
            self._runtime.log.info("unit %s %s", unit, "is there" if alive else "is gone")

    def exchange(self, engine: FusionEngine) -> None:
        """Everything that has come since the last call goes to the engine, what the engine has to say goes out."""
        assert isinstance(engine, PartitionedEngine)
        self._tell_alive(engine)
        while (sample := self._bands.receive(timeout_s=0)) is not None:
            self._take(sample, BandFrame, engine.band)
        while (sample := self._tracks.receive(timeout_s=0)) is not None:
            self._take(sample, TrackFrame, engine.neighbour_tracks)
        while (sample := self._registrations.receive(timeout_s=0)) is not None:
            self._take(sample, Registration, engine.neighbour_registration)
        if engine.neighbours.conflict:
            self._runtime.fail(engine.neighbours.conflict)
        told = engine.band_message()
        if told is not None:
            self._publisher.put(encode(told), encoding(told))
        self._follow(engine)
        self._log(engine)

    def _log(self, engine: PartitionedEngine) -> None:
        log, owning, inherited = self._runtime.log, engine.neighbours.owning(), engine.counters["inherited"]
        if owning != self._owned:
            log.info("the area is %s", "ours" if owning else "no longer ours")
        if inherited != self._inherited:
            log.info("going on with %d tracks of a unit that is gone", inherited - self._inherited)
        self._owned, self._inherited = owning, inherited

    def _tell_alive(self, engine: PartitionedEngine) -> None:
        """Others are gone only if we are still there ourselves: else it is we who are cut off."""
        now_s = time.monotonic()
        sure = now_s - self._changed_s >= _SURE_S and now_s - self._here_s >= _BACK_S
        if self._told_alive or self._unit_id not in self._alive or not sure:
            return
        self._told_alive = True
        with self._lock:
            engine.alive(frozenset(self._alive - {self._unit_id}))

    def _take(self, sample: Sample, kind: type[M], give: Callable[[M], None]) -> None:
        unit = last_chunk(sample.key)
        if unit == self._unit_id:
            return
        try:
            message = decode(sample.payload, kind, sample.encoding)
            if message.unit_id != unit:
                raise RefusedMessage("wrong_unit", f"{sample.key} brought a {kind.__name__} of {message.unit_id}.")
            with self._lock:
                give(message)
        except RefusedMessage as error:
            self._runtime.counters.refuse(error.reason)
            self._runtime.log.debug("refused: %s", error)

    def _follow(self, engine: PartitionedEngine) -> None:
        if time.monotonic() < self._follow_due_s:
            return
        self._follow_due_s = time.monotonic() + _FOLLOW_EVERY_S
        wanted = frozenset(name for name, sensor in engine.sensors.items() if engine.wants(sensor.info))
        before = self.plots.sensors
        if wanted != before:
            self.plots.follow(wanted)
            self._runtime.log.info("plots of %s", ", ".join(sorted(wanted)) or "no sensor")
