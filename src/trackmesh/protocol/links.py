"""The links of a participant to its routers: which are up, which was lost and when."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime

SETTLING_S = 3.0
RECENT_S = 60.0
"""A loss is worth telling for this long after the link is back."""


class Links:
    """Takes note of links that come and go. Any thread may tell or ask.

    Args:
        log: told a sentence at each loss and each return.
        clock: UTC ns.
    """

    def __init__(self, log: Callable[[str], None] = lambda _: None, clock: Callable[[], int] = time.time_ns) -> None:
        self._log = log
        self._clock = clock
        self._lock = threading.Lock()
        self._up: set[str] = set()
        self._lost = ""
        self._lost_ns = self._back_ns = 0
        self._losses = 0
        self._cut_off_ns = 0

    def came(self, router: str) -> None:
        """There is a link to the router at this locator."""
        with self._lock:
            first, lost = not self._up, self._lost
            self._up.add(router)
            if not (first and lost):
                return
            self._back_ns = self._clock()
            gone_ns = max(0, self._back_ns - self._lost_ns)
            self._cut_off_ns += gone_ns
        self._log(f"joined through {router} again after {gone_ns / 1e9:.1f} s")

    def went(self, router: str) -> None:
        """The link to the router at this locator is gone."""
        with self._lock:
            if router not in self._up:
                return
            self._up.discard(router)
            self._lost, self._lost_ns = router, self._clock()
            self._losses += 1
        self._log(f"the link to the router {router} is lost")

    @property
    def up(self) -> list[str]:
        """Locators of the routers that there is a link to, sorted."""
        with self._lock:
            return sorted(self._up)

    @property
    def steady(self) -> bool:
        """Whether there was a link for some time: just after one is back, what it withheld is still on its way."""
        with self._lock:
            return bool(self._up or not self._lost) and self._clock() - self._back_ns > SETTLING_S * 1e9

    def figures(self) -> dict[str, float]:
        """Links lost since the start, and seconds without any; nothing where there never were links."""
        with self._lock:
            if not (self._up or self._lost):
                return {}
            gone_ns = self._cut_off_ns
            if self._lost and not self._up:
                gone_ns += max(0, self._clock() - self._lost_ns)
            return {"links_lost": float(self._losses), "cut_off_s": gone_ns / 1e9}

    def notice(self) -> str:
        """One sentence of what is or was lately wrong with the links; empty if nothing."""
        with self._lock:
            if not self._lost:
                return ""
            since, now_ns = clock_time(self._lost_ns), self._clock()
            if not self._up:
                return f"There is no link to a router since {since}: {self._lost} was lost."
            if self._lost not in self._up:
                return f"The router {self._lost} was lost at {since}; joined through {min(self._up)} instead."
            if now_ns - self._back_ns > RECENT_S * 1e9:
                return ""
            gone_s = max(0, self._back_ns - self._lost_ns) / 1e9
            return f"There was no link to the router {self._lost} for {gone_s:.1f} s from {since}."


def clock_time(t_ns: int) -> str:
    """A time (UTC ns) as people read it: ``12:03:04 UTC``."""
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%H:%M:%S UTC")
