"""What every service shares: start, health, threads, signals, orderly stop.

A service is run so::

    def main(settings: FusionSettings) -> int:
        return ServiceRuntime("fusion", settings).run(start)

    def start(runtime: ServiceRuntime) -> None:
        plots = runtime.closing(runtime.bus.subscribe(runtime.keys.plots("*")))
        runtime.spawn("engine", lambda: work(plots))
        runtime.set_state("ready")

and tested so, in one process and without signals::

    with ServiceRuntime("fusion", settings, bus=MemoryBus(hub)) as runtime:
        start(runtime)
"""

from __future__ import annotations

import logging
import math
import os
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from typing import Literal, Self, TypeVar

from trackmesh.protocol.bus import Bus, Closeable, Publisher
from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import ServiceStatus
from trackmesh.services.health import Counters, Health, Latencies, Notices
from trackmesh.services.heartbeat import beat
from trackmesh.services.logs import configure_logging
from trackmesh.services.process import EXIT_DEADLINE, EXIT_FAILED, EXIT_OK, on_signal
from trackmesh.services.settings import ServiceSettings, SettingsError, Texts

__all__ = [
    "EXIT_DEADLINE",
    "EXIT_FAILED",
    "EXIT_OK",
    "Counters",
    "Health",
    "Latencies",
    "ServiceRuntime",
    "ServiceSettings",
    "SettingsError",
    "Texts",
    "configure_logging",
]

State = Literal["starting", "compiling", "ready", "stopping"]
C = TypeVar("C", bound=Closeable)

STATUS_PERIOD_S = 1.0


class ServiceRuntime:
    """One service at work: its bus, its name and boot id, its counters, its threads.

    Attributes:
        kind: the kind of service (``fusion``), second to last chunk of its liveliness and status keys.
        settings: as given.
        keys: the keys of the realm.
        boot_id: drawn anew for each runtime.
        counters, latencies: what the status tells; count there.
        stopping: set once the service shall stop; long loops look at it.
        log: the service's logger.
        health: called once a second for what else the status shall tell; replace it.
    """

    def __init__(self, kind: str, settings: ServiceSettings, *, bus: Bus | None = None) -> None:
        self.kind = kind
        self.settings = settings
        self.keys = Keys(settings.realm)
        self.boot_id = uuid.uuid4().hex[:16]
        self.counters = Counters()
        self.latencies = Latencies()
        self.stopping = threading.Event()
        self.log = logging.getLogger(f"trackmesh.{kind}")
        self.health: Callable[[], Health] = Health
        self._notices = Notices(lambda said: self.log.warning("%s", said), lambda said: self.log.info("%s", said))
        self._bus = bus
        self._owns_bus = bus is None
        self._state: State = "starting"
        self._failed = False
        self._started_s = time.monotonic()
        self._status: Publisher | None = None
        self._status_lock = threading.Lock()
        self._seq = 0
        self._threads: list[threading.Thread] = []
        self._on_stop: list[Callable[[], None]] = []
        self._on_exit: list[Callable[[], None]] = []

    @property
    def bus(self) -> Bus:
        """The bus; there once the runtime has started."""
        if self._bus is None:
            raise RuntimeError("The runtime has not started.")
        return self._bus

    @property
    def exit_code(self) -> int:
        """0, or 1 once something has failed."""
        return EXIT_FAILED if self._failed else EXIT_OK

    def set_state(self, state: State) -> None:
        """Say what the service is at; published at once. A service that is stopping stays so."""
        self._state = "stopping" if self.stopping.is_set() else state
        self._publish_status()

    def spawn(self, name: str, target: Callable[[], None]) -> None:
        """Run ``target`` in a thread that is joined at the stop; an exception in it stops the service with exit code 1.

        It must end soon after ``stopping`` is set, or after what it reads (see ``closing``) is closed.
        """
        thread = threading.Thread(target=self._guarded, args=(name, target), name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def closing(self, resource: C) -> C:
        """Close ``resource`` at the stop, before threads are joined: what a thread waits for must end."""
        self._on_stop.append(resource.close)
        return resource

    def on_exit(self, action: Callable[[], None]) -> None:
        """Call ``action`` at the stop, after threads are joined and before the bus is left; last one first."""
        self._on_exit.append(action)

    def stop(self, reason: str = "asked to") -> None:
        """Ask the service to stop; any thread may, but no signal handler."""
        if not self.stopping.is_set():
            self.log.info("stopping: %s", reason)
            self.stopping.set()

    def fail(self, reason: str) -> None:
        """Stop with exit code 1."""
        self._failed = True
        self.log.error("%s", reason)
        self.stop("failed")

    def start(self) -> Self:
        """Open the bus unless one was given, declare that the service is alive, begin its status.

        Raises:
            BusError: no router can be reached.
        """
        if self._bus is None:
            self._bus = self._open_bus()
        self._status = self._bus.publisher(self.keys.status(self.kind, self.settings.unit_id), history=1)
        token = self._bus.declare_alive(self.keys.live(self.kind, self.settings.unit_id))
        self._on_exit.append(token.close)
        self._publish_status()
        self.spawn("status", self._status_loop)
        return self

    def close(self) -> bool:
        """Stop in order, within the deadline of the settings; whether all has ended."""
        self.stop()
        deadline = time.monotonic() + self.settings.stop_deadline_s
        self.set_state("stopping")
        self._call(self._on_stop)
        ended = self._join(deadline)
        self._call(reversed(self._on_exit))
        if self._status is not None:
            self._status.close()
            self._status = None
        if self._owns_bus and self._bus is not None:
            self._bus.close()
        return ended

    def run(self, setup: Callable[[Self], None]) -> int:
        """Be the service of this process: start, ``setup``, wait for a signal or a failure, stop; the exit code.

        A stop that exceeds its deadline ends the process with ``EXIT_DEADLINE``.
        """
        configure_logging(self.settings.log_level, self.settings.log_format, f"{self.kind}/{self.settings.unit_id}")
        with on_signal(self._signalled):
            try:
                self.start()
                setup(self)
                self.stopping.wait()
            except TrackmeshError as error:
                if not self.stopping.is_set():
                    self.fail(str(error))
            except Exception:
                self.log.exception("the service could not start")
                self.fail("unexpected error")
            self._stop_or_exit()
        self.log.info("stopped", extra={"exit_code": self.exit_code})
        return self.exit_code

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _open_bus(self) -> Bus:
        # Not at the top: a service on an in-memory bus needs no network library.
        from trackmesh.protocol.zenoh_bus import ZenohBus

        return ZenohBus.open(
            self.settings.endpoints(),
            timeout_s=self.settings.connect_timeout_s,
            config_path=self.settings.zenoh_config,
            credentials=self.settings.credentials(),
            stop=self.stopping,
        )

    def _guarded(self, name: str, target: Callable[[], None]) -> None:
        try:
            target()
        except Exception:
            self.log.exception("thread %s failed", name)
            self.fail(f"The thread {name} failed.")

    def _call(self, actions: Iterable[Callable[[], None]]) -> None:
        for action in actions:
            try:
                action()
            except Exception:
                self._failed = True
                self.log.exception("a part could not be closed")

    def _join(self, deadline: float) -> bool:
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
        stuck = [t.name for t in self._threads if t.is_alive() and t is not threading.current_thread()]
        if stuck:
            self._failed = True
            self.log.error("threads did not end in time: %s", ", ".join(stuck))
        return not stuck

    def _stop_or_exit(self) -> None:
        # The bus has a deadline of its own; the watchdog is for what hangs all the same.
        watchdog = threading.Timer(self.settings.stop_deadline_s + 4.0, self._exit_now)
        watchdog.daemon = True
        watchdog.start()
        if not self.close():
            self._exit_now()
        watchdog.cancel()

    def _signalled(self, name: str) -> None:
        compiling = self._state == "compiling"
        self.stop(name)
        if compiling:
            # The compiler looks at no event for a minute, and nothing is at work yet that had to end in order.
            self._leave(EXIT_OK)

    def _exit_now(self) -> None:
        self.log.error("the stop took too long, leaving at once")
        self._leave(EXIT_DEADLINE)

    def _leave(self, exit_code: int) -> None:
        logging.shutdown()
        sys.stderr.flush()
        os._exit(exit_code)

    def _status_loop(self) -> None:
        while not self.stopping.wait(STATUS_PERIOD_S):
            self._publish_status()

    def _publish_status(self) -> None:
        with self._status_lock:
            if self._status is None:
                return
            status = self._status_now()
            self._seq += 1
            self._status.put(encode(status), encoding(status))
            self._beat()

    def _beat(self) -> None:
        if self.settings.heartbeat_file is None:
            return
        try:
            beat(self.settings.heartbeat_file, self._state)
        except OSError as error:
            self.counters.count("heartbeat_errors")
            if self._seq == 1:
                self.log.error("no heartbeat, %s: %s", error.filename, error.strerror)

    def _status_now(self) -> ServiceStatus:
        try:
            health = self.health()
        except Exception:
            # The status must go on: it is how others learn that something is wrong.
            self.log.exception("the health of the service could not be told")
            self.counters.count("health_errors")
            health = Health()
        links = self.bus.links
        link = links.notice()
        # Without a link nothing is heard of anybody: that is one thing that is wrong, not many.
        wrong = health.notices if links.steady else {}
        figures = health.figures | links.figures()
        return ServiceStatus(
            kind=self.kind,
            unit_id=self.settings.unit_id,
            boot_id=self.boot_id,
            seq=self._seq,
            t_ns=time.time_ns(),
            state=self._state,
            uptime_s=time.monotonic() - self._started_s,
            counters=self.counters.counts(),
            refused=self.counters.refused(),
            latency_ms=self.latencies.percentiles_ms(),
            figures={name: float(value) for name, value in figures.items() if math.isfinite(value)},
            sensors=health.sensors,
            routers=links.up,
            degraded=self._notices.update(({"link": link} if link else {}) | wrong),
        )
