"""What a watching person should know beside the picture: who has gone quiet, and what services say is wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.links import Links
from trackmesh.protocol.messages import ServiceStatus
from trackmesh.services.cli.tables import degraded_lines

QUIET_S = 3.0
FORGOTTEN_S = 3600.0
"""A service that said nothing for so long is taken to be gone for good."""


class Attention:
    """Follows the statuses of a deployment.

    Args:
        links: of who watches.
        clock: of seconds.
    """

    def __init__(self, links: Links, clock: Callable[[], float] = time.monotonic) -> None:
        self._links = links
        self._clock = clock
        self._last: dict[tuple[str, str], tuple[float, ServiceStatus]] = {}

    def take(self, status: ServiceStatus) -> None:
        """Note a status; a service that says it stops is not missed."""
        who = (status.kind, status.unit_id)
        if status.state == "stopping":
            self._last.pop(who, None)
        else:
            self._last[who] = (self._clock(), status)

    def lines(self) -> list[str]:
        """A line for each thing that is missing or wrong now."""
        link = self._links.notice()
        if link and not self._links.up:
            return [f"here: {link}"]
        now_s, told = self._clock(), []
        for (kind, unit), (heard_s, status) in sorted(self._last.items(), key=lambda item: item[0]):
            quiet_s = now_s - heard_s
            if quiet_s < QUIET_S:
                told += degraded_lines([status])
            elif quiet_s < FORGOTTEN_S:
                told.append(f"{kind} {unit}: says nothing since {quiet_s:.0f} s; it has died, or its link is down.")
        return [*([f"here: {link}"] if link else []), *told]


def routers_down(endpoints: Sequence[str], reach: Callable[[str], None]) -> list[str]:
    """Which of several routers do not answer, a line each; one alone has answered, or nothing could be asked.

    Args:
        endpoints: of the routers.
        reach: joins through one of them, or raises.
    """
    down = []
    for endpoint in endpoints if len(endpoints) > 1 else ():
        try:
            reach(endpoint)
        except TrackmeshError:
            down.append(f"router: {endpoint} does not answer.")
    return down
