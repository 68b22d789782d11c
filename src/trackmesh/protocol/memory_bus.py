"""A bus inside one process: the same contract as over a network, without sockets.

``MemoryHub`` is the network, ``MemoryBus(hub)`` one participant. Messages are delivered in the order of the puts.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Iterator
from typing import Generic, Self, TypeVar

from trackmesh.protocol.bus import AliveEvent, Query, QueryHandler, Sample
from trackmesh.protocol.errors import BusError
from trackmesh.protocol.keys import matches, parse_parameters

T = TypeVar("T")


class Buffer(Generic[T]):
    """A bounded, closable buffer that drops the oldest; ``dropped`` counts what it lost."""

    def __init__(self, expression: str, capacity: int) -> None:
        self.expression = expression
        self.dropped = 0
        self._items: deque[T] = deque()
        self._capacity = capacity
        self._closed = False
        self._changed = threading.Condition()

    def offer(self, item: T) -> None:
        """Append an item; the oldest gives way when full."""
        with self._changed:
            if self._closed:
                return
            if len(self._items) >= self._capacity:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self._changed.notify()

    def receive(self, timeout_s: float | None = None) -> T | None:
        """The oldest item, or None after ``timeout_s`` or when closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._items.popleft() if self._items else None

    def close(self) -> None:
        """No more items; a waiting receiver wakes."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[T]:
        while (item := self.receive()) is not None:
            yield item


class MemoryHub:
    """What participants share."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.subscriptions: list[Buffer[Sample]] = []
        self.watchers: list[Buffer[AliveEvent]] = []
        self.servers: list[tuple[str, QueryHandler]] = []
        self.tokens: list[str] = []
        self.kept: dict[str, deque[Sample]] = {}


class _Declared:
    def __init__(self, undo: list[tuple[object, list[object]]]) -> None:
        self._undo = undo

    def close(self) -> None:
        for item, place in self._undo:
            if item in place:
                place.remove(item)
        self._undo = []


class _MemoryPublisher:
    def __init__(self, hub: MemoryHub, key: str, history: int) -> None:
        self._hub = hub
        self._key = key
        self._history = history

    def put(self, payload: bytes, encoding: str) -> None:
        sample = Sample(self._key, bytes(payload), encoding)
        with self._hub.lock:
            if self._history:
                self._hub.kept.setdefault(self._key, deque(maxlen=self._history)).append(sample)
            for subscription in self._hub.subscriptions:
                if matches(subscription.expression, self._key):
                    subscription.offer(sample)

    def close(self) -> None:
        pass


class _Token:
    def __init__(self, hub: MemoryHub, key: str) -> None:
        self._hub: MemoryHub | None = hub
        self._key = key
        with hub.lock:
            hub.tokens.append(key)
            _announce(hub, AliveEvent(key, True))

    def close(self) -> None:
        hub, self._hub = self._hub, None
        if hub is None:
            return
        with hub.lock:
            hub.tokens.remove(self._key)
            if self._key not in hub.tokens:
                _announce(hub, AliveEvent(self._key, False))


def _announce(hub: MemoryHub, event: AliveEvent) -> None:
    for watcher in hub.watchers:
        if matches(watcher.expression, event.key):
            watcher.offer(event)


class MemoryBus:
    """One participant of a ``MemoryHub``."""

    def __init__(self, hub: MemoryHub | None = None) -> None:
        self.hub = hub or MemoryHub()
        self._declared: list[Buffer[Sample] | Buffer[AliveEvent] | _Declared | _Token] = []
        self._closed = False

    def publisher(self, key: str, *, history: int = 0) -> _MemoryPublisher:
        """See ``Bus.publisher``."""
        self._check_open()
        return _MemoryPublisher(self.hub, key, history)

    def subscribe(self, expression: str, *, history: bool = False, capacity: int = 256) -> Buffer[Sample]:
        """See ``Bus.subscribe``."""
        self._check_open()
        buffer: Buffer[Sample] = Buffer(expression, capacity)
        with self.hub.lock:
            if history:
                for key, samples in self.hub.kept.items():
                    for sample in samples if matches(expression, key) else ():
                        buffer.offer(sample)
            self.hub.subscriptions.append(buffer)
        self._declared.append(buffer)
        return buffer

    def query(
        self,
        expression: str,
        payload: bytes = b"",
        encoding: str = "",
        *,
        parameters: str = "",
        timeout_s: float = 2.0,
    ) -> Iterator[Sample]:
        """See ``Bus.query``; each server answers in a thread of its own."""
        self._check_open()
        wanted = parse_parameters(parameters)
        replies: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        with self.hub.lock:
            servers = [(key, handler) for key, handler in self.hub.servers if matches(expression, key)]

        def ask(key: str, handler: QueryHandler) -> None:
            try:
                for data, enc in handler(Query(key, wanted, payload, encoding)):
                    replies.put(Sample(key, bytes(data), enc))
            finally:
                replies.put(None)

        for key, handler in servers:
            threading.Thread(target=ask, args=(key, handler), daemon=True).start()
        running = len(servers)
        while running:
            try:
                reply = replies.get(timeout=timeout_s)
            except queue.Empty:
                return
            if reply is None:
                running -= 1
            else:
                yield reply

    def serve(self, key: str, handler: QueryHandler, *, workers: int = 2) -> _Declared:
        """See ``Bus.serve``."""
        self._check_open()
        entry = (key, handler)
        with self.hub.lock:
            self.hub.servers.append(entry)
        declared = _Declared([(entry, self.hub.servers)])  # type: ignore[list-item]
        self._declared.append(declared)
        return declared

    def declare_alive(self, key: str) -> _Token:
        """See ``Bus.declare_alive``."""
        self._check_open()
        token = _Token(self.hub, key)
        self._declared.append(token)
        return token

    def alive(self, expression: str, *, timeout_s: float = 1.0) -> list[str]:
        """See ``Bus.alive``."""
        with self.hub.lock:
            return sorted({t for t in self.hub.tokens if matches(expression, t)})

    def watch_alive(self, expression: str) -> Buffer[AliveEvent]:
        """See ``Bus.watch_alive``."""
        self._check_open()
        watcher: Buffer[AliveEvent] = Buffer(expression, 4096)
        with self.hub.lock:
            for token in sorted(set(self.hub.tokens)):
                if matches(expression, token):
                    watcher.offer(AliveEvent(token, True))
            self.hub.watchers.append(watcher)
        self._declared.append(watcher)
        return watcher

    def close(self) -> None:
        """See ``Bus.close``."""
        self._closed = True
        for declared in reversed(self._declared):
            declared.close()
            with self.hub.lock:
                if isinstance(declared, Buffer):
                    for place in (self.hub.subscriptions, self.hub.watchers):
                        if declared in place:
                            place.remove(declared)  # type: ignore[arg-type]
        self._declared = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._closed:
            raise BusError("The bus is closed.")
