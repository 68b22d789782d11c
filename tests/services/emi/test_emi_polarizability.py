from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ive

from trackmesh.services.emi.fields import MU0
from trackmesh.services.emi.polarizability import (
    cylinder,
    from_thesis_beta,
    rotation,
    sphere,
    to_thesis_beta,
    world_tensor,
)

COPPER = 5.17e7
A = 0.2
VOLUME = 4.0 / 3.0 * np.pi * A**3
angles = st.floats(-3.1, 3.1)


def sphere_by_bessel(radius_m: float, omega: float, sigma: float, mu_r: float) -> complex:
    """The same boundary problem with modified Bessel functions of half order."""
    x = radius_m * np.sqrt(1j * omega * MU0 * mu_r * sigma)
    ratio = ive(0.5, x) / ive(1.5, x)
    q = x * ratio - 1.0
    return complex(2.0 * np.pi * radius_m**3 * (2.0 * mu_r - q) / (mu_r + q))


@pytest.mark.parametrize("mu_r", [1.0, 5.0, 100.0])
@pytest.mark.parametrize("omega", [0.01, 0.5, 1.0, 30.0, 1e3, 1e6])
def test_sphere_agrees_with_bessel_functions(omega: float, mu_r: float) -> None:
    ours, theirs = sphere(A, omega, COPPER, mu_r), sphere_by_bessel(A, omega, COPPER, mu_r)
    assert abs(ours - theirs) < 1e-9 * 4.0 * np.pi * A**3


def test_sphere_has_its_static_and_perfect_limits() -> None:
    assert sphere(A, 1e-9, COPPER, 100.0).real == pytest.approx(4 * np.pi * A**3 * 99 / 102, rel=1e-6)
    assert abs(sphere(A, 1e-9, COPPER)) < 1e-9
    assert sphere(A, 1e18, COPPER).real == pytest.approx(-2 * np.pi * A**3, rel=1e-6)


def test_default_bodies_have_their_known_values() -> None:
    assert to_thesis_beta(sphere(A, 1e3, COPPER)) / VOLUME == pytest.approx(0.9584 + 0.0405j, abs=1e-4)
    volume = np.pi * A**2 * 0.8
    across, along = (to_thesis_beta(m) / volume for m in cylinder(A, 0.8, 1e3, COPPER))
    assert across.real == pytest.approx(0.654, abs=1e-3)
    assert along.real == pytest.approx(0.293, abs=1e-3)


def test_thesis_beta_goes_there_and_back() -> None:
    assert from_thesis_beta(to_thesis_beta(0.3 - 0.1j)) == pytest.approx(0.3 - 0.1j)


@given(angles, angles, angles)
def test_rotation_is_proper_and_has_the_documented_axis(psi: float, theta: float, phi: float) -> None:
    u = rotation(psi, theta, phi)
    np.testing.assert_allclose(u @ u.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(u) == pytest.approx(1.0)
    axis = (-np.sin(theta), np.cos(theta) * np.sin(phi), np.cos(theta) * np.cos(phi))
    np.testing.assert_allclose(u[:, 2], axis, atol=1e-12)


@given(angles, angles)
def test_world_tensor_keeps_the_principal_values_and_the_axis(theta: float, phi: float) -> None:
    u = rotation(0.3, theta, phi)
    tensor = world_tensor([1.0, 1.0, 0.4], u)
    np.testing.assert_allclose(np.linalg.eigvalsh(tensor.real), [0.4, 1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(tensor @ u[:, 2], 0.4 * u[:, 2], atol=1e-12)
