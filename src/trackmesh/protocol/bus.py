"""The bus: publish, subscribe, query, serve, alive.

Everything above the network is written against ``Bus``. ``memory_bus.MemoryBus`` joins parts of one process, for tests
and offline use; ``zenoh_bus.ZenohBus`` joins hosts. Payloads are bytes, the codec is the caller's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol, Self

from trackmesh.protocol.links import Links

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where a router is looked for, and listens, unless told otherwise."""


WAITING = 64
"""How many questions may wait for a worker, unless a server says otherwise; more are refused at once."""


class Sample(NamedTuple):
    """One message as it came."""

    key: str
    payload: bytes
    encoding: str


class AliveEvent(NamedTuple):
    """A liveliness token that appeared or went."""

    key: str
    alive: bool


class Query(NamedTuple):
    """A question as it came to a server."""

    key: str
    parameters: dict[str, str]
    payload: bytes
    encoding: str


QueryHandler = Callable[[Query], Iterable[tuple[bytes, str]]]
"""Answers a query: yields (payload, encoding) of each reply as it is ready. It runs in a worker thread; if it raises,
the asker gets one more reply, an error envelope with the code ``internal``."""


class Closeable(Protocol):
    """Something declared on the bus that can be taken back."""

    def close(self) -> None:
        """Take it back; twice is once."""


class Publisher(Closeable, Protocol):
    """A declared publisher of one key."""

    def put(self, payload: bytes, encoding: str) -> None:
        """Publish one message. Never blocks on a slow or absent network, never raises for it; nothing once closed."""


class Subscription(Closeable, Protocol):
    """Messages of a key expression, oldest first, in a bounded buffer that drops the oldest.

    Attributes:
        dropped: how many messages gave way because nobody took them in time.
    """

    dropped: int

    def receive(self, timeout_s: float | None = None) -> Sample | None:
        """The next message, or None when the time is over or the subscription is closed."""

    def __iter__(self) -> Iterator[Sample]:
        """Messages until the subscription is closed."""


class AliveSubscription(Closeable, Protocol):
    """Comings and goings of liveliness tokens, starting with those already there.

    Who loses the network hears all tokens go, and come again with it.
    """

    def receive(self, timeout_s: float | None = None) -> AliveEvent | None:
        """The next event, or None when the time is over or the subscription is closed."""

    def __iter__(self) -> Iterator[AliveEvent]:
        """Events until the subscription is closed."""


class Bus(Protocol):
    """What every part of trackmesh needs of a network.

    Attributes:
        links: to the routers, as they come and go.
    """

    links: Links

    def publisher(self, key: str, *, history: int = 0) -> Publisher:
        """Declare a publisher.

        Args:
            key: a whole key.
            history: how many messages are kept for late joiners and to fill the gaps of an outage; 0 for none. They are
                gone with the publisher.
        """

    def subscribe(
        self, expression: str, *, history: bool = False, capacity: int = 256, fair: bool = False
    ) -> Subscription:
        """Subscribe to a key expression.

        Args:
            expression: of the keys.
            history: also what publishers kept, gaps filled in order.
            capacity: how many messages wait, at most.
            fair: keys take turns where several wait, and a full buffer drops messages of a key that holds more than its
                share: a key that floods cannot displace the others. The order of each key's messages is kept.
        """

    def query(
        self,
        expression: str,
        payload: bytes = b"",
        encoding: str = "",
        *,
        parameters: str = "",
        timeout_s: float = 2.0,
    ) -> Iterator[Sample]:
        """Ask all servers of an expression, and iterate over the replies as they come, in order for each server.

        Ends when all servers are done, when they are gone, or ``timeout_s`` after the call; which of these it was, the
        envelopes tell. The question is sent by the call itself, not by the first step of the iteration.
        """

    def serve(self, key: str, handler: QueryHandler, *, workers: int = 2, waiting: int = WAITING) -> Closeable:
        """Answer queries to a key, ``workers`` at a time; a bounded number waits, more are answered ``busy``."""

    def declare_alive(self, key: str) -> Closeable:
        """Declare a liveliness token."""

    def alive(self, expression: str, *, timeout_s: float = 1.0) -> list[str]:
        """Keys of the tokens present now, sorted."""

    def watch_alive(self, expression: str) -> AliveSubscription:
        """Follow liveliness tokens."""

    def close(self) -> None:
        """Take back all declarations and leave, under a deadline; twice is once."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc: object) -> None: ...
