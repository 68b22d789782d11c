from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW

from trackmesh.services.estimation.uncertain import NOISE_MODELS, assumed_variance, distribution, quantile, sample

sigmas = st.floats(1e-3, 1e6)
means = st.floats(-1e6, 1e6)


@LAW
@given(st.floats(1e-9, 1.0 - 1e-9), means, sigmas)
def test_the_quantile_is_the_inverse_of_the_distribution(p: float, mean: float, sigma: float) -> None:
    x = quantile(p, mean, sigma)
    # The mean may be far from zero in units of sigma.
    assert distribution(x, mean, sigma) == pytest.approx(p, rel=1e-9 + 1e-14 * abs(mean) / sigma)


@LAW
@given(st.floats(-50.0, 50.0), means, sigmas)
def test_equation_5_as_it_is_printed(z: float, mean: float, sigma: float) -> None:
    x = mean + z * sigma
    printed = 1.0 / (1.0 + np.exp(np.pi * (mean - x) / (np.sqrt(3.0) * sigma)))
    assert distribution(x, mean, sigma) == pytest.approx(printed, rel=1e-12, abs=1e-300)


def test_far_out_nothing_overflows() -> None:
    with np.errstate(all="raise", under="ignore"):
        np.testing.assert_array_equal(distribution(np.array([-1e9, 0.0, 1e9])), [0.0, 0.5, 1.0])


def test_sigma_is_the_standard_deviation_and_the_samples_follow_the_distribution() -> None:
    x = sample(np.random.default_rng(1), (200_000,), 7.0)
    assert x.std() == pytest.approx(7.0, rel=0.01)
    assert x.mean() == pytest.approx(0.0, abs=0.05)
    assert scipy.stats.kstest(x, lambda v: distribution(v, 0.0, 7.0)).pvalue > 0.01
    assert scipy.stats.kstest(x, "norm", (0.0, 7.0)).pvalue < 1e-6
    oracle = scipy.stats.logistic(scale=7.0 * np.sqrt(3.0) / np.pi)
    np.testing.assert_allclose(distribution(x[:100], 0.0, 7.0), oracle.cdf(x[:100]))


def test_sigma_broadcasts_and_samples_are_finite() -> None:
    x = sample(np.random.default_rng(2), (50_000, 2), np.array([1.0, 10.0]))
    assert np.isfinite(x).all()
    np.testing.assert_allclose(x.std(axis=0), [1.0, 10.0], rtol=0.03)


def test_the_two_sided_bounds_are_little_wider_than_those_of_the_gaussian() -> None:
    np.testing.assert_allclose(quantile([0.975, 0.995]), [2.02, 2.92], atol=0.005)


def test_what_a_filter_assumes() -> None:
    assert NOISE_MODELS == ("gaussian", "uncertain")
    assert assumed_variance(3.0, 4.0, "gaussian") == 9.0
    assert assumed_variance(3.0, 4.0, "uncertain") == 25.0
    np.testing.assert_array_equal(assumed_variance([1.0, 2.0], 1.0, "gaussian"), [1.0, 4.0])
    np.testing.assert_array_equal(assumed_variance(2.0, [0.0, 1.0], "gaussian"), [4.0, 4.0])
