"""The bus over Zenoh: client mode, through one or more routers.

What makes it robust is chosen by measurement: a receiving callback only appends to a buffer of ours, so that a slow
reader never holds up another key of the session; samples are dropped rather than blocking a publisher; messages that
must not be missed are kept by their publishers (``zenoh_history``).
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Generic, Self, TypeVar

import zenoh
from zenoh import ext, handlers

from trackmesh.protocol.buffer import Buffer
from trackmesh.protocol.bus import WAITING, AliveEvent, Query, QueryHandler, Sample
from trackmesh.protocol.credentials import Credentials
from trackmesh.protocol.errors import BusError
from trackmesh.protocol.fair_buffer import FairBuffer
from trackmesh.protocol.keys import parse_parameters
from trackmesh.protocol.links import Links
from trackmesh.protocol.refused import why_refused
from trackmesh.protocol.serving import Job, QueryPool
from trackmesh.protocol.zenoh_config import client_config, credentials_of, endpoints_of
from trackmesh.protocol.zenoh_history import Undeclarable, declare_publisher, declare_subscriber

_log = logging.getLogger(__name__)

CLOSE_DEADLINE_S = 3.0
RETRY_S = 0.2
ALIVE_CAPACITY = 65_536

D = TypeVar("D", bound="_Declaration")
T = TypeVar("T")


class _Rank(IntEnum):
    """The order in which what is declared is taken back."""

    SUBSCRIPTION, SERVER, TOKEN, PUBLISHER = range(4)


class _Declaration:
    """Something declared in a session, taken back once; a session that is closed has done so already."""

    rank = _Rank.TOKEN

    def __init__(self, declared: Undeclarable) -> None:
        self._declared: Undeclarable | None = declared
        self._lock = threading.Lock()
        self.forget: Callable[[], None] = lambda: None

    def close(self) -> None:
        with self._lock:
            declared, self._declared = self._declared, None
        if declared is None:
            return
        self.forget()
        with contextlib.suppress(zenoh.ZError):
            declared.undeclare()
        self._after()

    def _after(self) -> None:
        """What else there is to close."""


class _Subscription(_Declaration, Generic[T]):
    rank = _Rank.SUBSCRIPTION

    def __init__(self, subscriber: Undeclarable, buffer: Buffer[T]) -> None:
        super().__init__(subscriber)
        self.buffer = buffer
        buffer.on_close(self.close)

    def _after(self) -> None:
        self.buffer.close()


class _ZenohPublisher(_Declaration):
    rank = _Rank.PUBLISHER

    def __init__(self, publisher: zenoh.Publisher | ext.AdvancedPublisher) -> None:
        super().__init__(publisher)
        self._put = publisher.put

    def put(self, payload: bytes, encoding: str) -> None:
        # The only error is that of a closed session or publisher, and then there is nothing left to do.
        with contextlib.suppress(zenoh.ZError):
            self._put(payload, encoding=encoding)


class _Server(_Declaration):
    rank = _Rank.SERVER

    def __init__(self, session: zenoh.Session, key: str, handler: QueryHandler, workers: int, waiting: int) -> None:
        self._key = key
        self._pool = QueryPool(handler, workers, waiting)
        super().__init__(session.declare_queryable(key, self._take))

    def _take(self, query: zenoh.Query) -> None:
        question = Query(
            self._key,
            parse_parameters(str(query.parameters)),
            query.payload.to_bytes() if query.payload is not None else b"",
            str(query.encoding) if query.encoding is not None else "",
        )

        def reply(payload: bytes, encoding: str) -> None:
            try:
                query.reply(self._key, payload, encoding=encoding)
            except zenoh.ZError as error:
                raise BusError(f"{error}") from None

        # The asker waits until the query object is dropped.
        self._pool.submit(Job(question, reply, query.drop))

    def _after(self) -> None:
        self._pool.close()


class _AliveWatcher:
    """Turns liveliness samples into events, one for each change."""

    def __init__(self, buffer: Buffer[AliveEvent]) -> None:
        self._buffer = buffer
        self._present: set[str] = set()

    def __call__(self, sample: zenoh.Sample) -> None:
        key, alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        if alive == (key in self._present):
            return
        (self._present.add if alive else self._present.discard)(key)
        self._buffer.offer(AliveEvent(key, alive))


class _ExitGuard:
    """Closes what a program forgot to close: an open session with a subscriber would keep its process for ever.

    ``atexit`` is too late for it, it comes after the threads of the session are waited for.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: set[ZenohBus] = set()
        self._started = False

    def add(self, bus: ZenohBus) -> None:
        with self._lock:
            self._open.add(bus)
            if not self._started:
                self._started = True
                threading.Thread(target=self._wait, name="zenoh-exit").start()

    def discard(self, bus: ZenohBus) -> None:
        with self._lock:
            self._open.discard(bus)

    def _wait(self) -> None:
        threading.main_thread().join()
        for bus in list(self._open):
            bus.close()


_guard = _ExitGuard()


class ZenohBus:
    """One participant of a Zenoh network; made by ``open``."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._declared: dict[_Declaration, None] = {}
        self._closed = False
        self.links = Links(_log.warning)
        _guard.add(self)
        self._declare(
            lambda session: _Declaration(session.info.declare_link_events_listener(self._on_link, history=True))
        )

    @classmethod
    def open(
        cls,
        endpoints: Sequence[str] = (),
        *,
        timeout_s: float = 10.0,
        config_path: Path | None = None,
        credentials: Credentials | None = None,
        stop: threading.Event | None = None,
    ) -> Self:
        """Join the network through a router; tries until one answers.

        Args:
            endpoints: of the routers (``tcp/host:7447``); none means those in the file, or the local one.
            timeout_s: how long to try.
            config_path: a JSON5 file of Zenoh settings, for whatever else there is to set.
            credentials: for routers that ask for a certificate, or for a name and a password.
            stop: ends the trying when set.

        Raises:
            BusError: no router answers in time, or the settings are wrong.
        """
        zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
        config = client_config(endpoints, config_path, credentials)
        deadline = time.monotonic() + timeout_s
        stop = stop or threading.Event()
        for attempt in itertools.count():
            try:
                return cls(zenoh.open(config))
            except zenoh.ZError:
                if time.monotonic() + RETRY_S > deadline or stop.wait(RETRY_S):
                    break
            if attempt == 0:
                where = " or ".join(endpoints_of(config, "connect"))
                _log.info("no router answers at %s yet, trying for %g s", where, timeout_s)
        raise BusError(_nobody(config))

    def publisher(self, key: str, *, history: int = 0) -> _ZenohPublisher:
        """See ``Bus.publisher``."""
        return self._declare(lambda session: _ZenohPublisher(declare_publisher(session, key, history)))

    def subscribe(
        self, expression: str, *, history: bool = False, capacity: int = 256, fair: bool = False
    ) -> Buffer[Sample]:
        """See ``Bus.subscribe``."""
        buffer = FairBuffer(capacity) if fair else Buffer[Sample](capacity)
        callback = _offer_to(buffer)
        return self._declare(
            lambda session: _Subscription(declare_subscriber(session, expression, history, callback), buffer)
        ).buffer

    def query(
        self,
        expression: str,
        payload: bytes = b"",
        encoding: str = "",
        *,
        parameters: str = "",
        timeout_s: float = 2.0,
    ) -> Iterator[Sample]:
        """See ``Bus.query``."""
        replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        cancel = zenoh.CancellationToken()
        try:
            self._session.get(
                f"{expression}?{parameters}" if parameters else expression,
                handlers.Callback(replies.put, lambda: replies.put(None)),
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                payload=payload,
                encoding=encoding or None,
                express=True,
                cancellation_token=cancel,
            )
        except zenoh.ZError as error:
            raise BusError(f"The question to {expression} could not be sent: {error}.") from None
        return _replies(replies, cancel)

    def serve(self, key: str, handler: QueryHandler, *, workers: int = 2, waiting: int = WAITING) -> _Server:
        """See ``Bus.serve``."""
        return self._declare(lambda session: _Server(session, key, handler, workers, waiting))

    def declare_alive(self, key: str) -> _Declaration:
        """See ``Bus.declare_alive``."""
        return self._declare(lambda session: _Declaration(session.liveliness().declare_token(key)))

    def alive(self, expression: str, *, timeout_s: float = 1.0) -> list[str]:
        """See ``Bus.alive``."""
        try:
            replies = self._session.liveliness().get(expression, timeout=timeout_s)
            return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})
        except zenoh.ZError as error:
            raise BusError(f"Who is alive at {expression} could not be asked: {error}.") from None

    def watch_alive(self, expression: str) -> Buffer[AliveEvent]:
        """See ``Bus.watch_alive``."""
        buffer: Buffer[AliveEvent] = Buffer(ALIVE_CAPACITY)
        watcher = _AliveWatcher(buffer)

        def declare(session: zenoh.Session) -> _Subscription[AliveEvent]:
            return _Subscription(session.liveliness().declare_subscriber(expression, watcher, history=True), buffer)

        return self._declare(declare).buffer

    def close(self) -> None:
        """See ``Bus.close``."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        _guard.discard(self)
        # Closing can hang on some links; whoever leaves must not.
        thread = threading.Thread(target=self._close_all, name="zenoh-close", daemon=True)
        thread.start()
        thread.join(CLOSE_DEADLINE_S)
        if thread.is_alive():
            _log.warning("the Zenoh session did not close within %g s", CLOSE_DEADLINE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        note = self.links.came if event.kind == zenoh.SampleKind.PUT else self.links.went
        note(str(event.link.dst))

    def _declare(self, make: Callable[[zenoh.Session], D]) -> D:
        if self._closed:
            raise BusError("The bus is closed.")
        try:
            declared = make(self._session)
        except zenoh.ZError as error:
            raise BusError(f"The bus refuses: {error}.") from None
        with self._lock:
            self._declared[declared] = None
        declared.forget = lambda: self._forget(declared)
        return declared

    def _forget(self, declared: _Declaration) -> None:
        with self._lock:
            self._declared.pop(declared, None)

    def _close_all(self) -> None:
        with self._lock:
            declared = sorted(self._declared, key=lambda d: d.rank)
        for one in declared:
            one.close()
        self._session.close()  # type: ignore[no-untyped-call]


def _offer_to(buffer: Buffer[Sample]) -> Callable[[zenoh.Sample], None]:
    def offer(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            buffer.offer(Sample(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)))

    return offer


def _replies(replies: queue.SimpleQueue[zenoh.Reply | None], cancel: zenoh.CancellationToken) -> Iterator[Sample]:
    try:
        while (reply := replies.get()) is not None:
            # Not ok is only the library's own notice that the time is over.
            if (sample := reply.ok) is not None:
                yield Sample(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))
    finally:
        cancel.cancel()  # type: ignore[no-untyped-call]


def _nobody(config: zenoh.Config) -> str:
    endpoints = endpoints_of(config, "connect")
    for endpoint in endpoints:
        if reason := why_refused(endpoint, credentials_of(config)):
            return f"The router at {endpoint} does not let us in: {reason}."
    return f"No router answers at {' or '.join(endpoints)}; start one with `trackmesh router`."
