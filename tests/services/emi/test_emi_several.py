from __future__ import annotations

import numpy as np
import pytest
from tests.services.emi.makers import COARSE, ball, error_m, noise, noisy, rod, solve, together

from trackmesh.services.emi.diagnosis.results import ScanResult
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.scans import Options
from trackmesh.sim.emi import Buried, clean_field_nt

THREE = Options(most_targets=3)
HALF_METRE = (ball((-0.25, 0.0, -0.9)), rod((0.25, 0.0, -0.8)))


def errors_m(result: ScanResult, truths: tuple[Buried, ...]) -> FloatArray:
    """Distance of each truth from the nearest target."""
    found = np.array([target.position_m for target in result.targets])
    return np.array([np.linalg.norm(found - truth.position_m[0], axis=1).min() for truth in truths])


@pytest.mark.parametrize("sigma_known", [True, False])
def test_two_targets_half_a_metre_apart_are_found(sigma_known: bool) -> None:
    field, sigma = noisy(together(COARSE, *HALF_METRE), 20.0, 10)
    results = solve(COARSE, field, sigma if sigma_known else None, THREE)
    found = [r for r in results if len(r.targets) == 2]
    assert len(found) >= 9
    assert np.median([errors_m(r, HALF_METRE).max() for r in found]) < 0.12
    assert all(np.argmin(r.bic) == 2 for r in found)


def test_each_of_two_targets_has_its_own_covariance() -> None:
    truths = (ball((-0.6, 0.1, -0.9)), rod((0.6, -0.1, -0.8)))
    field, sigma = noisy(together(COARSE, *truths), 25.0, 60)
    results = solve(COARSE, field, sigma, Options(most_targets=2))
    nees = []
    for result in results:
        assert result.status == "ok"
        for truth in truths:
            target = min(result.targets, key=lambda t: float(np.linalg.norm(t.position_m - truth.position_m[0])))
            error = np.concatenate(
                [target.position_m - truth.position_m[0], target.tensor_m3[0] - truth.elements_m3[0]]
            )
            nees.append(error @ np.linalg.solve(target.covariance, error) / 9.0)
    assert 0.8 < np.mean(nees) < 1.3


def test_three_targets_are_found() -> None:
    truths = (ball((-1.0, -0.8, -0.7)), rod((0.9, -0.6, -0.8)), rod((0.0, 1.0, -0.7)))
    (result,) = solve(COARSE, *noisy(together(COARSE, *truths), 25.0), THREE)
    assert result.status == "ok"
    assert errors_m(result, truths).max() < 0.1
    assert len(result.bic) == 4


@pytest.mark.parametrize("truth", [ball(), rod(), rod(pitch=0.0, roll=0.0)])
def test_one_target_stays_one(truth: Buried) -> None:
    field, sigma = noisy(clean_field_nt(COARSE, truth), 20.0, 30)
    results = solve(COARSE, field, sigma, THREE)
    assert [len(r.targets) for r in results] == [1] * 30
    assert all(np.argmin(r.bic) == 1 and len(r.bic) == 3 for r in results)


def test_noise_stays_none() -> None:
    field = np.random.default_rng(1).normal(size=(50, 1, len(COARSE.positions_m), 3))
    assert all(r.status == "no_target" for r in solve(COARSE, field, 1.0, THREE))


def test_the_strongest_at_the_surface_comes_first() -> None:
    near, far = ball((-0.8, 0.0, -0.6)), ball((0.8, 0.0, -1.2))
    (result,) = solve(COARSE, *noisy(together(COARSE, far, near), 30.0), Options(most_targets=2))
    assert [error_m(result, truth, i) < 0.2 for i, truth in enumerate((near, far))] == [True, True]


def test_two_targets_and_outliers_are_told_apart() -> None:
    clean = together(COARSE, ball((-0.6, 0.1, -0.9)), rod((0.6, -0.1, -0.8)))
    sigma = noise(clean, 25.0)
    rng = np.random.default_rng(3)
    field = clean + sigma * rng.normal(size=clean.shape)
    hit = rng.random(field.shape) < 0.01
    field[hit] += 20.0 * sigma * rng.choice([-1.0, 1.0], hit.sum())
    (result,) = solve(COARSE, field, sigma, THREE)
    assert (result.status, len(result.targets)) == ("ok", 2)
    assert abs(result.n_outliers - hit.sum()) <= 3
