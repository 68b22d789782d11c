"""Changes of assignment between one moment and the next, and GOSPA with a penalty for them.

The penalty is that of A. F. Garcia-Fernandez, A. S. Rahmathullah, L. Svensson, "A metric on the space of finite sets of
trajectories for evaluation of multi-target tracking algorithms", IEEE Trans. Signal Processing 68 (2020): gamma^p for a
target that changes from one track to another, half of it for one that changes between a track and none. There the
assignments of all moments are chosen together, which is another assignment problem for every run; here each moment has
the best one of its own, as in the usual tool boxes, so that every frame has its value.
"""

from __future__ import annotations

from typing import NamedTuple

from trackmesh.protocol.arrays import IntArray
from trackmesh.sim.metrics.matching import Gospa

UNASSIGNED = -1
"""In place of a track's id: the target has none."""


class Switches(NamedTuple):
    """What changed from one moment to the next.

    Attributes:
        assignments: targets that changed from one track to another count one, those that lost their track or found one
            again count a half; a target's first track is no change.
        identities: targets that are followed by another track than when they were last followed.
    """

    assignments: float
    identities: int


class Followers:
    """Which track each target has, moment by moment."""

    def __init__(self) -> None:
        self._now: dict[int, int] = {}
        self._last: dict[int, int] = {}

    def step(self, present: IntArray, target_id: IntArray, track_id: IntArray) -> Switches:
        """The next moment: ids (n,) of the targets that are there, and who is assigned to whom (k,), (k,)."""
        followed = dict(zip(target_id.tolist(), track_id.tolist(), strict=True))
        assignments, identities = 0.0, 0
        for target in present.tolist():
            track, before = followed.get(target, UNASSIGNED), self._now.get(target, UNASSIGNED)
            if target in self._last and track != before:
                assignments += 0.5 * ((track != UNASSIGNED) + (before != UNASSIGNED))
            self._now[target] = track
        for target, track in followed.items():
            identities += self._last.get(target, track) != track
            self._last[target] = track
        return Switches(assignments, identities)


def gospa_with_switching(moment: Gospa, switches: float, penalty_m: float, p: float = 2.0) -> float:
    """(gospa^p + penalty^p switches)^(1/p), in metres."""
    return float((moment.total_m**p + penalty_m**p * switches) ** (1.0 / p))
