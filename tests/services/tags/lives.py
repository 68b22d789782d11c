"""Tags in a table, fed range by range."""

from __future__ import annotations

from typing import Any

import numpy as np
from tests.services.tags.makers import FloatArray, distances, ranges

from trackmesh.services.tags import life, table
from trackmesh.services.tags.life import Manners
from trackmesh.services.tags.records import Describe, Records, make_rules, make_work, sizes
from trackmesh.services.tags.telling import Told, make_told, tell

SIGMA = 0.3


class Table:
    """A few tags among readers (R, 3)."""

    def __init__(self, readers: FloatArray, manners: Manners | None = None, rows: int = 1, **description: Any) -> None:
        self.readers = readers
        self.manners = manners or Manners()
        self.rules = make_rules(Describe(**description))
        self.work = make_work(self.rules)
        # One block more than can be needed: without a free one nothing is taken.
        self.tags = table.make_tags(self.rules, rows, rows + 1)
        self.rng = np.random.default_rng(7)

    def take(self, z: Records) -> int:
        return int(life.take_ranges(self.tags, self.rules[0], self.manners, self.readers, z, self.work[0]))

    def hear(
        self, t_s: float, place: Any, *readers: int, noise: FloatArray | float | None = None, row: int = 0
    ) -> None:
        """One instant: a tag at a place, heard by these readers."""
        d = distances(np.array(place, float), self.readers)[list(readers)]
        d = d + (SIGMA * self.rng.normal(size=len(d)) if noise is None else noise)
        self.take(ranges(*[(t_s, r, max(m, 0.0)) for r, m in zip(readers, d, strict=True)], sigma=SIGMA, row=row))

    def wait(self, now_s: float) -> None:
        life.end_waiting(self.tags, self.rules[0], self.manners, self.readers, now_s, 0, self.work[0])

    def told(self, t_s: float, row: int = 0) -> Told:
        out = make_told(1, sizes(self.rules)[1])
        tell(self.tags, self.rules[0], np.array([row]), t_s, 5.0, self.work[0], out)
        return out

    @property
    def state(self) -> int:
        return int(self.tags.life["state"][0])

    def count(self, what: int) -> int:
        return int(self.tags.counts[what])

    @property
    def free_blocks(self) -> int:
        return int(self.tags.blocks.top[0])
