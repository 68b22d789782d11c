"""The EMI service: answers a query that carries a batch of scans with one result a scan, each as it is done."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from trackmesh.protocol.bus import Query
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import EmiResult, EmiScanBatch
from trackmesh.protocol.serving import answers
from trackmesh.services.emi.convert import to_message, to_request
from trackmesh.services.emi.engine import Coils, Options, invert
from trackmesh.services.emi.settings import EmiSettings
from trackmesh.services.runtime import ServiceRuntime

KIND = "emi"
Reply = tuple[bytes, str]


def main(settings: EmiSettings) -> int:
    """Be the EMI service of this process; returns its exit code."""
    return ServiceRuntime(KIND, settings).run(lambda runtime: start(runtime, settings))


def start(runtime: ServiceRuntime, settings: EmiSettings) -> None:
    """Compile the kernels, then answer queries."""
    runtime.set_state("compiling")
    started_s = time.monotonic()
    warm_up()
    runtime.log.info("kernels ready after %.1f s", time.monotonic() - started_s)
    service = EmiService(runtime, settings)
    key = runtime.keys.service(KIND, settings.unit_id)
    runtime.closing(runtime.bus.serve(key, service.handle, workers=settings.workers))
    runtime.set_state("ready")


def warm_up() -> None:
    """Compile every kernel, or load it from the cache: the first request shall not wait for that."""
    x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    positions = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    field = 1.0 / (1.0 + ((positions - 2.0) ** 2).sum(1))[None, None, :, None] * np.ones(3)
    field[..., 7, 0] += 5.0
    for is_loop in (True, False):
        list(invert(Coils(positions, 0.5, 1.0, is_loop), field, 0.01, Options()))


class EmiService:
    """Answers queries; any number of threads may call ``handle``."""

    def __init__(self, runtime: ServiceRuntime, settings: EmiSettings) -> None:
        self._runtime = runtime
        self._settings = settings
        for name in ("requests", "scans"):
            runtime.counters.count(name, 0)

    def handle(self, query: Query) -> Iterator[Reply]:
        """One envelope a scan, and the end; an error envelope in place of what is refused or given up."""
        started_s = time.monotonic()
        counters, largest = self._runtime.counters, self._settings.max_request_bytes
        counters.count("requests")
        yield from answers(query, EmiScanBatch, self._results, counters.refuse, max_bytes=largest)
        self._runtime.latencies.record(time.monotonic() - started_s)

    def _results(self, batch: EmiScanBatch) -> Iterator[EmiResult]:
        started_s = time.monotonic()
        self._check_size(batch)
        for result in invert(*to_request(batch, self._settings.lr_threshold)):
            self._check_time(started_s)
            self._runtime.counters.count("scans")
            self._runtime.counters.count(f"scans_{result.status}")
            yield to_message(batch, result)

    def _check_size(self, batch: EmiScanBatch) -> None:
        limits = self._settings
        for what, size, limit in (
            ("A scan has {} samples", batch.field.shape[2], limits.max_samples),
            ("The request holds {} numbers", batch.field.size, limits.max_numbers),
        ):
            if size > limit:
                raise RefusedMessage("too_large", f"{what.format(size)}, at most {limit} are accepted.")

    def _check_time(self, started_s: float) -> None:
        limit_s = self._settings.request_deadline_s
        if self._runtime.stopping.is_set():
            raise RefusedMessage("stopping", "The service is stopping.")
        if time.monotonic() - started_s > limit_s:
            raise RefusedMessage("deadline", f"The request was given up after {limit_s:g} s; ask for fewer scans.")
