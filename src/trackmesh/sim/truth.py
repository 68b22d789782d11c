"""Where the simulated targets really are, as a function of time.

A target's path is a chain of legs, each of constant speed and turn rate, so its state has a closed form at any
time; there is no grid. With heading h (clockwise from north), turn rate w (clockwise) and speed v, after tau s::

    position = start + v tau sinc(w tau / 2) [sin(h + w tau / 2), cos(h + w tau / 2)]
    velocity = v [sin(h + w tau), cos(h + w tau)]

Everything follows from scenario and seed. A longer horizon adds legs and targets and changes none, so processes
that look ahead differently still see the same world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.messages import TruthFrame
from trackmesh.sim.legs import Legs, quiet_lives, turning_legs, unit_vector
from trackmesh.sim.scenario import Scenario

TRUTH_STREAM = 1
"""Spawn key of the truth's random numbers, apart from those of every radar."""


class TruthState(NamedTuple):
    """The targets that are there at one time: ids (n,) and states (n, 4) [east, north, veast, vnorth]."""

    ids: IntArray
    states: FloatArray


@dataclass(frozen=True)
class Truth:
    """All targets up to ``horizon_s``; one row a target.

    Attributes:
        ids: (n,) from 1, the turning targets first.
        quiet: (n,) bool, whether the target never manoeuvres.
        born_s, dies_s: (n,) the target is there from ``born_s`` until before ``dies_s``.
        horizon_s: states are right up to this time.
        legs: the paths.
    """

    ids: IntArray
    quiet: np.ndarray[tuple[int], np.dtype[np.bool_]]
    born_s: FloatArray
    dies_s: FloatArray
    horizon_s: float
    legs: Legs

    @property
    def quiet_ids(self) -> IntArray:
        """Ids of the targets that never manoeuvre."""
        return self.ids[self.quiet]

    def states(self, rows: IntArray, t_s: FloatArray) -> FloatArray:
        """States (m, 4) of the targets ``rows`` (m,), each at its own time ``t_s`` (m,)."""
        leg = self.legs.at(rows, t_s)
        tau = t_s - self.legs.t_s[leg]
        speed, half_turn = self.legs.speed_mps[leg], 0.5 * self.legs.turn_rate_rad_s[leg] * tau
        middle = self.legs.heading_rad[leg] + half_turn
        chord = speed * tau * np.sinc(half_turn / np.pi)
        position = self.legs.position_m[leg] + chord[:, None] * unit_vector(middle)
        return np.concatenate([position, speed[:, None] * unit_vector(middle + half_turn)], axis=1)

    def alive(self, t_s: FloatArray | float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which targets (n,) are there at ``t_s``, one time or (n,) of them."""
        return np.asarray((self.born_s <= t_s) & (t_s < self.dies_s))

    def state_at(self, t_s: float) -> TruthState:
        """The targets that are there at ``t_s``."""
        rows = np.flatnonzero(self.alive(t_s))
        return TruthState(self.ids[rows], self.states(rows, np.full(len(rows), t_s)))


def make_truth(scenario: Scenario, seed: int, horizon_s: float | None = None) -> Truth:
    """The truth of a scenario up to ``horizon_s`` (the scenario's duration where None)."""
    horizon_s = scenario.duration_s if horizon_s is None else horizon_s
    targets = scenario.seen_targets()
    streams = np.random.SeedSequence(seed, spawn_key=(TRUTH_STREAM,)).spawn(3)
    turning_rng, quiet_rng, life_rng = (np.random.default_rng(stream) for stream in streams)
    turning = turning_legs(targets, targets.count - targets.quiet_count, turning_rng, horizon_s)
    quiet = quiet_lives(targets, targets.quiet_count, quiet_rng, horizon_s)
    paths = Legs.join([turning, quiet.legs])
    n, n_turning = len(paths.first) - 1, len(turning.first) - 1
    born_s = np.concatenate([np.zeros(n_turning), quiet.legs.t_s])
    born_s[: targets.count] += life_rng.uniform(0.0, 1.0, targets.count) * targets.appear_s
    dies_s = np.concatenate([np.full(n_turning, np.inf), quiet.exit_s])
    if targets.lifetime_s is not None:
        dies_s = np.minimum(dies_s, born_s + life_rng.uniform(*targets.lifetime_s, n))
    return Truth(np.arange(1, n + 1), np.arange(n) >= n_turning, born_s, dies_s, horizon_s, paths)


class World:
    """A scenario and a seed: the truth as far ahead as anyone asks."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        self.seed = seed
        self._truth = make_truth(scenario, seed)

    def truth(self, until_s: float) -> Truth:
        """The truth, right at least up to ``until_s``."""
        if until_s > self._truth.horizon_s:
            self._truth = make_truth(self.scenario, self.seed, 2.0 * until_s)
        return self._truth


def truth_frame(world: World, t_s: float, start_ns: int) -> TruthFrame:
    """The message of the truth ``t_s`` after the scenario's start at ``start_ns``."""
    ids, states = world.truth(t_s).state_at(t_s)
    t_ns = start_ns + round(t_s * 1e9)
    return TruthFrame(scenario_id=world.scenario.name, t_ns=t_ns, id=ids, state=states)
