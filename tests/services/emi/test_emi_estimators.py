from __future__ import annotations

import numpy as np
import pytest
from benchmarks.peer_kf_ekf import joint_ekf, separate_kf_ekf
from tests.services.emi.makers import COARSE, DIPOLE, TENSOR, ball, coils, error_m, field_t, noisy, rod, solve

from trackmesh.services.emi.estimators import ESTIMATORS
from trackmesh.services.emi.fields import to_elements
from trackmesh.services.emi.polarizability import from_thesis_beta, rotation, world_tensor
from trackmesh.services.emi.recursive import joint_filter, scalar_update, separate_filters
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import sensor_arrays
from trackmesh.sim.emi import Buried, bury, clean_field_nt, survey_geometry

THESIS = survey_geometry((4.0, 4.0), 0.1, transmitter=DIPOLE)
# Principal values beta of the thesis's own bodies, by the volume: its axial time constant is 3 L tau.
ROD_BETA = np.array([0.6542, 0.6542, 0.2731]) * np.pi * 0.2**2 * 0.8


def thesis_rod(pitch_deg: float, roll_deg: float) -> Buried:
    across, _, along = (from_thesis_beta(beta) for beta in ROD_BETA)
    principal = (across.real, across.real, along.real)
    return bury("rod", principal, np.array([0.0, 0.0, -1.0]), np.deg2rad(pitch_deg), np.deg2rad(roll_deg))


def mean_error(estimator: str, truth: Buried, snr_db: float, n: int = 12) -> tuple[float, float, float]:
    """Mean horizontal and vertical error and mean error, in cm."""
    field, sigma = noisy(clean_field_nt(THESIS, truth), snr_db, n, seed=11)
    options = Options(estimator=estimator, background="none")  # type: ignore[arg-type]
    places = np.array([r.targets[0].position_m for r in solve(THESIS, field, sigma, options)])
    e = 100.0 * (places - truth.position_m[0])
    return (
        float(np.hypot(e[:, 0], e[:, 1]).mean()),
        float(np.abs(e[:, 2]).mean()),
        float(np.linalg.norm(e, axis=1).mean()),
    )


def test_scalar_updates_are_one_of_a_vector() -> None:
    rng = np.random.default_rng(1)
    root, h, x, z = rng.normal(size=(5, 5)), rng.normal(size=(3, 5)), rng.normal(size=5), rng.normal(size=3)
    P = root @ root.T
    K = P @ h.T @ np.linalg.inv(h @ P @ h.T + np.eye(3))
    want_x, want_P = x + K @ (z - h @ x), P - K @ h @ P
    for row, number in zip(h, z, strict=True):
        scalar_update(x, P, row, float(number - row @ x))
    np.testing.assert_allclose(x, want_x, rtol=1e-10)
    np.testing.assert_allclose(P, want_P, rtol=1e-8, atol=1e-10)


def test_filters_are_those_in_plain_numpy() -> None:
    c = coils(is_loop=False, n=9, spacing_m=0.4)._replace(moment_am2=1e7 * 4.0 * np.pi)
    sensor = sensor_arrays(c, "none")
    y = field_t(c, np.array([0.1, -0.2, -1.0]), TENSOR)
    y = y + 0.01 * np.abs(y).max() * np.random.default_rng(2).normal(size=y.shape)
    r, m = np.array([0.0, 0.0, -1.1]), 0.8 * to_elements(TENSOR)
    ours_r, ours_m = separate_filters(sensor, y, np.ones_like(y), r, m[None].copy(), 10.0, 1e-8)
    theirs_r, theirs_m = separate_kf_ekf(c.positions_m, y[0], r, m, 10.0, 1e-8)
    np.testing.assert_allclose(ours_r, theirs_r, rtol=1e-6)
    np.testing.assert_allclose(ours_m[0], theirs_m, rtol=1e-6)
    ours, P = joint_filter(sensor, y, np.ones_like(y), np.concatenate([r, m]), 10.0 * np.eye(9))
    theirs, want = joint_ekf(c.positions_m, y[0], np.concatenate([r, m]), 10.0 * np.eye(9))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    np.testing.assert_allclose(P, want, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("snr_db", "horizontal_cm"), [(10.0, 0.78), (20.0, 0.36), (30.0, 0.14)])
def test_initial_horizontal_error_of_a_sphere_is_the_known_one(snr_db: float, horizontal_cm: float) -> None:
    assert mean_error("initial", ball(), snr_db, 60)[0] == pytest.approx(horizontal_cm, rel=0.15)


def test_initial_errors_of_a_rod_are_the_known_ones() -> None:
    # Pitch 0 to 90 degrees at no roll.
    for pitch, horizontal_cm in ((15, 4.6), (30, 7.6), (45, 8.0), (60, 6.4), (75, 3.5)):
        assert mean_error("initial", thesis_rod(pitch, 0.0), 20.0)[0] == pytest.approx(horizontal_cm, rel=0.15)
    assert mean_error("initial", ball(), 20.0)[1] == pytest.approx(6.3, rel=0.05)
    assert 9.7 / 1.15 < mean_error("initial", thesis_rod(0.0, 90.0), 20.0)[1] < 10.9 * 1.15
    assert mean_error("initial", thesis_rod(0.0, 0.0), 20.0)[1] == pytest.approx(31.5, rel=0.15)


@pytest.mark.parametrize(
    ("truth", "snr_db", "error_cm"),
    [
        (ball(), 10.0, 5.8),
        (ball(), 20.0, 5.2),
        (ball(), 40.0, 5.2),
        (thesis_rod(45.0, 45.0), 20.0, 7.95),
        (thesis_rod(90.0, 0.0), 20.0, 7.95),
        (thesis_rod(0.0, 0.0), 20.0, 27.0),
    ],
)
def test_the_filter_pair_of_the_thesis_stays_where_it_is_known_to_stay(
    truth: Buried, snr_db: float, error_cm: float
) -> None:
    assert mean_error("kf-ekf-thesis", truth, snr_db)[2] == pytest.approx(error_cm, rel=0.15)


@pytest.mark.parametrize("truth", [ball(), thesis_rod(45.0, 45.0), thesis_rod(90.0, 0.0)])
def test_the_default_does_what_the_thesis_claims(truth: Buried) -> None:
    field, sigma = noisy(clean_field_nt(THESIS, truth), 20.0, 20)
    results = solve(THESIS, field, sigma, Options(background="none"))
    targets = [r.targets[0] for r in results]
    assert np.mean([error_m(r, truth) for r in results]) < 0.02
    strength = [np.linalg.norm(t.tensor_m3[0] - truth.elements_m3[0]) for t in targets]
    assert np.mean(strength) < 0.04 * np.linalg.norm(truth.elements_m3[0])


@pytest.mark.parametrize("background", ["none", "const", "plane"])
def test_the_joint_filter_comes_near_to_least_squares(background: str) -> None:
    truth = rod()
    field, sigma = noisy(clean_field_nt(COARSE, truth), 20.0, 20)
    if background != "none":
        field[..., 2] += 5.0 * sigma
    rms = {}
    for estimator in ("varpro", "ekf9"):
        options = Options(estimator=estimator, background=background)  # type: ignore[arg-type]
        results = solve(COARSE, field, sigma, options)
        rms[estimator] = np.sqrt(np.mean([error_m(r, truth) ** 2 for r in results]))
    assert rms["ekf9"] < 1.5 * rms["varpro"]


@pytest.mark.parametrize("estimator", ["initial", "kf-ekf-thesis", "ekf9"])
def test_what_is_no_least_squares_says_how_far_from_it_it_is(estimator: str) -> None:
    truth = rod()
    field, sigma = noisy(clean_field_nt(COARSE, truth), 30.0, 20)
    results = solve(COARSE, field, sigma, Options(estimator=estimator))  # type: ignore[arg-type]
    targets = [r.targets[0] for r in results]
    sd = [np.sqrt(np.trace(t.covariance[:3, :3])) for t in targets]
    assert all("estimator_inefficient" in r.reasons for r in results)
    assert np.median([error_m(r, truth) for r in results] / np.array(sd)) < 2.0


def test_initial_works_on_components_that_make_no_vector() -> None:
    world = world_tensor([-0.05, -0.05, -0.05], rotation(0.0, 0.0, 0.0)).real
    scalar = survey_geometry((4.0, 4.0), 0.2)
    scalar = scalar.model_copy(update={"receiver": scalar.receiver.model_copy(update={"components": "z"})})
    truth = Buried(np.array([[0.0, 0.0, -1.0]]), world[None], np.zeros((1, 3)), ("ball",))
    (result,) = solve(scalar, *noisy(clean_field_nt(scalar, truth), 30.0), Options(estimator="initial"))
    assert error_m(result, truth) < 0.3


def test_all_estimators_are_known_by_name() -> None:
    assert set(ESTIMATORS) == {"varpro", "ekf9", "kf-ekf-thesis", "initial"}
