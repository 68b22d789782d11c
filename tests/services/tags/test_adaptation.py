"""Learning the acceleration: the recursions, the collapse of the slides' form, and what cures it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.services.tags.makers import FloatArray, One

from trackmesh.services.tags.adaptation import adapt
from trackmesh.services.tags.records import (
    ADAPT_ALPHA,
    ADAPT_VARIANCE,
    CORRECTED,
    FORGET,
    LIMITS,
    MEAN_LAG,
    PRINTED_ADAPTATION,
    WITH_COVARIANCE,
)

DT_S = 0.2


def process(alpha: float, variance: float, n: int, seed: int = 1) -> FloatArray:
    """A first-order process sampled every ``DT_S``."""
    rng, a = np.random.default_rng(seed), np.zeros(n)
    keep = math.exp(-alpha * DT_S)
    a[0] = math.sqrt(variance) * rng.normal()
    for k in range(1, n):
        a[k] = keep * a[k - 1] + math.sqrt(variance * (1 - keep**2)) * rng.normal()
    return a


def feed(one: One, a: FloatArray, own_variance: float = 0.0, dt_s: float = DT_S) -> One:
    """Adapt to estimates (n,) of the acceleration east, known up to this variance; nothing happens north."""
    for value in a:
        one.f.x[-1, 4:6] = value, -value
        one.f.P[-1, 4, 4] = one.f.P[-1, 5, 5] = own_variance
        adapt(one.rules[0], one.f, dt_s)
    return one


def test_without_a_wish_nothing_is_adapted() -> None:
    one = feed(One().begin(), process(0.5, 9.0, 50))
    assert one.f.variance.tolist() == [4.0, 4.0] and one.f.alpha.tolist() == [0.5, 0.5]


def test_the_moments_are_running_means() -> None:
    a = process(0.5, 9.0, 40)
    one = feed(One(adapt=PRINTED_ADAPTATION).begin(), a)
    assert one.f.r0[0] == pytest.approx(np.mean(a**2))
    assert one.f.r1[0] == pytest.approx(np.sum(a[1:] * a[:-1]) / len(a))
    assert one.f.lag_s == pytest.approx(DT_S)
    beta = one.f.r1[0] / one.f.r0[0]
    assert one.f.alpha[0] == pytest.approx(-math.log(beta) / DT_S)


def test_the_variance_is_r0_by_whatever_way() -> None:
    a = process(0.5, 9.0, 300)
    by_detour = feed(One(adapt=ADAPT_VARIANCE | ADAPT_ALPHA).begin(), a)
    straight = feed(One(adapt=ADAPT_VARIANCE).begin(), a)
    assert by_detour.f.variance[0] == pytest.approx(by_detour.f.r0[0])
    assert straight.f.variance[0] == straight.f.r0[0]
    assert straight.f.alpha[0] == 0.5


@pytest.mark.parametrize("alpha", [0.5, 2.0])
def test_a_process_seen_without_noise_is_identified(alpha: float) -> None:
    one = feed(One(adapt=PRINTED_ADAPTATION | MEAN_LAG).begin(), process(alpha, 4.0, 20_000))
    assert one.f.alpha[0] == pytest.approx(alpha, rel=0.15)
    assert one.f.variance[0] == pytest.approx(4.0, rel=0.2)


def test_the_covariance_is_part_of_the_square() -> None:
    a = process(0.5, 4.0, 400)
    shrunk = 0.3 * a
    missing = float(np.mean(a**2 - shrunk**2))
    assert feed(One(adapt=ADAPT_VARIANCE).begin(), shrunk).f.variance[0] < 0.15 * 4.0
    mended = feed(One(adapt=ADAPT_VARIANCE | WITH_COVARIANCE).begin(), shrunk, missing)
    assert mended.f.variance[0] == pytest.approx(np.mean(a**2))


def test_old_instants_are_forgotten_where_that_is_asked_for() -> None:
    a = np.concatenate([np.full(500, 10.0), np.full(120, 1.0)])
    keeps = feed(One(adapt=ADAPT_VARIANCE | WITH_COVARIANCE).begin(), a)
    forgets = feed(One(adapt=ADAPT_VARIANCE | WITH_COVARIANCE | FORGET).begin(), a)
    assert keeps.f.variance[0] > 50.0 and forgets.f.variance[0] < 3.0


def test_the_corrected_form_is_bounded_and_waits() -> None:
    one = One(adapt=CORRECTED, acceleration_least_mps2=0.5, acceleration_most_mps2=3.0).begin()
    feed(one, np.full(8, 100.0))
    assert one.f.variance[0] == 4.0
    feed(one, np.full(8, 100.0))
    assert one.f.variance[0] == 9.0
    feed(one, np.zeros(2000))
    assert one.f.variance[0] == 0.25


def test_moments_of_no_process_change_nothing() -> None:
    # Alternating signs: r(1) is negative, and no alpha fits.
    one = feed(One(adapt=PRINTED_ADAPTATION).begin(), np.array([1.0, -1.0] * 20))
    assert one.f.alpha[0] == 0.5
    limited = feed(One(adapt=PRINTED_ADAPTATION | LIMITS).begin(), np.array([1.0, -1.0] * 20))
    assert 0.02 <= limited.f.alpha[0] <= 2.0


def test_alpha_jumps_with_the_last_interval_unless_the_mean_one_is_taken() -> None:
    a = process(0.5, 4.0, 3000)
    for flags, ratio in ((PRINTED_ADAPTATION, 5.0), (PRINTED_ADAPTATION | MEAN_LAG, 1.0)):
        one = feed(One(adapt=flags).begin(), a)
        before = float(one.f.alpha[0])
        feed(one, a[-1:], dt_s=DT_S / 5.0)
        assert one.f.alpha[0] / before == pytest.approx(ratio, rel=0.05)


def test_no_time_between_instants_is_no_instant() -> None:
    one = feed(One(adapt=CORRECTED).begin(), np.full(3, 5.0), dt_s=0.0)
    assert one.f.instants == 0
