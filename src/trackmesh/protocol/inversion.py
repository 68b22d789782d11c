"""A batch of scans inverted by all EMI services of a realm: shared out in portions, collected as they are done.

A service takes a portion when it is done with its last one, so a fast one gets more of them. What a service leaves
undone when it ends is given to the others.
"""

from __future__ import annotations

import queue
import threading
import time
import weakref
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np

from trackmesh.protocol.bus import Closeable
from trackmesh.protocol.errors import Incomplete, QueryFailed, RefusedMessage, TrackmeshError, Unavailable
from trackmesh.protocol.messages import EmiResult, EmiScanBatch

PORTION_NUMBERS = 500_000
"""Numbers a portion holds at most, unless a single scan has more."""
PORTIONS_A_SERVICE = 4
AT_A_TIME = 2
"""Portions a service has at hand, so that it need not wait for the next one."""
COME_BACK = ("busy", "stopping")
"""Errors that say: not this service, not now."""


Ask = Callable[[str, EmiScanBatch], Iterator[EmiResult]]
"""Asks one service for one portion."""


class _Over(NamedTuple):
    """A service takes no further portions; why, if it should have."""

    error: TrackmeshError | None


class _Work:
    """What the threads share. They do not hold the ``Inversion``, so that one that is forgotten ends."""

    def __init__(self, ask: Ask, batch: EmiScanBatch, n_services: int) -> None:
        self.ask = ask
        self.batch = batch
        self.events: queue.SimpleQueue[tuple[str, EmiResult] | _Over] = queue.SimpleQueue()
        self._changed = threading.Condition()
        self._stopped = False
        self._todo = deque(portions(batch, n_services))
        self._at_hand = 0
        self._failed: set[str] = set()

    def take(self, unit: str) -> list[int]:
        """Indices of the next portion; none when all are done, or the service has failed.

        While others have portions at hand it waits: they may come back.
        """
        with self._changed:
            while self._at_hand and not self._todo and not self._over(unit):
                self._changed.wait()
            if not self._todo or self._over(unit):
                return []
            self._at_hand += 1
            return self._todo.popleft()

    def put_back(self, unit: str, indices: list[int]) -> None:
        """A portion is done but for ``indices``; if there are any, the service has failed."""
        with self._changed:
            self._at_hand -= 1
            if indices:
                self._failed.add(unit)
                self._todo.append(indices)
            self._changed.notify_all()

    def stop(self) -> None:
        """No further portions."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _over(self, unit: str) -> bool:
        return self._stopped or unit in self._failed

    def serve(self, unit: str) -> None:
        """Have one service take portions until there are none; run by a thread."""
        error: TrackmeshError | None = None
        while error is None and (indices := self.take(unit)):
            error = self._one(unit, indices)
        self.events.put(_Over(error))

    def _one(self, unit: str, indices: list[int]) -> TrackmeshError | None:
        left = dict.fromkeys(indices)
        try:
            for result in self.ask(unit, portion(self.batch, indices)):
                if not result.index < len(indices) or indices[result.index] not in left:
                    raise RefusedMessage("invalid", f"The service {unit} answers what was not asked.")
                index = indices[result.index]
                del left[index]
                self.events.put((unit, result.model_copy(update={"index": index})))
        except TrackmeshError as error:
            return error
        finally:
            self.put_back(unit, list(left))
        return None


class Inversion(Iterator[EmiResult]):
    """The results of a batch, each as it is done, in any order; iterate over it, or ``receive`` with a time limit.

    It ends early by ``cancel``, at the end of a ``with`` block, and when nobody holds it any more; the services are
    then told that nobody waits.

    Attributes:
        total: scans asked.
        done: results so far.
        by_unit: of these, how many each service gave.

    Raises:
        Unavailable: no service answers.
        Incomplete: all services ended, or the time, before all scans were done.
        QueryFailed: a service answers with an error.
    """

    def __init__(
        self, ask: Ask, units: Sequence[str], batch: EmiScanBatch, token: Closeable, finish_by_s: float
    ) -> None:
        self.total = len(batch.field)
        self.done = 0
        self.by_unit: Counter[str] = Counter()
        self._work = _Work(ask, batch, len(units))
        self._finish_by_s = finish_by_s
        self._error: TrackmeshError | None = None
        self._end = weakref.finalize(self, _end, self._work, token)
        self._end.atexit = False
        self._threads = 0
        for unit in units:
            for _ in range(AT_A_TIME):
                self._threads += 1
                threading.Thread(target=self._work.serve, args=(unit,), name=f"invert-{unit}", daemon=True).start()

    def cancel(self) -> None:
        """Have no further results; twice is once."""
        self._end()

    def receive(self, timeout_s: float | None = None) -> EmiResult | None:
        """The next result; None when there are no more, or the time is over. Raises as iterating does."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while self.done < self.total and self._end.alive:
            if not self._threads:
                self.cancel()
                raise self._why()
            try:
                event = self._work.events.get(
                    timeout=None if deadline is None else max(0.0, deadline - time.monotonic())
                )
            except queue.Empty:
                return None
            if isinstance(event, _Over):
                self._take_over(event)
                continue
            unit, result = event
            self.done += 1
            self.by_unit[unit] += 1
            return result
        self.cancel()
        return None

    def __next__(self) -> EmiResult:
        if (result := self.receive()) is None:
            raise StopIteration
        return result

    def _take_over(self, event: _Over) -> None:
        self._threads -= 1
        error = event.error
        if isinstance(error, QueryFailed) and error.code not in COME_BACK:
            self.cancel()
            raise error
        # Who was there and left says more than who never answered.
        if error is not None and (self._error is None or isinstance(self._error, Unavailable)):
            self._error = error

    def _why(self) -> TrackmeshError:
        error = self._error
        if error is None or (isinstance(error, Unavailable) and self.done):
            late = time.monotonic() >= self._finish_by_s
            what = "were not finished in time" if late else "ended half-way"
            return Incomplete(f"The emi services {what}: {self.done} of {self.total} answers received.", self.done)
        if isinstance(error, Incomplete) and error.received != self.done:
            return Incomplete(f"{self.done} of {self.total} scans are answered. {error}", self.done)
        return error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.cancel()


def _end(work: _Work, token: Closeable) -> None:
    work.stop()
    token.close()


def portions(batch: EmiScanBatch, n_services: int) -> Iterator[list[int]]:
    """Indices of the scans of each portion."""
    n_scans = len(batch.field)
    size = max(1, PORTION_NUMBERS // max(1, batch.field[0].size))
    if n_services > 1:
        size = min(size, max(1, -(-n_scans // (PORTIONS_A_SERVICE * n_services))))
    for first in range(0, n_scans, size):
        yield list(range(first, min(first + size, n_scans)))


def portion(batch: EmiScanBatch, indices: list[int]) -> EmiScanBatch:
    """Some scans of a batch as a batch."""
    if len(indices) == len(batch.field):
        return batch
    first, last = indices[0], indices[-1]
    in_a_row = last - first + 1 == len(indices)
    field = batch.field[first : last + 1] if in_a_row else batch.field[np.array(indices)]
    return batch.model_copy(update={"field": field})
