"""What is done with a question: checked, handed to the workers, answered scan by scan, given up when nobody waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

from trackmesh.protocol.bus import Query
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import EmiResult, EmiScanBatch
from trackmesh.protocol.messages.base import TopMessage
from trackmesh.protocol.serving import answers, asked_format
from trackmesh.services.emi.service.convert import Head, to_request
from trackmesh.services.emi.service.geometries import Geometries
from trackmesh.services.emi.service.pool import Solver
from trackmesh.services.emi.service.settings import EmiSettings
from trackmesh.services.emi.service.work import Job, survey_key
from trackmesh.services.runtime import ServiceRuntime

Reply = tuple[bytes, str]
ASKING = "asking"
"""Parameter of a question that names the token of whoever waits for the answer."""


class Askers:
    """Who waits for answers, and what ends when he no longer does. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, list[threading.Event]] = {}

    def begin(self, asker: str | None) -> threading.Event:
        """An event that is set when the asker has gone."""
        gone = threading.Event()
        if asker is not None:
            with self._lock:
                self._waiting.setdefault(asker, []).append(gone)
        return gone

    def end(self, asker: str | None, gone: threading.Event) -> None:
        """His question is answered."""
        if asker is not None:
            with self._lock:
                events = [event for event in self._waiting.pop(asker, []) if event is not gone]
                if events:
                    self._waiting[asker] = events

    def left(self, asker: str) -> int:
        """The asker has gone; how many questions that ends."""
        with self._lock:
            events = self._waiting.pop(asker, [])
        for event in events:
            event.set()
        return len(events)


class EmiService:
    """Answers queries; any number of threads may call ``handle``."""

    def __init__(self, runtime: ServiceRuntime, settings: EmiSettings, solver: Solver) -> None:
        self.askers = Askers()
        self._runtime = runtime
        self._settings = settings
        self._solver = solver
        self._geometries = Geometries(settings.max_geometries)
        for name in ("requests", "scans"):
            runtime.counters.count(name, 0)

    def handle(self, query: Query) -> Iterator[Reply]:
        """One envelope a scan, as each is done, and the end; an error envelope in place of what is refused."""
        started_s = time.monotonic()
        counters, largest = self._runtime.counters, self._settings.max_request_bytes
        counters.count("requests")
        yield from answers(
            query,
            EmiScanBatch,
            lambda batch: self._results(batch, query, started_s),
            counters.refuse,
            max_bytes=largest,
        )
        self._runtime.latencies.record(time.monotonic() - started_s)

    def _results(self, batch: EmiScanBatch, query: Query, started_s: float) -> Iterator[TopMessage | bytes]:
        geometry_id, geometry = self._geometries.resolve(batch)
        self._check_numbers(batch)
        head = Head(batch.batch_id, batch.field_unit, self._settings.unit_id, geometry_id)
        left = dict.fromkeys(range(len(batch.field)))
        if batch.field.shape[2] > self._settings.max_samples:
            yield from self._given_up(left, head, f"more_than_{self._settings.max_samples}_samples")
            return
        request = to_request(batch, geometry, self._settings.lr_threshold)
        job = Job(survey_key(request, geometry_id), request, head, asked_format(query))
        asker = query.parameters.get(ASKING)
        gone = self.askers.begin(asker)
        try:
            for solved in self._solver.solve(job, lambda: self._unwanted(gone), self._until(started_s)):
                del left[solved.scan]
                self._count(solved.status)
                yield solved.payload
        finally:
            self.askers.end(asker, gone)
        self._check_wanted(gone)
        yield from self._given_up(left, head, "deadline")

    def _until(self, started_s: float) -> float:
        return started_s + self._settings.request_deadline_s

    def _unwanted(self, gone: threading.Event) -> bool:
        return gone.is_set() or self._runtime.stopping.is_set()

    def _check_wanted(self, gone: threading.Event) -> None:
        if self._runtime.stopping.is_set():
            raise RefusedMessage("stopping", "The service is stopping.")
        if gone.is_set():
            raise RefusedMessage("cancelled", "Nobody waits for the rest any more.")

    def _given_up(self, indices: dict[int, None], head: Head, reason: str) -> Iterator[EmiResult]:
        """Answers for scans that are not worked on: they may be asked again, in smaller portions."""
        for index in indices:
            self._count("too_large")
            yield EmiResult(
                batch_id=head.batch_id,
                index=index,
                status="too_large",
                reasons=[reason],
                unit_id=head.unit_id,
                geometry_id=head.geometry_id,
            )

    def _count(self, status: str) -> None:
        self._runtime.counters.count("scans")
        self._runtime.counters.count(f"scans_{status}")

    def _check_numbers(self, batch: EmiScanBatch) -> None:
        limit = self._settings.max_numbers
        if batch.field.size > limit:
            raise RefusedMessage(
                "too_large", f"The request holds {batch.field.size} numbers, at most {limit} are accepted."
            )
