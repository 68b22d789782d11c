"""The bank of alpha-beta filters that finds out by itself how much a target manoeuvres."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.alpha_beta_makers import INDICES, filtered, held, rms, scales, simulated
from tests.services.estimation.makers import LAW, FloatArray, plain_python, seeds

from trackmesh.services.estimation import alpha_beta as ab


def banked(z: FloatArray, dt_s: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Means (plots, n, 4) and covariances (plots, n, 4, 4) of a bank fed with plots (plots, n, 2)."""
    rows, every = np.arange(z.shape[1]), np.full(z.shape[1], dt_s)
    bank, found = ab.make_bank(len(rows)), []
    for plots in z:
        ab.feed_bank(bank, rows, plots, every)
        found.append(ab.bank_estimate(bank, rows, every))
    return np.array([mean for mean, _ in found]), np.array([P for _, P in found])


@pytest.mark.parametrize("index", INDICES)
def test_the_bank_is_near_the_kalman_filter_that_knows_the_noise(index: float) -> None:
    # 1000 tracks of 100 plots; both filters see the same plots.
    truth, z = simulated(index, 1000, 100, 7)
    best = filtered(z, np.ones(100), *ab.kalman_gains(100, index)) - truth
    error = banked(z)[0] - truth
    assert rms(error[1:, :, :2]) <= 1.13 * rms(best[1:, :, :2])
    assert rms(error[1:, :, 2:]) <= 1.13 * rms(best[1:, :, 2:])


@pytest.mark.parametrize("index", [0.0, *INDICES, 10.0])
def test_the_banks_covariance_holds_its_errors(index: float) -> None:
    truth, z = simulated(index, 500, 100, 8)
    mean, P = banked(z)
    error = (mean - truth)[40:]
    distance = np.sum(error * np.linalg.solve(P[40:], error[..., None])[..., 0], axis=-1)
    assert 0.93 < np.mean(distance < 9.488) < 0.999
    np.testing.assert_array_equal(P, P.swapaxes(-1, -2))


def test_the_indices_of_the_bank_are_those_of_its_k_end() -> None:
    np.testing.assert_array_equal(ab.k_end_rule(ab.BANK_INDEX), ab.BANK_K_END)


def test_each_filter_of_the_bank_is_the_plain_filter() -> None:
    _, z = simulated(0.2, 3, 60, 2)
    bank, rows = ab.make_bank(3), np.arange(3)
    for plots in z:
        ab.feed_bank(bank, rows, plots, np.full(3, 2.5))
    for c, k_end in enumerate(ab.BANK_K_END):
        np.testing.assert_allclose(bank.x[:, c], filtered(z, np.full(60, 2.5), *held(k_end, 60))[-1], rtol=1e-10)


def test_the_energy_is_the_mean_squared_innovation() -> None:
    _, z = simulated(0.2, 2, 15, 3)
    bank, rows, dt_s = ab.make_bank(2), np.arange(2), np.ones(2)
    squares = []
    for k, plots in enumerate(z):
        predicted = bank.x[:, :, :2] + bank.x[:, :, 2:]
        ab.feed_bank(bank, rows, plots, dt_s)
        if k >= 2:
            squares.append(np.square(plots[:, None] - predicted))
    np.testing.assert_allclose(bank.energy, np.mean(squares, axis=0))


@LAW
@given(seeds, scales, scales, st.floats(-1e4, 1e4))
def test_the_bank_knows_no_units_and_no_place(seed: int, metres: float, seconds: float, place: float) -> None:
    z = np.random.default_rng(seed).normal(size=(30, 2, 2)) * [1.0, 5.0]
    mean, P = (a[-1] for a in banked(z))
    got_mean, got_P = (a[-1] for a in banked(metres * (z + place), seconds))
    factor = metres * np.array([1.0, 1.0, 1.0 / seconds, 1.0 / seconds])
    shift = metres * place * np.array([1.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose((got_mean - shift) / factor, mean, atol=1e-6)
    np.testing.assert_allclose(got_P / np.outer(factor, factor), P, rtol=1e-4, atol=1e-6)
    assert np.all(np.linalg.eigvalsh(P) > 0.0)


def test_a_straight_line_without_noise_is_followed_exactly() -> None:
    z = np.arange(40.0)[:, None, None] * np.array([3.0, -2.0])
    mean, P = (a[-1, 0] for a in banked(z))
    np.testing.assert_allclose(mean, [117.0, -78.0, 3.0, -2.0], atol=1e-9)
    assert np.all(np.abs(P) < 1e-12)


def test_before_the_fifth_plot_the_bank_says_that_it_does_not_know() -> None:
    _, P = banked(simulated(0.2, 3, 6, 5)[1])
    np.testing.assert_array_equal(P[:4], np.broadcast_to(np.diag(np.full(4, np.inf)), (4, 3, 4, 4)))
    assert np.all(np.isfinite(P[4:]))


def test_rows_are_apart_may_repeat_and_start_anew() -> None:
    _, z = simulated(0.2, 1, 12, 6)
    alone, _ = banked(z)
    bank, one = ab.make_bank(3), np.array([1])
    ab.feed_bank(bank, np.array([1, 1, 1]), np.full((3, 2), 1e6), np.ones(3))
    assert bank.k.tolist() == [0, 3, 0]
    assert not bank.x[[0, 2]].any()
    bank.k[1] = 0
    ab.feed_bank(bank, np.ones(12, np.int64), z[:, 0], np.ones(12))
    np.testing.assert_array_equal(ab.bank_estimate(bank, one, np.ones(1))[0], alone[-1])


def test_an_estimate_wants_an_interval() -> None:
    with pytest.raises(ValueError, match="positive"):
        ab.bank_estimate(ab.make_bank(1), np.array([0]), np.array([0.0]))


def walked() -> list[float]:
    _, z = simulated(0.2, 2, 25, 9)
    mean, P = (a[-1] for a in banked(z))
    path = filtered(z, np.ones(25), *held(np.array(6), 25))[-1]
    return [*mean.ravel().tolist(), *P.ravel().tolist(), *path.ravel().tolist()]


def test_uncompiled_code_gives_the_same() -> None:
    got = plain_python("walked()", "tests.services.estimation.test_alpha_beta_bank")
    np.testing.assert_allclose(walked(), got, rtol=1e-10)
