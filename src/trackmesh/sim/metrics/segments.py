"""Stretches of time in which a track keeps to a target."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray


class Cover(NamedTuple):
    """Which tracks were with which target (k,), frame by frame; several tracks may be with one target."""

    frame: IntArray
    target_id: IntArray
    track_id: IntArray

    def by_target(self) -> dict[int, Cover]:
        """What was with each target."""
        order = np.argsort(self.target_id, kind="stable")
        targets, first = np.unique(self.target_id[order], return_index=True)
        columns = zip(*(np.split(column[order], first[1:]) for column in self), strict=True)
        return {target: Cover(*its) for target, its in zip(targets.tolist(), columns, strict=False)}


class Segments(NamedTuple):
    """Unbroken stretches (s,): from frame ``first`` to frame ``last`` a track was with a target in every frame."""

    target_id: IntArray
    track_id: IntArray
    first: IntArray
    last: IntArray


def segments(cover: Cover) -> Segments:
    """The stretches of a cover, by target, track and time."""
    order = np.lexsort((cover.frame, cover.track_id, cover.target_id))
    frame, target, track = cover.frame[order], cover.target_id[order], cover.track_id[order]
    begins = np.ones(len(order), np.bool_)
    begins[1:] = (target[1:] != target[:-1]) | (track[1:] != track[:-1]) | (frame[1:] != frame[:-1] + 1)
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(order)) - 1 if len(first) else first
    return Segments(target[first], track[first], frame[first], frame[last])


def fewest_changes(cover: Cover) -> int:
    """How often the number of the track must change at least, to be with one target whenever some track is.

    Whoever follows a number as long as it lasts, and then takes the one that lasts longest, changes least often. A gap
    without any track is no change.
    """
    if not len(cover.frame):
        return 0
    frames, rank = np.unique(cover.frame, return_inverse=True)
    lasting = segments(cover._replace(frame=rank))
    changes, place = -1, 0
    while place < len(frames):
        place = int(lasting.last[(lasting.first <= place) & (lasting.last >= place)].max()) + 1
        changes += 1
    return changes


def covered_s(first_s: FloatArray, last_s: FloatArray) -> float:
    """The length of the union of intervals (s,), in seconds."""
    order = np.argsort(first_s)
    first, last = first_s[order], np.maximum.accumulate(last_s[order])
    before = np.concatenate([[-np.inf], last[:-1]])[: len(last)]
    return float(np.maximum(last - np.maximum(first, before), 0.0).sum())
