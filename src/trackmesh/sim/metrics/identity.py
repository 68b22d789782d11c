"""Who follows whom: identities over a whole run."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray, IntArray


class Pairs(NamedTuple):
    """Matched pairs (k,) of a whole run, frame by frame.

    Attributes:
        frame: (k,) which frame.
        target_id, track_id: (k,) who was matched with whom.
        distance_m: (k,) how far apart.
    """

    frame: IntArray
    target_id: IntArray
    track_id: IntArray
    distance_m: FloatArray


def identity_switches(pairs: Pairs, counted: npt.NDArray[np.bool_] | None = None) -> int:
    """How often a target is matched with another track than at its last match.

    ``counted`` (frames,) says in which frames a switch counts; the others only tell who was last.
    """
    order = np.lexsort((pairs.frame, pairs.target_id))
    target, track = pairs.target_id[order], pairs.track_id[order]
    switched = (target[1:] == target[:-1]) & (track[1:] != track[:-1])
    if counted is not None:
        switched &= counted[pairs.frame[order][1:]]
    return int(switched.sum())


def lasting(pairs: Pairs, frames: int) -> Pairs:
    """The pairs that lasted: those in a row of at least ``frames`` matches of one target with one track.

    While two targets cross, the best pairing may flip for a moment though both tracks are right; what is left shows the
    changes that stay.
    """
    order = np.lexsort((pairs.frame, pairs.target_id))
    target, track = pairs.target_id[order], pairs.track_id[order]
    begins = np.ones(len(order), np.bool_)
    begins[1:] = (target[1:] != target[:-1]) | (track[1:] != track[:-1])
    row = np.cumsum(begins) - 1
    kept = order[np.bincount(row)[row] >= frames] if len(order) else order
    return Pairs(pairs.frame[kept], pairs.target_id[kept], pairs.track_id[kept], pairs.distance_m[kept])


def purity(pairs: Pairs) -> float:
    """The share of matches in which a track follows the target it follows most often; NaN for no match."""
    return _majority_share(pairs.track_id, pairs.target_id)


def continuity(pairs: Pairs) -> float:
    """The share of matches in which a target is followed by the track that follows it most often; NaN for none."""
    return _majority_share(pairs.target_id, pairs.track_id)


def _majority_share(who: IntArray, whom: IntArray) -> float:
    if not len(who):
        return float("nan")
    couples, often = np.unique(np.stack([who, whom], axis=1), axis=0, return_counts=True)
    first = np.flatnonzero(np.diff(couples[:, 0], prepend=couples[0, 0] - 1))
    return float(np.maximum.reduceat(often, first).sum() / len(who))
