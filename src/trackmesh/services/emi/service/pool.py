"""Who works on requests: the service itself, or worker processes among which requests are shared out in pieces.

Pieces of all requests at hand are taken in turn, so that a large one does not hold up a small one. A worker that dies
is started again, and its piece given to another once; the rest of the service does not notice.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol, cast

from trackmesh.protocol.errors import QueryFailed
from trackmesh.services.emi.service.child import Child
from trackmesh.services.emi.service.work import Job, Piece, Solved, Surveys, pieces, solve_piece
from trackmesh.services.emi.service.worker import SOLVED

_log = logging.getLogger(__name__)

START_S = 300.0
"""A worker may have to compile first."""
AGAIN_S = 1.0
LOOK_S = 0.1
GRACE_S = 0.3
"""How long a worker may go on with its piece when the pool is closed."""
TRIES = 2


class Solver(Protocol):
    """What works on jobs."""

    def solve(self, job: Job, stop: Callable[[], bool], deadline_s: float) -> Iterator[Solved]:
        """Answers, each as it is done; fewer than scans if ``stop`` says so, or at the deadline (monotonic time).

        Raises:
            QueryFailed: a piece could not be solved.
        """

    def close(self) -> None:
        """Work no longer."""


class OwnWork:
    """Solves jobs in the thread that asks."""

    def __init__(self) -> None:
        self._surveys = Surveys()

    def solve(self, job: Job, stop: Callable[[], bool], deadline_s: float) -> Iterator[Solved]:
        """See ``Solver.solve``."""
        self._surveys.tell(job.key, job.request.coils, job.request.options)
        ready = self._surveys.get(job.key)
        for piece in pieces(job, 1):
            if stop() or time.monotonic() > deadline_s:
                return
            yield from solve_piece(ready, piece)

    def close(self) -> None:
        """Nothing is kept running."""


class _Ticket:
    """A job at the pool: its pieces yet to be taken, each with how often it may be tried, and where answers go."""

    def __init__(self, job: Job, workers: int) -> None:
        self.job = job
        self.todo = deque((piece, TRIES) for piece in pieces(job, workers))
        self.unanswered = len(self.todo)
        self.answers: queue.SimpleQueue[list[Solved] | QueryFailed] = queue.SimpleQueue()


class _Taken(NamedTuple):
    ticket: _Ticket
    piece: Piece
    tries: int


class WorkerPool:
    """Solves jobs in processes of its own; any number of threads may ask.

    Args:
        processes: how many; the constructor starts them, and they compile or load the kernels meanwhile.
    """

    def __init__(self, processes: int) -> None:
        self._lock = threading.Condition()
        self._tickets: deque[_Ticket] = deque()
        self._closing = threading.Event()
        self._ready = threading.Semaphore(0)
        self._warm = threading.Event()
        self._children: dict[int, Child] = {}
        self._threads = [
            threading.Thread(target=self._employ, args=(i,), name=f"emi-worker-{i}", daemon=True)
            for i in range(processes)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def pids(self) -> list[int]:
        """Of the processes."""
        return [child.pid for child in list(self._children.values())]

    def wait_ready(self, stop: threading.Event, timeout_s: float = START_S) -> bool:
        """Wait until all workers can work; whether they can."""
        deadline = time.monotonic() + timeout_s
        for _ in self._threads:
            while not self._ready.acquire(timeout=LOOK_S):
                if stop.is_set() or time.monotonic() > deadline:
                    return False
        return True

    def solve(self, job: Job, stop: Callable[[], bool], deadline_s: float) -> Iterator[Solved]:
        """See ``Solver.solve``."""
        ticket = _Ticket(job, len(self._threads))
        with self._lock:
            self._tickets.append(ticket)
            self._lock.notify_all()
        try:
            while ticket.unanswered and not stop() and (left_s := deadline_s - time.monotonic()) > 0:
                try:
                    answer = ticket.answers.get(timeout=min(left_s, LOOK_S))
                except queue.Empty:
                    continue
                if isinstance(answer, QueryFailed):
                    raise answer
                ticket.unanswered -= 1
                yield from answer
        finally:
            with self._lock:
                ticket.todo.clear()
                if ticket in self._tickets:
                    self._tickets.remove(ticket)

    def close(self) -> None:
        """End all workers; jobs at hand get no further answers."""
        self._closing.set()
        with self._lock:
            self._lock.notify_all()
        deadline = time.monotonic() + GRACE_S
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        for child in list(self._children.values()):
            child.kill()
        for thread in self._threads:
            thread.join(AGAIN_S)

    def _employ(self, number: int) -> None:
        """Keep one worker at work, and start another when it dies."""
        # With a cold cache the first one compiles for all.
        while number and not self._warm.wait(LOOK_S) and not self._closing.is_set():
            pass
        first = True
        while not self._closing.is_set():
            child = self._children[number] = Child()
            try:
                child.wait_ready()
                self._warm.set()
                if first:
                    self._ready.release()
                    first = False
                while (taken := self._take()) is not None:
                    self._give(child, taken)
            except (EOFError, OSError):
                if not self._closing.is_set():
                    _log.error("the worker process %d ended, starting another", child.pid)
            child.end()
            # One that cannot even start is not started again at once.
            self._closing.wait(AGAIN_S if first else 0.0)

    def _take(self) -> _Taken | None:
        """The next piece, of the request that waited longest; None when the pool is closed."""
        with self._lock:
            while not self._tickets and not self._closing.is_set():
                self._lock.wait()
            if self._closing.is_set():
                return None
            ticket = self._tickets.popleft()
            piece, tries = ticket.todo.popleft()
            if ticket.todo:
                self._tickets.append(ticket)
            return _Taken(ticket, piece, tries)

    def _give(self, child: Child, taken: _Taken) -> None:
        try:
            word, content = child.solve(taken.ticket.job, taken.piece)
        except (EOFError, OSError):
            self._give_back(taken)
            raise
        if word == SOLVED:
            taken.ticket.answers.put(cast("list[Solved]", content))
        else:
            _log.error("a piece of a request could not be solved: %s", content)
            taken.ticket.answers.put(QueryFailed("internal", "The service failed to answer; its log says why."))

    def _give_back(self, taken: _Taken) -> None:
        if taken.tries <= 1:
            taken.ticket.answers.put(QueryFailed("internal", "Two worker processes died of this request."))
            return
        with self._lock:
            if not taken.ticket.todo:
                self._tickets.append(taken.ticket)
            taken.ticket.todo.append((taken.piece, taken.tries - 1))
            self._lock.notify_all()
