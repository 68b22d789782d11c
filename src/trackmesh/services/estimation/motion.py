"""Motion models: how one state and its covariance move over dt."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]


@kernel
def predict_constant_velocity(x: FloatArray, P: FloatArray, dt_s: float, q: float) -> None:
    """Predict a constant-velocity state in place.

    x' = F x, P' = F P F^T + Q with F = [[I, dt I], [0, I]] and the continuous white-noise acceleration
    Q = q [[dt^3/3 I, dt^2/2 I], [dt^2/2 I, dt I]] (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2).

    Args:
        x: (4,) state [east_m, north_m, veast, vnorth].
        P: (4, 4) covariance, symmetric.
        dt_s: seconds, >= 0; with 0 nothing changes.
        q: spectral density of the acceleration, m^2/s^3.
    """
    x[0] += dt_s * x[2]
    x[1] += dt_s * x[3]
    # Blocks: position-position, position-velocity, velocity-velocity; each line uses old values of those below it.
    for i in range(2):
        for j in range(i, 2):
            P[i, j] += dt_s * (P[i, j + 2] + P[j, i + 2]) + dt_s * dt_s * P[i + 2, j + 2]
        P[i, i] += q * dt_s**3 / 3.0
    P[1, 0] = P[0, 1]
    for i in range(2):
        for j in range(2):
            P[i, j + 2] += dt_s * P[i + 2, j + 2]
        P[i, i + 2] += q * dt_s * dt_s / 2.0
    for i in range(2):
        for j in range(2):
            P[j + 2, i] = P[i, j + 2]
        P[i + 2, i + 2] += q * dt_s
