"""Static magnetic fields of a coil, and the response of a small target to them.

Every field here is H in A/m; B = mu0 H. The transmitter is a point dipole or a circular loop, in free space and
at frequencies low enough that neither retardation nor the ground matters. A target answers as a point dipole,

    m = M H_p,   B_s = mu0 / (4 pi) G(d) m,   G(d) = (3 d d^T / d^2 - I) / d^3,

with M its magnetic polarizability tensor (m^3) and d the vector from target to receiver.
Sources: J. D. Jackson, Classical Electrodynamics, section 5.5; W. R. Smythe, Static and Dynamic Electricity, 7.10
for the loop, whose elliptic integrals are evaluated by the arithmetic-geometric mean in a form that keeps its
digits on the axis.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from trackmesh.services.emi.kernels import FloatArray, inlined, kernel
from trackmesh.services.emi.vectors import Symmetric, Vector, add, dot, dyad, minus, scaled, times, vector

MU0 = 4e-7 * pi
"""Magnetic constant, H/m (the value before 2019; today's differs by 1.3e-10)."""


@kernel
def loop_integrals(kc2: float) -> tuple[float, float]:
    """K(m) and s with E(m) = K (1 - m/2 - m^2 s), for ``kc2`` = 1 - m in (0, 1].

    Arithmetic-geometric mean (Abramowitz and Stegun 17.6). s stays of order one as m -> 0, so that the differences
    of K and E in the field of a loop can be taken before they are computed.
    """
    m = 1.0 - kc2
    a = 0.5 * (1.0 + sqrt(kc2))
    b = sqrt(sqrt(kc2))
    e = 0.25 / a  # c_n / m, with c_n the half difference of the means
    s, weight = e * e, 1.0
    while weight * e * e > 1e-18 * s or weight == 1.0:
        a, b = 0.5 * (a + b), sqrt(a * b)
        e = m * e * e / (4.0 * a)
        weight *= 2.0
        s += weight * e * e
    return 0.5 * pi / a, s


@kernel
def loop_terms(rho2: float, z: float, radius: float) -> tuple[float, float, float, float]:
    """Field of a horizontal loop of unit current at (rho, z): g = H_rho / rho, f = H_z, dg/dz, df/dz."""
    rho = sqrt(rho2)
    beta2 = (radius + rho) ** 2 + z * z
    alpha2 = (radius - rho) ** 2 + z * z
    kc2, m = alpha2 / beta2, 4.0 * radius * rho / beta2
    K, s = loop_integrals(kc2)
    E = K * (1.0 - 0.5 * m - m * m * s)
    c = 0.5 / (pi * sqrt(beta2))
    p = radius * radius - rho2 - z * z
    f = c * (K + p / alpha2 * E)
    w = 0.25 - (1.0 - 0.5 * m) * s
    q = 16.0 * radius * radius * c / (beta2 * alpha2)
    g = q * z * K * w
    # Derivatives by m of K, E and s, times dm/dz = m_z; that of s carries a factor m, taken out of 1/m.
    m_z = -2.0 * m * z / beta2
    K_z = K * (0.5 - m * s) / (2.0 * kc2) * m_z
    E_z = -0.5 * K * (0.5 + m * s) * m_z
    s_z = -0.5 * z / beta2 * (0.5 - 8.0 * s + 6.0 * m * s + 2.0 * m * m * s * s) / kc2
    w_z = 0.5 * s * m_z - (1.0 - 0.5 * m) * s_z
    f_z = -z / beta2 * f + c * (K_z + p / alpha2 * E_z - 2.0 * z / alpha2 * (1.0 + p / alpha2) * E)
    g_z = q * K * w * (1.0 - 3.0 * z * z / beta2 - 2.0 * z * z / alpha2) + q * z * (K_z * w + K * w_z)
    return g, f, g_z, f_z


@inlined
def green(d: Vector) -> Symmetric:
    """G(d) = (3 d d^T / d^2 - I) / d^3, in m^-3."""
    d2 = dot(d, d)
    inverse_cube = 1.0 / (d2 * sqrt(d2))
    return dyad(d, d, 1.5 * inverse_cube / d2, -inverse_cube)


@inlined
def green_gradient(d: Vector, m: Vector) -> Symmetric:
    """Gradient of G(d) m by d: 3/d^5 [(d.m) (I - 5 d d^T / d^2) + d m^T + m d^T], which has no trace."""
    d2, dm = dot(d, d), dot(d, m)
    factor = 3.0 / (d2 * d2 * sqrt(d2))
    return add(dyad(d, d, -2.5 * factor * dm / d2, factor * dm), dyad(d, m, factor, 0.0))


@kernel
def loop_primary(d: Vector, axis: Vector, radius: float) -> tuple[Vector, Symmetric]:
    """Field and gradient of a loop with unit moment, ``d`` from its centre."""
    z = dot(d, axis)
    rho = minus(d, scaled(axis, z))
    rho2 = dot(rho, rho)
    g, f, g_z, f_z = loop_terms(rho2, z, radius)
    # div H = 0 gives the radial derivative from the axial one, curl H = 0 makes the gradient symmetric.
    radial = (-2.0 * g - f_z) / rho2 if rho2 > 0.0 else 0.0
    c = 1.0 / (pi * radius * radius)
    h = (c * (g * rho[0] + f * axis[0]), c * (g * rho[1] + f * axis[1]), c * (g * rho[2] + f * axis[2]))
    gradient = add(dyad(axis, axis, 0.5 * c * (f_z - g), c * g), dyad(rho, rho, 0.5 * c * radial, 0.0))
    return h, add(gradient, dyad(rho, axis, c * g_z, 0.0))


@inlined
def dipole_primary(d: Vector, axis: Vector) -> tuple[Vector, Symmetric]:
    """Field and gradient of a point dipole with unit moment, ``d`` from it."""
    c = 0.25 / pi
    moment = scaled(axis, c)
    return times(green(d), moment), green_gradient(d, moment)


@inlined
def primary(d: Vector, axis: Vector, radius: float) -> tuple[Vector, Symmetric]:
    """Field and gradient of a transmitter with unit moment: a loop, or a dipole where ``radius`` is 0."""
    if radius > 0.0:
        return loop_primary(d, axis, radius)
    return dipole_primary(d, axis)


@kernel
def _primary_many(d: FloatArray, axis: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    h, gradient = np.empty((len(d), 3)), np.empty((len(d), 6))
    for i in range(len(d)):
        h_i, g_i = primary(vector(d, i), vector(axis, i), radius)
        for j in range(3):
            h[i, j] = h_i[j]
        for j in range(6):
            gradient[i, j] = g_i[j]
    return h, gradient


@kernel
def _secondary_many(d: FloatArray, moment: FloatArray) -> FloatArray:
    out = np.empty((len(d), 3))
    for i in range(len(d)):
        b = times(green(vector(d, i)), vector(moment, i))
        out[i, 0], out[i, 1], out[i, 2] = b
    return out


@kernel
def _green_many(d: FloatArray) -> FloatArray:
    out = np.empty((len(d), 6))
    for i in range(len(d)):
        g = green(vector(d, i))
        for j in range(6):
            out[i, j] = g[j]
    return out


def primary_field(
    offset_m: FloatArray, axis: FloatArray, moment_am2: float, radius_m: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Primary field of a coil.

    Args:
        offset_m: (n, 3) from the coil's centre to where the field is wanted.
        axis: (3,) or (n, 3) direction of the moment; need not be a unit vector.
        moment_am2: turns times current times area.
        radius_m: of a circular loop; 0 for a point dipole.

    Returns:
        H (n, 3) in A/m, and its gradient (n, 3, 3) by ``offset_m`` in A/m^2.
    """
    offset_m = np.ascontiguousarray(offset_m, np.float64)
    axes = np.array(np.broadcast_to(axis, offset_m.shape), np.float64, order="C")
    axes /= np.sqrt((axes * axes).sum(-1, keepdims=True))
    h, gradient = _primary_many(offset_m, axes, radius_m)
    return moment_am2 * h, moment_am2 * from_elements(gradient)


def secondary_field(offset_m: FloatArray, moment_am2: FloatArray) -> FloatArray:
    """Field B (n, 3) in T of point dipoles.

    Args:
        offset_m: (n, 3) from the dipole to the receiver.
        moment_am2: (3,) or (n, 3), m = M H_p.
    """
    offset_m = np.ascontiguousarray(offset_m, np.float64)
    moments = np.ascontiguousarray(np.broadcast_to(moment_am2, offset_m.shape), np.float64)
    return MU0 / (4.0 * pi) * _secondary_many(offset_m, moments)


def green_tensor(offset_m: FloatArray) -> FloatArray:
    """G(d) for ``offset_m`` (n, 3): (n, 3, 3) in m^-3."""
    return from_elements(_green_many(np.ascontiguousarray(offset_m, np.float64)))


def to_elements(matrix: FloatArray) -> FloatArray:
    """The elements xx, yy, zz, xy, xz, yz (..., 6) of symmetric matrices (..., 3, 3)."""
    return np.stack([matrix[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], -1)


def from_elements(elements: FloatArray) -> FloatArray:
    """Symmetric matrices (..., 3, 3) from their elements (..., 6)."""
    return np.asarray(elements[..., np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])])
