from __future__ import annotations

import numpy as np
import pytest
from geoana.em.static import CircularLoopWholeSpace, MagneticDipoleWholeSpace
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ellipe, ellipk

from trackmesh.services.emi.fields import (
    MU0,
    from_elements,
    green_tensor,
    loop_integrals,
    primary_field,
    secondary_field,
    to_elements,
)
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation

RADIUS_M = 0.5
angles = st.floats(-3.1, 3.1)


def points(seed: int = 1, n: int = 500) -> FloatArray:
    """All around the coil, some on its axis and some next to it, none near the wire."""
    d = np.random.default_rng(seed).normal(size=(n, 3))
    d[:5, :2] = 0.0
    d[5:10, :2] *= 1e-4
    near_wire = (np.abs(np.hypot(d[:, 0], d[:, 1]) - RADIUS_M) < 0.05) & (np.abs(d[:, 2]) < 0.05)
    return np.asarray(d[~near_wire])


def relative(ours: FloatArray, theirs: FloatArray) -> float:
    return float((np.linalg.norm(ours - theirs, axis=-1) / np.linalg.norm(theirs, axis=-1)).max())


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.3, -0.5, 0.8), (1.0, 0.0, 0.0)])
def test_loop_agrees_with_geoana(axis: tuple[float, float, float]) -> None:
    d, unit = points(), np.array(axis) / np.linalg.norm(axis)
    oracle = CircularLoopWholeSpace(radius=RADIUS_M, current=20.0, orientation=unit, location=np.zeros(3))
    b = oracle.magnetic_flux_density(d)
    h, _ = primary_field(d, np.array(axis), 20.0 * np.pi * RADIUS_M**2, RADIUS_M)
    assert relative(oracle.mu * h, b) < 1e-12
    assert relative(MU0 * h, b) < 2e-10


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.3, -0.5, 0.8)])
def test_dipole_agrees_with_geoana(axis: tuple[float, float, float]) -> None:
    d, unit = points(), np.array(axis) / np.linalg.norm(axis)
    oracle = MagneticDipoleWholeSpace(moment=3.0, orientation=unit, location=np.zeros(3))
    h, _ = primary_field(d, np.array(axis), 3.0)
    assert relative(oracle.mu * h, oracle.magnetic_flux_density(d)) < 1e-12
    b = secondary_field(d, 3.0 * unit)
    assert relative(b, oracle.magnetic_flux_density(d)) < 2e-10


@pytest.mark.parametrize("m", [0.0, 1e-9, 0.01, 0.5, 0.99, 1.0 - 1e-9])
def test_elliptic_integrals_agree_with_scipy(m: float) -> None:
    K, s = loop_integrals(1.0 - m)
    m = 1.0 - (1.0 - m)
    assert pytest.approx(ellipk(m), rel=1e-13) == K
    assert K * (1.0 - m / 2.0 - m * m * s) == pytest.approx(ellipe(m), rel=1e-13)


@pytest.mark.parametrize("radius_m", [0.0, RADIUS_M])
def test_gradient_is_the_derivative_of_the_field(radius_m: float) -> None:
    d, axis, step = points(2), np.array([0.3, -0.5, 0.8]), 1e-3
    _, gradient = primary_field(d, axis, 1.0, radius_m)
    for j in range(3):
        e = step * np.eye(3)[j]
        h = {k: primary_field(d + k * e, axis, 1.0, radius_m)[0] for k in (-3, -2, -1, 1, 2, 3)}
        # Sixth-order central difference; its own error grows where the field bends within a step.
        difference = (45 * (h[1] - h[-1]) - 9 * (h[2] - h[-2]) + (h[3] - h[-3])) / (60 * step)
        far = np.linalg.norm(d, axis=1) > 0.3
        if radius_m:
            far &= np.hypot(np.linalg.norm(np.cross(d, axis), axis=1) - RADIUS_M, d @ axis) > 0.3
        assert relative(gradient[far][:, :, j], difference[far]) < 1e-8


def test_gradient_on_the_axis_of_a_loop_is_finite_and_continuous() -> None:
    d = np.array([[0.0, 0.0, 0.7], [1e-9, 0.0, 0.7]])
    _, gradient = primary_field(d, np.array([0.0, 0.0, 1.0]), 1.0, RADIUS_M)
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient[0], gradient[1], atol=1e-8)


def test_default_coil_has_the_known_field_at_one_metre() -> None:
    d, z, moment = np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 0.0, 1.0]), 20.0 * np.pi * 0.25
    assert 1e6 * MU0 * primary_field(d, z, moment)[0][0, 2] == pytest.approx(3.14, abs=0.01)
    assert 1e6 * MU0 * primary_field(d, z, moment, 0.5)[0][0, 2] == pytest.approx(2.25, abs=0.01)


def test_loop_far_away_is_a_dipole() -> None:
    d, z = 200.0 * points(3), np.array([0.0, 0.0, 1.0])
    d = d[np.linalg.norm(d, axis=1) > 50.0]
    assert relative(primary_field(d, z, 1.0, RADIUS_M)[0], primary_field(d, z, 1.0)[0]) < 5e-4


@given(angles, angles, angles)
def test_fields_turn_with_their_coil(psi: float, theta: float, phi: float) -> None:
    turn, d, z = rotation(psi, theta, phi), points(4, 20), np.array([0.0, 0.0, 1.0])
    h, gradient = primary_field(d, z, 1.0, RADIUS_M)
    h_turned, gradient_turned = primary_field(d @ turn.T, turn @ z, 1.0, RADIUS_M)
    np.testing.assert_allclose(h_turned, h @ turn.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(gradient_turned, turn @ gradient @ turn.T, rtol=1e-8, atol=1e-10)


def test_green_tensor_is_the_printed_kernel() -> None:
    d = points(5, 50)
    r = np.linalg.norm(d, axis=1)[:, None, None]
    expected = (3.0 * d[:, :, None] * d[:, None, :] / r**2 - np.eye(3)) / r**3
    np.testing.assert_allclose(green_tensor(d), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


def test_elements_and_matrices_are_inverse() -> None:
    elements = np.arange(12.0).reshape(2, 6)
    np.testing.assert_array_equal(to_elements(from_elements(elements)), elements)
