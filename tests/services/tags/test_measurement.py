"""One range: against dense Kalman formulas, against integration, and that covariances stay covariances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.tags.makers import LAW, NEVER, PLAIN, FloatArray, One, covariance, ranges, seeds

from trackmesh.services.tags.measurement import linearise_at_mean, linearise_unscented, update

PLACE = np.array([3.0, -4.0, 0.0])


def take(one: One, place: FloatArray, metres: float, sigma: float = 1.0, relative: float = 0.0) -> float:
    z = ranges((0.0, 0, metres), sigma=sigma)
    z["relative"] = relative
    return float(update(one.rules[0], one.f.x[0], one.f.P[0], place, z[0], one.work[0]))


def unscented(x: FloatArray, P: FloatArray, place: FloatArray) -> FloatArray:
    h = np.empty(4)
    linearise_unscented(x, P, place, np.empty(5), h)
    return h


@LAW
@given(seed=seeds, height=st.floats(0.0, 5.0))
def test_ekf_is_the_dense_update(seed: int, height: float) -> None:
    rng = np.random.default_rng(seed)
    one = One(update="ekf", bias_sd_m=1.0, scale_sd=0.1, **PLAIN).begin()
    x, P = rng.normal(size=8), covariance(rng, 8)
    x[:2] += 20.0
    x[7] *= 0.1
    one.set(x, P)
    place, z, sigma = np.array([3.0, -4.0, height]), 25.0, 0.7

    def h(x: FloatArray) -> float:
        return float((1 + x[7]) * math.sqrt((x[0] - 3.0) ** 2 + (x[1] + 4.0) ** 2 + height**2) + x[6])

    H = np.array([(h(x + 1e-6 * e) - h(x - 1e-6 * e)) / 2e-6 for e in np.eye(8)])
    H[6], H[7] = 1.0, (h(x) - x[6]) / (1 + x[7])
    S = H @ P @ H + sigma**2
    K = P @ H / S
    value = take(one, place, z, sigma)
    np.testing.assert_allclose(one.f.x[0], x + K * (z - h(x)), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(one.f.P[0], P - np.outer(K, K) * S, rtol=1e-5, atol=1e-5)
    assert value == pytest.approx(-0.5 * (math.log(2 * math.pi * S) + (z - h(x)) ** 2 / S), rel=1e-6)


def hermite(x: FloatArray, P: FloatArray, place: FloatArray, n: int = 40) -> tuple[float, float]:
    """Mean and variance of the distance under a Gaussian position, by Gauss-Hermite quadrature."""
    t, w = np.polynomial.hermite_e.hermegauss(n)
    w = w / w.sum()
    u, v = np.meshgrid(t, t, indexing="ij")
    points = x[:2] + np.stack([u, v], -1) @ np.linalg.cholesky(P[:2, :2]).T
    d = np.hypot(*(points - place[:2]).transpose(2, 0, 1))
    mean = float((np.outer(w, w) * d).sum())
    return mean, float((np.outer(w, w) * (d - mean) ** 2).sum())


@LAW
@given(seed=seeds, share=st.floats(0.02, 0.2))
def test_the_unscented_moments_are_those_of_the_distance(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    x = np.append(PLACE[:2] + 10.0 * np.array([math.cos(1.0 + seed), math.sin(1.0 + seed)]), np.zeros(4))
    P = covariance(rng, 6)
    P *= (share * 10.0) ** 2 / np.linalg.eigvalsh(P[:2, :2]).max()
    h, (mean, variance) = unscented(x, P, PLACE), hermite(x, P, PLACE)
    g = np.array([h[1], h[2]])
    assert h[0] == pytest.approx(mean, rel=1e-3)
    assert g @ P[:2, :2] @ g + h[3] == pytest.approx(variance, rel=0.15)
    assert h[3] >= 0.0


def test_a_sure_position_makes_both_forms_one() -> None:
    x, P = np.array([10.0, 7.0, 0, 0, 0, 0]), 1e-8 * np.eye(6)
    at_mean = np.empty(4)
    linearise_at_mean(x, PLACE, at_mean)
    np.testing.assert_allclose(unscented(x, P, PLACE), at_mean, atol=1e-6)
    np.testing.assert_allclose(unscented(x, np.zeros((6, 6)), PLACE), at_mean)


def test_on_the_reader_itself_there_is_a_direction_too() -> None:
    h = np.empty(4)
    linearise_at_mean(np.append(PLACE[:2], np.zeros(4)), PLACE, h)
    assert h.tolist() == [0.0, 1.0, 0.0, 0.0]


def six_dimensional(x: FloatArray, P: FloatArray, place: FloatArray, z: float, R: float) -> Any:
    """The unscented update in all six dimensions, kappa = -3, with the state as it stands: position first."""
    L = np.linalg.cholesky(P) * math.sqrt(3.0)
    points = np.vstack([x, x + L.T, x - L.T])
    w = np.array([-1.0] + [1.0 / 6.0] * 12)
    d = np.hypot(points[:, 0] - place[0], points[:, 1] - place[1])
    mean = w @ d
    S, C = w @ (d - mean) ** 2 + R, (points - x).T @ (w * (d - mean))
    return x + C / S * (z - mean), P - np.outer(C, C) / S


@LAW
@given(seed=seeds)
def test_with_the_position_first_the_six_dimensional_transform_is_the_two_dimensional_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one = One(**PLAIN).begin()
    x, P = rng.normal(size=6) * 10.0, covariance(rng, 6, 30.0)
    one.set(x, P)
    take(one, PLACE, 12.0)
    want_x, want_P = six_dimensional(x, P, PLACE, 12.0, 1.0)
    np.testing.assert_allclose(one.f.x[0], want_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.f.P[0], want_P, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("name", ["ut", "ekf"])
@LAW
@given(seed=seeds, log_sigma=st.floats(-3, 1), scale=st.floats(-2, 4), doubted=st.booleans())
def test_a_covariance_stays_one(name: str, seed: int, log_sigma: float, scale: float, doubted: bool) -> None:
    rng = np.random.default_rng(seed)
    one = One(update=name, bias_sd_m=1.0, scale_sd=0.1, **({} if doubted else PLAIN)).begin()
    x, P = rng.normal(size=8) * 20.0, covariance(rng, 8, 10.0**scale)
    x[7] = 0.05
    one.set(x, P)
    for _ in range(5):
        take(one, PLACE + rng.normal(size=3) * [20, 20, 0], rng.uniform(0.0, 60.0), 10.0**log_sigma)
    after = one.f.P[0]
    assert (after == after.T).all() and (np.diag(after) >= 0).all()
    assert np.linalg.eigvalsh(after).min() > -1e-9 * np.trace(P)


def test_noise_may_be_a_share_of_the_distance() -> None:
    near, far = One(update="ekf", **PLAIN).begin(5.0, -4.0), One(update="ekf", **PLAIN).begin(103.0, -4.0)
    for one, distance in ((near, 2.0), (far, 100.0)):
        take(one, PLACE, distance, 1e-3, relative=0.15)
        expected = 1.0 / (1.0 / 9.0 + 1.0 / (0.15 * distance) ** 2)
        assert one.f.P[0, 0, 0] == pytest.approx(expected, rel=1e-3)


def shifted(nu_sigmas: float, long: float, short: float) -> float:
    """How far, in prior sigmas, a range moves the state that is so many sigmas off."""
    one = One(update="ekf", doubt_long=long, doubt_short=short).begin(13.0, -4.0, sigma=1.0)
    take(one, PLACE, 10.0 + nu_sigmas * math.sqrt(2.0), 1.0)
    return float(one.f.x[0, 0] - 13.0)


def test_long_ranges_are_doubted_and_short_ones_are_not() -> None:
    free = shifted(6.0, NEVER, NEVER)
    assert free == pytest.approx(6.0 * math.sqrt(2.0) / 2.0)
    # The gain is cut by (r / c)^2.
    assert shifted(6.0, 1.5, NEVER) == pytest.approx(free / 16.0)
    assert shifted(-6.0, 1.5, NEVER) == pytest.approx(-free)
    assert shifted(-6.0, 1.5, 3.0) == pytest.approx(-free / 4.0)
    assert shifted(1.4, 1.5, 3.0) == pytest.approx(shifted(1.4, NEVER, NEVER))


@pytest.mark.parametrize(("nu", "sign"), [(6.0, 1.0), (-6.0, -1.0)])
def test_a_doubt_is_told_in_sigmas(nu: float, sign: float) -> None:
    one = One(update="ekf").begin(13.0, -4.0, sigma=1.0)
    take(one, PLACE, 10.0 + nu * math.sqrt(2.0), 1.0)
    assert one.work[0].doubt == pytest.approx(6.0 * sign)


def test_bias_and_scale_are_found_from_a_known_place() -> None:
    one = One(bias_sd_m=2.0, scale_sd=0.1, **PLAIN).begin(0.0, 0.0, sigma=1e-3)
    rng = np.random.default_rng(5)
    for _ in range(400):
        place = np.append(rng.uniform(-60, 60, 2), 0.0)
        d = math.hypot(*place[:2])
        take(one, place, 1.06 * d + 0.8 + 0.3 * rng.normal(), 0.3)
    assert one.f.x[0, 6:].tolist() == pytest.approx([0.8, 0.06], abs=0.1)
    assert one.f.x[0, 7] == pytest.approx(0.06, abs=4 * math.sqrt(one.f.P[0, 7, 7]))
