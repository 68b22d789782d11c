"""The score for recordings in which only some of what the sensors see has a truth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.messages import TrackFrame, TruthFrame
from trackmesh.sim.metrics import match, mean, nearest_distance, rmse
from trackmesh.sim.scoring.picture import picture
from trackmesh.sim.scoring.timeline import TruthTimeline


@dataclass(frozen=True)
class NearestSummary:
    """A run scored by the nearest track of each target with a truth.

    Attributes:
        frames: how many were scored.
        tracks: how many different tracks were shown.
        gospa_m, false: means over the frames; what is real but has no truth counts as false.
        coverage: share of targets with a track nearer than ``c_m``; ``rmse_m`` is of those.
    """

    c_m: float
    frames: int
    tracks: int
    gospa_m: float
    false: float
    coverage: float
    rmse_m: float

    def as_dict(self) -> dict[str, float | int]:
        """The figures by name."""
        return asdict(self)


def score_nearest(frames: Iterable[TrackFrame], truth: Iterable[TruthFrame], c_m: float = 30.0) -> NearestSummary:
    """Score frames, one a batch of plots, against the truth frame nearest in time.

    A target is seen in a frame where some track is nearer than ``c_m``; one track may serve two targets. It is the
    method for recordings in which only some of the boats that the sensors see carry a receiver.

    Raises:
        TrackmeshError: the truth is empty.
    """
    timeline, shown = TruthTimeline(truth), set[int]()
    gospa_m, false, distance = list[float](), list[int](), list[FloatArray]()
    for frame in frames:
        tracks = picture(frame)
        targets_m = timeline.nearest(frame.t_ns).state[:, :2]
        parts = match(targets_m, tracks.position_m, c_m).gospa()
        gospa_m.append(parts.total_m)
        false.append(parts.false)
        distance.append(nearest_distance(targets_m, tracks.position_m))
        shown.update(tracks.track_id.tolist())
    every = np.concatenate([np.zeros(0), *distance])
    return NearestSummary(
        c_m=c_m,
        frames=len(gospa_m),
        tracks=len(shown),
        gospa_m=mean(gospa_m),
        false=mean(false),
        coverage=mean(every < c_m),
        rmse_m=rmse(every[every < c_m]),
    )
