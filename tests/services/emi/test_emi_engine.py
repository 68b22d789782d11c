from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.stats import chi2

from trackmesh.protocol.messages import EmiGeometry, EmiTransmitter
from trackmesh.services.emi.convert import to_coils
from trackmesh.services.emi.engine import CHUNK_SAMPLES, Options, invert, sensor_arrays
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.results import ScanResult
from trackmesh.services.emi.varpro import evaluate
from trackmesh.sim.emi import (
    LOOP,
    Buried,
    bury,
    clean_field_nt,
    grid_positions,
    join,
    principal_polarizability,
    survey_geometry,
)

COARSE = survey_geometry((4.0, 4.0), 0.2)
DIPOLE = EmiTransmitter(model="dipole", radius_m=0.5, current_a=20.0)


def rod(place: tuple[float, float, float] = (0.1, -0.2, -1.0), pitch: float = 45.0, roll: float = 45.0) -> Buried:
    across, along = principal_polarizability("cylinder")
    return bury("cylinder", (across, across, along), np.array(place), np.deg2rad(pitch), np.deg2rad(roll))


def ball(place: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> Buried:
    value, _ = principal_polarizability("sphere")
    return bury("sphere", (value, value, value), np.array(place), 0.0, 0.0)


def noisy(field: FloatArray, snr_db: float, n: int, seed: int = 1) -> tuple[FloatArray, float]:
    """``n`` draws of one clean scan (1, C, W, K), and their sigma."""
    sigma = float(np.sqrt((field**2).mean())) * 10 ** (-snr_db / 20)
    return field + sigma * np.random.default_rng(seed).normal(size=(n, *field.shape[1:])), sigma


def solve(
    geometry: EmiGeometry, field_nt: FloatArray, sigma_nt: float | None, options: Options | None = None
) -> list[ScanResult]:
    sigma_t = None if sigma_nt is None else 1e-9 * sigma_nt
    return list(invert(to_coils(geometry), 1e-9 * field_nt, sigma_t, options or Options()))


def same(a: ScanResult, b: ScanResult) -> bool:
    """Bit for bit, but for the index."""
    if (a.target is None) != (b.target is None) or a._replace(scan_index=0, target=None) != b._replace(
        scan_index=0, target=None
    ):
        return False
    if a.target is None or b.target is None:
        return True
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in zip(a.target, b.target, strict=True))


def error_m(result: ScanResult, truth: Buried) -> float:
    assert result.target is not None
    return float(np.linalg.norm(result.target.position_m - truth.position_m[0]))


@pytest.mark.parametrize("transmitter", [LOOP, DIPOLE])
@pytest.mark.parametrize("truth", [ball(), rod()], ids=["sphere", "cylinder"])
def test_reaches_the_cramer_rao_bound_and_knows_its_own_error(transmitter: EmiTransmitter, truth: Buried) -> None:
    geometry, n = survey_geometry((4.0, 4.0), 0.1, transmitter=transmitter), 150
    field, sigma = noisy(clean_field_nt(geometry, truth), 20.0, n)
    results = solve(geometry, field, sigma)
    errors, nees = np.empty((n, 3)), np.empty(n)
    for i, result in enumerate(results):
        assert result.status == "ok"
        target = result.target
        assert target is not None
        error = np.concatenate([target.position_m, target.tensor_m3[0]])
        error -= np.concatenate([truth.position_m[0], truth.elements_m3[0]])
        errors[i], nees[i] = error[:3], error @ np.linalg.solve(target.covariance, error)
    assert 0.85 < np.sqrt((errors**2).sum(1).mean() / bound_m2(geometry, truth, sigma)) < 1.15
    assert 0.91 <= (nees < chi2.ppf(0.95, 9)).mean() <= 0.99
    p_values = np.array([r.p_value for r in results])
    assert 0.4 < p_values.mean() < 0.6


def bound_m2(geometry: EmiGeometry, truth: Buried, sigma_nt: float) -> float:
    """Trace of the Cramer-Rao bound of the position over the whole scan, background unknown."""
    sensor = sensor_arrays(to_coils(geometry), "const")
    n = len(geometry.positions_m)
    w = np.full((1, n, 3), 1e9 / sigma_nt)
    reduced = evaluate(sensor, np.zeros((1, n, 3)), w, np.arange(n), truth.position_m[0], truth.elements_m3)[0]
    order = [6, 7, 8, 0, 1, 2, 3, 4, 5]
    fisher = reduced[np.ix_(order, order)]
    scale = np.sqrt(np.diagonal(fisher))
    bound = np.linalg.inv(fisher / np.outer(scale, scale)) / np.outer(scale, scale)
    return float(np.trace(bound[:3, :3]))


@pytest.mark.parametrize("sigma_known", [True, False])
def test_noise_alone_is_no_target(sigma_known: bool) -> None:
    n = len(COARSE.positions_m)
    field = np.random.default_rng(4).normal(size=(200, 1, n, 3))
    results = solve(COARSE, field, 1.0 if sigma_known else None)
    assert sum(r.status != "no_target" for r in results) < 2
    assert all(r.target is None for r in results if r.status == "no_target")


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
    field, sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 8)
    good = solve(COARSE, field, sigma)
    broken = field.copy()
    broken[3] = np.nan
    broken[5, 0, :, 1] = np.inf
    broken[6, 0, ::10] = np.nan
    broken[7] = 0.0
    results = solve(COARSE, broken, sigma)
    assert [r.status for r in results] == ["ok"] * 3 + ["invalid", "ok", "invalid", "ok", "no_target"]
    assert results[6].n_masked == 45
    assert "masked_samples" in results[6].reasons
    assert all(same(results[i], good[i]) for i in (0, 1, 2, 4))


@pytest.mark.parametrize("sigma_known", [True, False])
def test_results_do_not_depend_on_the_company_a_scan_keeps(sigma_known: bool) -> None:
    geometry = survey_geometry((2.0, 2.0), 0.2)
    truths = [ball((0.0, 0.1, -0.7)), rod((0.2, -0.1, -0.6)), rod((0.0, 0.0, -0.8), 0.0, 90.0)]
    clean = clean_field_nt(geometry, join(truths * 40))
    field, sigma = clean + 0.1 * np.random.default_rng(6).normal(size=clean.shape), 0.1 if sigma_known else None
    assert len(field) > CHUNK_SAMPLES // len(geometry.positions_m) > 1
    together = solve(geometry, field, sigma)
    backwards = solve(geometry, field[::-1], sigma)[::-1]
    alone = [solve(geometry, field[i : i + 1], sigma)[0] for i in range(len(field))]
    assert [r.scan_index for r in together] == list(range(len(field)))
    assert all(same(a, b) and same(a, c) for a, b, c in zip(together, backwards, alone, strict=True))


@pytest.mark.parametrize(
    ("places", "reason"),
    [
        (grid_positions((4.0, 4.0), 0.2)[[220]], "too_few_places"),
        (grid_positions((4.0, 4.0), 0.2)[[200, 220, 245]], "too_few_places"),
        (np.repeat(grid_positions((4.0, 4.0), 0.2)[[220]], 50, axis=0), "too_few_places"),
        (grid_positions((4.0, 0.0), 0.1), "collinear"),
        (grid_positions((4.0, 4.0), 0.2)[[200, 220, 245, 180]], "too_few_samples"),
    ],
)
def test_too_little_geometry_is_underdetermined(places: FloatArray, reason: str) -> None:
    geometry = EmiGeometry(positions_m=places, transmitter=LOOP)
    field, sigma = noisy(clean_field_nt(geometry, rod()), 20.0, 2)
    for result in solve(geometry, field, sigma):
        assert (result.status, result.reasons, result.target) == ("underdetermined", (reason,), None)


def test_a_few_good_places_are_enough() -> None:
    places = grid_positions((1.6, 1.6), 0.8)
    geometry = EmiGeometry(positions_m=places, transmitter=LOOP)
    truth = rod()
    field, sigma = noisy(clean_field_nt(geometry, truth), 50.0, 1)
    (result,) = solve(geometry, field, sigma)
    assert error_m(result, truth) < 0.02


def test_a_spike_and_outliers_are_weighed_down() -> None:
    truth = rod((0.1, -0.2, -1.0))
    field, sigma = noisy(clean_field_nt(COARSE, truth), 20.0, 2)
    field[0, 0, 17, 2] += 1000.0 * np.abs(field).max()
    rng = np.random.default_rng(8)
    hit = rng.random(field[1].shape) < 0.01
    field[1, hit] += 20.0 * sigma * rng.choice([-1.0, 1.0], hit.sum())
    results = solve(COARSE, field, sigma)
    for result in results:
        assert "outliers" in result.reasons
        assert error_m(result, truth) < 0.05
    assert results[0].n_outliers == 1
    assert abs(results[1].n_outliers - hit.sum()) <= 2
    plain = solve(COARSE, field[:1], sigma, Options(robust=False))[0]
    assert plain.target is None or error_m(plain, truth) > 0.2


@pytest.mark.parametrize(("background", "limit_m"), [("none", None), ("const", 0.05), ("plane", 0.05)])
def test_an_offset_of_the_detector_is_taken_off(background: str, limit_m: float | None) -> None:
    truth = ball((0.1, -0.2, -1.0))
    field, sigma = noisy(clean_field_nt(COARSE, truth), 20.0, 1)
    field[..., 2] += 5.0 * sigma
    options = Options(background=background, robust=False)  # type: ignore[arg-type]
    (result,) = solve(COARSE, field, sigma, options)
    if limit_m is None:
        assert "misfit" in result.reasons
        assert error_m(result, truth) > 0.1
    else:
        assert error_m(result, truth) < limit_m


def test_a_second_target_shows_as_a_misfit_and_widens_the_covariance() -> None:
    two = clean_field_nt(COARSE, ball((-0.5, 0.0, -0.8))) + clean_field_nt(COARSE, rod((0.6, 0.2, -0.9)))
    field, sigma = noisy(two, 30.0, 1)
    (result,) = solve(COARSE, field, sigma, Options(robust=False))
    assert result.status == "multiple_or_mismatch"
    assert result.p_value is not None and result.p_value < 1e-6
    assert result.target is not None


def test_a_target_outside_is_found_near_the_rim_and_marked_further_out() -> None:
    for x, status in ((2.3, "ok"), (3.2, "edge")):
        truth = ball((x, 0.0, -1.0))
        field, sigma = noisy(clean_field_nt(COARSE, truth), 30.0, 1)
        (result,) = solve(COARSE, field, sigma)
        assert result.status == status
        assert error_m(result, truth) < 0.3


def test_a_dipole_near_its_coil_is_warned_of() -> None:
    geometry = survey_geometry((4.0, 4.0), 0.2, transmitter=DIPOLE)
    field, sigma = noisy(clean_field_nt(geometry, ball()), 20.0, 1)
    assert "dipole_transmitter_near" in solve(geometry, field, sigma)[0].reasons


def test_unknown_noise_is_estimated() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 20)
    estimated = np.array([r.sigma_t for r in solve(COARSE, field, None)])
    assert estimated.mean() == pytest.approx(1e-9 * sigma, rel=0.02)
    assert all(r.p_value is None for r in solve(COARSE, field[:2], None))


def test_position_does_not_depend_on_the_unit_of_the_field() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 1)
    usual = solve(COARSE, field, sigma)[0].target
    huge = solve(COARSE, 1e12 * field, 1e12 * sigma)[0].target
    assert usual is not None and huge is not None
    np.testing.assert_allclose(huge.position_m, usual.position_m, atol=1e-8)
    np.testing.assert_allclose(huge.tensor_m3, 1e12 * usual.tensor_m3, rtol=1e-6)


@pytest.mark.parametrize("sigma", [None, 1.0])
@pytest.mark.parametrize("level", [1.0, 1e9, -0.1])
def test_a_stuck_sensor_sees_no_target(level: float, sigma: float | None) -> None:
    field = np.full((1, 1, len(COARSE.positions_m), 3), level)
    field[..., 2] *= 3.0
    assert solve(COARSE, field, sigma)[0].status == "no_target"


def test_a_field_without_noise_has_finite_answers() -> None:
    (result,) = solve(COARSE, clean_field_nt(COARSE, rod()), None)
    assert result.status == "ok"
    assert error_m(result, rod()) < 1e-6
    assert result.target is not None
    numbers = [result.chi2, result.likelihood_ratio, result.sigma_t, result.target.axis_sd_rad]
    assert np.isfinite([x for x in numbers if x is not None]).all()
    assert np.isfinite(result.target.covariance).all()


def test_numbers_beyond_reason_are_invalid_and_not_a_crash() -> None:
    field = 1e300 * np.random.default_rng(1).normal(size=(3, 1, len(COARSE.positions_m), 3))
    field[1], sigma = noisy(clean_field_nt(COARSE, rod()), 20.0, 1)
    statuses = [r.status for r in solve(COARSE, field, sigma)]
    assert statuses == ["invalid", "ok", "invalid"]


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
