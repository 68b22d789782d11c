"""The cases: how many targets, how they fly, what is wrong with the two radars."""

from __future__ import annotations

from typing import NamedTuple

WARM_UP_S = 20.0
"""What is decided before is not counted."""

CYCLE_S = 2.0
P_DETECT = 0.95
SIGMA_RANGE_M, SIGMA_AZIMUTH_DEG = 50.0, 0.2
"""Of noise, and again of interference."""

BIAS_RANGE_M, BIAS_AZIMUTH_DEG = 150.0, 0.4
"""Of the second radar, where it has one."""


class Case(NamedTuple):
    """One case.

    Attributes:
        name: in tables.
        targets: how many, half of them turning now and then; in formations half of them lead and half follow.
        duration_s: after the warm-up.
        seeds: how many runs.
        scale: of all errors.
        side_m: of the square where targets are.
        bias: the second radar measures too far and too far clockwise.
        formation_m: distance of the two targets of a formation, 0 for single targets.
        coverage: share of the targets that each radar sees.
        gaps: each radar loses a third of its targets for 15 s.
        asynchronous: the radars turn in 2.0 and 2.7 s and see each target when the beam passes it.
        told: the radars tell of their interference, so that it is in R.
    """

    name: str
    targets: int
    duration_s: float = 120.0
    seeds: int = 6
    scale: float = 1.0
    side_m: float = 100e3
    bias: bool = False
    formation_m: float = 0.0
    coverage: float = 1.0
    gaps: bool = False
    asynchronous: bool = False
    told: bool = True


CASES = (
    Case("nominal, 20", 20),
    Case("nominal, 80", 80),
    Case("bias, 80", 80, bias=True),
    Case("formations of 500 m, 80", 80, scale=2.0, formation_m=500.0),
    Case("formations of 1000 m and bias, 80", 80, scale=2.0, formation_m=1000.0, bias=True),
    Case("interference not in R, 80", 80, scale=2.0, told=False),
    Case("gaps, 80", 80, gaps=True),
    Case("asynchronous, 80", 80, asynchronous=True),
    Case("70 % coverage, 200 in 20 km", 200, seeds=3, scale=2.0, side_m=20e3, coverage=0.7),
    Case("nominal, 500", 500, seeds=2),
    Case(
        "coverage, gaps, bias, asynchronous, 500", 500, seeds=2, scale=2.0, coverage=0.7, gaps=True, bias=True,
        asynchronous=True,
    ),
    Case("nominal, 2000", 2000, duration_s=20.0, seeds=1),
    Case("gaps, asynchronous, 2000", 2000, duration_s=30.0, seeds=1, scale=2.0, gaps=True, asynchronous=True),
)  # fmt: skip
