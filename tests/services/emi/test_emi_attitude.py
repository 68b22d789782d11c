from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from trackmesh.services.emi.diagnosis.attitude import Attitude, Attitudes, attitude, attitudes, undefined_angles
from trackmesh.services.emi.diagnosis.shape import Principal, principal_values
from trackmesh.services.emi.fields import to_elements
from trackmesh.services.emi.polarizability import rotation, world_tensor

ROD = (-0.098, -0.098, -0.044)
BODY = (-0.12, -0.05, 0.06)
right = st.floats(-1.4, 1.4)


def pose(
    principal: tuple[float, float, float],
    angles: tuple[float, float, float],
    sd: float = 1e-4,
    n: int = 1,
    seed: int = 1,
) -> tuple[Attitudes, Principal]:
    """Attitudes of ``n`` draws of one body turned by psi, theta, phi."""
    rng = np.random.default_rng(seed)
    root = sd * (np.eye(6) + 0.2 * rng.normal(size=(6, 6)))
    truth = to_elements(world_tensor(principal, rotation(*angles)).real)
    tensors = truth + rng.normal(size=(n, 6)) @ root.T
    covariance = np.broadcast_to(root @ root.T, (n, 6, 6))
    found = principal_values(tensors, covariance)
    return attitudes(found, covariance), found


def one(principal: tuple[float, float, float], angles: tuple[float, float, float], sd: float = 1e-4) -> Attitude:
    return attitude(*pose(principal, angles, sd), 0)


@given(right, right)
def test_angles_of_a_rod_are_those_it_was_turned_by(theta: float, phi: float) -> None:
    found = one(ROD, (0.0, theta, phi), 1e-9)
    assert found.angles_rad["theta"] == pytest.approx(theta, abs=1e-5)
    assert found.angles_rad["phi"] == pytest.approx(phi, abs=1e-4)
    assert found.undefined == {"psi": "axisymmetric"}


@given(right, right, right)
def test_angles_of_any_other_body_too(psi: float, theta: float, phi: float) -> None:
    # The axis of this one is that of its third value, the larger transverse one comes first.
    found = one((-0.12, -0.10, 0.06), (psi, theta, phi), 1e-9)
    assert [*found.angles_rad.values()] == pytest.approx([theta, phi, psi], abs=1e-4)
    assert found.undefined == {}


@pytest.mark.parametrize("principal", [ROD, BODY])
def test_covariance_of_axis_and_angles_is_that_of_the_spread(principal: tuple[float, float, float]) -> None:
    truth = one(principal, (0.3, 0.4, 0.7), 1e-9)
    stack, found = pose(principal, (0.3, 0.4, 0.7), 1e-3, 800)
    told = [attitude(stack, found, i) for i in range(800)]
    kept = [a for a in told if a.angles_rad.keys() == truth.angles_rad.keys()]
    assert len(kept) > 700
    errors = np.array([np.subtract([*a.angles_rad.values()], [*truth.angles_rad.values()]) for a in kept])
    nees = np.array([e @ np.linalg.solve(a.covariance, e) for e, a in zip(errors, kept, strict=True)])
    assert 0.92 < (nees < chi2.ppf(0.95, errors.shape[1])).mean() < 0.98
    axis = rotation(0.3, 0.4, 0.7)[:, 2] if principal == ROD else stack.axis.mean(0)
    off = np.arccos(np.minimum(np.abs(stack.axis @ axis / np.linalg.norm(axis)), 1.0))
    assert 0.9 < np.sqrt(np.mean((off / stack.axis_sd_rad) ** 2)) < 1.1


def test_the_covariance_of_an_axis_has_none_along_it() -> None:
    stack, _ = pose(ROD, (0.0, 0.4, 0.7), 1e-3)
    assert abs(stack.axis[0] @ stack.axis_covariance[0] @ stack.axis[0]) < 1e-12


def test_a_rod_along_x_has_no_roll() -> None:
    found = one(ROD, (0.0, np.pi / 2, 0.0))
    assert found.undefined == {"phi": "gimbal", "psi": "axisymmetric"}
    assert abs(found.angles_rad["theta"]) == pytest.approx(np.pi / 2, abs=0.01)
    assert found.covariance.shape == (1, 1)


def test_a_sphere_has_no_angles() -> None:
    found = one((-0.05, -0.05, -0.05), (0.0, 0.4, 0.7))
    assert found.undefined == dict.fromkeys(("theta", "phi", "psi"), "isotropic")
    assert found.angles_rad == {}


@pytest.mark.parametrize(
    ("shape", "axis_x", "sd", "undefined"),
    [
        ("general", 0.1, [0.1, 0.1, 0.1], {}),
        ("general", 0.1, [1.0, 1.0, 0.1], {"theta": "uncertain", "phi": "uncertain"}),
        ("general", 0.1, [0.1, 0.1, np.inf], {"psi": "uncertain"}),
        ("general", 0.1, [0.1, 1.0, 0.1], {"phi": "gimbal", "psi": "gimbal"}),
        ("general", -0.9995, [0.1, 0.1, 0.1], {"phi": "gimbal", "psi": "gimbal"}),
        ("axisymmetric", 0.1, [0.1, 0.1, 0.1], {"psi": "axisymmetric"}),
    ],
)
def test_angles_that_are_hardly_known_are_not_told(
    shape: str, axis_x: float, sd: list[float], undefined: dict[str, str]
) -> None:
    assert undefined_angles(shape, axis_x, np.array(sd)) == undefined
