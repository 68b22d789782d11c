from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2
from tests.services.emi.makers import (
    COARSE,
    DIPOLE,
    ball,
    error_m,
    noise,
    noisy,
    rod,
    same,
    solve,
)

from trackmesh.protocol.messages import EmiGeometry, EmiTransmitter
from trackmesh.services.emi.engine import CHUNK_SAMPLES, invert
from trackmesh.services.emi.fields import from_elements
from trackmesh.services.emi.polarizability import rotation
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import sensor_arrays
from trackmesh.services.emi.service.convert import to_coils
from trackmesh.services.emi.varpro import evaluate
from trackmesh.sim.emi import LOOP, Buried, clean_field_nt, grid_positions, join, survey_geometry


@pytest.mark.parametrize("transmitter", [LOOP, DIPOLE])
@pytest.mark.parametrize("truth", [ball(), rod()], ids=["sphere", "cylinder"])
def test_reaches_the_cramer_rao_bound_and_knows_its_own_error(transmitter: EmiTransmitter, truth: Buried) -> None:
    geometry, n = survey_geometry((4.0, 4.0), 0.1, transmitter=transmitter), 150
    field, sigma = noisy(clean_field_nt(geometry, truth), 20.0, n)
    results = solve(geometry, field, sigma)
    errors, nees = np.empty((n, 3)), np.empty(n)
    for i, result in enumerate(results):
        assert result.status == "ok"
        (target,) = result.targets
        error = np.concatenate([target.position_m, target.tensor_m3[0]])
        error -= np.concatenate([truth.position_m[0], truth.elements_m3[0]])
        errors[i], nees[i] = error[:3], error @ np.linalg.solve(target.covariance, error)
    assert 0.85 < np.sqrt((errors**2).sum(1).mean() / bound_m2(geometry, truth, sigma)) < 1.15
    assert 0.91 <= (nees < chi2.ppf(0.95, 9)).mean() <= 0.99
    p_values = np.array([r.p_value for r in results])
    assert 0.4 < p_values.mean() < 0.6
    assert 0.85 < np.mean([r.local_chi2 for r in results]) < 1.15


def bound_m2(geometry: EmiGeometry, truth: Buried, sigma_nt: float) -> float:
    """Trace of the Cramer-Rao bound of the position over the whole scan, background unknown."""
    sensor = sensor_arrays(to_coils(geometry), "const")
    n = len(geometry.positions_m)
    w = np.full((1, n, 3), 1e9 / sigma_nt)
    reduced = evaluate(sensor, np.zeros((1, n, 3)), w, np.arange(n), truth.position_m, truth.elements_m3[:, None])[0]
    order = [6, 7, 8, 0, 1, 2, 3, 4, 5]
    fisher = reduced[np.ix_(order, order)]
    scale = np.sqrt(np.diagonal(fisher))
    bound = np.linalg.inv(fisher / np.outer(scale, scale)) / np.outer(scale, scale)
    return float(np.trace(bound[:3, :3]))


def test_a_weak_target_is_seen_well_before_it_is_certain() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, ball()), -10.0, 40)
    results = solve(COARSE, field, sigma)
    statuses = Counter(r.status for r in results)
    assert statuses["no_target"] <= 2
    assert all("depth_uncertain" in r.reasons for r in results if r.status == "low_snr")


@pytest.mark.parametrize(("snr_db", "told"), [(0.0, True), (30.0, False)])
def test_a_covariance_that_is_too_small_is_told(snr_db: float, told: bool) -> None:
    field, sigma = noisy(clean_field_nt(COARSE, ball()), snr_db, 5)
    assert all(("covariance_optimistic" in r.reasons) == told for r in solve(COARSE, field, sigma))


def test_one_bad_scan_leaves_the_others_bit_for_bit() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 64)
    good = solve(COARSE, field, sigma)
    broken = field.copy()
    broken[40] = np.nan
    results = solve(COARSE, broken, sigma)
    assert results[40].status == "invalid"
    assert all(same(results[i], good[i]) for i in range(64) if i != 40)


@pytest.mark.parametrize("options", [Options(), Options(most_targets=2), Options(estimator="ekf9")])
@pytest.mark.parametrize("sigma_known", [True, False])
def test_results_do_not_depend_on_the_company_a_scan_keeps(sigma_known: bool, options: Options) -> None:
    geometry = survey_geometry((2.0, 2.0), 0.2)
    truths = [ball((0.0, 0.1, -0.7)), rod((0.2, -0.1, -0.6)), rod((0.0, 0.0, -0.8), 0.0, 90.0)]
    clean = clean_field_nt(geometry, join(truths * 30))
    field, sigma = clean + 0.1 * np.random.default_rng(6).normal(size=clean.shape), 0.1 if sigma_known else None
    assert len(field) > CHUNK_SAMPLES // len(geometry.positions_m) > 1
    whole = solve(geometry, field, sigma, options)
    backwards = solve(geometry, field[::-1], sigma, options)[::-1]
    alone = [solve(geometry, field[i : i + 1], sigma, options)[0] for i in range(0, len(field), 3)]
    assert [r.scan_index for r in whole] == list(range(len(field)))
    assert all(same(a, b) for a, b in zip(whole, backwards, strict=True))
    assert all(same(a, b) for a, b in zip(whole[::3], alone, strict=True))


def test_a_few_good_places_are_enough() -> None:
    geometry = EmiGeometry(positions_m=grid_positions((1.6, 1.6), 0.8), transmitter=LOOP)
    field, sigma = noisy(clean_field_nt(geometry, rod()), 50.0, 1)
    (result,) = solve(geometry, field, sigma)
    assert error_m(result, rod()) < 0.02


def test_a_dipole_near_its_coil_is_warned_of() -> None:
    geometry = survey_geometry((4.0, 4.0), 0.2, transmitter=DIPOLE)
    field, sigma = noisy(clean_field_nt(geometry, ball()), 20.0, 1)
    assert "dipole_transmitter_near" in solve(geometry, field, sigma)[0].reasons


def test_unknown_noise_is_estimated() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 20)
    estimated = np.array([r.sigma_t for r in solve(COARSE, field, None)])
    assert estimated.mean() == pytest.approx(1e-9 * sigma, rel=0.02)
    assert all(r.p_value is None for r in solve(COARSE, field[:2], None))


def test_noise_of_channels_that_differ_is_weighed() -> None:
    clean = np.concatenate([clean_field_nt(COARSE, rod()), clean_field_nt(COARSE, rod())], 1)
    sigma = noise(clean[:, :1], 20.0) * np.array([1.0, 30.0])[:, None, None]
    field = clean + sigma * np.random.default_rng(4).normal(size=(20, *clean.shape[1:]))
    known = solve(COARSE, field, sigma)
    guessed = solve(COARSE, field, None)
    rms = [np.sqrt(np.mean([error_m(r, rod()) ** 2 for r in rs])) for rs in (known, guessed)]
    assert rms[1] < 1.15 * rms[0]


def test_position_does_not_depend_on_the_unit_of_the_field() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 1)
    usual = solve(COARSE, field, sigma)[0].targets[0]
    for scale in (1e12, 1e-5):
        scaled = solve(COARSE, scale * field, scale * sigma)[0].targets[0]
        np.testing.assert_allclose(scaled.position_m, usual.position_m, atol=1e-8)
        np.testing.assert_allclose(scaled.tensor_m3, scale * usual.tensor_m3, rtol=1e-6)


def test_a_field_without_noise_has_finite_answers() -> None:
    (result,) = solve(COARSE, clean_field_nt(COARSE, rod()), None)
    assert result.status == "ok"
    assert error_m(result, rod()) < 1e-6
    numbers = [result.chi2, result.likelihood_ratio, result.sigma_t, result.targets[0].axis_sd_rad]
    assert np.isfinite([x for x in numbers if x is not None]).all()
    assert np.isfinite(result.targets[0].covariance).all()


def test_per_sample_noise_weighs_the_samples() -> None:
    truth = rod()
    clean = clean_field_nt(COARSE, truth)
    rng = np.random.default_rng(9)
    sigma = np.where(rng.random((len(COARSE.positions_m), 1)) < 0.3, 30.0, 1.0) * 0.02 * np.ones(3)
    field = clean + sigma * rng.normal(size=(30, *clean.shape[1:]))
    results = list(invert(to_coils(COARSE), 1e-9 * field, 1e-9 * sigma, Options(robust=False)))
    blind = solve(COARSE, field, float(sigma.mean()), Options(robust=False))
    rms = [np.sqrt(np.mean([error_m(r, truth) ** 2 for r in rs])) for rs in (results, blind)]
    assert rms[0] < 0.5 * rms[1]
    assert 0.3 < np.mean([r.p_value for r in results]) < 0.7


def test_a_prior_and_an_area_hold_the_search() -> None:
    truth = rod()
    field, sigma = noisy(clean_field_nt(COARSE, truth), 0.0, 1)
    (free,) = solve(COARSE, field, sigma)
    prior = np.array([truth.position_m[0], [1e-3, 1e-3, 1e-3]])
    (held,) = solve(COARSE, field, sigma, Options(prior_m=prior))
    assert error_m(held, truth) < 2e-3 < error_m(free, truth)
    assert np.sqrt(np.diagonal(held.targets[0].covariance)[:3]).max() < 1.1e-3
    (outside,) = solve(COARSE, field, sigma, Options(area_m=(0.5, 0.5, 1.5, 1.5)))
    assert outside.status == "edge"
    assert "at_search_bound" in outside.reasons
    assert (outside.targets[0].position_m[:2] >= 0.5).all()


def test_angles_and_axis_come_with_a_target() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod(pitch=30.0, roll=-20.0)), 20.0, 1)
    (target,) = solve(COARSE, field, sigma)[0].targets
    assert target.attitude.angles_rad == pytest.approx({"theta": np.deg2rad(30), "phi": np.deg2rad(-20)}, abs=0.05)
    assert target.shape == "axisymmetric"
    assert target.p_isotropic < 0.01 < target.p_axisymmetric
    (sphere,) = solve(COARSE, noisy(clean_field_nt(COARSE, ball()), 20.0, 1)[0], sigma)[0].targets
    assert sphere.axis is None
    assert sphere.attitude.undefined["theta"] == "isotropic"


@settings(max_examples=8, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_a_scan_that_is_turned_and_moved_has_its_target_turned_and_moved(yaw: float, east: float, north: float) -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 1)
    turn, shift = rotation(yaw, 0.0, 0.0).T, np.array([east, north, 3.0])
    moved = COARSE.model_copy(update={"positions_m": COARSE.positions_m @ turn.T + shift})
    (usual,), (other,) = solve(COARSE, field, sigma)[0].targets, solve(moved, field @ turn.T, sigma)[0].targets
    np.testing.assert_allclose(other.position_m, turn @ usual.position_m + shift, atol=2e-4)
    np.testing.assert_allclose(
        from_elements(other.tensor_m3[0]), turn @ from_elements(usual.tensor_m3[0]) @ turn.T, atol=2e-4
    )
    np.testing.assert_allclose(other.principal_m3, usual.principal_m3, rtol=5e-3)
    assert other.axis is not None and usual.axis is not None
    assert abs(other.axis @ turn @ usual.axis) == pytest.approx(1.0, abs=1e-4)


def test_numerics_and_engine_know_no_clock_no_network_no_messages() -> None:
    banned = {"time", "datetime", "logging", "pydantic", "socket", "threading", "zenoh"}
    room = Path(__file__).resolve().parents[3] / "src/trackmesh/services/emi"
    for path in (*room.glob("*.py"), *room.glob("estimators/*.py"), *room.glob("diagnosis/*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            assert not {name.split(".")[0] for name in names} & banned, path
            assert not any(name.startswith(("trackmesh.protocol", "trackmesh.services.runtime")) for name in names), (
                path
            )
