"""What to do with a state that is none: not finite, or with a covariance that is not positive semi-definite."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.bank import State, Work
from trackmesh.services.estimation.jit import inlined, kernel
from trackmesh.services.estimation.plots import Plot

FloatArray = npt.NDArray[np.float64]

SLACK = 1e-9
"""How far below nought a pivot may be, in variances."""

_LEAST_PIVOT = 1e-12
_REPAIRED_SPREAD = 100.0


@kernel
def is_state(x: FloatArray, P: FloatArray, d: int, w: Work) -> bool:
    """Whether all is finite, no variance negative and, to ``SLACK`` variances, no pivot of P = L D L^T either."""
    # Constants for the compiler.
    if d == 4:
        return _is_state(x, P, 4, w.product, w.block)
    if d == 5:
        return _is_state(x, P, 5, w.product, w.block)
    return _is_state(x, P, 6, w.product, w.block)


@inlined
def _is_state(x: FloatArray, P: FloatArray, d: int, U: FloatArray, inverse: FloatArray) -> bool:
    for a in range(d):
        if not (np.isfinite(x[a]) and 0.0 <= P[a, a] < np.inf):
            return False
        for b in range(a + 1):
            value = P[a, b]
            for c in range(b):
                value -= U[a, c] * U[b, c] * inverse[c]
            U[a, b] = value
        if not U[a, a] >= -SLACK * P[a, a]:
            return False
        # A pivot of nought is that of a variable known exactly, whose covariances must be nought as well.
        inverse[a] = 1.0 / max(U[a, a], _LEAST_PIVOT * P[a, a] + 1e-300)
    return True


@kernel
def repair(s: State, j: int, d: int, plot: Plot) -> None:
    """Put something in the place of what is no state: its variances alone, or the plot where it is not even finite."""
    for a in range(d):
        variance = abs(s.P[j, a, a])
        if not (np.isfinite(s.x[j, a]) and np.isfinite(variance)):
            s.x[j, a] = plot.z[a] if a < 2 else 0.0
            variance = plot.R[2 * a] if a < 2 else _REPAIRED_SPREAD * _REPAIRED_SPREAD
        for b in range(d):
            s.P[j, a, b] = s.P[j, b, a] = 0.0
        s.P[j, a, a] = variance
