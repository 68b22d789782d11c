from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trackmesh.services.estimation import bias
from trackmesh.services.estimation.bias import Geometry, Tracks

FloatArray = npt.NDArray[np.float64]

POLAR = Geometry(True, np.array([3e3, -2e3]))
POSITION = Geometry(False, np.zeros(2))
BIAS = np.array([150.0, 0.007, 0.5])


def places(seed: int = 1, n: int = 40) -> FloatArray:
    return np.random.default_rng(seed).uniform(-60e3, 60e3, (n, 2))


def covariances(seed: int, n: int) -> FloatArray:
    rows = np.random.default_rng(seed).normal(0.0, 1.0, (n, 4, 6)) * np.array([100.0, 100.0, 15.0, 15.0])[:, None]
    return np.asarray(rows @ np.swapaxes(rows, 1, 2))


# --- what biases do ---


def test_a_radar_measures_its_bias_too_far_and_too_clockwise() -> None:
    true = places()
    east, north = (true - POLAR.site_m).T
    r, azimuth = np.hypot(east, north) + 150.0, np.arctan2(east, north) + 0.007
    measured = np.stack([r * np.sin(azimuth), r * np.cos(azimuth)], axis=1) + POLAR.site_m
    assert bias.corrected(POLAR, measured, BIAS) == pytest.approx(true, abs=1e-6)
    assert (np.hypot(*(measured - POLAR.site_m).T) > np.hypot(east, north)).all()
    due_north = bias.corrected(POLAR, POLAR.site_m + np.array([[0.0, 1e4]]), np.array([0.0, 0.1, 0.0])) - POLAR.site_m
    assert due_north[0, 0] < 0.0


def test_a_position_sensor_measures_its_bias_too_far_east_and_north() -> None:
    true = places()
    assert bias.corrected(POSITION, true + np.array([80.0, -30.0]), np.array([80.0, -30.0, 0.0])) == pytest.approx(true)


@pytest.mark.parametrize("geometry", [POLAR, POSITION])
def test_a_time_offset_says_how_far_the_target_is_ahead(geometry: Geometry) -> None:
    true, velocity = places(), np.full((40, 2), [200.0, -50.0])
    seen = np.concatenate([true + 0.5 * velocity, velocity], axis=1)
    assert bias.corrected(geometry, seen, np.array([0.0, 0.0, 0.5])) == pytest.approx(true, abs=1e-6)
    assert bias.corrected(geometry, seen[:, :2], np.array([0.0, 0.0, 0.5])) == pytest.approx(seen[:, :2], abs=1e-6)


@pytest.mark.parametrize("geometry", [POLAR, POSITION])
def test_the_negative_bias_is_the_inverse(geometry: Geometry) -> None:
    measured = places()
    again = bias.corrected(geometry, bias.corrected(geometry, measured, BIAS), -BIAS)
    assert again == pytest.approx(measured, abs=1e-6)


@pytest.mark.parametrize("geometry", [POLAR, POSITION])
def test_one_target_of_known_place_tells_the_bias(geometry: Geometry) -> None:
    measured = places()
    told = bias.told(geometry, measured, bias.corrected(geometry, measured, BIAS))
    assert told == pytest.approx(np.tile(BIAS[:2], (40, 1)), rel=1e-6)


@pytest.mark.parametrize("geometry", [POLAR, POSITION])
def test_the_jacobian_is_that_of_central_differences(geometry: Geometry) -> None:
    at = np.concatenate([places(2), np.random.default_rng(3).normal(0, 150, (40, 2))], axis=1)
    present = BIAS * [1.0, 1.0, 0.0]
    true = bias.corrected(geometry, at, present)
    J = bias.jacobian(geometry, np.concatenate([true, at[:, 2:]], axis=1))
    for k, step in enumerate([1e-2, 1e-7, 1e-4]):
        more, less = (bias.corrected(geometry, at, present + sign * step * np.eye(3)[k]) for sign in (1, -1))
        assert J[:, :, k] == pytest.approx(-(more - less) / (2 * step), rel=1e-5, abs=1e-3)


def test_at_the_site_itself_nothing_is_divided_by_zero() -> None:
    at = np.concatenate([[POLAR.site_m], np.ones((1, 2))], axis=1)
    with np.errstate(all="raise"):
        assert np.isfinite(bias.corrected(POLAR, at, BIAS)).all()
        assert np.isfinite(bias.jacobian(POLAR, at)).all()


def test_hypotheses_are_corrected_all_at_once() -> None:
    at, hypotheses = places(), np.random.default_rng(4).normal(0, 1, (5, 1, 3)) * [100.0, 0.01, 0.0]
    together = bias.corrected(POLAR, at, hypotheses)
    for k in range(5):
        assert together[k] == pytest.approx(bias.corrected(POLAR, at, hypotheses[k, 0]))


def test_spread_and_length_are_metres_at_the_range() -> None:
    assert bias.length(np.array([30.0, 0.001, 9.0]), True, 40e3) == pytest.approx(50.0)
    assert bias.length(np.array([30.0, 40.0, 9.0]), False, 40e3) == pytest.approx(50.0)
    assert bias.spread(np.diag([30.0**2, 0.001**2, 9.0]), True, 40e3) == pytest.approx(50.0)


# --- what pairs tell ---


def test_rows_are_whitened_as_by_a_library() -> None:
    R, columns = covariances(5, 20)[:, :2, :2], np.random.default_rng(6).normal(0, 1, (20, 2, 7))
    assert bias.whitened(R, columns) == pytest.approx(np.linalg.solve(np.linalg.cholesky(R), columns))


def test_distances_are_those_of_the_dense_formula() -> None:
    rng = np.random.default_rng(7)
    left, H, R = rng.normal(0, 100, (20, 2)), rng.normal(0, 1, (20, 2, 6)), covariances(8, 20)[:, :2, :2]
    A = rng.normal(0, 10, (6, 6))
    for k, D in enumerate(bias.distances(left, H, A @ A.T, R)):
        assert pytest.approx(left[k] @ np.linalg.solve(H[k] @ A @ A.T @ H[k].T + R[k], left[k])) == D


def test_what_is_no_covariance_is_noticed() -> None:
    R = np.array([np.eye(2), np.zeros((2, 2)), [[1.0, 1.0], [1.0, 1.0]], np.full((2, 2), np.nan), -np.eye(2)])
    assert bias.positive_definite(R).tolist() == [True, False, False, False, False]


def test_the_error_of_where_a_target_is_says_nothing_of_the_difference() -> None:
    rng, n = np.random.default_rng(9), 200_000
    truth = np.array([30e3, 20e3, 150.0, -80.0])
    Pa, Pb = covariances(10, 2)
    a, b = (truth + rng.standard_normal((n, 4)) @ np.linalg.cholesky(P).T for P in (Pa, Pb))
    left, H = bias.residuals(
        Tracks(POSITION, a, np.broadcast_to(Pa, (n, 4, 4))), np.zeros(3),
        Tracks(POLAR, b, np.broadcast_to(Pb, (n, 4, 4))), np.zeros(3),
    )  # fmt: skip
    assert left == pytest.approx(a[:, :2] - b[:, :2])
    velocity = H[:, :, 2]
    azimuth = -H[:, :, 4]
    for known in (velocity, azimuth):
        spread = np.std(known, axis=0)[:, None] * np.std(left, axis=0)
        correlation = (known - known.mean(axis=0)).T @ left / n / spread
        assert np.abs(correlation).max() < 0.01
    assert np.abs(np.corrcoef(a[:, 0], left[:, 0])[0, 1]) > 0.3, "of one track alone it does"


def test_sensors_on_one_mast_tell_nothing_of_the_sum_of_their_biases() -> None:
    rng, P = np.random.default_rng(11), covariances(12, 40)
    a, b = (np.concatenate([places(), np.zeros((40, 2))], axis=1) + rng.normal(0, 300, (40, 4)) for _ in range(2))
    _, H = bias.residuals(Tracks(POLAR, a, P), BIAS, Tracks(POLAR, b, P), -BIAS)
    assert H[:, :, :3] == pytest.approx(-H[:, :, 3:], abs=1e-12)


def test_a_look_counts_as_much_as_in_the_exact_solution_of_correlated_errors() -> None:
    rho, n = np.exp(-2.0 / 8.0), 30
    R = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    exact = np.ones(n) @ np.linalg.solve(R, np.ones(n))
    assert 1.0 + (n - 1) * bias.repetition(2.0, 8.0) == pytest.approx(exact)
    assert bias.repetition(np.inf, 8.0) == 1.0
    assert bias.repetition(0.0, 8.0) == 0.0
    assert bias.repetition(2.0, 0.0) == 1.0


# --- the filter ---


def test_learning_is_weighted_least_squares_with_the_prior_as_rows() -> None:
    rng = np.random.default_rng(13)
    H, R, y = rng.normal(0, 1, (30, 2, 6)), covariances(14, 30)[:, :2, :2], rng.normal(0, 100, (30, 2))
    weight = rng.uniform(0.1, 1.0, 30)
    beta, prior = rng.normal(0, 10, 6), rng.uniform(1.0, 100.0, 6)
    rows, right = [np.diag(1.0 / prior)], [beta / prior]
    for k in range(30):
        root = np.linalg.inv(np.linalg.cholesky(R[k] / weight[k]))
        rows.append(root @ H[k])
        right.append(root @ y[k])
    A, target = np.concatenate(rows), np.concatenate(right)
    found, P = bias.learn(beta, np.diag(prior**2), *bias.information(y, H, R, weight))
    assert found == pytest.approx(np.linalg.lstsq(A, target, rcond=None)[0], rel=1e-9)
    assert np.linalg.inv(A.T @ A) == pytest.approx(P, rel=1e-9)


def test_what_has_no_variance_is_not_learnt() -> None:
    H = np.random.default_rng(15).normal(0, 1, (30, 2, 3))
    precision, vector = bias.information(np.ones((30, 2)), H, np.tile(np.eye(2), (30, 1, 1)), np.ones(30))
    beta, P = bias.learn(np.array([0.0, 0.0, 0.25]), np.diag([1.0, 1.0, 0.0]), precision, vector)
    assert beta[2] == 0.25
    assert not P[2].any()
    assert beta[:2].all()


def test_biases_wander_as_told_and_no_further_than_the_prior() -> None:
    prior, walk = np.array([300.0, 0.01, 0.0]), np.array([1.0, 3e-5, 1.0])
    beta, P = bias.drift(np.array([100.0, 0.0, 0.0]), np.diag([25.0, 0.0, 0.0]), prior, walk, 10.0)
    assert np.diag(P) == pytest.approx([25.0 + 10.0, 10 * 9e-10, 0.0], rel=1e-3)
    assert beta[0] == pytest.approx(100.0, abs=0.01)
    beta, P = bias.drift(beta, P, prior, walk, 1e9)
    assert np.sqrt(np.diag(P)) == pytest.approx(prior)
    assert beta == pytest.approx(0.0, abs=1e-6)


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), steps=st.lists(st.floats(0.0, 1e5), min_size=1, max_size=8))
def test_the_covariance_stays_one_whatever_comes(seed: int, steps: list[float]) -> None:
    rng = np.random.default_rng(seed)
    prior = rng.uniform(0.0, 1.0, 9) * np.tile([300.0, 0.01, 0.5], 3)
    walk = rng.uniform(0.0, 1.0, 9) * np.tile([1.0, 1e-4, 1e-2], 3)
    prior[rng.random(9) < 0.2] = 0.0
    beta, P = np.zeros(9), np.diag(prior**2)
    for dt_s in steps:
        H = rng.normal(0, 1, (20, 2, 9)) * np.tile([1.0, 5e4, 200.0], 3)
        R = covariances(int(rng.integers(1000)), 20)[:, :2, :2]
        beta, P = bias.drift(beta, P, prior, walk, dt_s)
        more = bias.information(rng.normal(0, 1e3, (20, 2)), H, R, rng.uniform(0, 1, 20))
        beta, P = bias.learn(beta, P, *more)
        assert np.array_equal(P, P.T)
        scale = np.where(prior > 0.0, prior, 1.0)
        assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-12
        assert (np.diag(P) <= 1.0001 * prior**2).all()


def test_what_is_known_is_told_direction_by_direction() -> None:
    prior = np.array([300.0, 0.01, 0.0, 300.0, 0.01, 0.0])
    P = np.diag([1.0, 0.0001**2, 0.0, 300.0**2 / 2, 0.01**2 / 2, 0.0])
    P[0, 0] = P[0, 3] = P[3, 0] = P[3, 3]
    known = bias.known(P, prior)
    assert known.remaining == pytest.approx([0.5, 1e-4, 0.0, 0.5, 0.5, 0.0])
    assert known.held == pytest.approx([0.5, 0.0, 0.0, 0.5, 0.0, 0.0])
    assert known.tie[0, 3] == pytest.approx(0.5)
