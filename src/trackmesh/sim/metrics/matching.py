"""OSPA and GOSPA of one moment, by the best one-to-one pairing of targets and tracks.

- OSPA: D. Schuhmacher, B.-T. Vo, B.-N. Vo, "A consistent metric for performance evaluation of multi-object
  filters", IEEE Trans. Signal Processing 56 (2008).
- GOSPA: A. S. Rahmathullah, A. F. Garcia-Fernandez, L. Svensson, "Generalized optimal sub-pattern assignment
  metric", FUSION 2017, with alpha = 2, where the distance falls apart into localisation, missed and false.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
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


def match(targets_m: FloatArray, tracks_m: FloatArray, c_m: float = 1000.0, p: float = 2.0) -> Match:
    """The one-to-one pairing that is best for GOSPA (alpha = 2) and OSPA alike.

    Both are least where the gain sum (c^p - d^p) over the pairs nearer than c is largest; so sets fall apart into
    groups that are linked by such pairs, each solved by itself.
    """
    i, j, distance = _near_pairs(targets_m, tracks_m, c_m)
    n, m = len(targets_m), len(tracks_m)
    gain = c_m**p - distance**p
    alone = (np.bincount(i, minlength=n)[i] == 1) & (np.bincount(j, minlength=m)[j] == 1)
    rest = np.flatnonzero(~alone)
    chosen = [edges[_best(i[edges], j[edges], gain[edges])] for edges in _groups(rest, i, n + j, n + m)]
    kept = np.concatenate([np.flatnonzero(alone), *chosen])
    kept = kept[np.argsort(i[kept])]
    return Match(i[kept], j[kept], distance[kept], n, m, c_m, p)


def gospa(targets_m: FloatArray, tracks_m: FloatArray, c_m: float = 1000.0, p: float = 2.0) -> Gospa:
    """GOSPA with alpha = 2: the least (sum d^p + (missed + false) c^p / 2)^(1/p) over all pairings."""
    return match(targets_m, tracks_m, c_m, p).gospa()


def ospa(targets_m: FloatArray, tracks_m: FloatArray, c_m: float = 1000.0, p: float = 2.0) -> float:
    """OSPA: the least ((sum min(d, c)^p + |n - m| c^p) / max(n, m))^(1/p) over all pairings, in metres."""
    return match(targets_m, tracks_m, c_m, p).ospa()


def _near_pairs(targets_m: FloatArray, tracks_m: FloatArray, c_m: float) -> tuple[IntArray, IntArray, FloatArray]:
    if not len(targets_m) or not len(tracks_m):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    found = KDTree(targets_m).sparse_distance_matrix(KDTree(tracks_m), c_m, output_type="ndarray")
    i, j = found["i"].astype(np.int64), found["j"].astype(np.int64)
    distance = np.linalg.norm(targets_m[i] - tracks_m[j], axis=1)
    near = distance < c_m
    return i[near], j[near], distance[near]


def _groups(edges: IntArray, one: IntArray, other: IntArray, nodes: int) -> list[IntArray]:
    """The edges of each set of nodes that are linked; edge e joins ``one[e]`` and ``other[e]``."""
    if not len(edges):
        return []
    links = coo_array((np.ones(len(edges)), (one[edges], other[edges])), shape=(nodes, nodes))
    _, group = connected_components(links, directed=False)
    edges = edges[np.argsort(group[one[edges]], kind="stable")]
    starts = np.flatnonzero(np.diff(group[one[edges]])) + 1
    return np.split(edges, starts)


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
