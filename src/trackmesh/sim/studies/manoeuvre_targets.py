"""Targets that fly straight, turn and change speed, measured in position only: the test set of the manoeuvre filters.

Flights of 100 to 250 m/s (held within 60 to 350) with a little white acceleration, straight for 10 s and an exponential
time of mean 35 s, then a manoeuvre: a turn of 1 to 6 deg/s to either side (two in three), or a tangential acceleration
of 3 to 10 m/s^2 of either sign. Manoeuvres begin and end at any time, not at scans. ``three_manoeuvres`` is one fixed
flight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray

STEP_S = 0.1
"""Of the truth; the interval of scans is a multiple of it."""

SPEED_MPS, SPEED_HELD_MPS = (100.0, 250.0), (60.0, 350.0)
ACCELERATION_DENSITY = 0.04
TURNS = 0.65
TURN_RATE_DEGPS, TURN_S, TURN_MOST_DEG = (1.0, 6.0), (6.0, 30.0), 200.0
ACCELERATION_MPS2, ACCELERATION_S = (3.0, 10.0), (5.0, 20.0)
STRAIGHT_LEAST_S, STRAIGHT_MEAN_S = 10.0, 35.0


class Leg(NamedTuple):
    """Part of a flight: for how long, with which turn rate (rad/s, anticlockwise) and acceleration along the path."""

    duration_s: float
    turn_rate_radps: float = 0.0
    acceleration_mps2: float = 0.0


class Measured(NamedTuple):
    """Runs of one target each, T scans: truth (runs, T + 1, 4) from time 0, and plots (runs, T, 2) of scans 1 to T."""

    truth: FloatArray
    plots: FloatArray
    period_s: float
    sigma_m: float


def random_legs(rng: np.random.Generator, duration_s: float) -> list[Leg]:
    """Straight parts and manoeuvres in turn, until ``duration_s`` is full."""
    legs: list[Leg] = []
    while sum(leg.duration_s for leg in legs) < duration_s:
        legs.append(Leg(STRAIGHT_LEAST_S + rng.exponential(STRAIGHT_MEAN_S)))
        legs.append(_turn(rng) if rng.random() < TURNS else _speed_change(rng))
    return legs


def _turn(rng: np.random.Generator) -> Leg:
    rate_degps = rng.uniform(*TURN_RATE_DEGPS)
    duration_s = min(rng.uniform(*TURN_S), TURN_MOST_DEG / rate_degps)
    return Leg(duration_s, turn_rate_radps=float(np.deg2rad(rate_degps) * rng.choice([-1, 1])))


def _speed_change(rng: np.random.Generator) -> Leg:
    return Leg(rng.uniform(*ACCELERATION_S), acceleration_mps2=rng.uniform(*ACCELERATION_MPS2) * rng.choice([-1, 1]))


def flight(
    legs: list[Leg], duration_s: float, velocity_mps: FloatArray, rng: np.random.Generator, density: float
) -> FloatArray:
    """States (n, 4) every ``STEP_S`` from the origin on, disturbed by white acceleration of ``density`` (m^2/s^3)."""
    n = round(duration_s / STEP_S) + 1
    leg_of_step = np.searchsorted(np.cumsum([leg.duration_s for leg in legs]), STEP_S * np.arange(n), side="right")
    noise = rng.normal(0.0, np.sqrt(density * STEP_S), (n, 2))
    states = np.empty((n, 4))
    position, velocity = np.zeros(2), np.asarray(velocity_mps, float)
    for k in range(n):
        states[k, :2], states[k, 2:] = position, velocity
        leg = legs[min(int(leg_of_step[k]), len(legs) - 1)]
        after = _moved(velocity, leg)
        position = position + 0.5 * STEP_S * (velocity + after)
        velocity = after + noise[k]
    return states


def _moved(velocity: FloatArray, leg: Leg) -> FloatArray:
    """Velocity after one step of a leg."""
    angle = leg.turn_rate_radps * STEP_S
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ velocity
    if leg.acceleration_mps2 == 0.0:
        return np.asarray(turned)
    speed = np.hypot(*velocity)
    return np.asarray(turned / speed * np.clip(speed + leg.acceleration_mps2 * STEP_S, *SPEED_HELD_MPS))


def random_flights(runs: int, period_s: float, sigma_m: float, duration_s: float, seed: int) -> Measured:
    """Runs over random flights."""
    rng = np.random.default_rng(seed)
    flights = []
    for _ in range(runs):
        heading, speed = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*SPEED_MPS)
        velocity = speed * np.array([np.cos(heading), np.sin(heading)])
        flights.append(flight(random_legs(rng, duration_s), duration_s, velocity, rng, ACCELERATION_DENSITY))
    return _measured(np.array(flights), period_s, sigma_m, rng)


THREE_MANOEUVRES = [
    Leg(40.0),
    Leg(20.0, turn_rate_radps=float(np.deg2rad(4.0))),
    Leg(30.0),
    Leg(12.0, turn_rate_radps=float(np.deg2rad(-8.0))),
    Leg(30.0),
    Leg(15.0, acceleration_mps2=10.0),
    Leg(25.0),
]
"""Turns of 4 deg/s for 20 s and -8 deg/s for 12 s, then 10 m/s^2 for 15 s."""


def three_manoeuvres(runs: int, period_s: float, sigma_m: float, seed: int) -> Measured:
    """Runs over one flight at 200 m/s with two turns and a speed change, measured anew in each."""
    rng = np.random.default_rng(seed)
    states = flight(THREE_MANOEUVRES, 172.0, np.array([200.0, 0.0]), rng, 0.0)
    return _measured(np.repeat(states[None], runs, axis=0), period_s, sigma_m, rng)


def _measured(flights: FloatArray, period_s: float, sigma_m: float, rng: np.random.Generator) -> Measured:
    truth = flights[:, :: round(period_s / STEP_S)]
    plots = truth[:, 1:, :2] + rng.normal(0.0, sigma_m, (*truth[:, 1:].shape[:2], 2))
    return Measured(truth, plots, period_s, sigma_m)
