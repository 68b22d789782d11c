"""One picture of the frames of several units: a track that two of them tell is shown once."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import Float32Array, FloatArray
from trackmesh.protocol.messages import COASTING, ENDED, TrackFrame, symmetric

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


_Q_M2PS3 = 50.0
_UPPER = np.triu_indices(6)


def ahead(state: FloatArray, covariance: Float32Array, dt_s: FloatArray) -> tuple[FloatArray, Float32Array]:
    """States (n, 6) and upper triangles (n, 21) after dt_s (n,): F P F^T + Q, constant velocity.

    Q is that of white acceleration noise, 50 m^2/s^3 an axis; accelerations are left alone.
    """
    n = len(state)
    F, Q = np.tile(np.eye(6), (n, 1, 1)), np.zeros((n, 6, 6))
    F[:, 0, 2] = F[:, 1, 3] = dt_s
    for a in range(2):
        Q[:, a, a] = _Q_M2PS3 * dt_s**3 / 3.0
        Q[:, a, a + 2] = Q[:, a + 2, a] = _Q_M2PS3 * dt_s**2 / 2.0
        Q[:, a + 2, a + 2] = _Q_M2PS3 * dt_s
    P = F @ symmetric(covariance) @ np.swapaxes(F, 1, 2) + Q
    moved = (F @ state[:, :, None])[:, :, 0]
    return moved, P[:, _UPPER[0], _UPPER[1]].astype(np.float32)


class LatestFrames:
    """The last frame of each unit, as one picture: doubles removed, a dead unit's tracks carried on for a while.

    Args:
        bridge_s: how long a dead unit's tracks are shown: the lease and two cycles.
        clock: seconds that only grow.
    """

    def __init__(self, bridge_s: float = 6.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._bridge_s = bridge_s
        self._clock = clock
        self._last: dict[str, tuple[float, TrackFrame]] = {}
        self._dead: set[str] = set()

    def update(self, frame: TrackFrame) -> None:
        """Take in a frame."""
        _, last = self._last.get(frame.unit_id, (0.0, None))
        if last is None or last.boot_id != frame.boot_id or frame.seq > last.seq:
            self._last[frame.unit_id] = self._clock(), frame

    def note_alive(self, unit_id: str, alive: bool) -> None:
        """Take note of a unit that came or went."""
        (self._dead.discard if alive else self._dead.add)(unit_id)

    def frames(self) -> list[TrackFrame]:
        """The present picture, one frame a unit, ordered by unit, without ended tracks."""
        now_s, found = self._clock(), []
        for unit in sorted(self._last):
            heard_s, frame = self._last[unit]
            if unit not in self._dead:
                found.append(some_of(frame, frame.status != ENDED))
            elif now_s - heard_s <= self._bridge_s:
                found.append(_carried_on(some_of(frame, frame.status != ENDED), now_s - heard_s))
        return without_doubles(found)


def _carried_on(frame: TrackFrame, dt_s: float) -> TrackFrame:
    n = len(frame.track_id)
    state, covariance = ahead(frame.state, frame.covariance, np.full(n, dt_s))
    status = np.full(n, COASTING, np.uint8)
    more = {"state": state, "covariance": covariance, "status": status, "t_ns": frame.t_ns + round(dt_s * 1e9)}
    return frame.model_copy(update=more)
