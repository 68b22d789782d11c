"""The tags of the demo: where they are told to be, beside where they are."""

from __future__ import annotations

from collections import deque

import numpy as np

from trackmesh.protocol.messages import LOCATED, TagFrame
from trackmesh.sim.scenario import Scenario
from trackmesh.sim.tag_paths import TagPaths
from trackmesh.sim.tags import tag_name

_FRAMES_SCORED = 600


def reader_table(world: Scenario) -> dict[str, object]:
    """The readers of a scenario as a file for the tag service."""
    tags = world.heard_tags()
    defaults = {
        "max_range_m": tags.max_range_m,
        "sigma_m": tags.sigma_range_m,
        "p_detect": tags.p_detect,
        "period_s": tags.tick_s,
    }
    readers = [{"id": reader.id, "site_enu_m": list(reader.site_enu_m)} for reader in tags.readers]
    return {"defaults": defaults, "readers": readers}


class TagState:
    """What was told of the tags so far.

    Attributes:
        start_ns: when the scenario began.
    """

    def __init__(self, world: Scenario) -> None:
        self.start_ns = 0
        self._count = world.heard_tags().count
        self._paths = TagPaths(world.heard_tags())
        self._number = {tag_name(k + 1): k for k in range(self._count)}
        self._located = 0
        self._squared: deque[float] = deque(maxlen=_FRAMES_SCORED)

    def take(self, frame: TagFrame) -> None:
        """Note a picture, and score it."""
        rows = np.flatnonzero(frame.status == LOCATED)
        self._located = len(rows)
        if not len(rows):
            return
        tag = np.array([self._number[frame.tag_id[row]] for row in rows.tolist()])
        truth = self._paths.place(tag, np.full(len(tag), (frame.t_ns - self.start_ns) / 1e9))
        self._squared.append(float(((frame.state[rows, :2] - truth) ** 2).sum(axis=1).mean()))

    def line(self) -> str:
        """How many are located now, and how well they were of late."""
        if not self._squared:
            return "-"
        return f"{self._located} of {self._count} located, {np.sqrt(np.mean(self._squared)):.1f} m RMS"
