from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, SCALE, FloatArray, IntArray, covariances, seeds

from trackmesh.services.estimation.pairs import (
    PairRules,
    chi2_upper,
    local_density,
    log_ratio,
    state_distances,
)

UNCLIPPED = PairRules(low=-np.inf, high=np.inf)


def states(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    return rng.normal(size=(n, 4)) * [200, 200, 30, 30], covariances(rng, (n,), 4) * SCALE


def all_pairs(n: int, m: int) -> tuple[IntArray, IntArray]:
    i, j = (a.ravel() for a in np.indices((n, m)))
    return i, j


@LAW
@given(seeds, st.integers(1, 4), st.integers(1, 4))
def test_distances_equal_a_dense_solution(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    (xa, Pa), (xb, Pb), (i, j) = states(rng, n), states(rng, m), all_pairs(n, m)
    blur = covariances(rng, (len(i),), 2, 1e4)
    d, S = xa[i] - xb[j], Pa[i] + Pb[j]
    S[:, :2, :2] += blur
    distance, logdet = state_distances(xa, Pa, xb, Pb, i, j, blur)
    np.testing.assert_allclose(distance, np.einsum("ka,ka->k", d, np.linalg.solve(S, d[..., None])[..., 0]), rtol=1e-8)
    np.testing.assert_allclose(logdet, np.linalg.slogdet(S)[1], atol=1e-8)


def test_a_pair_without_a_positive_covariance_is_infinitely_far() -> None:
    x, P, zero = np.zeros((1, 4)), np.zeros((1, 4, 4)), np.zeros(1, np.int64)
    distance, _ = state_distances(x, P, x, P, zero, zero, np.zeros((1, 2, 2)))
    assert np.isinf(distance).all()


@LAW
@given(seeds, st.floats(2.0, 30.0))
def test_the_increment_is_the_ratio_of_student_t_to_unrelated_tracks(seed: int, nu: float) -> None:
    rng = np.random.default_rng(seed)
    rules = UNCLIPPED._replace(nu=nu)
    (xa, Pa), (xb, Pb), zero = states(rng, 1), states(rng, 1), np.zeros(1, np.int64)
    rho = rng.uniform(1e-10, 1e-6, 1)
    got = log_ratio(rules, *state_distances(xa, Pa, xb, Pb, zero, zero, np.zeros((1, 2, 2))), rho)
    # The t density here has S as its scale matrix.
    related = scipy.stats.multivariate_t(np.zeros(4), (Pa + Pb)[0], df=nu).logpdf((xa - xb)[0])
    # Velocities of two unrelated tracks differ by a normal of variance 2 s_v^2 per axis; at equal velocities that is
    speed = scipy.stats.multivariate_normal(np.zeros(2), 2 * rules.speed_mps**2 * np.eye(2)).logpdf(np.zeros(2))
    assert got[0] == pytest.approx(related - np.log(rho[0]) - speed, abs=1e-8)


@LAW
@given(seeds)
def test_infinite_degrees_of_freedom_are_the_gaussian_density(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (xa, Pa), (xb, Pb), zero = states(rng, 1), states(rng, 1), np.zeros(1, np.int64)
    found = state_distances(xa, Pa, xb, Pb, zero, zero, np.zeros((1, 2, 2)))
    got, nearly = (log_ratio(UNCLIPPED._replace(nu=nu), *found, np.ones(1)) for nu in (np.inf, 1e9))
    related = scipy.stats.multivariate_normal(np.zeros(4), (Pa + Pb)[0]).logpdf((xa - xb)[0])
    assert got[0] == pytest.approx(related + np.log(4 * np.pi * UNCLIPPED.speed_mps**2), rel=1e-9, abs=1e-8)
    assert nearly[0] == pytest.approx(got[0], rel=1e-4, abs=1e-4)


def test_increments_are_clipped() -> None:
    rules = PairRules()
    got = log_ratio(rules, np.array([0.0, 1e12, np.inf]), np.zeros(3), np.full(3, 1e-9))
    assert got.tolist() == [rules.high, rules.low, rules.low]


@LAW
@given(seeds, st.integers(0, 30))
def test_density_counts_the_others_in_the_circle(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    x, others, radius = rng.uniform(0, 3e4, (5, 4)), rng.uniform(0, 3e4, (m, 4)), 1e4
    inside = (np.linalg.norm(x[:, None, :2] - others[None, :, :2], axis=2) < radius).sum(axis=1)
    np.testing.assert_allclose(local_density(x, others, radius), np.maximum(inside, 1) / (np.pi * radius**2))


@pytest.mark.parametrize(("z", "tail"), [(3.719, 1e-4), (2.326, 1e-2), (1.645, 5e-2)])
def test_chi_square_quantiles_against_scipy(z: float, tail: float) -> None:
    dof = np.concatenate([np.arange(4.0, 40.0), [100.0, 500.0, 2000.0]])
    # Worst at 4 degrees of freedom and the far tail; the test multiplies it by 1.3.
    np.testing.assert_allclose(chi2_upper(dof, z), scipy.stats.chi2.isf(tail, dof), rtol=0.03)
    np.testing.assert_allclose(chi2_upper(dof[8:], z), scipy.stats.chi2.isf(tail, dof[8:]), rtol=0.01)
