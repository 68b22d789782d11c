from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ive

from trackmesh.services.emi.fields import MU0
from trackmesh.services.emi.polarizability import (
    cylinder,
    decay_roots,
    from_thesis_beta,
    rotation,
    sphere,
    sphere_step_off,
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


@pytest.mark.parametrize("mu_r", [1.0, 5.0, 100.0])
@pytest.mark.parametrize("omega", [0.3, 30.0, 3e3])
def test_decay_and_frequency_response_are_one_function(mu_r: float, omega: float) -> None:
    # The Laplace transform of the decay is (M(0) - M(s)) / s; the series can be transformed term by term.
    tau_s = COPPER * MU0 * mu_r * A**2
    x2 = decay_roots(mu_r, 20_000) ** 2
    weight = 12.0 * np.pi * A**3 * mu_r / (x2 + (mu_r - 1.0) * (mu_r + 2.0))
    transform = (weight / (x2 / tau_s + 1j * omega)).sum()
    still = 4.0 * np.pi * A**3 * (mu_r - 1.0) / (mu_r + 2.0)
    expected = (still - sphere(A, omega, COPPER, mu_r)) / (1j * omega)
    assert abs(transform - expected) < 1e-3 * abs(expected)


@pytest.mark.parametrize("mu_r", [1.0, 50.0])
def test_decay_begins_at_the_change_of_the_field_and_has_its_rate(mu_r: float) -> None:
    tau_s = COPPER * MU0 * mu_r * A**2
    still = 4.0 * np.pi * A**3 * (mu_r - 1.0) / (mu_r + 2.0)
    early = sphere_step_off(A, np.array([1e-8 * tau_s]), COPPER, mu_r)
    assert early[0] == pytest.approx(still + 2.0 * np.pi * A**3, rel=0.02)
    t = tau_s * np.array([0.01, 0.1])
    step = 1e-5 * t
    difference = (sphere_step_off(A, t - step, COPPER, mu_r) - sphere_step_off(A, t + step, COPPER, mu_r)) / (2 * step)
    np.testing.assert_allclose(sphere_step_off(A, t, COPPER, mu_r, rate=True), difference, rtol=1e-6)


def test_there_is_no_decay_before_the_field_is_off() -> None:
    with pytest.raises(ValueError, match="after the field"):
        sphere_step_off(A, np.array([0.0]), COPPER)
