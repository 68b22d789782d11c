"""Questions about a picture that a one-to-one pairing would hide: what is nearest to what."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from trackmesh.protocol.arrays import FloatArray, IntArray


def nearest_target(targets_m: FloatArray, tracks_m: FloatArray, gate_m: float) -> tuple[IntArray, FloatArray]:
    """The target (m,) nearest to each track and its distance (m,) in metres; -1 and infinity beyond the gate.

    Several tracks may have the same target: one of them is what is meant, the others are one too many.
    """
    if not len(targets_m) or not len(tracks_m):
        return np.full(len(tracks_m), -1, np.int64), np.full(len(tracks_m), np.inf)
    distance, target = KDTree(targets_m).query(tracks_m, distance_upper_bound=gate_m)
    return np.where(np.isfinite(distance), target, -1).astype(np.int64), distance


def nearest_distance(targets_m: FloatArray, tracks_m: FloatArray) -> FloatArray:
    """The distance (n,) from each target to its nearest track, infinite where there is no track."""
    return np.asarray(_distances(targets_m, tracks_m).min(axis=1, initial=np.inf), np.float64)


def tracked_once(targets_m: FloatArray, tracks_m: FloatArray, gate_m: float) -> npt.NDArray[np.bool_]:
    """Which targets (n,) have exactly one track within ``gate_m``, each track counting for its nearest target."""
    distance = _distances(targets_m, tracks_m)
    if not distance.size:
        return np.zeros(len(targets_m), np.bool_)
    nearest = distance.argmin(axis=0)
    near = distance[nearest, np.arange(len(tracks_m))] < gate_m
    return np.asarray(np.bincount(nearest[near], minlength=len(targets_m)) == 1)


def _distances(targets_m: FloatArray, tracks_m: FloatArray) -> FloatArray:
    difference = targets_m.reshape(-1, 1, 2) - tracks_m.reshape(1, -1, 2)
    return np.asarray(np.linalg.norm(difference, axis=2), np.float64)
