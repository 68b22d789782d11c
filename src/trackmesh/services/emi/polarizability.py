"""Polarizability of simple bodies: m = M H with M in m^3, complex for e^{+j omega t}.

The sphere is exact; the cylinder is the empirical form that is in use for unexploded ordnance (and was tuned for
a length of eight radii).
"""

from __future__ import annotations

from cmath import exp, sqrt
from math import cos, pi, sin

import numpy as np
import numpy.typing as npt

from trackmesh.services.emi.fields import MU0
from trackmesh.services.emi.kernels import FloatArray

ComplexArray = npt.NDArray[np.complex128]

DECAYED = 40.0
"""Exponent beyond which nothing is left of a term."""
MOST_TERMS = 20_000
TAU_LONG = 31.0
"""A cylinder's axial time constant by its transverse one (the thesis prints 3 L, which has a unit)."""


def sphere(radius_m: float, omega_rad_s: float, conductivity_s_m: float, mu_r: float = 1.0) -> complex:
    """Polarizability (m^3) of a conducting permeable sphere in a uniform field.

    M = 2 pi a^3 (2 mu_r - q) / (mu_r + q), q = x^2 / (x coth x - 1) - 1, x = a sqrt(j omega mu sigma), which is the
    vector potential matched at the surface (J. R. Wait, Geophysics 16, 1951). Limits: 4 pi a^3 (mu_r - 1) /
    (mu_r + 2) for a static field, -2 pi a^3 for a perfect conductor.
    """
    x2 = 1j * omega_rad_s * MU0 * mu_r * conductivity_s_m * radius_m**2
    q = _skin_term(x2)
    return 2.0 * pi * radius_m**3 * (2.0 * mu_r - q) / (mu_r + q)


def sphere_step_off(
    radius_m: float,
    times_s: FloatArray,
    conductivity_s_m: float,
    mu_r: float = 1.0,
    *,
    rate: bool = False,
) -> FloatArray:
    """Polarizability (m^3) of a sphere at times (n,) > 0 after a steady field was switched off; or -d/dt of it (m^3/s).

    M = 12 pi a^3 mu_r sum_k exp(-x_k^2 t / tau) / (x_k^2 + (mu_r - 1) (mu_r + 2)), tau = sigma mu a^2, with x_k > 0 the
    roots of tan x = (mu_r - 1) x / (mu_r - 1 + x^2) (J. R. Wait and K. P. Spies, Canadian J. Physics 47, 1969): the
    poles of ``sphere``, and so what time gates see of it.

    Raises:
        ValueError: a time is not positive.
    """
    times_s = np.asarray(times_s, np.float64)
    if not (times_s > 0.0).all():
        raise ValueError("Times must be after the field was switched off.")
    tau_s = conductivity_s_m * MU0 * mu_r * radius_m**2
    least = float(times_s.min()) / tau_s
    x2 = decay_roots(mu_r, min(MOST_TERMS, 2 + int(np.sqrt(DECAYED / least) / pi))) ** 2
    weight = 12.0 * pi * radius_m**3 * mu_r / (x2 + (mu_r - 1.0) * (mu_r + 2.0))
    return np.asarray(np.exp(-x2 * (times_s[:, None] / tau_s)) @ (weight * x2 / tau_s if rate else weight))


def decay_roots(mu_r: float, n: int) -> FloatArray:
    """The first roots (n,) x > 0 of tan x = (mu_r - 1) x / (mu_r - 1 + x^2), by bisection: one a half turn."""
    low = pi * np.arange(1, n + 1)
    high = low + 0.5 * pi
    for _ in range(60):
        middle = 0.5 * (low + high)
        excess = (middle**2 + mu_r - 1.0) * np.sin(middle) - (mu_r - 1.0) * middle * np.cos(middle)
        beyond = excess * np.cos(low) > 0.0
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return 0.5 * (low + high)


def cylinder(
    radius_m: float,
    length_m: float,
    omega_rad_s: float,
    conductivity_s_m: float,
    mu_r: float = 1.0,
    tau_long: float = TAU_LONG,
) -> tuple[complex, complex]:
    """Polarizability (m^3) of a conducting cylinder, transverse and axial.

    M = -3/2 beta with beta_t = V/2 (0.35 + f(tau)), beta_a = L V / (4 a) (f(tau_long tau) - 0.7),
    f(tau) = (sqrt(j omega tau) - 2) / (sqrt(j omega tau) + 1), tau = a^2 sigma mu / mu_r^2 (the form used by
    Liu Zhiyang, EMI detection by filter tracking, 2018, equations 5-3 and 5-4, with the unit of the axial time
    constant set right).
    """
    volume = pi * radius_m**2 * length_m
    tau_s = radius_m**2 * conductivity_s_m * MU0 / mu_r
    transverse = 0.5 * volume * (0.35 + _relaxation(omega_rad_s * tau_s))
    axial = length_m * volume / (4.0 * radius_m) * (_relaxation(omega_rad_s * tau_long * tau_s) - 0.7)
    return from_thesis_beta(transverse), from_thesis_beta(axial)


def from_thesis_beta(beta_m3: complex) -> complex:
    """M of the thesis's principal polarizability beta: M = -3/2 beta."""
    return -1.5 * beta_m3


def to_thesis_beta(polarizability_m3: complex) -> complex:
    """The thesis's principal polarizability: beta = -2/3 M."""
    return -polarizability_m3 / 1.5


def rotation(psi_rad: float, theta_rad: float, phi_rad: float) -> FloatArray:
    """Columns are the body's axes in the world, (3, 3), from yaw psi, pitch theta, roll phi.

    Equation 2-18 of the thesis with its entry (2, 2) corrected. The third column, the axis of a body of revolution,
    is (-sin theta, cos theta sin phi, cos theta cos phi).
    """
    cs, ss = cos(psi_rad), sin(psi_rad)
    ct, st = cos(theta_rad), sin(theta_rad)
    cp, sp = cos(phi_rad), sin(phi_rad)
    return np.array(
        [
            [cs * ct, ss * ct, -st],
            [-ss * cp + cs * st * sp, ss * st * sp + cs * cp, ct * sp],
            [ss * sp + cs * st * cp, -cs * sp + ss * st * cp, ct * cp],
        ]
    )


def world_tensor(principal_m3: npt.ArrayLike, body_axes: FloatArray) -> ComplexArray:
    """M = U diag(principal) U^T (3, 3) for body axes U (3, 3), one axis a column."""
    return np.asarray((body_axes * np.asarray(principal_m3, np.complex128)) @ body_axes.T)


def _skin_term(x2: complex) -> complex:
    if abs(x2) < 1e-3:
        return 1.0 / (1.0 / 3.0 - x2 / 45.0 + 2.0 * x2**2 / 945.0 - x2**3 / 4725.0) - 1.0
    x = sqrt(x2)
    coth = (1.0 + exp(-2.0 * x)) / (1.0 - exp(-2.0 * x))
    return x2 / (x * coth - 1.0) - 1.0


def _relaxation(omega_tau: float) -> complex:
    root = sqrt(1j * omega_tau)
    return (root - 2.0) / (root + 1.0)
