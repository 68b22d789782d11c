"""Publishers that keep what they sent, subscribers that miss nothing of it: Zenoh's advanced pair, and what it lacks.

The library fills gaps between samples of a publisher that it knows. Two of its means do not work with keys that have a
verbatim chunk (``@v1``), and say nothing of it: it does not notice a publisher that comes later, nor understand
heartbeats. And it asks once for what is missing: if the link is only just back, and nobody answers yet, all of the
outage is skipped. So a subscriber here asks a publisher's cache itself when it first hears of it, by its token or by a
sample, and whenever a number is missing, until it has an answer; holds back what comes meanwhile, and delivers all in
order; and a lost last sample is found by asking periodically.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Protocol

import zenoh
from zenoh import ext, handlers

RECOVERY_S = 0.5
FETCH_TIMEOUT_S = 2.0
RETRIES_S = (0.05, 0.15, 0.3, 0.5)
"""Just after a link is back, a question finds nobody for some ten milliseconds, on a busy machine for longer."""

HELD_MOST = 10_000
SOURCES_MOST = 10_000

Deliver = Callable[[zenoh.Sample], None]
_Source = tuple[str, int]


class Undeclarable(Protocol):
    """A declaration of the library."""

    def undeclare(self) -> None:
        """Take it back."""


def declare_publisher(session: zenoh.Session, key: str, history: int) -> zenoh.Publisher | ext.AdvancedPublisher:
    """A publisher that never blocks, and keeps its last ``history`` samples."""
    drop, high = zenoh.CongestionControl.DROP, zenoh.Priority.DATA_HIGH
    if not history:
        return session.declare_publisher(key, congestion_control=drop, priority=high, express=True)
    return ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=drop,
        priority=high,
        express=True,
        cache=ext.CacheConfig(max_samples=history),
        # For the sequence numbers; heartbeats would go unheard.
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
        publisher_detection=True,
    )


def declare_subscriber(session: zenoh.Session, expression: str, history: bool, deliver: Deliver) -> Undeclarable:
    """A subscriber; with ``history`` it is given what publishers keep as well, each publisher's samples in order."""
    if history:
        return _HistorySubscriber(session, expression, deliver)
    return session.declare_subscriber(expression, deliver)


class _HistorySubscriber:
    def __init__(self, session: zenoh.Session, expression: str, deliver: Deliver) -> None:
        merge = _Merge(session, deliver)
        # The stubs want seconds, the library a timedelta.
        every: float = timedelta(seconds=RECOVERY_S)  # type: ignore[assignment]
        self._subscriber = ext.declare_advanced_subscriber(
            session, expression, merge.on_sample, recovery=ext.RecoveryConfig(periodic_queries=every, heartbeat=None)
        )
        self._tokens = self._subscriber.detect_publishers(merge.on_token, history=True)

    def undeclare(self) -> None:
        self._tokens.undeclare()  # type: ignore[no-untyped-call]
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]


@dataclass
class _Stream:
    """The samples of one publisher.

    Attributes:
        cache: where its cache answers.
        held: not None while its cache is being asked: what came meanwhile, and what the cache has answered.
        last: the number delivered last.
        answered: whether the cache has answered this question at all.
        attempts: questions without an answer since the last one with any.
    """

    cache: str
    held: list[zenoh.Sample] | None = field(default_factory=list)
    last: int | None = None
    answered: bool = False
    attempts: int = 0


class _Merge:
    """Puts what a cache answers in the place of what did not come."""

    def __init__(self, session: zenoh.Session, deliver: Deliver) -> None:
        self._session = session
        self._deliver = deliver
        self._lock = threading.Lock()
        self._streams: OrderedDict[_Source, _Stream] = OrderedDict()

    def on_token(self, token: zenoh.Sample) -> None:
        """A publisher is there: ``{key}/@adv/pub/{zid}/{eid}/_``; this is also where its cache answers."""
        cache = str(token.key_expr)
        zid, eid = cache.split("/")[-3:-1]
        if token.kind != zenoh.SampleKind.PUT or not eid.isdigit():
            return
        source = (zid, int(eid))
        with self._lock:
            stream = self._streams.get(source)
            idle = stream is not None and stream.held is None
            if stream is not None and idle:
                stream.held, stream.attempts = [], 0
        if stream is None:
            self._stream(source, cache)
        elif idle:
            # It was out of reach. The library itself asks only those of whom it has heard something live.
            self._fetch(stream)

    def on_sample(self, sample: zenoh.Sample) -> None:
        """A sample came live, or was recovered by the library."""
        info = sample.source_info
        if info is None:
            self._deliver(sample)
            return
        source = (str(info.source_id.zid), info.source_id.eid)
        stream = self._stream(source, f"{sample.key_expr}/@adv/pub/{source[0]}/{source[1]}/_")
        with self._lock:
            if stream.held is not None:
                if len(stream.held) < HELD_MOST:
                    stream.held.append(sample)
                return
            if stream.last is None or _after(_number(sample), stream.last) <= 1:
                self._deliver_new(stream, sample)
                return
            stream.held, stream.attempts = [sample], 0
        self._fetch(stream)

    def _stream(self, source: _Source, cache: str) -> _Stream:
        with self._lock:
            stream = self._streams.get(source)
            if stream is not None:
                return stream
            stream = self._streams[source] = _Stream(cache)
            if len(self._streams) > SOURCES_MOST:
                self._streams.popitem(last=False)
        self._fetch(stream)
        return stream

    def _fetch(self, stream: _Stream) -> None:
        def on_reply(reply: zenoh.Reply) -> None:
            with self._lock:
                if reply.ok is not None and stream.held is not None:
                    stream.answered = True
                    stream.held.append(reply.ok)

        stream.answered = False
        # Numbers go round after 2^32; then all of the cache is asked for.
        from_last = stream.last is not None and stream.last < 2**32 - HELD_MOST
        try:
            self._session.get(
                f"{stream.cache}?_sn={stream.last}.." if from_last else stream.cache,
                handlers.Callback(on_reply, lambda: self._fetched(stream)),
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                timeout=FETCH_TIMEOUT_S,
            )
        except zenoh.ZError:
            self._release(stream)

    def _fetched(self, stream: _Stream) -> None:
        if stream.answered:
            stream.attempts = 0
            if self._deliver_held(stream):
                # What is missing still is asked for again as long as answers bring some of it.
                self._fetch(stream)
        elif stream.attempts == len(RETRIES_S):
            self._release(stream)
        else:
            retry = threading.Timer(RETRIES_S[stream.attempts], self._fetch, (stream,))
            stream.attempts += 1
            retry.daemon = True
            retry.start()

    def _deliver_held(self, stream: _Stream) -> bool:
        """Deliver up to the first number that is missing; whether to ask for that, which may have come too late."""
        with self._lock:
            before, held = stream.last, self._sorted(stream)
            for i, sample in enumerate(held):
                if stream.last is not None and _after(_number(sample), stream.last) > 1 and before != stream.last:
                    stream.held = held[i:]
                    return True
                self._deliver_new(stream, sample)
            stream.held = None
            return False

    def _release(self, stream: _Stream) -> None:
        with self._lock:
            for sample in self._sorted(stream):
                self._deliver_new(stream, sample)
            stream.held = None

    def _sorted(self, stream: _Stream) -> list[zenoh.Sample]:
        held = stream.held or []
        return sorted(held, key=lambda sample: _after(_number(sample), _number(held[0])))

    def _deliver_new(self, stream: _Stream, sample: zenoh.Sample) -> None:
        number = _number(sample)
        if stream.last is None or _after(number, stream.last) > 0:
            stream.last = number
            self._deliver(sample)


def _number(sample: zenoh.Sample) -> int:
    return sample.source_info.source_sn if sample.source_info is not None else 0


def _after(number: int, other: int) -> int:
    """How far a number lies after another; they have 32 bits and go round."""
    return (number - other + 2**31) % 2**32 - 2**31
