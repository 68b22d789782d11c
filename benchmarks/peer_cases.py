"""The cases that a fusion engine must stand: two radars and 50 targets, one hardship at a time.

Times are parts of the run, so that a short run holds the same events; those of 300 s are named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from benchmarks.trials import (
    EAST,
    NORTH,
    Kept,
    Trial,
    biased,
    coming_and_going,
    crossing,
    crossings,
    in_pairs,
    late,
    silent,
    trial,
    unseen,
    with_positions,
)

DURATION_S = 300.0
SMALL, LARGE = (150.0, 0.4), (300.0, 0.8)
"""Metres and degrees by which the second radar measures too much."""


class Bound(NamedTuple):
    """A figure and what it must not be above (or below, with ``least``); ``of`` names a case whose figure scales it."""

    figure: str
    limit: float
    least: bool = False
    of: str | None = None

    def text(self) -> str:
        """As people write it."""
        times = f" x {self.of}" if self.of else ""
        return f"{self.figure} {'>=' if self.least else '<='} {self.limit:g}{times}"


class Case(NamedTuple):
    """A case by name: what makes it, of a seed and a duration, its bounds, and settings that belong to it."""

    name: str
    make: Callable[..., Trial]
    bounds: tuple[Bound, ...]
    settings: dict[str, Any]

    @property
    def about(self) -> str:
        """Its first line of documentation."""
        return (self.make.__doc__ or "").splitlines()[0].rstrip(".")


CASES: dict[str, Case] = {}

Make = Callable[..., Trial]


def case(name: str, *bounds: Bound, **settings: Any) -> Callable[[Make], Make]:
    """Enter a case under this name."""

    def enter(make: Make) -> Make:
        CASES[name] = Case(name, make, bounds, settings)
        return make

    return enter


def _at_most(**limits: float) -> tuple[Bound, ...]:
    return tuple(Bound(figure, limit) for figure, limit in limits.items())


def _at_least(**limits: float) -> tuple[Bound, ...]:
    return tuple(Bound(figure, limit, least=True) for figure, limit in limits.items())


AS_NOMINAL = Bound("gospa_m", 1.02, of="nominal")
LEARNT = _at_most(bias_120_m=30.0, bias_120_deg=0.06)


# --- as the scenario is, and with biased radars ---


@case("nominal", *_at_most(gospa_m=515.0, rmse_m=73.0), *_at_least(pairs_right_pct=99.9))
def nominal(seed: int, duration_s: float = DURATION_S) -> Trial:
    """As the scenario is."""
    return trial(seed, duration_s)


@case("bias-150", AS_NOMINAL, *LEARNT)
def bias_150(seed: int, duration_s: float = DURATION_S) -> Trial:
    """The second radar is off by 150 m and .4 deg."""
    return biased(trial(seed, duration_s), EAST, *SMALL)


@case("bias-300", AS_NOMINAL, *LEARNT)
def bias_300(seed: int, duration_s: float = DURATION_S) -> Trial:
    """The second radar is off by 300 m and .8 deg."""
    return biased(trial(seed, duration_s), EAST, *LARGE)


@case("bias-step", *_at_most(gospa_m=560.0), *LEARNT)
def bias_step(seed: int, duration_s: float = DURATION_S) -> Trial:
    """The bias of 150 m and .4 deg appears after two fifths of the run (120 s)."""
    return biased(trial(seed, duration_s), EAST, *SMALL, from_s=0.4 * duration_s)


@case("bias-unregistered", *_at_least(gospa_m=1000.0), registration=False)
def bias_unregistered(seed: int, duration_s: float = DURATION_S) -> Trial:
    """Registration switched off under the bias of 150 m: the check that can fail."""
    return bias_150(seed, duration_s)


# --- clutter and misses ---


@case("pd-70")
def pd_70(seed: int, duration_s: float = DURATION_S) -> Trial:
    """Both radars detect 70 % instead of 90 %, and say so."""
    return trial(seed, duration_s, radars={"p_detect": 0.7})


@case("clutter-200")
def clutter_200(seed: int, duration_s: float = DURATION_S) -> Trial:
    """200 instead of 20 false plots a turn, which no radar declares."""
    return trial(seed, duration_s, radars={"clutter_per_scan": 200.0})


@case("pd-70-clutter-200", *_at_most(gospa_m=820.0))
def pd_70_clutter_200(seed: int, duration_s: float = DURATION_S) -> Trial:
    """Both: 70 % detected, 200 false plots a turn."""
    return trial(seed, duration_s, radars={"p_detect": 0.7, "clutter_per_scan": 200.0})


# --- targets that are close ---


@case("formation", *_at_most(gospa_m=530.0, switches=6.0), *_at_least(pairs_right_pct=98.0))
def formation(seed: int, duration_s: float = DURATION_S) -> Trial:
    """25 pairs: each second target flies 500 m beside the one before it, in a direction that stays."""
    return trial(seed, duration_s, rearrange=in_pairs(seed, 500.0))


@case("formation-bias", *_at_most(gospa_m=530.0, switches=6.0), *_at_least(pairs_right_pct=98.0))
def formation_bias(seed: int, duration_s: float = DURATION_S) -> Trial:
    """The pairs, and the second radar off by 150 m and .4 deg."""
    return biased(formation(seed, duration_s), EAST, *SMALL)


@case("crossing")
def crossing_pairs(seed: int, duration_s: float = DURATION_S) -> Trial:
    """25 pairs that meet once within 100 m at 20 to 40 deg; identities from 25 s before to 25 s after.

    Each second target's whole flight is turned and shifted, so that it meets the one before it.
    """
    meet = crossings(seed, 25, duration_s)
    looked = tuple(Kept(t - 25.0, t + 25.0, np.array([2 * k, 2 * k + 1])) for k, t in enumerate(meet.t_s.tolist()))
    given = trial(seed, duration_s, rearrange=crossing(meet))
    return replace(given, kept=looked)


# --- sensors that fall silent, targets that are not seen ---


@case("radar-dead", *_at_least(kept_pct=98.0))
def radar_dead(seed: int, duration_s: float = DURATION_S) -> Trial:
    """The first radar sends nothing for a fifth of the run (120 to 180 s); identities from 60 to 295 s."""
    return silent(trial(seed, duration_s), 0.4 * duration_s, 0.6 * duration_s, NORTH)


@case("unseen-20", *_at_least(kept_pct=90.0))
def unseen_20(seed: int, duration_s: float = DURATION_S) -> Trial:
    """A fifth of the targets is seen by no sensor for 15 s from 120 s on, the rest is; identities of that fifth."""
    given, begin_s = trial(seed, duration_s), 0.4 * duration_s
    some = np.sort(np.random.default_rng([seed, 5]).permutation(given.targets)[: given.targets // 5])
    gone = unseen(given, begin_s, begin_s + 15.0, some)
    return replace(gone, kept=(Kept(begin_s - 1.0, begin_s + 40.0, some),))


@case("blackout", *_at_least(kept_pct=90.0))
def blackout(seed: int, duration_s: float = DURATION_S) -> Trial:
    """No sensor sends anything for 15 s from 120 s on, the clock ticks; identities of all targets."""
    given, begin_s = trial(seed, duration_s), 0.4 * duration_s
    dark = silent(given, begin_s, begin_s + 15.0)
    return replace(dark, kept=(Kept(begin_s - 1.0, begin_s + 40.0),))


@case("come-and-go", *_at_most(shown_after_s=8.0, gone_after_s=15.0))
def come_and_go(seed: int, duration_s: float = DURATION_S) -> Trial:
    """A third of the targets appears, another third is gone, at some time of the run; identities of those that stay."""
    return coming_and_going(trial(seed, duration_s), seed)


# --- more sensors, fewer or more targets ---


@case("third-sensor")
def third_sensor(seed: int, duration_s: float = DURATION_S) -> Trial:
    """A third sensor measures positions: 80 m, every 3 s, 80 % detected, no clutter."""
    return with_positions(trial(seed, duration_s), seed, 3.0, 80.0, 0.8)


@case("bias-5", *_at_most(rmse_m=85.0))
def bias_5(seed: int, duration_s: float = DURATION_S) -> Trial:
    """Five targets only, the second radar off by 150 m and .4 deg."""
    return biased(trial(seed, duration_s, 5), EAST, *SMALL)


@case("bias-12")
def bias_12(seed: int, duration_s: float = DURATION_S) -> Trial:
    """Twelve targets, the second radar off by 150 m and .4 deg."""
    return biased(trial(seed, duration_s, 12), EAST, *SMALL)


@case("bias-1000", *_at_most(missed_pct=2.0))
def bias_1000(seed: int, duration_s: float = DURATION_S) -> Trial:
    """1000 targets from a cold start, the second radar off by 150 m and .4 deg; 80 s, identities from 40 s on."""
    given = biased(trial(seed, min(duration_s, 80.0), 1000), EAST, *SMALL)
    return replace(given, kept=(Kept(40.0, 75.0),))


# --- how plots are sent ---


@case("late", *_at_most(gospa_m=560.0))
def late_batches(seed: int, duration_s: float = DURATION_S) -> Trial:
    """Every turn arrives 0 to 1 s late, so that some overtake others; scored at the arrival."""
    return late(trial(seed, duration_s), seed, 1.0)


@case("sectors-32", *_at_most(gospa_m=620.0))
def sectors_32(seed: int, duration_s: float = DURATION_S) -> Trial:
    """A turn is sent as 32 sectors; scored at every sector."""
    return trial(seed, duration_s, sectors=32)


@case("sectors-32-bias", *_at_most(gospa_m=620.0))
def sectors_32_bias(seed: int, duration_s: float = DURATION_S) -> Trial:
    """32 sectors, and the second radar off by 150 m and .4 deg."""
    return biased(trial(seed, duration_s, sectors=32), EAST, *SMALL)


@case("sectors-32-late", *_at_most(gospa_m=710.0))
def sectors_32_late(seed: int, duration_s: float = DURATION_S) -> Trial:
    """32 sectors a turn, each 0 to 1 s late; scored at the arrival."""
    return late(trial(seed, duration_s, sectors=32), seed, 1.0)
