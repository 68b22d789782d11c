"""The SDK: watch and query tracks, ask who is there, invert scans, publish plots.

Example::

    with ZenohBus.open(["tcp/host:7447"]) as bus:
        for frame in Client(bus).watch_tracks():
            print(frame.t_ns, len(frame.track_id))
"""

from __future__ import annotations

import logging
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from typing import Generic, NamedTuple, Self, TypeVar

from trackmesh.protocol.bus import AliveSubscription, Bus, Sample, Subscription
from trackmesh.protocol.codec import decode, encode, encoding, open_envelope
from trackmesh.protocol.errors import Incomplete, QueryFailed, RefusedMessage, Unavailable
from trackmesh.protocol.inversion import Inversion
from trackmesh.protocol.keys import DEFAULT_REALM, Keys, kind_and_id, last_chunk
from trackmesh.protocol.merging import LatestFrames
from trackmesh.protocol.messages import (
    EmiResult,
    EmiScanBatch,
    HistoryQuery,
    RefinedFrame,
    Registration,
    SensorInfo,
    ServiceStatus,
    TagFrame,
    TrackFrame,
    TrackQuery,
)
from trackmesh.protocol.messages.base import TopMessage
from trackmesh.protocol.picture import Picture, TrackPicture
from trackmesh.protocol.ranging import RangePublisher
from trackmesh.protocol.sensor import SensorPublisher

__all__ = [
    "Client",
    "Incomplete",
    "Inversion",
    "LatestFrames",
    "Picture",
    "RangePublisher",
    "SensorPublisher",
    "TrackPicture",
    "Watch",
    "message_of",
]

M = TypeVar("M", bound=TopMessage)

_log = logging.getLogger(__name__)

_NAMES = ("sensor_id", "network_id", "unit_id", "scenario_id")
_SERVED_BY = {"tracks": "fusion", "history": "archive", "emi": "emi"}


def message_of(sample: Sample, kind: type[M]) -> M:
    """The message of a sample, whose id must be that of its key.

    Raises:
        RefusedMessage: whatever is wrong with it; ``wrong_key`` if it speaks for somebody else.
    """
    message = decode(sample.payload, kind, sample.encoding)
    name = next(getattr(message, field) for field in _NAMES if hasattr(message, field))
    if name != last_chunk(sample.key):
        raise RefusedMessage("wrong_key", f"{sample.key} brought a {kind.__name__} of {name}.")
    return message


class Watch(Generic[M]):
    """Messages as they come; iterate over it, or ``receive`` with a time limit.

    Attributes:
        refused: how many were refused, by reason.
    """

    def __init__(self, subscription: Subscription, kind: type[M]) -> None:
        self.refused: Counter[str] = Counter()
        self._subscription = subscription
        self._kind = kind

    @property
    def dropped(self) -> int:
        """How many gave way because nobody took them in time."""
        return self._subscription.dropped

    def receive(self, timeout_s: float | None = None) -> M | None:
        """The next good message, or None when the time is over or the watch is closed."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left_s = None if deadline is None else max(0.0, deadline - time.monotonic())
            sample = self._subscription.receive(left_s)
            if sample is None:
                return None
            try:
                return message_of(sample, self._kind)
            except RefusedMessage as error:
                self.refused[error.reason] += 1

    def close(self) -> None:
        """Watch no longer; an iteration ends."""
        self._subscription.close()

    def __iter__(self) -> Iterator[M]:
        while (message := self.receive()) is not None:
            yield message

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class _Stream(NamedTuple):
    """What was asked of whom, for the sentence when it goes wrong."""

    service: str
    unit: str
    asked_s: float
    timeout_s: float
    expected: int | None

    @property
    def kind(self) -> str:
        """Of the services that answer."""
        return _SERVED_BY[self.service]

    def broken_off(self, unit: str, received: int) -> Incomplete:
        late = time.monotonic() - self.asked_s >= self.timeout_s
        what = f"did not finish within {self.timeout_s:g} s" if late else "ended half-way"
        part = f"{received} of {self.expected}" if self.expected is not None else f"{received}"
        return Incomplete(f"The {self.kind} service {unit} {what}: {part} answers received.", received)


class Client:
    """What a user of a realm can ask and watch.

    Args:
        bus: a way into the network; it is not closed by the client.
        realm: the deployment's key space.
    """

    def __init__(self, bus: Bus, realm: str = DEFAULT_REALM) -> None:
        self.bus = bus
        self.keys = Keys(realm)
        self._geometries: set[tuple[str, str]] = set()

    # --- watching ---

    def watch_tracks(self, unit: str = "*", *, history: bool = True, capacity: int = 4096) -> Watch[TrackFrame]:
        """Frames as they are published; with ``history`` those lost in an outage too, and the last few before now."""
        return Watch(self.bus.subscribe(self.keys.tracks(unit), history=history, capacity=capacity), TrackFrame)

    def watch_units(self) -> AliveSubscription:
        """Comings and goings of fusion units, those already there first; for ``note_alive`` of a picture."""
        return self.bus.watch_alive(self.keys.live("fusion", "*"))

    def watch_refined(self, unit: str = "*", *, capacity: int = 4096) -> Watch[RefinedFrame]:
        """Refined states of some plots ago, of units whose ``lag`` is set."""
        return Watch(self.bus.subscribe(self.keys.refined(unit), history=True, capacity=capacity), RefinedFrame)

    def watch_tags(self, unit: str = "*", *, history: bool = True, capacity: int = 4096) -> Watch[TagFrame]:
        """Pictures of the tags as they are published."""
        return Watch(self.bus.subscribe(self.keys.tags(unit), history=history, capacity=capacity), TagFrame)

    def watch_registration(self, unit: str = "*") -> Watch[Registration]:
        """What units think is wrong with their sensors, the present first."""
        return Watch(self.bus.subscribe(self.keys.registration(unit), history=True), Registration)

    def watch_statuses(self, kind: str = "*", unit: str = "*") -> Watch[ServiceStatus]:
        """How services are, once a second each, the present first."""
        return Watch(self.bus.subscribe(self.keys.status(kind, unit), history=True), ServiceStatus)

    # --- asking ---

    def query_tracks(
        self, query: TrackQuery | None = None, unit: str = "*", *, timeout_s: float = 2.0
    ) -> list[TrackFrame]:
        """The present picture, one frame a unit, ordered by unit.

        A track on its way from one unit to another may be in both: see ``merging.without_doubles``.

        Raises:
            Unavailable: no unit answers.
            Incomplete: a unit ended before its answer was whole.
            QueryFailed: a unit answers with an error.
        """
        frames = list(self._ask("tracks", query or TrackQuery(), TrackFrame, unit, timeout_s))
        self._warn_of_silent(unit, {frame.unit_id for frame in frames})
        return sorted(frames, key=lambda frame: frame.unit_id)

    def history(self, query: HistoryQuery, unit: str = "*", *, timeout_s: float = 30.0) -> Iterator[TrackFrame]:
        """Past frames, as the archive finds them; raises as ``query_tracks``."""
        return self._ask("history", query, TrackFrame, unit, timeout_s)

    def invert(self, batch: EmiScanBatch, unit: str = "*", *, timeout_s: float = 60.0) -> Inversion:
        """One result a scan, each as it is done, by all EMI services that are alive, or by ``unit``.

        The batch is sent in portions. A service is sent a geometry once, and then told its name. See ``Inversion`` for
        progress, ``cancel``, and what iterating over it raises.
        """
        units = (self._alive_units("emi") or ["*"]) if unit == "*" else [unit]
        asker, asked_s = uuid.uuid4().hex, time.monotonic()
        token = self.bus.declare_alive(self.keys.asking(asker))

        def ask(name: str, part: EmiScanBatch) -> Iterator[EmiResult]:
            return self._ask_scans(name, part, asker, asked_s, timeout_s)

        return Inversion(ask, units, batch, token, asked_s + timeout_s)

    def _ask_scans(
        self, unit: str, batch: EmiScanBatch, asker: str, asked_s: float, timeout_s: float
    ) -> Iterator[EmiResult]:
        geometry_id = batch.geometry_id or (batch.geometry.content_id() if batch.geometry else "")
        named = batch.model_copy(update={"geometry": None, "geometry_id": geometry_id})
        known = (unit, geometry_id) in self._geometries or batch.geometry is None
        stream = _Stream("emi", unit, asked_s, timeout_s, len(batch.field))
        parameters = f"asking={asker}"
        try:
            for result in self._stream(named if known else batch, EmiResult, stream, parameters):
                if result.geometry_id == geometry_id:
                    self._geometries.add((unit, geometry_id))
                yield result
        except QueryFailed as error:
            if error.code != "unknown_geometry" or batch.geometry is None:
                raise
            # The service has been started again, or has heard of too many others since.
            self._geometries.discard((unit, geometry_id))
            yield from self._stream(batch, EmiResult, stream, parameters)

    def sensors(self, sensor: str = "*", *, timeout_s: float = 2.0) -> list[SensorInfo]:
        """The sensors that are there, ordered by id; those that do not answer well are left out."""
        found: dict[str, SensorInfo] = {}
        for reply in self.bus.query(self.keys.sensor(sensor), timeout_s=timeout_s):
            try:
                info = open_envelope(reply.payload, reply.encoding, SensorInfo)
            except RefusedMessage as error:
                _log.warning("%s gave no information: %s", reply.key, error)
                continue
            if isinstance(info, SensorInfo) and info.sensor_id == last_chunk(reply.key):
                found[info.sensor_id] = info
        return [found[name] for name in sorted(found)]

    def statuses(self, *, timeout_s: float = 2.0) -> list[ServiceStatus]:
        """How the services are that are alive, ordered by kind and id; those not heard in time are left out."""
        wanted = {who for who in self.alive() if who[0] != "sensor"}
        heard: dict[tuple[str, str], ServiceStatus] = {}
        deadline = time.monotonic() + timeout_s
        with self.watch_statuses() as watch:
            while wanted - heard.keys() and (left_s := deadline - time.monotonic()) > 0:
                if (status := watch.receive(left_s)) is not None:
                    heard[status.kind, status.unit_id] = status
        return [heard[who] for who in sorted(heard) if who in wanted]

    def registrations(self, *, timeout_s: float = 0.5) -> list[Registration]:
        """What the units that are alive think of their sensors, ordered by unit; silent ones are left out."""
        wanted = {unit for _, unit in self.alive("fusion")}
        heard: dict[str, Registration] = {}
        deadline = time.monotonic() + timeout_s
        with self.watch_registration() as watch:
            while wanted - heard.keys() and (left_s := deadline - time.monotonic()) > 0:
                if (one := watch.receive(left_s)) is not None:
                    heard[one.unit_id] = one
        return [heard[unit] for unit in sorted(heard) if unit in wanted]

    def alive(self, kind: str = "*") -> list[tuple[str, str]]:
        """Kind and id of the sensors and services that are alive, ordered."""
        return [kind_and_id(key) for key in self.bus.alive(self.keys.live(kind, "*"))]

    # --- how ---

    def _ask(self, service: str, query: TopMessage, kind: type[M], unit: str, timeout_s: float) -> Iterator[M]:
        return self._stream(query, kind, _Stream(service, unit, time.monotonic(), timeout_s, None))

    def _stream(self, query: TopMessage, kind: type[M], stream: _Stream, parameters: str = "") -> Iterator[M]:
        left_s = max(0.0, stream.asked_s + stream.timeout_s - time.monotonic())
        key = self.keys.service(stream.service, stream.unit)
        replies = self.bus.query(key, encode(query), encoding(query), parameters=parameters, timeout_s=left_s)
        # A generator of its own: the question is on its way before the first answer is asked for.
        return self._open(replies, kind, stream)

    def _open(self, replies: Iterator[Sample], kind: type[M], stream: _Stream) -> Iterator[M]:
        counts: Counter[str] = Counter()
        open_: set[str] = set()
        for reply in replies:
            open_.add(reply.key)
            opened = open_envelope(reply.payload, reply.encoding, kind)
            if not isinstance(opened, int):
                counts[reply.key] += 1
                yield opened
            elif opened == counts[reply.key]:
                counts[reply.key] += 0
                open_.discard(reply.key)
        if not counts and not open_:
            raise Unavailable(self._why_silent(stream))
        for key in sorted(open_):
            raise stream.broken_off(last_chunk(key), counts[key])

    def _alive_units(self, kind: str) -> list[str]:
        return [ident for _, ident in self.alive(kind)]

    def _why_silent(self, stream: _Stream) -> str:
        kind, unit = stream.kind, stream.unit
        alive = self._alive_units(kind)
        if unit != "*" and unit not in alive:
            others = f"; alive: {', '.join(alive)}" if alive else ", nor is any other"
            return f"The {kind} service {unit} is not alive{others}."
        if not alive:
            return f"No {kind} service is alive."
        silent = alive if unit == "*" else [unit]
        who = f"service {silent[0]} is" if len(silent) == 1 else f"services {', '.join(silent)} are"
        return f"The {kind} {who} alive but did not answer within {stream.timeout_s:g} s."

    def _warn_of_silent(self, unit: str, answered: set[str]) -> None:
        # A picture with a hole looks like a whole one.
        for silent in sorted(set(self._alive_units("fusion")) - answered) if unit == "*" else ():
            _log.warning("the fusion service %s is alive but did not answer; its tracks are missing", silent)
