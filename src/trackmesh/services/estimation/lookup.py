"""Finding values in unsorted arrays without a loop."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

IntArray = npt.NDArray[np.int64]


@kernel
def index_of(values: IntArray, wanted: IntArray) -> IntArray:
    """Index in ``values`` (n,), each at most once in it, of every ``wanted`` (m,), or -1 where there is none."""
    out = np.full(len(wanted), -1, np.int64)
    if len(values) == 0:
        return out
    order = np.argsort(values, kind="mergesort")
    ordered = values[order]
    for k in range(len(wanted)):
        place = np.searchsorted(ordered, wanted[k])
        if place < len(ordered) and ordered[place] == wanted[k]:
            out[k] = order[place]
    return out
