from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, kstest
from tests.services.emi.makers import coils

from trackmesh.services.emi.diagnosis.covariance import covariance_matrix, fisher_matrix, parameters_of
from trackmesh.services.emi.diagnosis.detection import (
    chi2_p_value,
    detection_limit,
    detection_threshold,
    noise_variance,
)
from trackmesh.services.emi.diagnosis.geometry import absurdity, coil_places, geometry_defect
from trackmesh.services.emi.diagnosis.shape import SHAPES, along_axes, principal_values
from trackmesh.services.emi.fields import from_elements, to_elements
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation, world_tensor
from trackmesh.services.emi.sensor import sensor_arrays
from trackmesh.services.emi.varpro import Bounds
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
    assert geometry_defect(np.unique(places, axis=0)) == defect


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
    np.testing.assert_allclose(detection_threshold(1, dof, True), 40.0)
    two = detection_threshold(2, dof, True)
    assert chi2.sf(two[0], 15) == pytest.approx(chi2.sf(40.0, 9))
    unknown = detection_threshold(1, dof, False)
    assert unknown[0] > 90.0
    assert unknown[1] == pytest.approx(40.0, abs=0.5)


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
    assert (got.vectors[:, 2, 2] >= 0.0).all()
    assert (np.abs(got.vectors[:, :, 2] @ axis) > 0.95).all()


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


def test_every_channel_is_told_along_the_same_axes() -> None:
    u = rotation(0.1, 0.4, 0.7)
    tensors = np.stack([to_elements(world_tensor(p, u).real) for p in ([0.02, -0.09, 0.05], [0.1, 0.2, 0.3])])
    curves = along_axes(tensors[None], u[None])[0]
    np.testing.assert_allclose(curves, [[0.02, -0.09, 0.05], [0.1, 0.2, 0.3]], atol=1e-12)


def test_parameters_of_a_target_are_its_place_and_its_elements_of_each_channel() -> None:
    assert parameters_of(0, 1, 2).tolist() == list(range(15))
    assert parameters_of(1, 2, 2).tolist() == [3, 4, 5, *range(12, 18), *range(24, 30)]


@pytest.mark.parametrize(("scale", "absurd"), [(1.0, None), (1e3, "spacing"), (1e-3, "spacing")])
def test_places_in_another_unit_are_told(scale: float, absurd: str | None) -> None:
    c = coils()._replace(positions_m=scale * grid_positions((1.0, 1.0), 0.1))
    assert absurdity(sensor_arrays(c, "const")) == absurd


def test_places_are_those_of_all_coils() -> None:
    c = coils()._replace(positions_m=GRID[:2], tx_offset_m=np.array([0.0, 0.0, 0.3]))
    assert len(coil_places(sensor_arrays(c, "const"))) == 4


def test_a_scan_excludes_less_of_what_lies_deeper() -> None:
    sensor = sensor_arrays(coils(), "const")
    bounds = Bounds(np.array([-4.0, -4.0, -8.0]), np.array([4.0, 4.0, -0.05]), 0.0)
    w = np.full((1, len(sensor.place_m), 3), 1e9)
    limit = detection_limit(sensor, w, bounds, 45.0, 1.0, 4.0)
    assert limit.depth_m.tolist() == [0.5, 1.0, 2.0, 4.0]
    assert (np.diff(limit.polarizability_m3) > 0.0).all()
    noisier = detection_limit(sensor, w, bounds, 45.0, 4.0, 4.0)
    np.testing.assert_allclose(noisier.polarizability_m3, 2.0 * limit.polarizability_m3)
