"""Which of our tracks and which of a neighbour's are one target: those that took the same plots.

No statistics: a plot has one key in the whole realm, and two equal keys among the last few suffice. It holds under any
bias, in formations and for late messages, as long as the units hear the same plots.
"""

from __future__ import annotations

import hashlib

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import assignment
from trackmesh.services.estimation.lookup import index_of

IntArray = npt.NDArray[np.int64]

NO_KEY = -1
KEPT, SENT, NEEDED = 8, 6, 2
"""Keys of a track that are kept, that are told to neighbours, and that must be equal."""

_INDEX_BITS, _SEQ_BITS, _SENSOR_BITS = 16, 24, 23


def sensor_bits(sensor_id: str, boot_id: str) -> int:
    """The part of a plot's key that tells the run of its sensor: 23 bits, the same in every unit."""
    digest = hashlib.blake2b(f"{sensor_id}/{boot_id}".encode(), digest_size=4).digest()
    return int.from_bytes(digest, "big") >> (32 - _SENSOR_BITS)


def plot_keys(sensor_id: str, boot_id: str, seq: int, n: int) -> IntArray:
    """Keys (n,) of the plots of a batch, positive: its sensor's run, its number modulo 2^24, the index in the batch."""
    high = (sensor_bits(sensor_id, boot_id) << _SEQ_BITS) | (seq & ((1 << _SEQ_BITS) - 1))
    return (high << _INDEX_BITS) | (np.arange(n, dtype=np.int64) & ((1 << _INDEX_BITS) - 1))


def pair(ours: IntArray, theirs: IntArray) -> tuple[IntArray, IntArray]:
    """Rows (k,) of our tracks and rows (k,) of theirs that share enough plots, one to one.

    Args:
        ours: (n, a) keys of each track, the youngest last, ``NO_KEY`` where there is none.
        theirs: (m, b) likewise.

    Among several the one with most keys in common counts; with equally many, that with the younger ones.
    """
    n, a = ours.shape
    m, b = theirs.shape
    flat = ours.ravel()
    known = np.flatnonzero(flat != NO_KEY)
    _, first = np.unique(flat[known], return_index=True)
    places = known[first]
    found = index_of(flat[places], theirs.ravel())
    hit = np.flatnonzero((found >= 0) & (theirs.ravel() != NO_KEY))
    i, j = places[found[hit]] // a, hit // b
    young = (places[found[hit]] % a + 1) / (a * (b + 1.0))
    couple, inverse = np.unique(i * m + j, return_inverse=True)
    count = np.bincount(inverse, minlength=len(couple))
    enough = count >= NEEDED
    if not enough.any():
        return np.empty(0, np.int64), np.empty(0, np.int64)
    score = (count + np.bincount(inverse, young, minlength=len(couple)) / b)[enough]
    rows, columns = couple[enough] // m, couple[enough] % m
    chosen = assignment.assign(rows, columns, score, n, m)
    columns = np.flatnonzero(chosen >= 0)
    return chosen[columns], columns
