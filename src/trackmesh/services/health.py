"""What a service counts and times about itself."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from trackmesh.protocol.messages import SensorHealth


@dataclass(frozen=True)
class Health:
    """What a service adds to its status: present values by name, its sensors, and what is missing or wrong now.

    ``notices`` are sentences by a name that stays while it lasts.
    """

    figures: dict[str, float] = field(default_factory=dict)
    sensors: list[SensorHealth] = field(default_factory=list)
    notices: dict[str, str] = field(default_factory=dict)


class Notices:
    """Tells each thing that is wrong once when it begins and once when it ends."""

    def __init__(self, begins: Callable[[str], None], ends: Callable[[str], None]) -> None:
        self._begins = begins
        self._ends = ends
        self._last: dict[str, str] = {}

    def update(self, now: Mapping[str, str]) -> list[str]:
        """The sentences of now, having told what is new and what is over."""
        for key in self._last.keys() - now.keys():
            self._ends(f"over: {self._last[key]}")
        for key in now.keys() - self._last.keys():
            self._begins(now[key])
        self._last = dict(now)
        return list(now.values())


class Counters:
    """Counts since start, by name; refusals apart, by reason. Any thread may count."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()

    def count(self, name: str, n: int = 1) -> None:
        """Add ``n`` to a count; 0 makes the name appear."""
        with self._lock:
            self._counts[name] += n

    def refuse(self, reason: str, n: int = 1) -> None:
        """Count refused input by its reason."""
        with self._lock:
            self._refused[reason] += n

    def counts(self) -> dict[str, int]:
        """The counts now."""
        with self._lock:
            return dict(self._counts)

    def refused(self) -> dict[str, int]:
        """The refusals now, by reason."""
        with self._lock:
            return dict(self._refused)


class Latencies:
    """Durations of the last minute, as percentiles. Any thread may record."""

    def __init__(self, window_s: float = 60.0, most: int = 20_000, clock: Callable[[], float] = time.monotonic) -> None:
        self._lock = threading.Lock()
        self._window_s = window_s
        self._clock = clock
        self._records: deque[tuple[float, float]] = deque(maxlen=most)

    def record(self, seconds: float) -> None:
        """One duration, now."""
        with self._lock:
            self._records.append((self._clock(), seconds))

    def percentiles_ms(self) -> dict[str, float]:
        """``p50``, ``p90`` and ``p99`` in milliseconds; empty without records."""
        with self._lock:
            oldest = self._clock() - self._window_s
            while self._records and self._records[0][0] < oldest:
                self._records.popleft()
            values = [seconds for _, seconds in self._records]
        if not values:
            return {}
        # A clock set back must not make the status invalid.
        points = np.maximum(np.percentile(values, [50, 90, 99]), 0.0) * 1e3
        return dict(zip(("p50", "p90", "p99"), points.tolist(), strict=True))
