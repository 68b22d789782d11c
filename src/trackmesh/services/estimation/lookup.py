"""Finding values in unsorted arrays without a loop."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]


def index_of(values: IntArray, wanted: IntArray) -> IntArray:
    """Index in ``values`` (n,), each at most once in it, of every ``wanted`` (m,), or -1 where there is none."""
    if not len(values):
        return np.full(len(wanted), -1, np.int64)
    order = np.argsort(values, kind="stable")
    place = np.minimum(np.searchsorted(values, wanted, sorter=order), len(values) - 1)
    found = order[place]
    return np.where(values[found] == wanted, found, -1)
