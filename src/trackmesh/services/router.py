"""A Zenoh router as a Python process, for machines without ``zenohd``.

The data plane is the same library; what it lacks are zenohd's plug-ins.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import zenoh

from trackmesh.protocol.bus import DEFAULT_ENDPOINT
from trackmesh.protocol.errors import BusError, TrackmeshError
from trackmesh.protocol.zenoh_config import endpoints_of, router_config
from trackmesh.services.heartbeat import beat
from trackmesh.services.logs import LogFormat, LogLevel, configure_logging
from trackmesh.services.process import EXIT_DEADLINE, EXIT_FAILED, EXIT_OK, on_signal

_log = logging.getLogger("trackmesh.router")

CLOSE_DEADLINE_S = 3.0
HEARTBEAT_S = 1.0


class Router:
    """A router that runs until it is closed.

    Args:
        listen: endpoints (``tcp/0.0.0.0:7447``); none means those in the file, or this host only.
        config_path: a JSON5 file of Zenoh settings, as ``zenohd -c`` reads it.

    Raises:
        BusError: the settings are wrong, or an endpoint is taken.
    """

    def __init__(self, listen: Sequence[str] = (), config_path: Path | None = None) -> None:
        config = router_config(listen, config_path)
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError:
            where = ", ".join(endpoints_of(config, "listen"))
            raise BusError(f"The router cannot listen at {where}; is another one running there?") from None
        self.locators = self._reached_at() or endpoints_of(config, "listen")

    def close(self) -> bool:
        """Leave, under a deadline; whether it was kept (on some links closing can hang)."""
        thread = threading.Thread(target=self._session.close, name="router-close", daemon=True)
        thread.start()
        thread.join(CLOSE_DEADLINE_S)
        return not thread.is_alive()

    def _reached_at(self) -> list[str]:
        # A port 0 is known, and 0.0.0.0 resolved, only once it listens.
        for reply in self._session.get(f"@/{self._session.zid()}/router", timeout=1.0):
            if reply.ok is not None:
                return list(json.loads(reply.ok.payload.to_string())["locators"])
        return []


def run_router(
    listen: Sequence[str] = (),
    config_path: Path | None = None,
    stop: threading.Event | None = None,
    heartbeat: Path | None = None,
) -> int:
    """Route until ``stop`` is set; the exit code.

    With ``heartbeat`` that file is rewritten every second, see ``services.heartbeat``.

    Raises:
        BusError: see ``Router``.
    """
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    stop = stop or threading.Event()
    started = time.monotonic()
    router = Router(listen, config_path)
    _log.info(
        "ready after %.1f s, reached at %s",
        time.monotonic() - started,
        " ".join(router.locators),
        extra={"locators": router.locators},
    )
    _wait(stop, heartbeat)
    if router.close():
        _log.info("stopped")
        return EXIT_OK
    _log.error("the router did not close within %g s", CLOSE_DEADLINE_S)
    return EXIT_DEADLINE


def _wait(stop: threading.Event, heartbeat: Path | None) -> None:
    while heartbeat is not None and not stop.is_set():
        try:
            beat(heartbeat, "ready")
        except OSError as error:
            _log.error("no heartbeat, %s: %s", error.filename, error.strerror)
            break
        stop.wait(HEARTBEAT_S)
    stop.wait()


def serve(
    listen: Sequence[str] = (),
    config_path: Path | None = None,
    log_level: LogLevel = "info",
    log_format: LogFormat = "human",
    heartbeat: Path | None = None,
) -> int:
    """Be the router of this process, until SIGTERM or SIGINT; the exit code."""
    configure_logging(log_level, log_format, "router")
    stop = threading.Event()
    with on_signal(lambda _name: stop.set()):
        try:
            code = run_router(listen, config_path, stop, heartbeat)
        except TrackmeshError as error:
            _log.error("%s", error)
            return EXIT_FAILED
    if code == EXIT_DEADLINE:
        logging.shutdown()
        os._exit(code)
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of ``python -m trackmesh.services.router``."""
    parser = argparse.ArgumentParser(description="A Zenoh router.")
    parser.add_argument("--listen", action="append", default=[], help=f"endpoint, default {DEFAULT_ENDPOINT}")
    parser.add_argument("--config", type=Path, help="JSON5 file of Zenoh settings, as zenohd reads it")
    parser.add_argument("--log-level", choices=("debug", "info", "warning", "error"), default="info")
    parser.add_argument("--log-format", choices=("human", "json"), default="human")
    given = parser.parse_args(arguments)
    return serve(given.listen, given.config, given.log_level, given.log_format)


if __name__ == "__main__":
    raise SystemExit(main())
