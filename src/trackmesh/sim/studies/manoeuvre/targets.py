"""Targets of the study: turns and speed changes as in ``manoeuvre_targets``, and others that the filter does not model.

All runs of a family fly at once, each with the white acceleration of the first family unless it has its own:

* T0, R: the one flight and the random flights of ``manoeuvre_targets``;
* weave: an acceleration across a straight course, of amplitude 20 m/s^2 and period 30 s, all the time;
* jink: straight flight, then 2 to 15 m/s^2 into any direction of the plane for 5 to 15 s;
* singer: an acceleration of 5 m/s^2 per axis with correlation time 20 s, all the time;
* wna: white acceleration of 5 m/s^1.5, all the time;
* cv: straight flight;
* both: as R, but each manoeuvre is a turn and a speed change at the same time;
* s-turns: as weave, but across the path itself, so that the speed stays and the turn rate swings to and fro.

Changes of speed along the path end at the limits of the first family.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray
from trackmesh.sim.studies.manoeuvre_targets import (
    ACCELERATION_DENSITY,
    ACCELERATION_MPS2,
    ACCELERATION_S,
    SPEED_HELD_MPS,
    SPEED_MPS,
    STEP_S,
    STRAIGHT_LEAST_S,
    STRAIGHT_MEAN_S,
    THREE_MANOEUVRES,
    TURN_MOST_DEG,
    TURN_RATE_DEGPS,
    random_legs,
)

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

WEAVE_MPS2, WEAVE_S = 20.0, 30.0
JINK_MPS2, JINK_S = (2.0, 15.0), (5.0, 15.0)
SINGER_MPS2, SINGER_S = 5.0, 20.0
WNA_DENSITY = 25.0


class Phase(NamedTuple):
    """Part of a flight: turn rate (rad/s, anticlockwise), acceleration along the path, and in the plane (m/s^2)."""

    duration_s: float
    turn_rate_radps: float = 0.0
    along_mps2: float = 0.0
    east_mps2: float = 0.0
    north_mps2: float = 0.0


class Commands(NamedTuple):
    """What the runs do at each step of the truth.

    Attributes:
        turn_radps, along_mps2, across_mps2: (n, runs) turn rate, accelerations along the path and to its left.
        push_mps2: (n, runs, 2) acceleration in the plane.
        manoeuvring: (n, runs) whether this is a manoeuvre.
    """

    turn_radps: FloatArray
    along_mps2: FloatArray
    across_mps2: FloatArray
    push_mps2: FloatArray
    manoeuvring: BoolArray


class Flights(NamedTuple):
    """Runs of one target each, T scans.

    Attributes:
        truth: (runs, T + 1, 4) from time 0.
        manoeuvring: (T, runs) whether anything but straight flight lies between a scan and the one before.
        since_onset: (T, runs) scans since the first one at or after the begin of the last manoeuvre; -1 before any.
    """

    truth: FloatArray
    manoeuvring: BoolArray
    since_onset: IntArray


Command = Callable[[np.random.Generator, FloatArray, int], Commands]
"""From a source of chance, the velocities (runs, 2) at the start, and the number of steps."""


class Family(NamedTuple):
    """What targets do, how densely white acceleration disturbs them (m^2/s^3), and at which speeds they start."""

    command: Command
    density: float = ACCELERATION_DENSITY
    speed_mps: tuple[float, float] = SPEED_MPS


def fly_family(name: str, runs: int, period_s: float, duration_s: float, rng: np.random.Generator) -> Flights:
    """Runs of one of ``FAMILIES``, seen every ``period_s``."""
    family = FAMILIES[name]
    heading, speed = rng.uniform(0.0, 2.0 * np.pi, runs), rng.uniform(*family.speed_mps, runs)
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    commands = family.command(rng, velocity, round(duration_s / STEP_S))
    states = fly(commands, velocity, rng, family.density)
    return seen_every(round(period_s / STEP_S), states, commands.manoeuvring)


def fly(commands: Commands, velocity_mps: FloatArray, rng: np.random.Generator, density: float) -> FloatArray:
    """States (n + 1, runs, 4) every ``STEP_S``, all from the origin, disturbed by white acceleration of ``density``."""
    n, runs = commands.turn_radps.shape
    noise = rng.normal(0.0, np.sqrt(density * STEP_S), (n, runs, 2))
    states = np.zeros((n + 1, runs, 4))
    position, velocity = np.zeros((runs, 2)), np.asarray(velocity_mps, float)
    states[0, :, 2:] = velocity
    for k in range(n):
        after = _moved(velocity, *(part[k] for part in commands[:4]))
        position = position + 0.5 * STEP_S * (velocity + after)
        velocity = after + noise[k]
        states[k + 1, :, :2], states[k + 1, :, 2:] = position, velocity
    return states


def _moved(
    velocity: FloatArray, turn: FloatArray, along: FloatArray, across: FloatArray, push: FloatArray
) -> FloatArray:
    """Velocities (runs, 2) after one step; a speed that is being changed stays within the limits."""
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-6)
    angle = STEP_S * (turn + across / speed)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack(
        [cos * velocity[:, 0] - sin * velocity[:, 1], sin * velocity[:, 0] + cos * velocity[:, 1]], axis=1
    )
    changed = np.where(along == 0.0, speed, np.clip(speed + STEP_S * along, *SPEED_HELD_MPS))
    return np.asarray(turned * (changed / speed)[:, None] + STEP_S * push)


def seen_every(steps: int, states: FloatArray, manoeuvring: BoolArray) -> Flights:
    """Flights (n + 1, runs, 4) at every so many steps."""
    scans = len(manoeuvring) // steps
    busy = manoeuvring[: scans * steps]
    began = busy & ~np.concatenate([busy[:1], busy[:-1]])
    # A manoeuvre that begins with step k, at k STEP_S, is first seen by the scan at or after that time.
    onset = np.zeros((scans + 1, busy.shape[1]), bool)
    step, run = np.nonzero(began)
    onset[-(-step // steps), run] = True
    scan = np.arange(scans + 1)[:, None]
    last = np.maximum.accumulate(np.where(onset, scan, -1), axis=0)
    since = np.where(last >= 0, scan - last, -1)[1:]
    within = np.asarray(busy.reshape(scans, steps, -1).any(axis=1))
    return Flights(np.swapaxes(states[::steps], 0, 1), within, since)


def straight(runs: int, n: int) -> Commands:
    """No manoeuvre at all."""
    none = np.zeros((n, runs))
    return Commands(none, none, none, np.zeros((n, runs, 2)), np.zeros((n, runs), bool))


def in_phases(phases: list[list[Phase]], n: int) -> Commands:
    """Commands of runs that are each a list of phases; the last one goes on."""
    moves = np.stack([_spread(np.array(run), n) for run in phases], axis=2)
    turn, along, *push = moves
    return Commands(turn, along, np.zeros_like(turn), np.stack(push, axis=2), (moves != 0.0).any(axis=0))


def _spread(phases: FloatArray, n: int) -> FloatArray:
    """What phases (m, 5) are at each of n steps, (4, n)."""
    phase = np.searchsorted(np.cumsum(phases[:, 0]), STEP_S * np.arange(n), side="right")
    return np.asarray(phases[np.minimum(phase, len(phases) - 1), 1:].T)


def _three_manoeuvres(_: np.random.Generator, velocity: FloatArray, n: int) -> Commands:
    return in_phases([[Phase(*leg) for leg in THREE_MANOEUVRES]] * len(velocity), n)


def _turns_and_speed_changes(rng: np.random.Generator, velocity: FloatArray, n: int) -> Commands:
    return in_phases([[Phase(*leg) for leg in random_legs(rng, n * STEP_S)] for _ in velocity], n)


def _now_and_then(rng: np.random.Generator, velocity: FloatArray, n: int, *, do: Callable[..., Phase]) -> Commands:
    """Straight flight and manoeuvres in turn."""
    runs: list[list[Phase]] = [[] for _ in velocity]
    for phases in runs:
        while sum(phase.duration_s for phase in phases) < n * STEP_S:
            phases += [Phase(STRAIGHT_LEAST_S + rng.exponential(STRAIGHT_MEAN_S)), do(rng)]
    return in_phases(runs, n)


def _turn_with_speed_change(rng: np.random.Generator) -> Phase:
    rate_degps = rng.uniform(*TURN_RATE_DEGPS)
    duration_s = min(rng.uniform(*ACCELERATION_S), TURN_MOST_DEG / rate_degps)
    sides = rng.choice([-1, 1], 2)
    return Phase(
        duration_s, float(np.deg2rad(rate_degps) * sides[0]), float(rng.uniform(*ACCELERATION_MPS2) * sides[1])
    )


def _jink(rng: np.random.Generator) -> Phase:
    duration_s, strength, angle = rng.uniform(*JINK_S), rng.uniform(*JINK_MPS2), rng.uniform(0.0, 2.0 * np.pi)
    return Phase(duration_s, east_mps2=float(strength * np.cos(angle)), north_mps2=float(strength * np.sin(angle)))


def _swing(rng: np.random.Generator, runs: int, n: int) -> FloatArray:
    """A sinusoidal acceleration that begins anywhere, (n, runs)."""
    turns = STEP_S * (np.arange(n) + 0.5)[:, None] / WEAVE_S + rng.random(runs)
    return np.asarray(WEAVE_MPS2 * np.sin(2.0 * np.pi * turns))


def _weave(rng: np.random.Generator, velocity: FloatArray, n: int) -> Commands:
    left = np.stack([-velocity[:, 1], velocity[:, 0]], axis=1) / np.hypot(velocity[:, 0], velocity[:, 1])[:, None]
    return _always(len(velocity), n)._replace(push_mps2=_swing(rng, len(velocity), n)[..., None] * left)


def _s_turns(rng: np.random.Generator, velocity: FloatArray, n: int) -> Commands:
    return _always(len(velocity), n)._replace(across_mps2=_swing(rng, len(velocity), n))


def _singer(rng: np.random.Generator, velocity: FloatArray, n: int) -> Commands:
    keep = np.exp(-STEP_S / SINGER_S)
    push = rng.normal(0.0, SINGER_MPS2, (n, len(velocity), 2))
    for k in range(1, n):
        push[k] = keep * push[k - 1] + np.sqrt(1.0 - keep * keep) * push[k]
    return _always(len(velocity), n)._replace(push_mps2=push)


def _always(runs: int, n: int) -> Commands:
    """No straight flight, and nothing else said."""
    return straight(runs, n)._replace(manoeuvring=np.ones((n, runs), bool))


FAMILIES = {
    "T0": Family(_three_manoeuvres, 0.0, (200.0, 200.0)),
    "R": Family(_turns_and_speed_changes),
    "weave": Family(_weave),
    "jink": Family(partial(_now_and_then, do=_jink)),
    "singer": Family(_singer),
    "wna": Family(lambda _, velocity, n: _always(len(velocity), n), WNA_DENSITY),
    "cv": Family(lambda _, velocity, n: straight(len(velocity), n)),
    "both": Family(partial(_now_and_then, do=_turn_with_speed_change)),
    "s-turns": Family(_s_turns),
}
"""The families by name."""
