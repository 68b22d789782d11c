from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    LAW,
    MODELS,
    TVIMM,
    FloatArray,
    Plot,
    assert_scaled,
    assert_sound,
    batch,
    begun,
    copied_state,
    covariance,
    dense_update,
    flow,
    noise,
    packed,
    random_state,
    random_walk,
    seeds,
    unpacked,
    velocities,
)

from trackmesh.services.estimation import imm
from trackmesh.services.estimation.bank import Models, State, make_work
from trackmesh.services.estimation.measurement import range_rate, update_position, update_scalar
from trackmesh.services.estimation.plots import Plots

ONE_MODEL = velocities((10.0,), (30.0,))

# --- position ---


@LAW
@given(seeds, st.integers(4, 6))
def test_the_update_equals_the_joseph_form_and_its_density_is_normal(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=d) * 100, covariance(rng, d, 400.0)
    plot = Plot(rng.normal(size=2) * 100, packed(covariance(rng, 2, 100.0)), 0.0)
    want_x, want_P, _ = dense_update(x, P, plot)
    density = scipy.stats.multivariate_normal(x[:2].copy(), P[:2, :2] + unpacked(plot.R))
    log_likelihood = update_position(x, P, d, plot.z, plot.R, np.empty((6, 2)))
    assert log_likelihood == pytest.approx(density.logpdf(plot.z), abs=1e-9)
    np.testing.assert_allclose(x, want_x, atol=1e-8)
    np.testing.assert_allclose(P, want_P, atol=1e-8)
    assert np.array_equal(P, P.T)


@pytest.mark.parametrize("P00", [-100.0, -1.0, np.nan])
def test_a_covariance_that_is_not_positive_skips_the_plot(P00: float) -> None:
    x, P = np.zeros(4), np.zeros((4, 4))
    P[0, 0] = P00
    before = P.copy()
    assert update_position(x, P, 4, np.ones(2), np.array([1.0, 0.0, 1.0]), np.empty((4, 2))) == -np.inf
    assert not x.any()
    assert np.array_equal(P, before, equal_nan=True)


# --- range rate ---


def seen_from(site: FloatArray, plot: Plot, range_rate_mps: float, variance: float, level: float = 1.0) -> Plots:
    """A plot with range rate, of a sensor at a site."""
    plots = batch(plot)
    plots["site"], plots["level"] = site, level
    plots["range_rate_mps"], plots["range_rate_variance"] = range_rate_mps, variance
    return plots


def any_plot(site: FloatArray, level: float = 1.0) -> Plots:
    return seen_from(site, Plot(np.zeros(2), np.ones(3), 0.0), 0.0, 1.0, level)


@LAW
@given(seeds, st.floats(0.1, 1.0))
def test_range_rate_is_how_the_slant_range_grows(seed: int, level: float) -> None:
    """Of a target that keeps its height; the elevation is that of the plot."""
    rng = np.random.default_rng(seed)
    site, x = rng.uniform(-5e4, 5e4, 2), np.concatenate([rng.uniform(-5e4, 5e4, 2), rng.normal(0.0, 200.0, 2)])
    height = np.linalg.norm(x[:2] - site) * np.tan(np.arccos(level))

    def slant(t_s: float) -> float:
        return float(np.hypot(np.linalg.norm(x[:2] + t_s * x[2:] - site), height))

    got = range_rate(x, any_plot(site, level)[0], np.empty(4))
    # The range is known to 1e-11 m, and is a parabola over a few milliseconds.
    assert got == pytest.approx((slant(1e-3) - slant(-1e-3)) / 2e-3, abs=1e-5)


@LAW
@given(seeds, st.floats(0.1, 1.0))
def test_the_gradient_of_the_range_rate(seed: int, level: float) -> None:
    """Against central differences of fourth order."""
    rng = np.random.default_rng(seed)
    site = rng.uniform(-1e3, 1e3, 2)
    angle, distance = rng.uniform(0, 2 * np.pi), 10 ** rng.uniform(1.5, 5.0)
    x = np.array([*(site + distance * np.array([np.cos(angle), np.sin(angle)])), *rng.normal(0.0, 200.0, 2)])
    plot, h = any_plot(site, level)[0], np.empty(4)
    range_rate(x, plot, h)
    want = np.empty(4)
    for k, step in enumerate([2e-3 * distance, 2e-3 * distance, 1.0, 1.0]):
        e = step * np.eye(4)[k]
        near, far = (
            range_rate(x + m * e, plot, np.empty(4)) - range_rate(x - m * e, plot, np.empty(4)) for m in (1, 2)
        )
        want[k] = (8.0 * near - far) / (12.0 * step)
    # What does not change along the line of sight is nought beside what changes across it.
    scale = np.array([*[np.linalg.norm(x[2:]) / distance] * 2, 1.0, 1.0]) * level
    np.testing.assert_allclose(h / scale, want / scale, rtol=1e-6, atol=1e-6)


def test_at_its_site_a_sensor_knows_no_direction() -> None:
    h = np.empty(4)
    assert range_rate(np.array([5.0, 7.0, 100.0, -50.0]), any_plot(np.array([5.0, 7.0]))[0], h) == 0.0
    assert np.isfinite(h).all()
    assert not h[2:].any()


def dense_scalar(
    x: FloatArray, P: FloatArray, h: FloatArray, nu: float, variance: float
) -> tuple[FloatArray, FloatArray, float]:
    """Textbook update with the Joseph form."""
    H = np.pad(h, (0, len(x) - 4))[None]
    s = float((H @ P @ H.T)[0, 0]) + variance
    K = P @ H.T / s
    left = np.eye(len(x)) - K @ H
    return (
        x + K[:, 0] * nu,
        left @ P @ left.T + variance * K @ K.T,
        float(scipy.stats.norm(0.0, np.sqrt(s)).logpdf(nu)),
    )


@LAW
@given(seeds, st.integers(4, 6), st.floats(-2.0, 4.0))
def test_the_scalar_update_is_the_dense_one(seed: int, d: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    x, P, h = rng.normal(size=d) * 100, covariance(rng, d, 400.0), rng.normal(size=4)
    nu, variance = rng.normal() * 50, 10.0**exponent
    want_x, want_P, want = dense_scalar(x, P, h, nu, variance)
    got = update_scalar(x, P, d, h, nu, variance, np.empty((6, 2)))
    assert got == pytest.approx(want, rel=1e-11)
    np.testing.assert_allclose(x, want_x, rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(P, want_P, rtol=0, atol=1e-10 * np.trace(P))
    assert np.array_equal(P, P.T)


def test_a_scalar_of_no_variance_is_skipped() -> None:
    x, P = np.zeros(4), np.zeros((4, 4))
    assert update_scalar(x, P, 4, np.ones(4), 1.0, 0.0, np.empty((4, 2))) == -np.inf
    assert not x.any()


def fed(models: Models, s: State, plots: Plots) -> State:
    out, w = copied_state(s), make_work(models)
    for plot in plots:
        imm.filter_plot(models, out, plot, w)
    return out


@pytest.mark.parametrize("models", [MODELS, TVIMM], ids=["imm", "tvimm"])
def test_a_range_rate_of_infinite_variance_changes_nothing(models: Models) -> None:
    plots = random_walk(np.random.default_rng(1), 10)
    plain = batch(*plots[1:])
    told = plain.copy()
    told["range_rate_mps"], told["site"], told["level"] = 1e3, [3.0, 4.0], 0.5
    start = begun(models, plots[0])
    one, other = fed(models, start, plain), fed(models, start, told)
    assert np.asarray(one).tobytes() == np.asarray(other).tobytes()
    x, P = np.ones(4), np.eye(4)
    update_scalar(x, P, 4, np.ones(4), 1.0, np.inf, np.empty((4, 2)))
    assert x.tolist() == [1.0] * 4
    assert np.array_equal(P, np.eye(4))


def test_one_model_with_range_rate_is_an_extended_kalman_filter() -> None:
    """Position first, then the range rate about the state that it gave."""
    rng, q, site = np.random.default_rng(2), 10.0, np.array([-2e3, 5e3])
    plots = random_walk(rng, 30)
    s = begun(ONE_MODEL, plots[0])
    x, P, t_s = s.x[0].copy(), s.P[0].copy(), plots[0].t_s
    for plot in plots[1:]:
        rate, level = rng.normal(0.0, 100.0), rng.uniform(0.5, 1.0)
        seen = seen_from(site, plot, rate, 4.0, level)
        F = flow(plot.t_s - t_s)
        x, P, _ = dense_update(F @ x, F @ P @ F.T + noise(plot.t_s - t_s, q), plot)
        off = x[:2] - site
        u = off / np.linalg.norm(off)
        h = level * np.concatenate([(x[2:] - (x[2:] @ u) * u) / np.linalg.norm(off), u])
        x, P, _ = dense_scalar(x, P, h, rate - level * float(x[2:] @ u), 4.0)
        s, t_s = fed(ONE_MODEL, s, seen), plot.t_s
        assert_scaled(s.x[0], s.P[0], x, P, 1e-10)


def test_models_are_judged_by_the_range_rate_too() -> None:
    """Alike in all but their speed: the one whose range grows as measured wins, by Bayes."""
    s = random_state(np.random.default_rng(3), MODELS)
    s.x[:], s.P[:] = [1e4, 0.0, 0.0, 0.0], np.diag([100.0, 100.0, 25.0, 25.0])
    s.x[:, 2] = [0.0, 10.0, 20.0]
    prior = s.mu.copy()
    plots = seen_from(np.zeros(2), Plot(np.array([1e4, 0.0]), np.array([100.0, 0.0, 100.0]), 0.0), 20.0, 9.0)
    want = prior * scipy.stats.norm(s.x[:, 2], np.sqrt(25.0 + 9.0)).pdf(20.0)
    got = fed(MODELS, s, plots).mu
    np.testing.assert_allclose(got, want / want.sum(), rtol=1e-9)


@LAW
@given(seeds, st.floats(0.0, 2.0 * np.pi))
def test_a_range_rate_tells_the_speed_along_the_line_of_sight(seed: int, angle: float) -> None:
    """What is not known of the velocity across it stays as it was, so far away that the direction is sure."""
    rng = np.random.default_rng(seed)
    u, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    s = random_state(rng, ONE_MODEL)
    s.x[0], s.P[0] = [*(1e6 * u), *rng.normal(0.0, 30.0, 2)], np.diag([1e4, 1e4, 900.0, 900.0])
    plot = Plot(1e6 * u, np.array([1e4, 0.0, 1e4]), 0.0)
    without, told = fed(ONE_MODEL, s, batch(plot)), fed(ONE_MODEL, s, seen_from(np.zeros(2), plot, 10.0, 1.0))
    V, told_V = without.P[0, 2:, 2:], told.P[0, 2:, 2:]
    assert u @ told_V @ u == pytest.approx(1.0 / (1.0 / 900.0 + 1.0), rel=1e-3)
    assert u @ told_V @ u < 0.002 * (u @ V @ u)
    assert across @ told_V @ across == pytest.approx(across @ V @ across, rel=1e-3)
    assert told.x[0, 2:] @ u == pytest.approx(10.0, abs=0.2)


@pytest.mark.parametrize("models", [MODELS, TVIMM], ids=["imm", "tvimm"])
@LAW
@given(seed=seeds, exponent=st.floats(-4.0, 4.0))
def test_sound_with_any_range_rate(models: Models, seed: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    plots = random_walk(rng, 12, 10 ** rng.uniform(0, 3))
    many = batch(*plots[1:])
    many["range_rate_mps"], many["range_rate_variance"] = rng.normal(0.0, 200.0, 11), 10.0**exponent
    many["site"] = plots[6].z
    assert_sound(models, fed(models, begun(models, plots[0]), many), slack=1e-10)
