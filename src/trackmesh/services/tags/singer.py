"""Singer's manoeuvring target along one axis: position, velocity, and an acceleration that decays at the rate alpha.

Singer (1970); the elements are those of the irregularly sampled form (8-14) to (8-17) of "RFID tracking" with its
misprints mended. With u = alpha dt and psi_i(s) what a unit impulse of the acceleration's noise has made of position,
velocity and acceleration after s seconds::

    A = [[1, dt, (u - 1 + e^-u) / alpha^2], [0, 1, (1 - e^-u) / alpha], [0, 0, e^-u]]
    Q = 2 alpha sigma^2 q,  q_ij = integral over [0, dt] of psi_i psi_j

The closed forms of q are small differences of large numbers: q_11 has no right digit left at u = 1e-3. Ranges come at
irregular times, so u is often as small; below ``SERIES_BELOW`` the product of the two power series is summed instead.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]

SERIES_BELOW = 0.4
TERMS = 14


def _coefficients() -> FloatArray:
    """The c (6, TERMS) with q_ij = dt^(5-i-j) sum_m c_m u^m for ij = 00, 01, 02, 11, 12, 22.

    psi_i(s) = sum over k >= 2-i of (-alpha)^(k-2+i) s^k / k!, so that
    c_m = (-1)^m sum over k + l = m + 4 - i - j of 1 / (k! l! (k + l + 1)).
    """
    c = np.zeros((6, TERMS))
    for row, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        for m, a in product(range(TERMS), range(TERMS)):
            if a <= m:
                k, other = a + 2 - i, m - a + 2 - j
                c[row, m] += (-1.0) ** m / (math.factorial(k) * math.factorial(other) * (k + other + 1))
    return c


_C = _coefficients()
_RISE = np.array([(-1.0) ** k / math.factorial(k + 2) for k in range(TERMS)])
"""(u - 1 + e^-u) / u^2 as a power series."""


@kernel
def transition(alpha: float, dt_s: float, out: FloatArray) -> None:
    """Write what an acceleration makes of position, velocity and itself after ``dt_s``: A_13, A_23, A_33 (3,).

    Args:
        alpha: 1/s, positive. dt_s: seconds, >= 0.
    """
    u = alpha * dt_s
    out[1] = -math.expm1(-u) / alpha
    out[2] = math.exp(-u)
    if u < SERIES_BELOW:
        rise = 0.0
        for k in range(TERMS - 1, -1, -1):
            rise = rise * u + _RISE[k]
        out[0] = dt_s * dt_s * rise
    else:
        out[0] = (u + math.expm1(-u)) / (alpha * alpha)


@kernel
def noise(alpha: float, variance: float, dt_s: float, out: FloatArray) -> None:
    """Write the process noise over ``dt_s`` as [pp, pv, pa, vv, va, aa] (6,).

    Args:
        alpha: 1/s, positive.
        variance: of the acceleration itself, sigma^2 in (m/s^2)^2; not that of the white noise that drives it.
        dt_s: seconds, >= 0.
    """
    u = alpha * dt_s
    scale = 2.0 * alpha * variance
    if u < SERIES_BELOW:
        powers = (dt_s**5, dt_s**4, dt_s**3, dt_s**3, dt_s * dt_s, dt_s)
        for row in range(6):
            total = 0.0
            for m in range(TERMS - 1, -1, -1):
                total = total * u + _C[row, m]
            out[row] = scale * powers[row] * total
        return
    e, ee = math.exp(-u), math.exp(-2.0 * u)
    a = 0.5 * scale / alpha
    out[0] = a / alpha**4 * (1.0 - ee + 2.0 * u + 2.0 * u**3 / 3.0 - 2.0 * u * u - 4.0 * u * e)
    out[1] = a / alpha**3 * (ee + 1.0 - 2.0 * e + 2.0 * u * e - 2.0 * u + u * u)
    out[2] = a / alpha**2 * (1.0 - ee - 2.0 * u * e)
    out[3] = a / alpha**2 * (4.0 * e - 3.0 - ee + 2.0 * u)
    out[4] = a / alpha * (ee + 1.0 - 2.0 * e)
    out[5] = a * (1.0 - ee)
