from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from tests.services.emi.makers import ATTITUDES, TENSOR, coils, field_t, ground

from trackmesh.services.emi.design import gram_matrices, model_field, response_rows
from trackmesh.services.emi.elimination import background_levels, reduce_background, solve_spd
from trackmesh.services.emi.estimators import Enough, Fit, Task
from trackmesh.services.emi.estimators.fit import varpro
from trackmesh.services.emi.fields import from_elements, to_elements
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation, world_tensor
from trackmesh.services.emi.sensor import XYZ, Z_ONLY, Background, Coils, Receiver, Sensor, sensor_arrays
from trackmesh.services.emi.varpro import Prior, Stop, evaluate, linear_part, search

EXACT = Enough(0.0, 0.01, 0.0, 0.0)


def fit(c: Coils, y: FloatArray, background: Background = "const", robust: bool = True) -> Fit:
    w = np.full(y.shape, 1.0 / np.abs(y).max())
    return varpro(Task(sensor_arrays(c, background), y, w, ground(), EXACT, robust))


def model(sensor: Sensor, r: FloatArray, tensor: FloatArray) -> FloatArray:
    levels = np.zeros((1, sensor.direction.shape[1], sensor.basis.shape[1]))
    return model_field(sensor, r[None], tensor[:, None], levels)[0]


@pytest.mark.parametrize("attitude", ATTITUDES)
@pytest.mark.parametrize("is_loop", [True, False])
@pytest.mark.parametrize("place", [(0.0, 0.0, -1.0), (0.3, 0.2, -0.6), (2.3, 0.0, -1.0)])
def test_noise_free_target_is_found_exactly(
    attitude: tuple[int, int], is_loop: bool, place: tuple[float, float, float]
) -> None:
    tensor = world_tensor([-0.098, -0.098, -0.044], rotation(0.0, *np.deg2rad(attitude))).real
    c = coils(is_loop)
    found = fit(c, field_t(c, np.array(place), tensor))
    assert np.abs(found.r_m[0] - place).max() < 1e-6
    np.testing.assert_allclose(found.tensor_m3[0, 0], to_elements(tensor), atol=1e-6)
    assert found.converged


def test_offset_tilted_and_scalar_sensors_are_modelled() -> None:
    rng = np.random.default_rng(0)
    c = coils(n=15)
    tilted = c._replace(
        tx_axis=np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=c.positions_m.shape),
        tx_offset_m=np.array([0.2, 0.0, 0.1]),
        receivers=(Receiver(XYZ, np.array([-0.3, 0.1, 0.0])),),
    )
    tilted = tilted._replace(tx_axis=tilted.tx_axis / np.linalg.norm(tilted.tx_axis, axis=1, keepdims=True))
    place = np.array([0.4, -0.3, -0.9])
    for c_ in (tilted, c._replace(receivers=(Receiver(Z_ONLY),)), c._replace(receivers=(Receiver(XYZ[:2]),))):
        found = fit(c_, field_t(c_, place, TENSOR))
        np.testing.assert_allclose(found.r_m[0], place, atol=1e-6)


def test_channels_share_the_position_and_keep_their_own_tensors() -> None:
    c, place = coils(n=15), np.array([0.2, 0.1, -1.0])
    y = np.concatenate([field_t(c, place, TENSOR), field_t(c, place, np.diag([0.01, 0.02, -0.03]))])
    found = fit(c, y)
    np.testing.assert_allclose(found.r_m[0], place, atol=1e-6)
    np.testing.assert_allclose(found.tensor_m3[0, 0], to_elements(TENSOR), atol=1e-7)
    np.testing.assert_allclose(found.tensor_m3[1, 0], [0.01, 0.02, -0.03, 0, 0, 0], atol=1e-7)


def test_dipole_model_of_a_loop_has_the_known_bias_and_the_loop_model_none() -> None:
    place, loop = np.array([0.0, 0.0, -1.0]), coils(n=41, spacing_m=0.1)
    standing, ball = np.diag([-0.098, -0.098, -0.044]), -0.048 * np.eye(3)
    for tensor, bias_m, share in ((standing, 0.196, 0.73), (ball, 0.238, 1.01)):
        y = field_t(loop, place, tensor)
        wrong = fit(loop._replace(is_loop=False), y, "none", robust=False)
        assert place[2] - wrong.r_m[0, 2] == pytest.approx(bias_m, abs=0.003)
        error = np.linalg.norm(from_elements(wrong.tensor_m3[0, 0]) - tensor) / np.linalg.norm(tensor)
        assert error == pytest.approx(share, abs=0.02)
        assert np.abs(fit(loop, y, "none").r_m[0] - place).max() < 1e-6


@pytest.mark.parametrize(("is_loop", "rx_radius_m"), [(True, 0.0), (False, 0.0), (True, 0.3)])
def test_jacobian_is_the_derivative_of_the_model(is_loop: bool, rx_radius_m: float) -> None:
    c = coils(is_loop, n=7, spacing_m=0.4)._replace(receivers=(Receiver(XYZ, np.array([0.1, 0.2, 0.0]), rx_radius_m),))
    sensor, r, elements = sensor_arrays(c, "none"), np.array([0.1, -0.2, -0.8]), to_elements(TENSOR)[None]
    shape = (1, len(c.positions_m), 3)
    rng = np.random.default_rng(3)
    step = 1e-3
    for j in range(3):
        e = step * np.eye(3)[j]
        h = {k: model(sensor, r + k * e, elements) for k in (-3, -2, -1, 1, 2, 3)}
        derivative = (45 * (h[1] - h[-1]) - 9 * (h[2] - h[-2]) + (h[3] - h[-3])) / (60 * step)
        # The Gram matrix holds D^T y for any y.
        y = rng.normal(size=shape)
        gram = gram_matrices(sensor, y, np.ones(shape), np.arange(shape[1]), r[None], elements[:, None])
        largest = np.linalg.norm(derivative) * np.linalg.norm(y)
        assert abs(gram[0, :, 6 + j, 9].sum() - float((derivative * y).sum())) < 1e-8 * largest


def test_background_elimination_is_least_squares_with_explicit_columns() -> None:
    c = coils(n=9, spacing_m=0.4)
    sensor, r = sensor_arrays(c, "plane"), np.array([[0.1, -0.2, -0.8]])
    n = len(c.positions_m)
    rng = np.random.default_rng(5)
    y, w = rng.normal(size=(1, n, 3)), rng.uniform(0.5, 2.0, (1, n, 3))
    explicit = np.zeros((n, 3, 9))
    for k in range(3):
        explicit[:, k, 3 * k : 3 * k + 3] = sensor.basis
    columns = np.hstack([1e9 * response_rows(sensor, r).reshape(-1, 6), explicit.reshape(-1, 9)]) * w.reshape(-1, 1)
    x, rss, rank, _ = np.linalg.lstsq(columns, (w * y).ravel())
    gram = gram_matrices(sensor, y, w, np.arange(n), r, np.zeros((1, 1, 6)))
    tensor, _, ours = linear_part(reduce_background(gram, 3))
    assert rank == 15
    assert ours == pytest.approx(rss[0], rel=1e-10)
    np.testing.assert_allclose(tensor[0, 0], 1e9 * x[:6], rtol=1e-8)
    np.testing.assert_allclose(background_levels(gram, 3, tensor)[0].ravel(), x[6:], rtol=1e-7)


def test_columns_of_two_targets_are_those_of_each() -> None:
    c = coils(n=9, spacing_m=0.4)
    sensor, n = sensor_arrays(c, "const"), len(c.positions_m)
    rng = np.random.default_rng(6)
    y, w = rng.normal(size=(2, n, 3)), rng.uniform(0.5, 2.0, (2, n, 3))
    r, tensor = np.array([[0.1, -0.2, -0.8], [-0.5, 0.3, -0.6]]), rng.normal(size=(2, 2, 6))
    both = gram_matrices(sensor, y, w, np.arange(n), r, tensor)
    for t in range(2):
        own = [0, *range(1 + 6 * t, 7 + 6 * t), *range(13 + 3 * t, 16 + 3 * t), 19]
        one = gram_matrices(sensor, y, w, np.arange(n), r[t : t + 1].copy(), tensor[:, t : t + 1].copy())
        np.testing.assert_allclose(both[:, :, own][:, :, :, own], one, rtol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_any_two_positions_leave_one_tensor_element_open(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = np.column_stack([rng.uniform(-2, 2, (5, 2)), np.zeros(5)])
    for n, rank in ((2, 5), (5, 6)):
        A = response_rows(
            sensor_arrays(coils()._replace(positions_m=positions[:n]), "none"), np.array([[0.1, 0.2, -1.0]])
        )
        A = A.reshape(-1, 6)
        s = np.linalg.svd(A / np.linalg.norm(A, axis=0), compute_uv=False)
        assert (s > 1e-10).sum() == rank


@pytest.mark.parametrize("is_loop", [True, False])
def test_scipy_finds_the_same_minimum(is_loop: bool) -> None:
    c, place = coils(is_loop), np.array([0.3, -0.2, -0.9])
    y = field_t(c, place, TENSOR)
    y = y + 0.1 * np.sqrt((y**2).mean()) * np.random.default_rng(7).normal(size=y.shape)
    sensor, unit = sensor_arrays(c, "const"), float(np.abs(y).max())
    w, every = np.full(y.shape, 1.0 / unit), np.arange(y.shape[1])
    # A window of all samples, so that both minimise over the same.
    start = np.array([[0.2, -0.1, -0.8]])
    first, _, _ = linear_part(evaluate(sensor, y, w, every, start, np.zeros((1, 1, 6))))
    ours = search(sensor, y, w, every, start, first, ground(), Stop(1e-9, 1e-12, 50))

    def misfit(x: FloatArray) -> FloatArray:
        signal, beneath = model_field(sensor, x[None, :3], x[None, None, 3:9] / 10.0, unit * x[9:].reshape(1, 3, 1))
        return np.asarray((w * (y - signal - beneath)).ravel())

    begin = np.concatenate([place + 0.05, 10.0 * ours.tensor_m3[0, 0], np.zeros(3)])
    theirs = least_squares(misfit, begin, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(ours.r_m[0], theirs.x[:3], atol=3e-7)
    np.testing.assert_allclose(ours.tensor_m3[0, 0], theirs.x[3:9] / 10.0, atol=1e-6)


def test_a_prior_weighs_as_much_as_it_knows() -> None:
    c, place = coils(n=9, spacing_m=0.4), np.array([0.3, -0.2, -0.9])
    y = field_t(c, place, TENSOR)
    sigma = 0.1 * float(np.abs(y).max())
    y = y + sigma * np.random.default_rng(7).normal(size=y.shape)
    sensor, w, every = sensor_arrays(c, "none"), np.full(y.shape, 1.0 / sigma), np.arange(y.shape[1])
    start, nothing = place[None].copy(), np.zeros((1, 1, 6))
    tensor, _, _ = linear_part(evaluate(sensor, y, w, every, start, nothing))
    mean, stop = place + np.array([0.05, 0.0, 0.1]), Stop(1e-9, 1e-12, 50)
    found = {}
    for sd in (1e-4, 1e4):
        prior = Prior(mean, np.eye(3) / sd**2)
        found[sd] = search(sensor, y, w, every, start, tensor, ground(prior=prior, sigma_known=True), stop).r_m[0]
    free = search(sensor, y, w, every, start, tensor, ground(), stop).r_m[0]
    np.testing.assert_allclose(found[1e-4], mean, atol=1e-5)
    np.testing.assert_allclose(found[1e4], free, atol=1e-6)


def test_a_prior_is_the_same_with_noise_that_is_known_and_that_is_estimated() -> None:
    c, place = coils(), np.array([0.3, -0.2, -0.9])
    y = field_t(c, place, TENSOR)
    sigma = 0.5 * float(np.sqrt((y**2).mean()))
    y = y + sigma * np.random.default_rng(8).normal(size=y.shape)
    sensor, every, start = sensor_arrays(c, "none"), np.arange(y.shape[1]), place[None].copy()
    prior, found = Prior(place + 0.05, np.eye(3) / 0.01**2), []
    for known, unit in ((True, sigma), (False, 7.0 * sigma)):
        w = np.full(y.shape, 1.0 / unit)
        tensor, _, _ = linear_part(evaluate(sensor, y, w, every, start, np.zeros((1, 1, 6))))
        here = ground(prior=prior, sigma_known=known)
        found.append(search(sensor, y, w, every, start, tensor, here, Stop(1e-9, 1e-12, 50)).r_m[0])
    np.testing.assert_allclose(found[0], found[1], atol=2e-4)


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
    sensor, r, tensor = sensor_arrays(c, "const"), np.array([[0.0, 0.1, -0.9]]), to_elements(TENSOR)[None, None]
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
