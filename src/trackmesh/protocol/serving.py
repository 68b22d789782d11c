"""The answering side of queries: typed answers in envelopes, and the worker threads behind a queryable."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeVar

from trackmesh.protocol.bus import WAITING, Query, QueryHandler
from trackmesh.protocol.codec import MAX_BYTES, Format, answer, decode, encoding, end, failure
from trackmesh.protocol.errors import BusError, QueryFailed, RefusedMessage
from trackmesh.protocol.messages import Envelope
from trackmesh.protocol.messages.base import TopMessage

M = TypeVar("M", bound=TopMessage)

_log = logging.getLogger(__name__)

_NOTHING = b"\x80"


def asked_format(query: Query) -> Format:
    """The format in which the answers are wanted: ``?fmt=json``, else msgpack."""
    return "json" if query.parameters.get("fmt") == "json" else "msgpack"


def answers(
    query: Query,
    kind: type[M],
    handle: Callable[[M], Iterable[TopMessage | bytes]],
    refuse: Callable[[str], None],
    *,
    max_bytes: int = MAX_BYTES,
) -> Iterator[tuple[bytes, str]]:
    """Answer a query with the messages of ``handle``, each in an ``ok`` envelope, then ``end``.

    A question that is refused, or for which ``handle`` raises ``RefusedMessage`` or ``QueryFailed``, is answered with
    an ``error`` envelope instead of the rest.

    Args:
        query: the question; an empty payload is a ``kind`` without any field.
        kind: the message the question must hold.
        handle: gives the answers, each when it is ready; bytes are one in its envelope already.
        refuse: called with the reason of a refusal, to count it.
        max_bytes: the largest question accepted.
    """
    fmt, done = asked_format(query), 0
    wrapped = encoding(Envelope, fmt)
    try:
        for message in handle(_question(query, kind, max_bytes)):
            yield message if isinstance(message, bytes) else answer(message, fmt), wrapped
            done += 1
    except RefusedMessage as error:
        refuse(error.reason)
        yield failure(error.reason, error.detail, fmt), wrapped
    except QueryFailed as error:
        yield failure(error.code, error.detail, fmt), wrapped
    yield end(done, fmt), wrapped


def _question(query: Query, kind: type[M], max_bytes: int) -> M:
    if query.payload:
        return decode(query.payload, kind, query.encoding, max_bytes)
    # A message without any field: valid where all of them have defaults, else refused as any other.
    return decode(_NOTHING, kind)


class Job(NamedTuple):
    """One question: ``reply`` sends one answer (BusError: the asker is out of reach), ``done`` ends them, once."""

    query: Query
    reply: Callable[[bytes, str], None]
    done: Callable[[], None]


class QueryPool:
    """Runs a handler in ``workers`` threads."""

    def __init__(self, handler: QueryHandler, workers: int, waiting: int = WAITING) -> None:
        self._handler = handler
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._places = threading.Semaphore(waiting + workers)
        self._closing = threading.Event()
        # Daemons: a handler stuck in its numerics must not keep the process from ending.
        self._threads = [threading.Thread(target=self._work, name=f"query-{i}", daemon=True) for i in range(workers)]
        for thread in self._threads:
            thread.start()

    def submit(self, job: Job) -> None:
        """Hand over a question; returns at once."""
        if self._closing.is_set():
            job.done()
        elif self._places.acquire(blocking=False):
            self._jobs.put(job)
        else:
            _reply_failure(job, "busy", "The service has too many questions waiting, ask again later.")
            job.done()

    def close(self, timeout_s: float = 1.0) -> None:
        """End: no further answers, even of questions half answered. Waits ``timeout_s`` for handlers at work."""
        self._closing.set()
        for _ in self._threads:
            self._jobs.put(None)
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._places.release()
            try:
                self._answer(job)
            finally:
                job.done()

    def _answer(self, job: Job) -> None:
        if self._closing.is_set():
            return
        try:
            for payload, kind in self._handler(job.query):
                if self._closing.is_set():
                    return
                job.reply(payload, kind)
        except BusError as error:
            _log.info("the answer to %s could not be sent: %s", job.query.key, error)
        except Exception:
            _log.exception("the handler of %s failed", job.query.key)
            _reply_failure(job, "internal", "The service failed to answer; its log says why.")


def _reply_failure(job: Job, code: str, detail: str) -> None:
    fmt = asked_format(job.query)
    try:
        job.reply(failure(code, detail, fmt), encoding(Envelope, fmt))
    except BusError as error:
        _log.info("the answer to %s could not be sent: %s", job.query.key, error)
