from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, FloatArray, covariance, covariances, seeds

from trackmesh.services.estimation.track_distances import (
    acceptance_limit,
    all_distances,
    cross_covariance,
    modified_covariance,
    sequential_statistic,
    squared_distances,
    weighted_covariance,
)

sizes = st.integers(1, 6)


class Pair(NamedTuple):
    """Two filters of one target: their transition, noise, and what a plot leaves of their errors."""

    F: FloatArray
    Q: FloatArray
    H: FloatArray
    Ra: FloatArray
    Rb: FloatArray
    start: FloatArray


def random_pair(rng: np.random.Generator, n: int) -> Pair:
    m = max(1, n // 2)
    F = np.eye(n) + 0.3 * rng.normal(size=(n, n))
    return Pair(
        F, covariance(rng, n), np.asarray(rng.normal(size=(m, n))), covariance(rng, m), covariance(rng, m, 4.0),
        covariance(rng, n, 9.0),
    )  # fmt: skip


def filtered(pair: Pair, looks: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """P_a, P_b and P_ab after some looks, filter by filter."""
    n = len(pair.F)
    Pa = Pb = pair.start
    Pab = np.zeros((n, n))
    for _ in range(looks):
        kept = []
        predicted = [pair.F @ P @ pair.F.T + pair.Q for P in (Pa, Pb)]
        for P, R in zip(predicted, (pair.Ra, pair.Rb), strict=True):
            K = np.linalg.solve(pair.H @ P @ pair.H.T + R, pair.H @ P).T
            kept.append(np.eye(n) - K @ pair.H)
        Pab = cross_covariance(Pab, pair.F, pair.Q, kept[0], kept[1])
        Pa, Pb = (A @ P for A, P in zip(kept, predicted, strict=True))
    return Pa, Pb, Pab


def joint(pair: Pair, looks: int) -> FloatArray:
    """The covariance (2 n, 2 n) of both errors, as one system with one process noise."""
    n = len(pair.F)
    zero = np.zeros((n, n))
    P = np.block([[pair.start, zero], [zero, pair.start]])
    F, Q = np.kron(np.eye(2), pair.F), np.kron(np.ones((2, 2)), pair.Q)
    for _ in range(looks):
        P = F @ P @ F.T + Q
        A, noise = np.zeros_like(P), np.zeros_like(P)
        for k, R in enumerate((pair.Ra, pair.Rb)):
            own = slice(k * n, (k + 1) * n)
            K = np.linalg.solve(pair.H @ P[own, own] @ pair.H.T + R, pair.H @ P[own, own]).T
            A[own, own] = np.eye(n) - K @ pair.H
            noise[own, own] = K @ R @ K.T
        P = A @ P @ A.T + noise
    return P


@LAW
@given(seeds, sizes, st.integers(0, 6))
def test_the_recursion_is_the_cross_covariance_of_the_joint_system(seed: int, n: int, looks: int) -> None:
    pair = random_pair(np.random.default_rng(seed), n)
    Pa, Pb, Pab = filtered(pair, looks)
    whole = joint(pair, looks)
    size = np.abs(whole).max()
    np.testing.assert_allclose(Pab, whole[:n, n:], atol=1e-7 * size)
    difference = np.hstack([np.eye(n), -np.eye(n)])
    np.testing.assert_allclose(modified_covariance(Pa, Pb, Pab), difference @ whole @ difference.T, atol=1e-6 * size)


@LAW
@given(seeds, sizes, st.integers(1, 6))
def test_common_noise_makes_the_modified_distance_the_greater_one(seed: int, n: int, looks: int) -> None:
    """With equal filters P_ab is not negative, so no true pair is nearer by the modified distance."""
    rng = np.random.default_rng(seed)
    pair = random_pair(rng, n)
    Pa, Pb, Pab = filtered(pair._replace(Rb=pair.Ra), looks)
    t = rng.normal(size=(20, n))
    weighted, modified = (
        squared_distances(t, np.broadcast_to(C, (20, n, n)))
        for C in (weighted_covariance(Pa, Pb), modified_covariance(Pa, Pb, Pab))
    )
    assert np.all(modified >= weighted * (1.0 - 1e-9))


@LAW
@given(seeds, sizes, st.integers(1, 5), st.integers(1, 5))
def test_distances_equal_a_dense_solution(seed: int, n: int, na: int, nb: int) -> None:
    rng = np.random.default_rng(seed)
    C, shift = covariance(rng, n), 1e4 * rng.normal(size=n)
    xa, xb = rng.normal(size=(2, na, n)) + shift, rng.normal(size=(2, nb, n)) + shift
    t = xa[:, :, None] - xb[:, None]
    dense = np.einsum("rabi,ij,rabj->rab", t, np.linalg.inv(C), t)
    np.testing.assert_allclose(all_distances(xa, xb, C), dense, rtol=1e-6, atol=1e-6)
    one_by_one = squared_distances(t.reshape(-1, n), np.tile(C, (2 * na * nb, 1, 1)))
    np.testing.assert_allclose(one_by_one, dense.ravel(), rtol=1e-6, atol=1e-6)


@LAW
@given(seeds, st.integers(1, 6))
def test_each_pair_has_its_own_covariance(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    t, C = rng.normal(size=(7, n)), covariances(rng, (7,), n)
    dense = np.einsum("ki,ki->k", t, np.linalg.solve(C, t[..., None])[..., 0])
    np.testing.assert_allclose(squared_distances(t, C), dense, rtol=1e-8)


def test_no_covariance_is_an_infinite_distance() -> None:
    C = np.array([np.eye(3), np.zeros((3, 3)), np.diag([1.0, -1.0, 1.0]), np.full((3, 3), np.nan)])
    got = squared_distances(np.ones((4, 3)), C)
    np.testing.assert_array_equal(got, [3.0, np.inf, np.inf, np.inf])
    with pytest.raises(np.linalg.LinAlgError):
        all_distances(np.zeros((2, 3)), np.zeros((2, 3)), C[2])


@LAW
@given(seeds, st.integers(1, 12), st.floats(1e-4, 0.5))
def test_the_limit_is_the_quantile_of_chi_square(seed: int, looks: int, alpha: float) -> None:
    assert acceptance_limit(looks, 6, alpha) == pytest.approx(scipy.stats.chi2.isf(alpha, 6 * looks), rel=1e-9)
    x = np.random.default_rng(seed).normal(size=(looks, 6))
    statistic = np.zeros(1)
    for t in x:
        statistic = sequential_statistic(statistic, squared_distances(t[None], np.eye(6)[None]))
    assert statistic[0] == pytest.approx((x * x).sum())


def test_the_level_is_kept_by_independent_looks() -> None:
    x = np.random.default_rng(3).normal(size=(20_000, 10, 4))
    statistic = (x * x).sum(axis=(1, 2))
    assert np.mean(statistic > acceptance_limit(10, 4, 0.05)) == pytest.approx(0.05, abs=0.006)


def test_filtered_differences_are_correlated_and_the_level_is_not_kept() -> None:
    """What (24) supposes does not hold: of true pairs far more than alpha are rejected, though each look is honest."""
    rng, runs, looks, gain = np.random.default_rng(4), 4_000, 40, 0.3
    # Two filters of a standing target with a constant gain: errors e <- (1 - K) e - K v.
    error, settled = np.zeros((2, runs)), np.sqrt(gain / (2.0 - gain))
    statistic, honest = np.zeros(runs), []
    for k in range(40 + looks):
        error = (1.0 - gain) * error + gain * rng.normal(size=(2, runs))
        if k >= 40:
            distance = squared_distances((error[0] - error[1])[:, None], np.full((runs, 1, 1), 2.0 * settled**2))
            honest.append(np.mean(distance > acceptance_limit(1, 1, 0.05)))
            statistic = sequential_statistic(statistic, distance)
    assert np.mean(honest) == pytest.approx(0.05, abs=0.01)
    assert statistic.mean() == pytest.approx(looks, rel=0.03)
    assert np.mean(statistic > acceptance_limit(looks, 1, 0.05)) > 0.12
    rho = (1.0 - gain) ** 2
    assert statistic.var() == pytest.approx(2 * looks * (1 + rho) / (1 - rho), rel=0.15)
