"""What is claimed of the filter, and whether it was found.

The bounds were set before this study was written, from other simulations of the same kinds of targets; what had been
measured then stands beside them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from trackmesh.sim.studies.manoeuvre.cells import OUT_OF_FAMILY, P_DETECT
from trackmesh.sim.studies.manoeuvre.measurement import Measured
from trackmesh.sim.studies.manoeuvre.scores import Value
from trackmesh.sim.studies.manoeuvre.variants import ABLATED, BRANCH_A, FIXED, IMM, TVIMM, WHOLE


class Claim(NamedTuple):
    """A number of one filter in one cell, over another filter's or as it is, and the bounds it has to keep."""

    cell: str
    metric: str
    low: float = -np.inf
    high: float = np.inf
    before: str = ""
    name: str = TVIMM
    over: str | None = IMM

    @property
    def text(self) -> str:
        """What is looked at."""
        unit = "" if self.over else {"position": " (m)", "velocity": " (m/s)"}.get(self.metric, "")
        other = f" / {self.over}" if self.over else ""
        return f"{self.cell}: {self.metric}{unit}, {self.name}{other}"


class Judged(NamedTuple):
    """A claim with what was found."""

    text: str
    low: float
    high: float
    before: str
    found: Value
    where: str = ""

    @property
    def holds(self) -> bool:
        """Whether the number is within its bounds."""
        return self.low <= self.found.value <= self.high

    @property
    def bound(self) -> str:
        """The bounds in words."""
        if np.isinf(self.low):
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if np.isinf(self.high) else f"{self.low:g} to {self.high:g}"


CLAIMS = (
    Claim("T0", "position", 16.4, 17.8, "17.1", over=None),
    Claim("T0", "velocity", 10.3, 11.3, "10.8", over=None),
    Claim("T0", "position", high=0.93, before="0.892"),
    Claim("T0", "velocity", high=0.88, before="0.830"),
    Claim("T0", "peak", high=0.97, before="0.913"),
    Claim("R1/30", "position", high=0.92, before="0.882"),
    Claim("R1/30", "velocity", high=0.85, before="0.803"),
    Claim("R1/30", "peak", high=0.97, before="0.923"),
    Claim("R1/30", "anees", 0.75, 1.05, "0.88", over=None),
    Claim("R1/30", "anees in manoeuvre", high=2.2, before="1.83", over=None),
    Claim("R2/30", "position", high=0.94, before="0.899"),
    Claim("R2/30", "velocity", high=0.86, before="0.805"),
    Claim("R1/10", "position", high=0.92, before="0.882"),
    Claim("R1/10", "velocity", high=0.81, before="0.751"),
    Claim("R4/30", "position", high=0.97, before="0.942"),
    Claim("R4/30", "velocity", high=0.90, before="0.840"),
    Claim("R4/30", "anees", high=1.15, before="1.00", over=None),
    Claim("R4/10", "anees", high=1.35, before="1.17", over=None),
    Claim("R4/10", "anees", low=1.5, before="about 2.0", name=WHOLE, over=None),
    Claim("R10/30", "position", high=1.02, before="0.996"),
    Claim("R10/30", "velocity", high=1.0, before="0.940"),
    Claim("R10/30", "anees", high=1.6, before="1.36", over=None),
)
"""In single cells, the families that the filter is made for."""

PARTS = (
    *(Claim(cell, "position", low=1.04, before="1.05 to 1.12", name=FIXED, over=BRANCH_A) for cell in ABLATED),
    *(Claim(cell, "velocity", low=1.12, before="1.16 to 1.19", name=FIXED, over=BRANCH_A) for cell in ABLATED),
    Claim("R1/30", "position", high=0.83, before="0.79", name=f"{BRANCH_A}, lag 1", over=BRANCH_A),
    Claim("R1/30", "position", high=0.73, before="0.69", name=f"{BRANCH_A}, lag 2", over=BRANCH_A),
    Claim("T0", "position", high=0.78, before="0.744", name=f"{BRANCH_A}, lag 1", over=BRANCH_A),
    Claim("T0", "position", high=0.70, before="0.66", name=f"{BRANCH_A}, lag 2", over=BRANCH_A),
)
"""What the estimation of turn rates and accelerations is worth, and the refinement of states some plots ago."""


def judge(found: Measured) -> list[Judged]:
    """Every claim with what was found."""
    return [
        *(_judged(found, claim) for claim in CLAIMS),
        *_others(found),
        *(_judged(found, claim) for claim in PARTS),
    ]


def _judged(found: Measured, claim: Claim) -> Judged:
    value = found.value(claim.cell, claim.metric, claim.name, claim.over)
    return Judged(claim.text, claim.low, claim.high, claim.before, value)


def _others(found: Measured) -> Iterator[Judged]:
    """The worst of all cells of targets that the filter is not made for."""
    for certain, metric, family, high, before in (
        (True, "position", "", 1.03, "1.019"),
        (True, "velocity", "but cv", 1.03, "1.014"),
        (True, "velocity", "cv", 1.12, "1.088"),
        (False, "position", "", 1.06, "1.054"),
        (False, "velocity", "cv", 1.13, "1.098"),
    ):
        cases = found.select(group=OUT_OF_FAMILY, certain=certain)
        if family:
            cases = [case for case in cases if (case.cell.family == "cv") is (family == "cv")]
        worst, value = found.worst(cases, metric)
        who = family if family == "cv" else f"other targets {family}".strip()
        pd = "" if certain else f", Pd {P_DETECT:g}"
        text = f"{who}{pd}: {metric}, worst of {len(cases)}, {TVIMM} / {IMM}"
        yield Judged(text, -np.inf, high, before, value, worst.cell.name)
