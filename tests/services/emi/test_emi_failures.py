"""What can be wrong with a scan, one test a kind: what is answered instead of a confident wrong place."""

from __future__ import annotations

import numpy as np
import pytest
from tests.services.emi.makers import COARSE, FINE, ball, error_m, noise, noisy, rod, same, solve, together

from trackmesh.protocol.messages import EmiGeometry
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import Background
from trackmesh.services.emi.service.convert import to_coils
from trackmesh.sim.emi import LOOP, clean_field_nt, grid_positions

TRUTH = rod()
BACKGROUNDS: tuple[Background, ...] = ("none", "const", "plane")
CLEAN = clean_field_nt(COARSE, TRUTH)
SIGMA = noise(CLEAN, 20.0)


def scan(seed: int = 1) -> FloatArray:
    """One draw at 20 dB."""
    return noisy(CLEAN, 20.0, 1, seed)[0]


def sd_m(result: object) -> float:
    """Standard deviation of the position of the only target."""
    (target,) = result.targets  # type: ignore[attr-defined]
    return float(np.sqrt(np.trace(target.covariance[:3, :3])))


def test_missing_numbers_are_masked_and_counted() -> None:
    field = scan()
    field[0, 0, 7, 1], field[0, 0, 99, 0] = np.nan, -np.inf
    (result,) = solve(COARSE, field, SIGMA)
    assert (result.status, result.reasons, result.n_masked) == ("ok", ("masked_samples",), 2)
    assert error_m(result, TRUTH) < 0.03


def test_a_scan_mostly_missing_is_invalid() -> None:
    field = scan()
    field[0, 0, : int(0.6 * field.shape[2])] = np.nan
    (result,) = solve(COARSE, field, SIGMA)
    assert (result.status, result.reasons, result.targets) == ("invalid", ("not_finite",), ())


def test_a_position_that_is_no_number_makes_its_scans_invalid() -> None:
    coils = to_coils(COARSE)
    positions = coils.positions_m.copy()
    positions[3, 1] = np.nan
    (result,) = solve(coils._replace(positions_m=positions), scan(), SIGMA)
    assert (result.status, result.reasons) == ("invalid", ("position_not_finite",))


def test_numbers_beyond_reason_are_invalid_and_not_a_crash() -> None:
    field = 1e300 * np.random.default_rng(1).normal(size=(3, 1, len(COARSE.positions_m), 3))
    field[1] = scan()[0]
    assert [r.status for r in solve(COARSE, field, SIGMA)] == ["invalid", "ok", "invalid"]


def test_zeros_hold_no_target() -> None:
    (result,) = solve(COARSE, np.zeros_like(scan()), SIGMA)
    assert (result.status, result.reasons, result.targets) == ("no_target", ("zero_field",), ())


@pytest.mark.parametrize("sigma", [None, 1.0])
@pytest.mark.parametrize("level", [1.0, 1e9, -0.1])
def test_a_stuck_sensor_sees_no_target(level: float, sigma: float | None) -> None:
    field = np.full((1, 1, len(COARSE.positions_m), 3), level)
    field[..., 2] *= 3.0
    assert solve(COARSE, field, sigma)[0].status == "no_target"


@pytest.mark.parametrize("sigma_known", [True, False])
def test_noise_alone_is_no_target_and_sets_a_limit(sigma_known: bool) -> None:
    field = np.random.default_rng(4).normal(size=(200, 1, len(COARSE.positions_m), 3))
    results = solve(COARSE, field, 1.0 if sigma_known else None)
    empty = [r for r in results if r.status == "no_target"]
    assert len(empty) > 198
    assert all(r.targets == () and r.limit is not None for r in empty)
    # A sphere as strong as the limit says is seen.
    limit = empty[0].limit
    assert limit is not None
    depth, strength = float(limit.depth_m[1]), float(limit.polarizability_m3[1])
    body = ball((0.0, 0.0, -depth))
    weak = body._replace(tensor_m3=np.eye(3)[None] * strength)
    seen = solve(COARSE, clean_field_nt(COARSE, weak) + field[:40], 1.0 if sigma_known else None)
    assert sum(r.status != "no_target" for r in seen) >= 32


def test_one_spike_is_cut() -> None:
    field = scan()
    field[0, 0, 17, 2] += 1000.0 * np.abs(field).max()
    (result,) = solve(COARSE, field, SIGMA)
    (clean,) = solve(COARSE, scan(), SIGMA)
    assert (result.status, result.reasons, result.n_outliers) == ("ok", ("outliers",), 1)
    assert error_m(result, TRUTH) < error_m(clean, TRUTH) + 0.003
    plain = solve(COARSE, field, SIGMA, Options(robust=False))[0]
    assert plain.status != "ok"


def test_a_hundredth_of_outliers_is_weighed_down() -> None:
    field = scan()
    rng = np.random.default_rng(8)
    hit = rng.random(field.shape) < 0.01
    field[hit] += 20.0 * SIGMA * rng.choice([-1.0, 1.0], hit.sum())
    (result,) = solve(COARSE, field, SIGMA)
    assert (result.status, result.reasons) == ("ok", ("outliers",))
    assert abs(result.n_outliers - hit.sum()) <= 2
    assert error_m(result, TRUTH) < 0.03


@pytest.mark.parametrize("n", [1, 2, 3])
def test_one_to_three_samples_determine_nothing(n: int) -> None:
    chosen = [200, 220, 245][:n]
    geometry = EmiGeometry(positions_m=COARSE.positions_m[chosen], transmitter=LOOP)
    (result,) = solve(geometry, scan()[:, :, chosen], SIGMA)
    assert (result.status, result.reasons, result.targets) == ("underdetermined", ("too_few_places",), ())


def test_four_samples_have_no_number_to_spare_for_a_background() -> None:
    chosen = [200, 220, 245, 180]
    geometry = EmiGeometry(positions_m=COARSE.positions_m[chosen], transmitter=LOOP)
    (result,) = solve(geometry, scan()[:, :, chosen], SIGMA)
    assert (result.status, result.reasons) == ("underdetermined", ("too_few_samples",))


def test_one_place_again_and_again_determines_nothing() -> None:
    places = np.repeat(COARSE.positions_m[[220]], 50, axis=0)
    field = noisy(clean_field_nt(EmiGeometry(positions_m=places, transmitter=LOOP), TRUTH), 20.0)[0]
    (result,) = solve(EmiGeometry(positions_m=places, transmitter=LOOP), field, SIGMA)
    assert (result.status, result.reasons) == ("underdetermined", ("too_few_places",))


def test_every_sample_twice_is_the_same_place_with_more_trust() -> None:
    twice = EmiGeometry(positions_m=np.repeat(COARSE.positions_m, 2, axis=0), transmitter=LOOP)
    (one,), (two,) = solve(COARSE, scan(), SIGMA), solve(twice, np.repeat(scan(), 2, axis=2), SIGMA)
    assert two.status == "ok"
    np.testing.assert_allclose(two.targets[0].position_m, one.targets[0].position_m, atol=1e-3)
    assert sd_m(two) == pytest.approx(sd_m(one) / np.sqrt(2.0), rel=0.05)
    # Averaged in cells it shows that their noise is the same.
    (averaged,) = solve(twice, np.repeat(scan(), 2, axis=2), SIGMA, Options(block_m=0.05))
    np.testing.assert_allclose(averaged.targets[0].position_m, two.targets[0].position_m, atol=1e-3)
    assert "misfit" in averaged.reasons
    assert sd_m(averaged) == pytest.approx(sd_m(one), rel=0.05)


@pytest.mark.parametrize("y", [0.0, -0.2])
def test_one_line_is_told_to_be_one(y: float) -> None:
    positions = grid_positions((4.0, 0.0), 0.1) + np.array([0.0, y, 0.0])
    geometry = EmiGeometry(positions_m=positions, transmitter=LOOP)
    field, sigma = noisy(clean_field_nt(geometry, TRUTH), 20.0, 1)
    (result,) = solve(geometry, field, sigma)
    assert result.status == "underdetermined"
    assert "collinear" in result.reasons


def test_two_lines_are_enough() -> None:
    line = grid_positions((4.0, 0.0), 0.1)
    positions = np.concatenate([line + np.array([0.0, y, 0.0]) for y in (-0.3, 0.3)])
    geometry = EmiGeometry(positions_m=positions, transmitter=LOOP)
    (result,) = solve(geometry, *noisy(clean_field_nt(geometry, TRUTH), 20.0, 1))
    assert result.status == "ok"
    assert error_m(result, TRUTH) < 0.1


@pytest.mark.parametrize(
    ("beyond_m", "statuses"),
    [(0.3, {"ok"}), (1.0, {"edge", "low_snr"}), (2.0, {"edge", "no_target"}), (5.0, {"no_target"})],
)
def test_a_target_outside_is_found_near_the_rim_and_marked_further_out(beyond_m: float, statuses: set[str]) -> None:
    truth = ball((2.0 + beyond_m, -0.2, -1.0))
    field = clean_field_nt(COARSE, truth) + SIGMA * np.random.default_rng(3).normal(size=(10, *CLEAN.shape[1:]))
    results = solve(COARSE, field, SIGMA)
    assert {r.status for r in results} <= statuses
    if beyond_m < 1.0:
        assert max(error_m(r, truth) for r in results) < 0.2


def test_positions_in_millimetres_are_no_positions() -> None:
    coils = to_coils(COARSE)
    (result,) = solve(coils._replace(positions_m=1e3 * coils.positions_m), scan(), SIGMA)
    assert (result.status, result.reasons) == ("invalid", ("spacing",))


@pytest.mark.parametrize("scale", [1e-14, 1e-9, 1.0, 1e9])
def test_the_scale_of_the_field_does_not_matter(scale: float) -> None:
    (usual,), (scaled,) = solve(COARSE, scan(), None), solve(COARSE, scale * scan(), None)
    assert scaled.status == "ok"
    np.testing.assert_allclose(scaled.targets[0].position_m, usual.targets[0].position_m, atol=1e-6)


def test_a_target_on_the_other_side_is_a_mismatch_unless_it_is_looked_for() -> None:
    above = rod((0.1, -0.2, 1.0))
    field, sigma = noisy(clean_field_nt(COARSE, above), 20.0)
    (wrong,) = solve(COARSE, field, sigma)
    assert wrong.status in ("multiple_or_mismatch", "edge")
    assert "misfit" in wrong.reasons
    (right,) = solve(COARSE, field, sigma, Options(side="unknown"))
    assert right.status == "ok"
    assert error_m(right, above) < 0.03


@pytest.mark.parametrize(
    ("disturbance", "good"),
    [("offset 5", ("const", "plane")), ("offset 50", ("const", "plane")), ("drift 10", ("plane",))],
)
def test_offset_and_drift_of_the_detector_are_taken_off(disturbance: str, good: tuple[str, ...]) -> None:
    kind, size = disturbance.split()
    shape = np.ones(len(COARSE.positions_m)) if kind == "offset" else COARSE.positions_m[:, 0] / 2.0
    field = scan()
    field[..., 2] += float(size) * SIGMA * shape
    for background in BACKGROUNDS:
        (result,) = solve(COARSE, field, SIGMA, Options(background=background, robust=False))
        if background in good:
            assert result.status == "ok"
            assert error_m(result, TRUTH) < 0.03
        else:
            assert result.status != "ok"


def test_places_that_are_not_exact_widen_the_covariance() -> None:
    rng = np.random.default_rng(5)
    positions = FINE.positions_m + 0.01 * rng.normal(size=FINE.positions_m.shape)
    moved = FINE.model_copy(update={"positions_m": positions})
    field, sigma = noisy(clean_field_nt(moved, TRUTH), 30.0)
    (result,), (exact,) = solve(FINE, field, sigma), solve(moved, field, sigma)
    assert result.status == "multiple_or_mismatch"
    assert "misfit_near_target" in result.reasons
    assert error_m(result, TRUTH) < 4.0 * sd_m(result)
    assert sd_m(result) > 3.0 * sd_m(exact)
    assert exact.status == "ok"


def test_coils_that_tilt_are_a_mismatch_unless_the_tilt_is_told() -> None:
    rng = np.random.default_rng(6)
    tilt = np.deg2rad(5.0) * rng.normal(size=(len(FINE.positions_m), 2))
    axes = np.stack([rotation(0.0, *angles)[:, 2] for angles in tilt])
    tilted = FINE.model_copy(update={"axes": axes})
    field, sigma = noisy(clean_field_nt(tilted, TRUTH), 30.0)
    (blind,), (told,) = solve(FINE, field, sigma), solve(tilted, field, sigma)
    assert blind.status == "multiple_or_mismatch"
    assert error_m(blind, TRUTH) < 4.0 * sd_m(blind)
    assert sd_m(blind) > 1.5 * sd_m(told)
    assert told.status == "ok"
    assert error_m(told, TRUTH) < 0.01


def test_a_very_large_scan_is_averaged_and_just_as_good() -> None:
    positions = grid_positions((4.0, 4.0), 0.02)
    geometry = EmiGeometry(positions_m=positions, transmitter=LOOP)
    assert len(positions) > 40_000
    field, sigma = noisy(clean_field_nt(geometry, TRUTH), 0.0)
    (result,) = solve(geometry, field, sigma)
    assert result.status == "ok"
    assert result.n_used < 15_000
    assert error_m(result, TRUTH) < 4.0 * sd_m(result) < 0.06


def test_a_weak_target_is_told_to_be_uncertain() -> None:
    field, sigma = noisy(clean_field_nt(COARSE, rod((0.1, -0.2, -1.5))), -13.0, 20)
    results = solve(COARSE, field, sigma)
    low = [r for r in results if r.status == "low_snr"]
    assert low
    assert all("depth_uncertain" in r.reasons for r in low)
    assert all(abs(r.targets[0].depth_m) <= 8.0 * np.sqrt(2.0) for r in results if r.targets)


def test_a_second_target_shows_as_a_mismatch_even_if_outliers_are_looked_for() -> None:
    field, sigma = noisy(together(COARSE, ball((-0.5, 0.0, -0.8)), rod((0.6, 0.2, -0.9))), 30.0)
    for robust in (True, False):
        (result,) = solve(COARSE, field, sigma, Options(robust=robust))
        assert result.status == "multiple_or_mismatch"
        assert result.p_value is not None and result.p_value < 1e-6
        assert result.n_outliers == 0
        assert result.targets[0].inflation > 1.5


def test_a_bad_scan_spoils_no_other() -> None:
    field = np.concatenate([scan(seed) for seed in range(8)])
    good = solve(COARSE, field, SIGMA)
    broken = field.copy()
    broken[3] = np.nan
    broken[5, 0, :, 1] = np.inf
    broken[6, 0, ::10] = np.nan
    broken[7] = 0.0
    results = solve(COARSE, broken, SIGMA)
    assert [r.status for r in results] == ["ok"] * 3 + ["invalid", "ok", "invalid", "ok", "no_target"]
    assert results[6].n_masked == 45
    assert all(same(results[i], good[i]) for i in (0, 1, 2, 4))
