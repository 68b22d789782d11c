"""How well tags are located: their frames against the truth. Tag ``tag-7`` is the target 7 of the truth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import LOCATED, TagFrame, TruthFrame


@dataclass(frozen=True)
class TagScore:
    """One tag over all frames within the truth that hold it.

    Attributes:
        tag: its name. frames: how many. located: share of them in which it is located; the rest is of those.
        rms_m, median_m, p95_m, worst_m: error of the position.
        nees: mean normalised squared error over its dimension; 1 where the covariance is right.
    """

    tag: str
    frames: int
    located: float
    rms_m: float
    median_m: float
    p95_m: float
    worst_m: float
    nees: float


class TagTruth:
    """Where tags really were, between the truth's frames on straight lines."""

    def __init__(self, frames: Iterable[TruthFrame]) -> None:
        kept = list(frames)
        self._begin_ns = kept[0].t_ns if kept else 0
        # Nanoseconds since the first frame: those since 1970 do not fit a float.
        parts = [np.column_stack([np.full(len(f.id), f.t_ns - self._begin_ns), f.id, f.state[:, :2]]) for f in kept]
        table = np.concatenate([np.empty((0, 4)), *parts])
        self._paths = {int(k): table[table[:, 1] == k] for k in np.unique(table[:, 1])}

    def at(self, tag: str, t_ns: int) -> FloatArray | None:
        """Position (2,) of a tag, or None outside of what is known."""
        number = tag.rpartition("-")[2]
        path = self._paths.get(int(number)) if number.isdecimal() else None
        t = float(t_ns - self._begin_ns)
        if path is None or not path[0, 0] <= t <= path[-1, 0]:
            return None
        return np.array([np.interp(t, path[:, 0], path[:, axis]) for axis in (2, 3)])


def score_tags(frames: Iterable[TagFrame], truth: TagTruth) -> list[TagScore]:
    """One score a tag, ordered by name.

    Raises:
        TrackmeshError: no frame lies within the truth of any tag.
    """
    errors: dict[str, list[tuple[bool, float, float]]] = {}
    for frame in frames:
        covariance = frame.covariance_matrices()[:, :2, :2]
        for row, tag in enumerate(frame.tag_id):
            place = truth.at(tag, frame.t_ns)
            if place is not None:
                e = frame.state[row, :2] - place
                nees = float(e @ np.linalg.solve(covariance[row] + 1e-12 * np.eye(2), e)) / 2.0
                errors.setdefault(tag, []).append((bool(frame.status[row] == LOCATED), float(e @ e), nees))
    if not errors:
        raise TrackmeshError("No frame lies within the truth of a tag; a tag must be named after its target: tag-7.")
    return [_score(tag, errors[tag]) for tag in sorted(errors)]


def _score(tag: str, rows: list[tuple[bool, float, float]]) -> TagScore:
    located = np.array([row[0] for row in rows])
    squared, nees = (np.array([row[k] for row in rows])[located] for k in (1, 2))
    if not len(squared):
        return TagScore(tag, len(rows), 0.0, *[float("nan")] * 5)
    off = np.sqrt(squared)
    return TagScore(
        tag,
        len(rows),
        float(located.mean()),
        float(np.sqrt(squared.mean())),
        float(np.median(off)),
        float(np.percentile(off, 95)),
        float(off.max()),
        float(nees.mean()),
    )
