"""The EMI service as a process: workers, bus, queryable, and an eye on those who wait."""

from __future__ import annotations

import os
import time

from trackmesh.protocol.bus import AliveSubscription
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import last_chunk
from trackmesh.services.emi.service.handler import EmiService
from trackmesh.services.emi.service.pool import OwnWork, Solver, WorkerPool
from trackmesh.services.emi.service.settings import EmiSettings
from trackmesh.services.emi.service.warm_up import warm_up
from trackmesh.services.runtime import ServiceRuntime

KIND = "emi"


def main(settings: EmiSettings) -> int:
    """Be the EMI service of this process; returns its exit code."""

    def setup(runtime: ServiceRuntime) -> None:
        start(runtime, settings)

    return ServiceRuntime(KIND, settings).run(setup)


def start(runtime: ServiceRuntime, settings: EmiSettings) -> EmiService:
    """Have the kernels compiled or loaded, then answer queries.

    Raises:
        TrackmeshError: the worker processes cannot be started.
    """
    runtime.set_state("compiling")
    started_s = time.monotonic()
    solver = make_solver(runtime, cores() if settings.processes is None else settings.processes)
    runtime.log.info("kernels ready after %.1f s", time.monotonic() - started_s)
    service = EmiService(runtime, settings, solver)
    watch = runtime.closing(runtime.bus.watch_alive(runtime.keys.asking("*")))
    runtime.spawn("askers", lambda: follow(watch, service))
    key = runtime.keys.service(KIND, settings.unit_id)
    runtime.closing(runtime.bus.serve(key, service.handle, workers=settings.workers, waiting=settings.waiting))
    runtime.set_state("ready")
    return service


def make_solver(runtime: ServiceRuntime, processes: int) -> Solver:
    """Workers that are ready; they end with the service."""
    if processes == 0:
        warm_up()
        return OwnWork()
    pool = WorkerPool(processes)
    runtime.on_exit(pool.close)
    if not pool.wait_ready(runtime.stopping) and not runtime.stopping.is_set():
        raise TrackmeshError("The worker processes could not be started; the log says why.")
    return pool


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def follow(watch: AliveSubscription, service: EmiService) -> None:
    """Give up what nobody waits for any more."""
    for event in watch:
        if not event.alive:
            service.askers.left(last_chunk(event.key))
