"""The paths of simulated targets: chains of straight legs and coordinated turns.

All targets of a kind are laid out in step, one leg of each at a time, so the random numbers of a leg do not
depend on how many follow. A turning target keeps one rule: whenever it flies straight, one of its two tightest
turn circles lies inside the area. It then can always turn, and never leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.sim.scenario import Targets

STRAIGHT_SPREAD = (0.6, 1.4)
"""Shortest and longest straight leg, as parts of the mean one."""

AIM_PART = 0.5
"""Where a target is turned back, and where a quiet one is aimed: at this inner part of the area."""


@dataclass(frozen=True)
class Legs:
    """Legs (k,) of n targets, in order of target, then time.

    Attributes:
        first: (n + 1,) first leg of each target, and the end.
        t_s: (k,) start of the leg.
        position_m: (k, 2) east, north there.
        speed_mps, heading_rad, turn_rate_rad_s: (k,); heading and rate clockwise from north.
    """

    first: IntArray
    t_s: FloatArray
    position_m: FloatArray
    speed_mps: FloatArray
    heading_rad: FloatArray
    turn_rate_rad_s: FloatArray

    def at(self, rows: IntArray, t_s: FloatArray) -> IntArray:
        """The leg (m,) on which each target ``rows`` (m,) is at ``t_s`` (m,); the first one before its start."""
        low, high = self.first[rows], self.first[rows + 1]
        while np.any(high - low > 1):
            middle = (low + high) // 2
            begun = self.t_s[middle] <= t_s
            low, high = np.where(begun, middle, low), np.where(begun, high, middle)
        return low

    @classmethod
    def from_steps(cls, steps: list[_Step]) -> Legs:
        """Legs of n targets laid out in step: each of ``steps`` holds the next leg of all."""
        n, depth = len(steps[0].t_s), len(steps)
        t, position, speed, heading, rate = (np.stack(part, axis=1) for part in zip(*steps, strict=True))
        return cls(
            np.arange(n + 1) * depth,
            t.ravel(),
            position.reshape(-1, 2),
            speed.ravel(),
            heading.ravel(),
            rate.ravel(),
        )

    @classmethod
    def join(cls, parts: list[Legs]) -> Legs:
        """The targets of all parts, one part after the other."""
        ends = np.cumsum([0] + [len(part.t_s) for part in parts])
        first = [part.first[:-1] + end for part, end in zip(parts, ends, strict=False)]
        return cls(
            np.concatenate([*first, ends[-1:]]),
            np.concatenate([part.t_s for part in parts]),
            np.concatenate([part.position_m for part in parts]),
            np.concatenate([part.speed_mps for part in parts]),
            np.concatenate([part.heading_rad for part in parts]),
            np.concatenate([part.turn_rate_rad_s for part in parts]),
        )


class QuietLives(NamedTuple):
    """One straight leg each, and when (m,) the target leaves the area."""

    legs: Legs
    exit_s: FloatArray


class _Step(NamedTuple):
    t_s: FloatArray
    position_m: FloatArray
    speed_mps: FloatArray
    heading_rad: FloatArray
    turn_rate_rad_s: FloatArray


class _Box(NamedTuple):
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, targets: Targets) -> _Box:
        return cls(np.array(targets.area_enu_m[:2]), np.array(targets.area_enu_m[2:]))

    def inner(self, part: float) -> _Box:
        middle, half = 0.5 * (self.low + self.high), 0.5 * part * (self.high - self.low)
        return _Box(middle - half, middle + half)

    def holds(self, center_m: FloatArray, radius_m: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        margin = radius_m[:, None] - 1e-6
        inside = (center_m >= self.low + margin) & (center_m <= self.high - margin)
        return np.asarray(inside.all(axis=1))

    def time_to_leave(self, position_m: FloatArray, velocity_mps: FloatArray, margin_m: FloatArray) -> FloatArray:
        """Seconds until a point at constant velocity is nearer than ``margin_m`` to the border; 0 where it is."""
        to_high = self.high - margin_m[:, None] - position_m
        to_low = self.low + margin_m[:, None] - position_m
        ahead = np.where(velocity_mps > 0, to_high, to_low)
        with np.errstate(divide="ignore", invalid="ignore"):
            wait = np.where(velocity_mps == 0, np.inf, ahead / velocity_mps)
        outside = (to_high < 0).any(axis=1) | (to_low > 0).any(axis=1)
        return np.where(outside, 0.0, np.maximum(wait.min(axis=1), 0.0))


def turning_legs(targets: Targets, count: int, rng: np.random.Generator, horizon_s: float) -> Legs:
    """Paths of ``count`` targets that turn now and then and stay inside the area, until after ``horizon_s``."""
    box = _Box.of(targets)
    tightest = np.deg2rad(targets.turn_rate_deg_s[1])
    straight_s = np.mean(targets.turn_duration_s) * (1.0 / targets.manoeuvre_share - 1.0)
    speed = rng.uniform(*targets.speed_mps, count)
    heading = rng.uniform(0.0, 2.0 * np.pi, count)
    radius = speed / tightest
    position = rng.uniform(box.low + 2.0 * radius[:, None], box.high - 2.0 * radius[:, None], (count, 2))
    t, steps = np.zeros(count), list[_Step]()
    shortest = 0.0
    while not steps or t.min(initial=np.inf) <= horizon_s:
        wanted = straight_s * rng.uniform(shortest, STRAIGHT_SPREAD[1], count)
        shortest = STRAIGHT_SPREAD[0]
        room = _time_to_turn(box, position, speed, heading, radius)
        straight = np.minimum(wanted, room)
        steps.append(_Step(t, position, speed, heading, np.zeros(count)))
        t, position = t + straight, position + (speed * straight)[:, None] * unit_vector(heading)
        rate, duration = _turn(targets, box, rng, position, speed, heading)
        back = _turn_to(rng, box, position, heading, rate)
        duration = np.where(room <= wanted, back, duration)
        steps.append(_Step(t, position, speed, heading, rate))
        center = _center(position, speed, heading, rate)
        t, heading = t + duration, heading + rate * duration
        position = center - (speed / rate)[:, None] * _right(heading)
    return Legs.from_steps(steps)


def quiet_lives(targets: Targets, count: int, rng: np.random.Generator, horizon_s: float) -> QuietLives:
    """Straight crossings: ``count`` targets at a time, each followed by another one from the border.

    The first ones start anywhere inside. Row g count + j is the g-th target of place j.
    """
    box, t, lives, exits = _Box.of(targets), np.zeros(count), list[_Step](), list[FloatArray]()
    position = rng.uniform(box.low, box.high, (count, 2))
    while not lives or t.min(initial=np.inf) <= horizon_s:
        speed = rng.uniform(*targets.speed_mps, count)
        heading = _bearing(position, rng.uniform(*box.inner(AIM_PART), (count, 2)))
        crossing = box.time_to_leave(position, speed[:, None] * unit_vector(heading), np.zeros(count))
        lives.append(_Step(t, position, speed, heading, np.zeros(count)))
        t = t + crossing
        exits.append(t)
        position = _on_border(box, rng, count)
    alone = Legs.from_steps([_Step(*(np.concatenate(part) for part in zip(*lives, strict=True)))])
    return QuietLives(alone, np.concatenate(exits))


def _time_to_turn(
    box: _Box, position: FloatArray, speed: FloatArray, heading: FloatArray, radius: FloatArray
) -> FloatArray:
    """Seconds until the second of the two tightest turn circles begins to leave the area."""
    velocity, side = speed[:, None] * unit_vector(heading), radius[:, None] * _right(heading)
    right = box.time_to_leave(position + side, velocity, radius)
    left = box.time_to_leave(position - side, velocity, radius)
    return np.maximum(right, left)


def _turn(
    targets: Targets,
    box: _Box,
    rng: np.random.Generator,
    position: FloatArray,
    speed: FloatArray,
    heading: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Turn rates (n,) whose whole circle lies in the area, the one drawn where it does; and durations (n,)."""
    n = len(speed)
    low, high = np.deg2rad(targets.turn_rate_deg_s)
    drawn = rng.uniform(low, high, n) * rng.choice([-1.0, 1.0], n)
    tightest = np.copysign(high, drawn)
    choices = [drawn, -drawn, tightest]
    fits = [box.holds(_center(position, speed, heading, w), np.abs(speed / w)) for w in choices]
    return np.select(fits, choices, -tightest), rng.uniform(*targets.turn_duration_s, n)


def _turn_to(
    rng: np.random.Generator, box: _Box, position: FloatArray, heading: FloatArray, rate: FloatArray
) -> FloatArray:
    """Seconds of a turn towards some point of the inner area."""
    aim = rng.uniform(*box.inner(AIM_PART), position.shape)
    angle = np.sign(rate) * (_bearing(position, aim) - heading)
    return np.mod(angle, 2.0 * np.pi) / np.abs(rate)


def _on_border(box: _Box, rng: np.random.Generator, count: int) -> FloatArray:
    share, side = rng.uniform(0.0, 1.0, count), rng.integers(0, 4, count)
    along = np.stack([share, np.zeros(count)], axis=1)
    unit = np.select(
        [(side == k)[:, None] for k in range(3)], [along, 1.0 - along, along[:, ::-1]], 1.0 - along[:, ::-1]
    )
    return box.low + unit * (box.high - box.low)


def _center(position: FloatArray, speed: FloatArray, heading: FloatArray, rate: FloatArray) -> FloatArray:
    return position + (speed / rate)[:, None] * _right(heading)


def _bearing(start: FloatArray, end: FloatArray) -> FloatArray:
    return np.arctan2(end[:, 0] - start[:, 0], end[:, 1] - start[:, 1])


def unit_vector(heading: FloatArray) -> FloatArray:
    """East and north (..., 2) of unit length in the direction ``heading``, clockwise from north."""
    return np.stack([np.sin(heading), np.cos(heading)], axis=-1)


def _right(heading: FloatArray) -> FloatArray:
    return np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
