"""Estimates that others made, moved to another time: nothing is known of their models, so the target flies on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.motion import predict_constant_velocity

FloatArray = npt.NDArray[np.float64]


@kernel
def extrapolate(x: FloatArray, P: FloatArray, t_s: FloatArray, to_s: float, q: float) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) of times (n,) at one time, by constant velocity.

    The noise is that of a white acceleration of density ``q`` (m^2/s^3), backwards in time as well: there it makes
    position and velocity err against each other.
    """
    x, P = x.copy(), P.copy()
    for k in range(len(x)):
        dt_s = to_s - t_s[k]
        predict_constant_velocity(x[k], P[k], dt_s, 0.0)
        long = abs(dt_s)
        for i in range(2):
            P[k, i, i] += q * long**3 / 3.0
            P[k, i, i + 2] += q * dt_s * long / 2.0
            P[k, i + 2, i] = P[k, i, i + 2]
            P[k, i + 2, i + 2] += q * long
    return x, P
