"""Signal strengths: what the law makes of noise, and that it is learnt from tags of known place."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.services.tags.makers import FloatArray

from trackmesh.services.tags.rssi import INFLATION, PathLoss, PathLossPrior

PRIOR = PathLossPrior(power_1m_dbm=-45.0, exponent=2.5, noise_db=3.0)


def readings(d: FloatArray, power: float, exponent: float, noise_db: float, seed: int = 1) -> FloatArray:
    noise = np.random.default_rng(seed).normal(size=len(d))
    return np.asarray(power - 10.0 * exponent * np.log10(d) + noise_db * noise)


def test_without_noise_a_range_is_exact() -> None:
    d = np.array([0.5, 1.0, 7.0, 120.0])
    np.testing.assert_allclose(PathLoss(PRIOR).ranges_m(readings(d, -45.0, 2.5, 0.0)), d)


@pytest.mark.parametrize(("noise_db", "exponent"), [(2.0, 3.0), (4.0, 3.0), (4.0, 2.0)])
def test_noise_of_a_range_is_a_share_of_the_distance(noise_db: float, exponent: float) -> None:
    law = PathLoss(PathLossPrior(-40.0, exponent, noise_db))
    for d in (3.0, 30.0):
        z = law.ranges_m(readings(np.full(200_000, d), -40.0, exponent, noise_db))
        assert np.std(np.log(z)) == pytest.approx(law.relative_noise / INFLATION, rel=0.01)
        assert np.mean(np.log(z)) == pytest.approx(math.log(d), abs=0.01)


def test_the_law_is_learnt_from_known_distances() -> None:
    law, rng = PathLoss(PRIOR), np.random.default_rng(2)
    assert law.exponent_sd == pytest.approx(0.5)
    for k in range(20):
        d = rng.uniform(2.0, 30.0, 30)
        law.learn(d, readings(d, -38.0, 3.1, 3.0, seed=k))
    assert law.readings == 600
    assert law.exponent == pytest.approx(3.1, abs=3 * law.exponent_sd + 0.02)
    assert law.power_1m_dbm == pytest.approx(-38.0, abs=1.5)
    assert law.exponent_sd < 0.1
    d = np.linspace(3.0, 28.0, 20)
    np.testing.assert_allclose(law.ranges_m(readings(d, -38.0, 3.1, 0.0)), d, rtol=0.07)


def test_what_is_learnt_is_the_regression_with_its_prior() -> None:
    law = PathLoss(PRIOR)
    d = np.array([2.0, 5.0, 11.0])
    p = readings(d, -50.0, 2.0, 1.0)
    law.learn(d, p)
    X = np.column_stack([np.ones(3), -10.0 * np.log10(d)])
    prior = np.diag([PRIOR.power_sd_db**-2.0, PRIOR.exponent_sd**-2.0])
    want = np.linalg.solve(prior + X.T @ X / 9.0, prior @ [-45.0, 2.5] + X.T @ p / 9.0)
    assert [law.power_1m_dbm, law.exponent] == pytest.approx(want.tolist())


def test_a_change_of_the_law_is_followed() -> None:
    law, rng = PathLoss(PRIOR), np.random.default_rng(4)
    for k in range(400):
        d = rng.uniform(2.0, 30.0, 30)
        law.learn(d, readings(d, -45.0, 2.5 if k < 200 else 3.5, 3.0, seed=k))
    assert law.exponent == pytest.approx(3.5, abs=0.1)


def test_absurd_readings_give_no_absurd_law() -> None:
    law = PathLoss(PRIOR)
    law.learn(np.array([1.0, 100.0]), np.array([-100.0, 100.0]))
    assert 1.0 < law.exponent < 7.0 and math.isfinite(law.relative_noise)
    assert np.isfinite(law.ranges_m(np.array([-200.0, 100.0]))).all()
    law.learn(np.empty(0), np.empty(0))


def test_a_wrong_exponent_is_wrong_by_much() -> None:
    d = np.full(1, 20.0)
    wrong = PathLoss(PRIOR._replace(exponent=2.0)).ranges_m(readings(d, -45.0, 2.5, 0.0))
    assert wrong[0] > 40.0
