"""How far a set of tracks is from a set of targets, at one time and over a whole run.

Positions are (n, 2) metres in one plane. Targets come first, tracks second, in every argument list.

- OSPA: D. Schuhmacher, B.-T. Vo, B.-N. Vo, "A consistent metric for performance evaluation of multi-object
  filters", IEEE Trans. Signal Processing 56 (2008).
- GOSPA: A. S. Rahmathullah, A. F. Garcia-Fernandez, L. Svensson, "Generalized optimal sub-pattern assignment
  metric", FUSION 2017, with alpha = 2, where the distance falls apart into localisation, missed and false.
- NEES: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with applications to tracking and navigation", 2001.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from trackmesh.protocol.arrays import FloatArray, IntArray


class Gospa(NamedTuple):
    """GOSPA and its parts: total_m^p = localisation + (missed + false) c^p / 2.

    Attributes:
        total_m: the metric.
        localisation: sum of d^p over the assigned pairs (m^p).
        missed: number of targets without a track.
        false: number of tracks without a target.
    """

    total_m: float
    localisation: float
    missed: int
    false: int


class Match(NamedTuple):
    """The best one-to-one pairs (k,) of ``n_targets`` and ``n_tracks`` that are nearer than ``c_m``.

    Attributes:
        target, track: (k,) rows.
        distance_m: (k,).
        n_targets, n_tracks, c_m, p: what was matched, and how.
    """

    target: IntArray
    track: IntArray
    distance_m: FloatArray
    n_targets: int
    n_tracks: int
    c_m: float
    p: float

    def gospa(self) -> Gospa:
        """GOSPA with alpha = 2 of the two sets."""
        localisation, k = float((self.distance_m**self.p).sum()), len(self.target)
        missed, false = self.n_targets - k, self.n_tracks - k
        total = (localisation + (missed + false) * self.c_m**self.p / 2) ** (1 / self.p)
        return Gospa(total, localisation, missed, false)

    def ospa(self) -> float:
        """OSPA of the two sets, in metres; 0 where both are empty, c where one is."""
        largest = max(self.n_targets, self.n_tracks)
        if largest == 0:
            return 0.0
        apart = largest - len(self.target)
        total = float((self.distance_m**self.p).sum()) + apart * self.c_m**self.p
        return float((total / largest) ** (1 / self.p))


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


def match(targets_m: FloatArray, tracks_m: FloatArray, c_m: float = 1000.0, p: float = 2.0) -> Match:
    """The one-to-one pairing that is best for GOSPA (alpha = 2) and OSPA alike.

    Both are least where the gain sum (c^p - d^p) over the pairs nearer than c is largest; so sets fall apart into
    groups that are linked by such pairs, each solved by itself.
    """
    i, j, distance = _near_pairs(targets_m, tracks_m, c_m)
    n, m = len(targets_m), len(tracks_m)
    gain = c_m**p - distance**p
    links = coo_array((np.ones(len(i)), (i, n + j)), shape=(n + m, n + m))
    _, group = connected_components(links, directed=False)
    alone = np.bincount(group[i], minlength=n + m)[group[i]] == 1
    chosen = [np.flatnonzero(alone)]
    rest = np.flatnonzero(~alone)
    rest = rest[np.argsort(group[i[rest]], kind="stable")]
    starts = np.flatnonzero(np.diff(group[i[rest]])) + 1
    chosen += [edges[_best(i[edges], j[edges], gain[edges])] for edges in np.split(rest, starts) if len(edges)]
    kept = np.concatenate(chosen)
    kept = kept[np.argsort(i[kept])]
    return Match(i[kept], j[kept], distance[kept], n, m, c_m, p)


def gospa(targets_m: FloatArray, tracks_m: FloatArray, c_m: float = 1000.0, p: float = 2.0) -> Gospa:
    """GOSPA with alpha = 2: the least (sum d^p + (missed + false) c^p / 2)^(1/p) over all pairings."""
    return match(targets_m, tracks_m, c_m, p).gospa()


def ospa(targets_m: FloatArray, tracks_m: FloatArray, c_m: float = 1000.0, p: float = 2.0) -> float:
    """OSPA: the least ((sum min(d, c)^p + |n - m| c^p) / max(n, m))^(1/p) over all pairings, in metres."""
    return match(targets_m, tracks_m, c_m, p).ospa()


def nees(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Normalised estimation error squared e^T P^-1 e (k,) of errors (k, d) with covariances (k, d, d).

    A consistent filter has mean d. A covariance that is singular gives infinity.
    """
    values, vectors = np.linalg.eigh(covariances)
    along = np.einsum("kji,kj->ki", vectors, errors)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(along == 0.0, 0.0, along**2 / np.maximum(values, 0.0))
    return np.asarray(terms.sum(axis=1), np.float64)


def rmse(distance_m: FloatArray) -> float:
    """Root of the mean square; NaN for none."""
    return float(np.sqrt(np.mean(np.square(distance_m)))) if len(distance_m) else float("nan")


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


def _majority_share(who: IntArray, whom: IntArray) -> float:
    if not len(who):
        return float("nan")
    couples, often = np.unique(np.stack([who, whom], axis=1), axis=0, return_counts=True)
    first = np.flatnonzero(np.diff(couples[:, 0], prepend=couples[0, 0] - 1))
    return float(np.maximum.reduceat(often, first).sum() / len(who))


def _near_pairs(targets_m: FloatArray, tracks_m: FloatArray, c_m: float) -> tuple[IntArray, IntArray, FloatArray]:
    if not len(targets_m) or not len(tracks_m):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    found = KDTree(targets_m).sparse_distance_matrix(KDTree(tracks_m), c_m, output_type="coo_matrix")
    i, j = found.row.astype(np.int64), found.col.astype(np.int64)
    distance = np.linalg.norm(targets_m[i] - tracks_m[j], axis=1)
    near = distance < c_m
    return i[near], j[near], distance[near]


def _best(i: IntArray, j: IntArray, gain: FloatArray) -> IntArray:
    """Which edges of one group are chosen."""
    rows, row = np.unique(i, return_inverse=True)
    columns, column = np.unique(j, return_inverse=True)
    edge = np.full((len(rows), len(columns)), -1)
    edge[row, column] = np.arange(len(i))
    gains = np.zeros(edge.shape)
    gains[row, column] = gain
    picked = edge[linear_sum_assignment(gains, maximize=True)]
    return np.asarray(picked[picked >= 0], np.int64)


def _distances(targets_m: FloatArray, tracks_m: FloatArray) -> FloatArray:
    difference = targets_m.reshape(-1, 1, 2) - tracks_m.reshape(1, -1, 2)
    return np.asarray(np.linalg.norm(difference, axis=2), np.float64)
