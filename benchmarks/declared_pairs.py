"""Whether the engine's association cycle is right: the pairs of local tracks that it declares to be one target.

The truth of a local track is that of most of its last plots. The engine tells its pairs and the plots that its local
tracks remember to nobody; what is read of it is read here and nowhere else.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from benchmarks.trials import CLUTTER, Feed, IntArray
from trackmesh.services.fusion.engine import FusionEngine

LAST_PLOTS = 5


@dataclass
class DeclaredPairs:
    """Counts over the cycles of a run.

    Attributes:
        right, wrong: declared pairs whose two local tracks are of the same target, or are not.
        paired, seen: targets with a confirmed local track at both sensors of a pair of sensors, and those of them for
            which a right pair is declared.
    """

    engine: FusionEngine
    right: int = 0
    wrong: int = 0
    paired: int = 0
    seen: int = 0
    _target: dict[tuple[float, float], int] = field(default_factory=dict)
    _last: object = None

    def note(self, feed: Feed) -> None:
        """Remember which target each plot of a batch is of, by where the engine puts it."""
        place, _ = self.engine.sensors[feed.batch.sensor_id].plane(feed.batch)
        for (east, north), target in zip(place.tolist(), feed.target.tolist(), strict=True):
            self._target[east, north] = target

    def look(self) -> None:
        """Count the pairs of the last cycle, unless they have been counted."""
        cycle = self.engine._cycle
        if cycle.declared is self._last:
            return
        self._last = cycle.declared
        truths: dict[int, dict[int, int]] = {}
        for sensor, local in enumerate(self.engine._locals):
            truths[sensor] = {row: self._truth(sensor, row) for row in local.rows.tolist() if local.life.hits[row] >= 3}
        found: dict[tuple[int, int], set[int]] = {}
        for pairs in cycle.declared:
            got = found.setdefault((pairs.a, pairs.b), set())
            got |= self._count(truths[pairs.a], truths[pairs.b], pairs.row_a, pairs.row_b)
        for (a, b), right in found.items():
            both = self._confirmed(a, truths[a]) & self._confirmed(b, truths[b])
            self.seen += len(both)
            self.paired += len(both & right)

    def figures(self) -> dict[str, float]:
        """Percentages; NaN where there was nothing to count."""
        return {
            "pairs_right_pct": _percent(self.right, self.right + self.wrong),
            "paired_pct": _percent(self.paired, self.seen),
        }

    def _count(self, a: dict[int, int], b: dict[int, int], row_a: IntArray, row_b: IntArray) -> set[int]:
        right = set[int]()
        for one, other in zip(row_a.tolist(), row_b.tolist(), strict=True):
            if one not in a or other not in b:
                continue
            same = a[one] == b[other] != CLUTTER
            self.right += same
            self.wrong += not same
            if same:
                right.add(a[one])
        return right

    def _truth(self, sensor: int, row: int) -> int:
        plots = self.engine._locals[sensor].filters.remembered(row)[-LAST_PLOTS:]
        of = [self._target.get((east, north), CLUTTER) for east, north in plots["z"].tolist()]
        return Counter(reversed(of)).most_common(1)[0][0] if of else CLUTTER

    def _confirmed(self, sensor: int, truth: dict[int, int]) -> set[int]:
        confirmed = self.engine._locals[sensor].life.confirmed
        return {target for row, target in truth.items() if confirmed[row] and target != CLUTTER}


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else float(np.nan)
