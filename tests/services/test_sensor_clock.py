"""Offset and drift of a sensor's clock, found from arrivals under jitter, bursts, wild stamps and steps."""

from __future__ import annotations

import numpy as np
import pytest

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.sensor_clock import ClockEstimate, SensorClock


def sent(seed: int, seconds: float = 300.0, rate_hz: float = 8.0) -> tuple[FloatArray, FloatArray]:
    """True times at which batches are sent, and how long each is under way."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    return t_s, 0.002 + rng.exponential(0.02, len(t_s)) + rng.uniform(0.0, 1.0 / rate_hz, len(t_s))


def held_up(t_s: FloatArray, delay_s: FloatArray, begin_s: float, end_s: float) -> FloatArray:
    """The delays where nothing gets through for a while and then all comes at once."""
    stuck = (t_s >= begin_s) & (t_s < end_s)
    return np.where(stuck, np.maximum(delay_s, end_s - t_s), delay_s)


def found(t_s: FloatArray, delay_s: FloatArray, ahead_s: FloatArray | float = 0.0) -> ClockEstimate:
    clock = SensorClock()
    arrived = t_s + delay_s
    seen = arrived - (t_s + ahead_s)
    for k in np.argsort(arrived, kind="stable").tolist():
        clock.heard(float(arrived[k]), float(seen[k]))
    return clock.estimate()


@pytest.mark.parametrize("ahead_s", [-3.0, -0.1, 0.0, 0.1, 5.0])
def test_an_offset_is_found_within_the_jitter(ahead_s: float) -> None:
    for seed in range(20):
        assert found(*sent(seed), ahead_s).offset_s == pytest.approx(ahead_s, abs=0.03)


@pytest.mark.parametrize("ppm", [-500.0, -100.0, 0.0, 100.0, 2000.0])
def test_a_drift_is_found_with_its_error(ppm: float) -> None:
    t_s, delay_s = sent(1, 600.0)
    errors = []
    for seed in range(20):
        t_s, delay_s = sent(seed, 600.0)
        one = found(t_s, delay_s, ppm * 1e-6 * t_s)
        assert one.drift_ppm is not None
        errors.append((one.drift_ppm - ppm) / one.drift_sigma_ppm)
        assert abs(one.drift_ppm - ppm) < 20.0
    assert np.sqrt(np.mean(np.square(errors))) < 2.5


def test_outages_whose_plots_come_at_once_change_nothing() -> None:
    for seed in range(20):
        t_s, delay_s = sent(seed)
        for begin in (35.0, 111.0, 150.0, 222.0):
            delay_s = held_up(t_s, delay_s, begin, begin + 8.0)
        one = found(t_s, delay_s)
        assert one.offset_s == pytest.approx(0.0, abs=0.03) and one.steps == 0
        assert one.drift_ppm == pytest.approx(0.0, abs=60.0)


def test_a_wild_stamp_now_and_then_is_not_the_clock() -> None:
    t_s, delay_s = sent(3)
    ahead = np.where(np.arange(len(t_s)) % 100 == 50, 1.9, 0.0)
    one = found(t_s, delay_s, ahead)
    assert one.offset_s == pytest.approx(0.0, abs=0.03) and one.steps == 0


@pytest.mark.parametrize("step_s", [-2.0, 0.3, 2.0])
def test_a_clock_that_is_set_is_told_anew_and_its_drift_does_not_suffer(step_s: float) -> None:
    t_s, delay_s = sent(4, 400.0)
    one = found(t_s, delay_s, np.where(t_s < 155.0, 0.0, step_s))
    assert one.steps == 1
    assert one.offset_s == pytest.approx(step_s, abs=0.03)
    assert one.drift_ppm == pytest.approx(0.0, abs=60.0)


def test_a_sensor_of_whole_turns_with_one_plot_is_not_said_to_drift() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        clock = SensorClock(10.0, 4.0)
        for k in range(150):
            clock.heard(4.0 * k, float(rng.uniform(0.0, 4.0)))
        one = clock.estimate()
        assert one.drift_ppm is not None and abs(one.drift_ppm) < 4.0 * max(one.drift_sigma_ppm, 25.0)
        assert one.steps == 0


def test_little_is_said_of_a_sensor_little_heard() -> None:
    clock = SensorClock()
    assert clock.estimate() == ClockEstimate(None, None, 0.0, 0)
    for k in range(6):
        clock.heard(float(k), 0.5)
    assert clock.estimate() == ClockEstimate(-0.5, None, 0.0, 0)
