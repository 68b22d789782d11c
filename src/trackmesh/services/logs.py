"""Logging of services: one line a record on stderr, for people or as JSON."""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import Any, Literal

LogFormat = Literal["human", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

_STANDARD = set(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class _Human(logging.Formatter):
    def __init__(self, origin: str) -> None:
        super().__init__(fmt=f"%(asctime)s %(levelname)-7s {origin} %(message)s")

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:
        utc = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        return f"{utc}.{int(record.msecs):03d}Z"


class _Json(logging.Formatter):
    def __init__(self, origin: str) -> None:
        super().__init__()
        self._origin = origin

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time_s": round(record.created, 3),
            "level": record.levelname.lower(),
            "service": self._origin,
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {name: value for name, value in vars(record).items() if name not in _STANDARD}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure_logging(level: LogLevel = "info", fmt: LogFormat = "human", origin: str = "trackmesh") -> None:
    """Send all log records of the process to stderr.

    Args:
        level: the least severe level shown.
        fmt: ``human``, or ``json`` with one object a line (fields given as ``extra`` are added to it).
        origin: who logs, for example ``fusion/main``.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Json(origin) if fmt == "json" else _Human(origin))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # numba logs every step of its compiler at debug level.
    logging.getLogger("numba").setLevel(logging.WARNING)
