"""A bus inside one process: the same contract as over a network, without sockets.

``MemoryHub`` is the network, ``MemoryBus(hub)`` one participant. Messages are delivered in the order of the puts.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple, Self, TypeVar

from trackmesh.protocol.buffer import Buffer
from trackmesh.protocol.bus import WAITING, AliveEvent, Query, QueryHandler, Sample
from trackmesh.protocol.errors import BusError
from trackmesh.protocol.fair_buffer import FairBuffer
from trackmesh.protocol.keys import matches, parse_parameters
from trackmesh.protocol.links import Links
from trackmesh.protocol.serving import Job, QueryPool

D = TypeVar("D", bound="_Declared")
ALIVE_CAPACITY = 65_536


class MemoryHub:
    """What participants share; ``lock`` guards the lists."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.subscriptions: list[_Subscription] = []
        self.watchers: list[_Watcher] = []
        self.publishers: list[_MemoryPublisher] = []
        self.servers: list[_Server] = []
        self.tokens: list[_Token] = []

    def alive(self, expression: str) -> list[str]:
        """Keys of the tokens that meet an expression, sorted."""
        with self.lock:
            return sorted({token.key for token in self.tokens if matches(expression, token.key)})

    def forget(self, subscription: _Subscription) -> None:
        """Deliver to it no longer."""
        with self.lock:
            self.subscriptions.remove(subscription)

    def announce(self, event: AliveEvent) -> None:
        """Tell watchers."""
        for watcher in self.watchers:
            if matches(watcher.expression, event.key):
                watcher.offer(event)


class _Declared:
    """Something of a participant that its hub lists until it is closed."""

    def __init__(self, hub: MemoryHub, place: list[Self]) -> None:
        self.hub = hub
        self._place = place
        with hub.lock:
            place.append(self)

    def _leave(self) -> bool:
        with self.hub.lock:
            if self not in self._place:
                return False
            self._place.remove(self)
            return True

    def close(self) -> None:
        self._leave()


class _Subscription(NamedTuple):
    expression: str
    buffer: Buffer[Sample]


class _Watcher(Buffer[AliveEvent]):
    def __init__(self, hub: MemoryHub, expression: str) -> None:
        super().__init__(ALIVE_CAPACITY)
        self.on_close(self._leave)
        self.expression = expression
        self._hub = hub

    def _leave(self) -> None:
        with self._hub.lock:
            self._hub.watchers.remove(self)


class _MemoryPublisher(_Declared):
    def __init__(self, hub: MemoryHub, key: str, history: int) -> None:
        self.key = key
        self.kept: deque[Sample] = deque(maxlen=history)
        super().__init__(hub, hub.publishers)

    def put(self, payload: bytes, encoding: str) -> None:
        sample = Sample(self.key, bytes(payload), encoding)
        with self.hub.lock:
            if self not in self._place:
                return
            self.kept.append(sample)
            for subscription in self.hub.subscriptions:
                if matches(subscription.expression, self.key):
                    subscription.buffer.offer(sample)


class _Server(_Declared):
    def __init__(self, hub: MemoryHub, key: str, handler: QueryHandler, workers: int, waiting: int) -> None:
        self.key = key
        self.pool = QueryPool(handler, workers, waiting)
        super().__init__(hub, hub.servers)

    def close(self) -> None:
        if self._leave():
            self.pool.close()


class _Token(_Declared):
    def __init__(self, hub: MemoryHub, key: str) -> None:
        self.key = key
        with hub.lock:
            if not hub.alive(key):
                hub.announce(AliveEvent(key, True))
            super().__init__(hub, hub.tokens)

    def close(self) -> None:
        with self.hub.lock:
            if self._leave() and not self.hub.alive(self.key):
                self.hub.announce(AliveEvent(self.key, False))


class MemoryBus:
    """One participant of a ``MemoryHub``."""

    def __init__(self, hub: MemoryHub | None = None) -> None:
        self.hub = hub or MemoryHub()
        self.links = Links()
        self._closing: list[Callable[[], None]] = []
        self._closed = False

    def publisher(self, key: str, *, history: int = 0) -> _MemoryPublisher:
        """See ``Bus.publisher``."""
        return self._mine(_MemoryPublisher(self._open_hub(), key, history))

    def subscribe(
        self, expression: str, *, history: bool = False, capacity: int = 256, fair: bool = False
    ) -> Buffer[Sample]:
        """See ``Bus.subscribe``."""
        hub = self._open_hub()
        buffer = FairBuffer(capacity) if fair else Buffer[Sample](capacity)
        subscription = _Subscription(expression, buffer)
        buffer.on_close(lambda: hub.forget(subscription))
        with hub.lock:
            for publisher in hub.publishers if history else ():
                for sample in publisher.kept if matches(expression, publisher.key) else ():
                    buffer.offer(sample)
            hub.subscriptions.append(subscription)
        self._closing.append(buffer.close)
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
        """See ``Bus.query``."""
        hub = self._open_hub()
        deadline = time.monotonic() + timeout_s
        replies: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        with hub.lock:
            servers = [server for server in hub.servers if matches(expression, server.key)]
        for server in servers:
            question = Query(server.key, parse_parameters(parameters), payload, encoding)
            server.pool.submit(_job(question, replies))
        return _replies(replies, len(servers), deadline)

    def serve(self, key: str, handler: QueryHandler, *, workers: int = 2, waiting: int = WAITING) -> _Server:
        """See ``Bus.serve``."""
        return self._mine(_Server(self._open_hub(), key, handler, workers, waiting))

    def declare_alive(self, key: str) -> _Token:
        """See ``Bus.declare_alive``."""
        return self._mine(_Token(self._open_hub(), key))

    def alive(self, expression: str, *, timeout_s: float = 1.0) -> list[str]:
        """See ``Bus.alive``."""
        return self._open_hub().alive(expression)

    def watch_alive(self, expression: str) -> Buffer[AliveEvent]:
        """See ``Bus.watch_alive``."""
        hub = self._open_hub()
        watcher = _Watcher(hub, expression)
        with hub.lock:
            for key in hub.alive(expression):
                watcher.offer(AliveEvent(key, True))
            hub.watchers.append(watcher)
        self._closing.append(watcher.close)
        return watcher

    def close(self) -> None:
        """See ``Bus.close``."""
        self._closed = True
        while self._closing:
            self._closing.pop()()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _open_hub(self) -> MemoryHub:
        if self._closed:
            raise BusError("The bus is closed.")
        return self.hub

    def _mine(self, declared: D) -> D:
        self._closing.append(declared.close)
        return declared


def _job(question: Query, replies: queue.SimpleQueue[Sample | None]) -> Job:
    def reply(payload: bytes, encoding: str) -> None:
        replies.put(Sample(question.key, bytes(payload), encoding))

    return Job(question, reply, lambda: replies.put(None))


def _replies(replies: queue.SimpleQueue[Sample | None], servers: int, deadline: float) -> Iterator[Sample]:
    while servers:
        try:
            reply = replies.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            return
        if reply is None:
            servers -= 1
        else:
            yield reply
