"""The published TV-IMM: its equations, and what is wrong with them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from tests.services.estimation.makers import (
    LAW,
    PAPER,
    SCALE,
    FloatArray,
    Plot,
    begun,
    covariances,
    filtered,
    flow,
    interacted,
    mixture_moments,
    output,
    random_state,
    random_walk,
    seeds,
    velocities,
)

from trackmesh.services.estimation import printed

TWO = velocities((1.0, 50.0), (30.0, 15.0), printed=True)


def product(x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    mean, covariance = np.empty(4), np.empty((4, 4))
    printed.product_of_gaussians(x, P, mean, covariance)
    return mean, covariance


def jittered(P: FloatArray) -> FloatArray:
    return np.asarray(P + printed.JITTER * np.trace(P) * np.eye(4))


@LAW
@given(seeds)
def test_the_product_of_gaussians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=(3, 4)), covariances(rng, (3,), 4)
    inverse = np.linalg.inv(P)
    want_P = np.linalg.inv(inverse.sum(axis=0))
    want_x = want_P @ np.einsum("nij,nj->i", inverse, x)
    mean, covariance = product(x, P)
    np.testing.assert_allclose(mean, want_x, atol=1e-5)
    np.testing.assert_allclose(covariance, want_P, atol=1e-5)
    assert np.array_equal(covariance, covariance.T)


@LAW
@given(seeds)
def test_inverse_and_density_with_jitter(seed: int) -> None:
    """In metres and metres a second."""
    rng = np.random.default_rng(seed)
    P = covariances(rng, (1,), 4)[0] * SCALE
    out, x, mean = np.empty((4, 4)), rng.normal(size=4) * 100, rng.normal(size=4) * 100
    printed.invert(P, out)
    np.testing.assert_allclose(out @ jittered(P), np.eye(4), atol=1e-8)
    want = scipy.stats.multivariate_normal(mean, jittered(P)).logpdf(x) + 2.0 * np.log(2.0 * np.pi)
    assert printed.log_normal(x, mean, P) == pytest.approx(want, rel=1e-8, abs=1e-8)


def test_a_singular_covariance_has_a_product() -> None:
    x, P = np.zeros((2, 4)), np.array([np.diag([1.0, 1.0, 0.0, 0.0]), np.eye(4)])
    mean, covariance = product(x, P)
    assert np.isfinite(covariance).all()
    assert not mean.any()


@LAW
@given(seeds)
def test_the_more_confident_model_wins_whatever_the_plot(seed: int) -> None:
    """ln(mu_1/mu_2) = D^T (P_1^-1 - P_2^-1) D / 2 with D = x_1 - x_2; no plot is in it."""
    rng = np.random.default_rng(seed)
    s = random_state(rng, TWO)
    s.x[:], s.P[:] = rng.normal(size=(2, 4)), covariances(rng, (2,), 4)
    printed.after_update(TWO, s)
    inverse, D = np.linalg.inv(s.P), s.x[0] - s.x[1]
    want = 0.5 * D @ (inverse[0] - inverse[1]) @ D
    bound = -np.log(printed.LEAST_PROBABILITY)
    if abs(want) < 0.9 * bound:
        assert np.log(s.mu[0] / s.mu[1]) == pytest.approx(want, rel=1e-4, abs=1e-4)
    assert s.mu.sum() == pytest.approx(1.0, abs=1e-12)


@LAW
@given(seeds)
def test_the_next_matrix_is_that_of_densities_of_states(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s = random_state(rng, PAPER)
    s.x[:], s.P[:] = rng.normal(size=(3, 4)), covariances(rng, (3,), 4)
    printed.after_update(PAPER, s)
    density = np.array(
        [[scipy.stats.multivariate_normal(s.x[b], s.P[b]).pdf(s.x[a]) for b in range(3)] for a in range(3)]
    )
    np.testing.assert_allclose(s.counts, density / density.sum(axis=1, keepdims=True), atol=1e-4)


def test_its_output_is_the_product() -> None:
    plots = random_walk(np.random.default_rng(1), 20)
    s = filtered(PAPER, begun(PAPER, plots[0]), plots[1:])
    for got, want in zip(output(PAPER, s), product(s.x, s.P), strict=True):
        assert np.array_equal(got, want)


def test_the_product_counts_shared_plots_once_a_model() -> None:
    """NEES of r matched models that see one plot: r times what it should be; of their mixture, what it should be."""
    rng, q, sigma, dt, r = np.random.default_rng(2), 10.0, 30.0, 2.0, 3
    models = velocities((q,) * r, (30.0,) * r)
    root = np.linalg.cholesky(q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2)))
    nees: list[list[float]] = [[], []]
    for _ in range(60):
        truth = np.array([0.0, 0.0, *rng.normal(0.0, 150.0, 2)])
        s = begun(models, Plot(rng.normal(0.0, sigma, 2), np.array([sigma**2, 0.0, sigma**2]), 0.0))
        for k in range(1, 30):
            truth = flow(dt) @ truth + root @ rng.normal(size=4)
            plot = Plot(truth[:2] + rng.normal(0.0, sigma, 2), np.array([sigma**2, 0.0, sigma**2]), dt * k)
            s = filtered(models, s, [plot])
            for kept, (x, P) in zip(nees, (product(s.x, s.P), mixture_moments(s.x, s.P, s.mu)), strict=True):
                kept.append(float((x - truth) @ np.linalg.solve(P, x - truth)) / 4.0)
    assert np.mean(nees[0]) == pytest.approx(r, rel=0.1)
    assert np.mean(nees[1]) == pytest.approx(1.0, rel=0.1)


def test_a_model_that_nothing_comes_to_keeps_a_place() -> None:
    """States so far apart that every density under another model is nought."""
    s = random_state(np.random.default_rng(3), PAPER)
    s.x[:, 0] = [1e5, 2e5, 3e5]
    printed.after_update(PAPER, s)
    assert 0.0 < s.mu.min() < 1e-9
    ahead = interacted(PAPER, s, 4.0)
    assert np.all(ahead.x[:, 0] > 0.9e5), "none has fallen to the origin"
    assert np.all(np.linalg.eigvalsh(ahead.P) > 0)
