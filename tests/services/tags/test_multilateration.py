"""Places from ranges alone: against scipy's robust least squares, and where two places fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st
from tests.services.tags.makers import LAW, LINE, SQUARE, FloatArray, distances, ranges, seeds

from trackmesh.services.tags.multilateration import MODES, cost_at, multilaterate
from trackmesh.services.tags.records import Records


def locate(readers: FloatArray, z: Records) -> FloatArray:
    modes = np.empty((MODES, 6))
    return modes[: multilaterate(readers, z, modes)]


def measured(place: FloatArray, readers: FloatArray, noise: FloatArray | float = 0.0, sigma: float = 1.0) -> Records:
    z = distances(place, readers) + noise
    return ranges(*[(0.0, k, metres) for k, metres in enumerate(z)], sigma=sigma)


@LAW
@given(st.floats(2.0, 38.0), st.floats(2.0, 38.0))
def test_exact_ranges_give_the_exact_place(east: float, north: float) -> None:
    modes = locate(SQUARE, measured(np.array([east, north]), SQUARE))
    np.testing.assert_allclose(modes[0, :2], [east, north], atol=1e-5)
    assert modes[0, 2] < 1e-8


@LAW
@given(seed=seeds)
def test_the_minimum_is_that_of_cauchys_loss(seed: int) -> None:
    rng = np.random.default_rng(seed)
    readers = np.column_stack([rng.uniform(0, 60, (6, 2)), rng.uniform(0, 3, 6)])
    place = rng.uniform(10, 50, 2)
    noise = rng.normal(size=6) * 0.8
    noise[0] += 12.0
    z = measured(place, readers, noise, 0.8)

    def residuals(p: FloatArray) -> FloatArray:
        return (z["range_m"] - distances(p, readers)) / 0.8

    starts = [rng.uniform(0, 60, 2) for _ in range(12)]
    found = [scipy.optimize.least_squares(residuals, start, loss="cauchy", f_scale=2.385) for start in starts]
    best = min(found, key=lambda one: float(one.cost))
    modes = locate(readers, z)
    # scipy's cost is half of ours.
    assert modes[0, 2] <= 2.0 * best.cost * 1.01
    assert cost_at(readers, z, *modes[0, :2]) == pytest.approx(modes[0, 2])


def test_one_range_round_a_corner_does_little_harm() -> None:
    place = np.array([12.0, 25.0])
    noise = np.array([15.0, 0.1, -0.1, 0.1])
    robust = locate(SQUARE, measured(place, SQUARE, noise, 0.3))[0]
    z = distances(place, SQUARE) + noise
    plain = scipy.optimize.least_squares(lambda p: z - distances(p, SQUARE), [20.0, 20.0]).x
    assert math.dist(robust[:2], place) < 0.05 * math.dist(plain, place)
    # And it is told: the ranges contradict each other.
    clean = locate(SQUARE, measured(place, SQUARE, 0.0, 0.3))[0]
    assert robust[3] > 3.0 * clean[3]


def test_readers_on_a_line_leave_a_mirror_image() -> None:
    modes = locate(LINE, measured(np.array([15.0, 12.0]), LINE, np.array([0.1, -0.1, 0.1])))
    assert len(modes) == 2
    assert sorted(modes[:, 1]) == pytest.approx([-12.0, 12.0], abs=0.5)
    assert modes[:, 2] == pytest.approx([modes[0, 2]] * 2, abs=1e-6)


def test_near_their_line_the_place_is_uncertain_across_it_and_one() -> None:
    modes = locate(LINE, measured(np.array([30.0, 0.3]), LINE))
    assert len(modes) == 1
    _, _, _, east, _, north = modes[0]
    assert north > 5.0 * east
    assert 0.3 < 2.0 * math.sqrt(north) < 30.0


@LAW
@given(seed=seeds)
def test_the_covariance_is_that_of_the_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place = np.array([14.0, 22.0])
    errors, covariances = [], []
    for _ in range(60):
        mode = locate(SQUARE, measured(place, SQUARE, 0.5 * rng.normal(size=4), 0.5))[0]
        errors.append(mode[:2] - place)
        covariances.append([[mode[3], mode[4]], [mode[4], mode[5]]])
    nees = [e @ np.linalg.solve(C, e) for e, C in zip(errors, covariances, strict=True)]
    assert 0.9 < np.mean(nees) < 3.2


def test_readers_at_one_spot_give_no_place() -> None:
    readers = np.zeros((3, 3))
    assert len(locate(readers, measured(np.array([3.0, 4.0]), readers))) == 0


def test_heights_are_reckoned_with() -> None:
    high = SQUARE + np.array([0.0, 0.0, 3.0])
    place = np.array([3.0, 2.0])
    np.testing.assert_allclose(locate(high, measured(place, high, sigma=0.1))[0, :2], place, atol=1e-5)
    ignored = locate(SQUARE, measured(place, high, sigma=0.1))[0, :2]
    assert math.dist(ignored, place) > 0.05
