"""Vectors and symmetric matrices of three dimensions as tuples: what kernels compute with, in registers.

All of these are compiled into their callers; called, they would take longer than what they compute.
"""

from __future__ import annotations

from trackmesh.services.emi.kernels import FloatArray, inlined

Vector = tuple[float, float, float]
Symmetric = tuple[float, float, float, float, float, float]
"""Elements xx, yy, zz, xy, xz, yz of a symmetric matrix."""


@inlined
def vector(rows: FloatArray, i: int) -> Vector:
    """Row ``i`` of an array (n, 3), without a view of it: to count its references takes longer than to read it."""
    return (rows[i, 0], rows[i, 1], rows[i, 2])


@inlined
def inner_vector(rows: FloatArray, i: int, j: int) -> Vector:
    """Row ``i, j`` of an array (n, m, 3)."""
    return (rows[i, j, 0], rows[i, j, 1], rows[i, j, 2])


@inlined
def inner_symmetric(rows: FloatArray, i: int, j: int) -> Symmetric:
    """Row ``i, j`` of an array (n, m, 6)."""
    return (rows[i, j, 0], rows[i, j, 1], rows[i, j, 2], rows[i, j, 3], rows[i, j, 4], rows[i, j, 5])


@inlined
def minus(a: Vector, b: Vector) -> Vector:
    """Difference."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inlined
def scaled(v: Vector, factor: float) -> Vector:
    """``factor`` times ``v``."""
    return (factor * v[0], factor * v[1], factor * v[2])


@inlined
def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def times(s: Symmetric, v: Vector) -> Vector:
    """Symmetric matrix times vector."""
    return (
        s[0] * v[0] + s[3] * v[1] + s[4] * v[2],
        s[3] * v[0] + s[1] * v[1] + s[5] * v[2],
        s[4] * v[0] + s[5] * v[1] + s[2] * v[2],
    )


@inlined
def dyad(a: Vector, b: Vector, scale: float, trace: float) -> Symmetric:
    """Symmetric product: scale (a b^T + b a^T) + trace I."""
    return (
        2.0 * scale * a[0] * b[0] + trace,
        2.0 * scale * a[1] * b[1] + trace,
        2.0 * scale * a[2] * b[2] + trace,
        scale * (a[0] * b[1] + a[1] * b[0]),
        scale * (a[0] * b[2] + a[2] * b[0]),
        scale * (a[1] * b[2] + a[2] * b[1]),
    )


@inlined
def add(a: Symmetric, b: Symmetric) -> Symmetric:
    """Sum of symmetric matrices."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5])
