"""Measures of the single integrated air picture: how complete, clear and continuous it is.

J. Votruba, R. Nisley, R. Rothrock, B. Zombro, "Single integrated air picture (SIAP) metrics implementation", 2001. A
track belongs to the target nearest to it within a gate; a target may have several.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.sim.metrics.segments import Cover, covered_s, fewest_changes, segments


class SiapCount(NamedTuple):
    """One moment.

    Attributes:
        targets, tracked: J, and J_T of them with a track.
        tracks, assigned: N, and N_A of them with a target.
        position_m, velocity_mps: sums of the errors of the assigned tracks.
    """

    targets: int
    tracked: int
    tracks: int
    assigned: int
    position_m: float
    velocity_mps: float


class Siap(NamedTuple):
    """A whole run; sums are over moments, NaN where there is nothing to divide by.

    Attributes:
        completeness: sum J_T / sum J, best 1.
        ambiguity: sum N_A / sum J_T, tracks for a tracked target, best 1.
        spuriousness: sum (N - N_A) / sum N, best 0.
        position_m, velocity_mps: mean errors of the assigned tracks.
        number_changes: how often the track number of targets changed, at least.
        changes_per_h: that for each hour in which a target is tracked.
        longest_segment: sum over targets of the longest stretch of one track, over the sum of their lives; best 1.
    """

    completeness: float
    ambiguity: float
    spuriousness: float
    position_m: float
    velocity_mps: float
    number_changes: int
    changes_per_h: float
    longest_segment: float


def siap_count(
    target: IntArray, distance_m: FloatArray, velocity_error_mps: FloatArray, n_targets: int
) -> SiapCount:  # fmt: skip
    """Count one moment: the target (m,) of each track or -1, and how far the track is off in position and velocity."""
    own = target >= 0
    return SiapCount(
        n_targets,
        len(np.unique(target[own])),
        len(target),
        int(own.sum()),
        float(distance_m[own].sum()),
        float(velocity_error_mps[own].sum()),
    )


def siap(counts: list[SiapCount], cover: Cover, t_s: FloatArray, alive: Cover) -> Siap:
    """The measures of a run.

    Args:
        counts: of each moment.
        cover: which tracks were with which target, its frames the moments.
        t_s: (k,) times of the moments.
        alive: in which moments each target was there; its track ids mean nothing.
    """
    sums = np.array(counts, np.float64).reshape(-1, 6).sum(axis=0)
    targets, tracked, tracks, assigned, position, velocity = sums.tolist()
    covers = cover.by_target()
    changes, tracked_s, longest_s, life_s = 0, 0.0, 0.0, 0.0
    for target, lived in alive.by_target().items():
        life_s += float(t_s[lived.frame.max()] - t_s[lived.frame.min()])
        if target not in covers:
            continue
        its = segments(covers[target])
        first_s, last_s = t_s[its.first], t_s[its.last]
        changes += fewest_changes(covers[target])
        tracked_s += covered_s(first_s, last_s)
        longest_s += float((last_s - first_s).max())
    return Siap(
        completeness=_ratio(tracked, targets),
        ambiguity=_ratio(assigned, tracked),
        spuriousness=_ratio(tracks - assigned, tracks),
        position_m=_ratio(position, assigned),
        velocity_mps=_ratio(velocity, assigned),
        number_changes=changes,
        changes_per_h=_ratio(3600.0 * changes, tracked_s),
        longest_segment=_ratio(longest_s, life_s),
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
