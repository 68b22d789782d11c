from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, kstest

from trackmesh.services.emi.diagnosis import (
    SHAPES,
    chi2_p_value,
    covariance_matrix,
    detection_threshold,
    fisher_matrix,
    geometry_defect,
    noise_variance,
    principal_values,
)
from trackmesh.services.emi.fields import from_elements, to_elements
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation, world_tensor
from trackmesh.sim.emi import grid_positions

GRID = grid_positions((4.0, 4.0), 0.5)


def noisy_tensors(
    principal: list[float], sd: float, n: int, seed: int = 1
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tensors (n, 6), their covariances and the axis of the truth."""
    u = rotation(0.0, 0.4, 0.7)
    rng = np.random.default_rng(seed)
    root = sd * (np.eye(6) + 0.2 * rng.normal(size=(6, 6)))
    truth = to_elements(world_tensor(principal, u).real)
    tensors = truth + rng.normal(size=(n, 6)) @ root.T
    return tensors, np.broadcast_to(root @ root.T, (n, 6, 6)), u[:, 2]


@pytest.mark.parametrize(
    ("places", "defect"),
    [
        (GRID, None),
        (GRID[:3], "too_few_places"),
        (np.repeat(GRID[:1], 50, axis=0), "too_few_places"),
        (np.repeat(GRID[:3], 50, axis=0), "too_few_places"),
        (GRID[:9], "collinear"),
        (np.outer(np.arange(20.0), [1.0, 2.0, 0.1]), "collinear"),
        (GRID[[0, 1, 9, 10]], None),
    ],
)
def test_geometry_defects(places: FloatArray, defect: str | None) -> None:
    assert geometry_defect(places) == defect


@given(st.integers(0, 10_000), st.floats(-12, 12))
def test_covariance_is_the_inverse_whatever_the_units(seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(1, 30, 9)) * np.where(np.arange(9) < 3, 1.0, 10.0**decades)
    fisher = x.transpose(0, 2, 1) @ x
    covariance, least = covariance_matrix(fisher)
    assert least[0] > 1e-9
    scale = np.sqrt(np.diagonal(fisher[0]))
    np.testing.assert_allclose((fisher[0] @ covariance[0]) * scale / scale[:, None], np.eye(9), atol=1e-6)


def test_a_missing_direction_is_told_and_harms_no_neighbour() -> None:
    x = np.random.default_rng(1).normal(size=(3, 30, 9))
    x[1, :, 4] = x[1, :, 5]
    fisher = x.transpose(0, 2, 1) @ x
    fisher[2, 0, 0] = np.nan
    covariance, least = covariance_matrix(fisher)
    assert (least < 1e-9).tolist() == [False, True, True]
    np.testing.assert_array_equal(covariance[0], covariance_matrix(fisher[:1])[0][0])


def test_fisher_matrix_shares_the_position_between_channels() -> None:
    reduced = np.random.default_rng(2).normal(size=(1, 2, 10, 10))
    reduced = reduced + reduced.transpose(0, 1, 3, 2)
    fisher = fisher_matrix(reduced)[0]
    np.testing.assert_allclose(fisher[:3, :3], reduced[0, 0, 6:9, 6:9] + reduced[0, 1, 6:9, 6:9])
    np.testing.assert_array_equal(fisher[3:9, 9:], np.zeros((6, 6)))
    np.testing.assert_array_equal(fisher[9:, 9:], reduced[0, 1, :6, :6])
    np.testing.assert_array_equal(fisher, fisher.T)


def test_threshold_is_the_calibrated_one_and_grows_with_channels_and_ignorance() -> None:
    dof = np.array([20, 5000])
    np.testing.assert_allclose(detection_threshold(1, dof, True), 45.0)
    two = detection_threshold(2, dof, True)
    assert chi2.sf(two[0], 15) == pytest.approx(chi2.sf(45.0, 9))
    unknown = detection_threshold(1, dof, False)
    assert unknown[0] > 100.0
    assert unknown[1] == pytest.approx(45.0, abs=0.5)


def test_p_value_is_uniform_for_noise() -> None:
    e = np.random.default_rng(3).normal(size=(2000, 40))
    p = chi2_p_value((e**2).sum(1), np.full(2000, 40))
    assert kstest(p, "uniform").pvalue > 0.01


def test_noise_variance_takes_the_robust_scale_where_it_can() -> None:
    both = noise_variance(np.array([30.0, 1e9]), np.array([5.0, 2.0]), np.array([20, 1015]), np.array([10, 1000]))
    np.testing.assert_allclose(both, [3.0, 4.0 * 1.015])


def test_a_rod_has_its_small_value_as_its_axis() -> None:
    tensors, covariance, axis = noisy_tensors([-0.098, -0.098, -0.044], 1e-3, 200)
    got = principal_values(tensors, covariance)
    assert (got.shape == SHAPES.index("axisymmetric")).mean() > 0.9
    assert (got.axis[:, 2] >= 0.0).all()
    cosine = np.abs(got.axis @ axis)
    ratio = np.arccos(np.minimum(cosine, 1.0)) / got.axis_sd_rad
    assert 0.85 < np.sqrt((ratio**2).mean()) < 1.15


@pytest.mark.parametrize("column", [0, 2])
def test_standard_deviations_are_those_of_the_spread(column: int) -> None:
    tensors, covariance, _ = noisy_tensors([-0.098, -0.098, -0.044], 1e-3, 600)
    got = principal_values(tensors, covariance)
    axial = got.shape == SHAPES.index("axisymmetric")
    z = (got.values_m3[axial, column] - (-0.098, 0.0, -0.044)[column]) / got.sd_m3[axial, column]
    assert 0.9 < np.sqrt((z**2).mean()) < 1.1


def test_a_sphere_is_called_isotropic_at_the_nominal_rate_and_given_one_value() -> None:
    tensors, covariance, _ = noisy_tensors([-0.05, -0.05, -0.05], 1e-3, 1000)
    got = principal_values(tensors, covariance)
    isotropic = got.shape == SHAPES.index("isotropic")
    assert 0.925 < isotropic.mean() < 0.975
    np.testing.assert_allclose(got.values_m3[isotropic].std(1), 0.0, atol=1e-12)


def test_three_different_values_are_general_and_fall_by_magnitude() -> None:
    tensors, covariance, _ = noisy_tensors([0.02, -0.09, 0.05], 1e-3, 50)
    got = principal_values(tensors, covariance)
    assert (got.shape == SHAPES.index("general")).all()
    np.testing.assert_allclose(got.values_m3.mean(0), [-0.09, 0.05, 0.02], atol=1e-3)


def test_principal_values_are_eigenvalues() -> None:
    tensors, covariance, _ = noisy_tensors([0.02, -0.09, 0.05], 1e-3, 5)
    got = principal_values(tensors, covariance)
    expected = np.linalg.eigvalsh(from_elements(tensors))
    np.testing.assert_allclose(np.sort(got.values_m3, axis=1), expected, rtol=1e-10)
