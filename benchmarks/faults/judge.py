"""What faults cost: who is tracked, how soon again after each, under which number; and where every batch went.

All of it is counted from what a client hears and from files; nothing here knows of processes.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.messages import COASTING, CONFIRMED, TrackFrame

NEAR_M = 600.0
STALE_NS = 1_500_000_000
CONCERN_ALL = ("router", "fusion", "client")
Batch = tuple[str, str, int]
"""Sensor, boot id, sequence number."""


class Fault(NamedTuple):
    """One fault: what, whom, from when to when (UTC ns); ``before`` is the track of each target that had one."""

    kind: str
    part: str
    began_ns: int
    healed_ns: int
    before: dict[int, int]


@dataclass
class Judged:
    """What a fault cost: seconds from healing until each target was tracked again, and who kept its number.

    Attributes:
        recovered_s: from the healing of this fault.
        undisturbed_s: from the last healing until then of a fault that concerned all targets: others may have begun
            before this one's consequences were over.
    """

    fault: Fault
    recovered_s: dict[int, float] = field(default_factory=dict)
    undisturbed_s: dict[int, float] = field(default_factory=dict)
    kept: dict[int, bool] = field(default_factory=dict)

    @property
    def missing(self) -> set[int]:
        """Targets that were not tracked again so far."""
        return self.fault.before.keys() - self.recovered_s.keys()


def tracked(frame: TrackFrame, ids: IntArray, positions_m: FloatArray) -> dict[int, tuple[int, int]]:
    """Target -> (track, time of its last plot), of the targets (n,) at (n, 2) that have a track near.

    Each track is given to the nearest target and each target takes its nearest track.
    """
    rows = np.flatnonzero((frame.status == CONFIRMED) | (frame.status == COASTING))
    if not len(rows) or not len(ids):
        return {}
    apart = np.linalg.norm(frame.state[rows, None, :2] - positions_m[None, :, :], axis=2)
    owner = apart.argmin(axis=1)
    found: dict[int, tuple[int, int]] = {}
    for j, target in enumerate(ids.tolist()):
        mine = np.flatnonzero((owner == j) & (apart[:, j] < NEAR_M))
        if len(mine):
            row = rows[mine[apart[mine, j].argmin()]]
            found[target] = (int(frame.track_id[row]), int(frame.updated_t_ns[row]))
    return found


class Judge:
    """Takes frames as they come, and faults as they heal."""

    def __init__(self) -> None:
        self.judged: list[Judged] = []
        self.now: dict[int, tuple[int, int]] = {}
        self.seen_ns = self.whole_ns = 0
        self._last_ns = self._all_healed_ns = 0

    def take(self, found: dict[int, tuple[int, int]], targets: int, came_ns: int) -> None:
        """What a frame shows of the targets that there are, and when it came."""
        if self._last_ns:
            apart_ns = came_ns - self._last_ns
            self.seen_ns += apart_ns
            # Of a picture that stands still nobody knows whether it is whole.
            self.whole_ns += min(apart_ns, STALE_NS) * (len(self.now) == targets)
        self._last_ns, self.now = came_ns, found
        for one in self.judged[-40:]:
            for target in sorted(one.missing):
                track, updated_ns = found.get(target, (-1, 0))
                if updated_ns > one.fault.healed_ns:
                    one.recovered_s[target] = (came_ns - one.fault.healed_ns) / 1e9
                    one.undisturbed_s[target] = (came_ns - max(one.fault.healed_ns, self._all_healed_ns)) / 1e9
                    one.kept[target] = track == one.fault.before[target]

    def healed(self, fault: Fault) -> None:
        """A fault is over."""
        self.judged.append(Judged(fault))
        if fault.part in CONCERN_ALL:
            self._all_healed_ns = fault.healed_ns

    def forget_dead(self, alive: Iterable[int]) -> None:
        """Targets that have left the area are nobody's fault."""
        there = set(alive)
        for one in self.judged:
            for target in one.missing - there:
                del one.fault.before[target]


class Account(NamedTuple):
    """Where the batches of all radars went; ``taken + died + told + untold = published``.

    Attributes:
        died: the last ones of a radar that was killed before anybody could fetch them.
        told: missing in between, and counted as gaps by the unit.
        untold: missing in between, and not counted.
        twice: taken twice by one run of the unit.
    """

    published: int
    taken: int
    died: int
    told: int
    untold: int
    twice: int


def account(published: Sequence[Batch], taken: Sequence[Sequence[Batch]], gaps: int) -> Account:
    """Where every batch went.

    Args:
        published: as the radars noted them, in order.
        taken: for each run of the unit what it took.
        gaps: batches that the unit's runs said were missing.
    """
    had = {batch for run in taken for batch in run}
    last: dict[tuple[str, str], int] = defaultdict(lambda: -1)
    for sensor, boot, seq in had:
        last[sensor, boot] = max(last[sensor, boot], seq)
    absent = [batch for batch in published if batch not in had]
    died = sum(seq > last[sensor, boot] for sensor, boot, seq in absent)
    between = len(absent) - died
    twice = sum(len(run) - len(set(run)) for run in taken)
    return Account(len(published), len(had), died, min(between, gaps), max(0, between - gaps), twice)


def read_journal(path: Path, sensor: str) -> list[Batch]:
    """What a radar noted."""
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    return [(sensor, fields[0], int(fields[1])) for fields in map(str.split, lines)]


def read_black_box(path: Path) -> list[Batch]:
    """The batches that a run of the unit took, whatever else it recorded; its last line may be cut off."""
    found = []
    for line in path.read_text(encoding="utf-8").split("\n")[:-1]:
        if line.startswith('{"type":"plots"') or '"type": "plots"' in line[:40]:
            fields = json.loads(line)
            found.append((fields["sensor_id"], fields["boot_id"], fields["seq"]))
    return found
