"""The equations of the slides as they are printed, to show what their misprints do.

Slides on RFID tracking, chapter 8: q23 of (8-17) has "-2 alpha th" where "-2 e^(-alpha th)" belongs; (8-19) averages
a_i a_{i-1} where it should average a_i^2, so that r(0) equals r(1) whatever happens; (8-21) takes alpha r(1) from r(0)
where beta r(1) belongs.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def printed_noise(alpha: float, variance: float, dt_s: float) -> FloatArray:
    """Q (3, 3) of one axis with the elements of (8-17) as printed."""
    u = alpha * dt_s
    e, ee = math.exp(-u), math.exp(-2.0 * u)
    q11 = (1 - ee + 2 * u + 2 * u**3 / 3 - 2 * u * u - 4 * u * e) / (2 * alpha**5)
    q12 = (ee + 1 - 2 * e + 2 * u * e - 2 * u + u * u) / (2 * alpha**4)
    q13 = (1 - ee - 2 * u * e) / (2 * alpha**3)
    q22 = (4 * e - 3 - ee + 2 * u) / (2 * alpha**3)
    q23 = (ee + 1 - 2 * u) / (2 * alpha**2)
    q33 = (1 - ee) / (2 * alpha)
    return 2.0 * alpha * variance * np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, q33]])


def printed_moments(a: FloatArray) -> tuple[float, float]:
    """r(0) and r(1) of estimates (n,) by (8-18) and (8-19) as printed."""
    r0 = r1 = 0.0
    for i in range(1, len(a)):
        r1 += (a[i] * a[i - 1] - r1) / i
        r0 += (a[i] * a[i - 1] - r0) / i
    return r0, r1


def printed_driving_variance(r0: float, r1: float, alpha: float) -> float:
    """The driving variance by (8-21) as printed."""
    return r0 - alpha * r1


def driving_variance(r0: float, r1: float) -> float:
    """The driving variance of a first-order process: r(0) - beta r(1) with beta = r(1) / r(0)."""
    return r0 - r1 * r1 / r0
