from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from trackmesh.services.emi.design import (
    Sensor,
    background_levels,
    gram_matrices,
    reduce_background,
    residuals,
    solve_spd,
)
from trackmesh.services.emi.engine import XYZ, Z_ONLY, Background, Coils, Options, search_bounds, sensor_arrays
from trackmesh.services.emi.fields import from_elements, primary_field, secondary_field, to_elements
from trackmesh.services.emi.fit import Data, Enough, Fit, fit_target
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation, world_tensor
from trackmesh.services.emi.varpro import evaluate, linear_part
from trackmesh.sim.emi import grid_positions

MOMENT = 20.0 * np.pi * 0.25
TENSOR = world_tensor([-0.098, -0.098, -0.044], rotation(0.0, np.pi / 4, np.pi / 4)).real
ATTITUDES = [(0, 0), (30, 0), (45, 45), (90, 0), (0, 90), (75, -30)]


def coils(is_loop: bool = True, n: int = 21, spacing_m: float = 0.2) -> Coils:
    side = (n - 1) * spacing_m
    return Coils(grid_positions((side, side), spacing_m), 0.5, MOMENT, is_loop)


def field(c: Coils, r: FloatArray, tensor: FloatArray) -> FloatArray:
    """(1, W, K) in T, by the public field functions."""
    place = np.asarray(r, np.float64)
    h, _ = primary_field(
        place - c.positions_m - c.tx_offset_m, c.tx_axis, c.moment_am2, c.radius_m if c.is_loop else 0.0
    )
    b = secondary_field(c.positions_m + c.rx_offset_m - place, h @ tensor)
    return np.asarray((b @ c.components.T)[None])


def fit(c: Coils, y: FloatArray, background: Background = "const", robust: bool = True) -> Fit:
    sensor = sensor_arrays(c, background)
    w = np.full(y.shape, 1.0 / np.abs(y).max())
    return fit_target(
        Data(sensor, y, w, search_bounds(sensor.place_m, Options()), 2.0), robust, Enough(0.0, 0.01, 0.0, 0.0)
    )


def design(sensor: Sensor, r: FloatArray, tensor: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Rows of A (C W K, 6) and the model (C, W, K) by way of the residuals of a zero field."""
    zero, one = np.zeros((1, n, len(sensor.components))), np.ones((1, n, len(sensor.components)))
    levels = np.zeros((1, len(sensor.components), sensor.basis.shape[1]))
    columns = [-residuals(sensor, zero, one, r, np.eye(6)[[a]], levels).ravel() for a in range(6)]
    return np.stack(columns, 1), -residuals(sensor, zero, one, r, tensor, levels)


@pytest.mark.parametrize("attitude", ATTITUDES)
@pytest.mark.parametrize("is_loop", [True, False])
@pytest.mark.parametrize("place", [(0.0, 0.0, -1.0), (0.3, 0.2, -0.6), (2.3, 0.0, -1.0)])
def test_noise_free_target_is_found_exactly(
    attitude: tuple[int, int], is_loop: bool, place: tuple[float, float, float]
) -> None:
    tensor = world_tensor([-0.098, -0.098, -0.044], rotation(0.0, *np.deg2rad(attitude))).real
    c = coils(is_loop)
    found = fit(c, field(c, np.array(place), tensor))
    assert np.abs(found.r_m - place).max() < 1e-6
    np.testing.assert_allclose(found.tensor_m3[0], to_elements(tensor), atol=1e-6)
    assert found.converged


def test_offset_tilted_and_scalar_sensors_are_modelled() -> None:
    rng = np.random.default_rng(0)
    c = coils(n=15)
    tilted = c._replace(
        tx_axis=np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=c.positions_m.shape),
        tx_offset_m=np.array([0.2, 0.0, 0.1]),
        rx_offset_m=np.array([-0.3, 0.1, 0.0]),
    )
    tilted = tilted._replace(tx_axis=tilted.tx_axis / np.linalg.norm(tilted.tx_axis, axis=1, keepdims=True))
    place = np.array([0.4, -0.3, -0.9])
    for sensor in (tilted, c._replace(components=Z_ONLY), c._replace(components=XYZ[:2])):
        found = fit(sensor, field(sensor, place, TENSOR))
        np.testing.assert_allclose(found.r_m, place, atol=1e-6)


def test_channels_share_the_position_and_keep_their_own_tensors() -> None:
    c, place = coils(n=15), np.array([0.2, 0.1, -1.0])
    y = np.concatenate([field(c, place, TENSOR), field(c, place, np.diag([0.01, 0.02, -0.03]))])
    found = fit(c, y)
    np.testing.assert_allclose(found.r_m, place, atol=1e-6)
    np.testing.assert_allclose(found.tensor_m3[0], to_elements(TENSOR), atol=1e-7)
    np.testing.assert_allclose(found.tensor_m3[1], [0.01, 0.02, -0.03, 0, 0, 0], atol=1e-7)


def test_dipole_model_of_a_loop_has_the_known_bias_and_the_loop_model_none() -> None:
    place, loop = np.array([0.0, 0.0, -1.0]), coils(n=41, spacing_m=0.1)
    standing, ball = np.diag([-0.098, -0.098, -0.044]), -0.048 * np.eye(3)
    for tensor, bias_m, share in ((standing, 0.196, 0.73), (ball, 0.238, 1.01)):
        y = field(loop, place, tensor)
        wrong = fit(loop._replace(is_loop=False), y, "none", robust=False)
        assert place[2] - wrong.r_m[2] == pytest.approx(bias_m, abs=0.003)
        error = np.linalg.norm(from_elements(wrong.tensor_m3[0]) - tensor) / np.linalg.norm(tensor)
        assert error == pytest.approx(share, abs=0.02)
        assert np.abs(fit(loop, y, "none").r_m - place).max() < 1e-6


@pytest.mark.parametrize("is_loop", [True, False])
def test_jacobian_is_the_derivative_of_the_model(is_loop: bool) -> None:
    c = coils(is_loop, n=7, spacing_m=0.4)
    sensor, r, elements = sensor_arrays(c, "none"), np.array([0.1, -0.2, -0.8]), to_elements(TENSOR)[None]
    shape = (1, len(c.positions_m), 3)
    rng = np.random.default_rng(3)
    step = 1e-3
    for j in range(3):
        e = step * np.eye(3)[j]
        h = {k: design(sensor, r + k * e, elements, shape[1])[1] for k in (-3, -2, -1, 1, 2, 3)}
        derivative = (45 * (h[1] - h[-1]) - 9 * (h[2] - h[-2]) + (h[3] - h[-3])) / (60 * step)
        # The Gram matrix holds D^T y for any y.
        y = rng.normal(size=shape)
        gram = gram_matrices(sensor, y, np.ones(shape), np.arange(shape[1]), r, elements)
        assert gram[0, :, 6 + j, 9].sum() == pytest.approx(float((derivative * y).sum()), rel=1e-7)


def test_background_elimination_is_least_squares_with_explicit_columns() -> None:
    c = coils(n=9, spacing_m=0.4)
    sensor, r = sensor_arrays(c, "plane"), np.array([0.1, -0.2, -0.8])
    n = len(c.positions_m)
    rng = np.random.default_rng(5)
    y, w = rng.normal(size=(1, n, 3)), rng.uniform(0.5, 2.0, (1, n, 3))
    A, _ = design(sensor, r, np.zeros((1, 6)), n)
    explicit = np.zeros((n, 3, 9))
    for k in range(3):
        explicit[:, k, 3 * k : 3 * k + 3] = sensor.basis
    columns = np.hstack([1e9 * A, explicit.reshape(-1, 9)]) * w.reshape(-1, 1)
    x, rss, rank, _ = np.linalg.lstsq(columns, (w * y).ravel())
    gram = gram_matrices(sensor, y, w, np.arange(n), r, np.zeros((1, 6)))
    tensor, _, ours = linear_part(reduce_background(gram, 3))
    assert rank == 15
    assert ours == pytest.approx(rss[0], rel=1e-10)
    np.testing.assert_allclose(tensor[0], 1e9 * x[:6], rtol=1e-8)
    np.testing.assert_allclose(background_levels(gram, 3, tensor)[0].ravel(), x[6:], rtol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_any_two_positions_leave_one_tensor_element_open(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = np.column_stack([rng.uniform(-2, 2, (5, 2)), np.zeros(5)])
    for n, rank in ((2, 5), (5, 6)):
        sensor = sensor_arrays(Coils(positions[:n], 0.5, MOMENT), "none")
        A, _ = design(sensor, np.array([0.1, 0.2, -1.0]), np.zeros((1, 6)), n)
        s = np.linalg.svd(A / np.linalg.norm(A, axis=0), compute_uv=False)
        assert (s > 1e-10).sum() == rank


@pytest.mark.parametrize("is_loop", [True, False])
def test_scipy_finds_the_same_minimum(is_loop: bool) -> None:
    c, place = coils(is_loop), np.array([0.3, -0.2, -0.9])
    y = field(c, place, TENSOR)
    y = y + 0.1 * np.sqrt((y**2).mean()) * np.random.default_rng(7).normal(size=y.shape)
    sensor, unit = sensor_arrays(c, "const"), float(np.abs(y).max())
    everywhere = search_bounds(sensor.place_m, Options())
    w = np.full(y.shape, 1.0 / unit)
    ours = fit_target(Data(sensor, y, w, everywhere, 1e3), False, Enough(0.0, 0.1, 0.0, 0.0))

    def misfit(x: FloatArray) -> FloatArray:
        levels = unit * x[9:].reshape(1, 3, 1)
        return np.asarray(residuals(sensor, y, w, x[:3], x[None, 3:9] / 10.0, levels).ravel())

    start = np.concatenate([place + 0.05, 10.0 * ours.tensor_m3[0], np.zeros(3)])
    theirs = least_squares(misfit, start, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(ours.r_m, theirs.x[:3], atol=3e-7)
    np.testing.assert_allclose(ours.tensor_m3[0], theirs.x[3:9] / 10.0, atol=1e-6)


def test_solve_scales_and_survives_a_missing_direction() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(9, 6)) * 10.0 ** np.arange(-6, 6, 2)
    a, b = x.T @ x, rng.normal(size=(6, 2))
    np.testing.assert_allclose(solve_spd(a, b), np.linalg.solve(a, b), rtol=1e-9)
    a[:, 2] = a[2, :] = 0.0
    b[2] = 0.0
    solved = solve_spd(a, b)
    keep = [0, 1, 3, 4, 5]
    assert np.isfinite(solved).all()
    np.testing.assert_allclose(solved[keep], np.linalg.solve(a[np.ix_(keep, keep)], b[keep]), rtol=1e-9)


def test_weights_of_zero_are_absent_samples() -> None:
    c = coils(n=9, spacing_m=0.4)
    sensor, r, tensor = sensor_arrays(c, "const"), np.array([0.0, 0.1, -0.9]), to_elements(TENSOR)[None]
    y = np.random.default_rng(2).normal(size=(1, 81, 3))
    w = np.ones_like(y)
    w[:, ::2] = 0.0
    present = np.arange(1, 81, 2)
    np.testing.assert_allclose(
        evaluate(sensor, y, w, np.arange(81), r, tensor),
        evaluate(sensor, y, np.ones_like(y), present, r, tensor),
        rtol=1e-9,
        atol=1e-20,
    )
