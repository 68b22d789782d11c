"""One picture of the frames of several units: a track that two of them tell is shown once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import TrackFrame

PER_TRACK = (
    "track_id", "epoch", "status", "state", "covariance", "height_m", "height_variance_m2", "model_probability",
    "manoeuvre_fit", "members", "updated_t_ns", "first_t_ns",
)  # fmt: skip
"""The fields of a frame that have a row a track."""


def some_of(frame: TrackFrame, keep: npt.NDArray[np.bool_]) -> TrackFrame:
    """The frame with only these tracks (n,)."""
    if keep.all():
        return frame
    given = [name for name in PER_TRACK if getattr(frame, name) is not None]
    return frame.model_copy(update={name: np.ascontiguousarray(getattr(frame, name)[keep]) for name in given})


def without_doubles(frames: Sequence[TrackFrame]) -> list[TrackFrame]:
    """Frames of different units, each without the tracks that another tells in a higher epoch, or the same one later.

    While a track goes from one unit to another, both may tell it for a moment: they do so under one id.
    """
    if len(frames) < 2:
        return list(frames)
    ident = np.concatenate([one.track_id for one in frames])
    epoch = np.concatenate([one.epoch for one in frames])
    t_ns = np.concatenate([np.full(len(one.track_id), one.t_ns) for one in frames])
    order = np.lexsort((t_ns, epoch, ident))
    counts = np.ones(len(order), np.bool_)
    counts[:-1] = ident[order][1:] != ident[order][:-1]
    keep = np.zeros(len(order), np.bool_)
    keep[order[counts]] = True
    starts = np.cumsum([len(one.track_id) for one in frames])[:-1]
    return [some_of(one, part) for one, part in zip(frames, np.split(keep, starts), strict=True)]
