"""The filters of the study: the service's default, each of its branches alone, and the default's parts taken out."""

from __future__ import annotations

import math
from typing import NamedTuple

from trackmesh.services.estimation.bank import NEVER_SPLIT, Branch, Models, make_models
from trackmesh.services.estimation.filters import generic_models, manoeuvre_models
from trackmesh.services.estimation.motion import TANGENTIAL, TURN

TURN_RATE_MAX_DEGPS, ACCELERATION_MAX_MPS2, MANOEUVRE_S, QUIET_S, Q_QUIET = 6.0, 10.0, 18.0, 45.0, 0.3
"""What the service supposes of targets unless it is told otherwise."""

_WORDS = (ACCELERATION_MAX_MPS2, MANOEUVRE_S, QUIET_S, Q_QUIET)
MANOEUVRE = manoeuvre_models(math.radians(TURN_RATE_MAX_DEGPS), *_WORDS)
GENERIC = generic_models(*_WORDS)

TVIMM, IMM, BRANCH_A = "tvimm", "imm", "branch A"
FIXED, WHOLE = "branch A, nothing estimated", "branch A, whole steps"

LAGGED = ("T0", "R1/30", "R2/30", "R4/30")
"""Cells in which states some plots ago are looked at."""

ABLATED = LAGGED


class Variant(NamedTuple):
    """A filter: its models, and of how many plots ago it tells."""

    models: Models
    lag: int = 0


def without_estimation(branch: Branch) -> Branch:
    """The branch with turn rates and accelerations along the path known exactly, as their prior's mean."""
    known = (model._replace(sd=0.0) if model.kind in (TURN, TANGENTIAL) else model for model in branch.models)
    return branch._replace(models=tuple(known))


def variants(cell: str, certain: bool) -> dict[str, Variant]:
    """The filters that are run in a cell, by name; the parts only where every plot is there."""
    branches = {TVIMM: (MANOEUVRE, GENERIC), IMM: (GENERIC,), BRANCH_A: (MANOEUVRE,)}
    found = {name: Variant(make_models(own)) for name, own in branches.items()}
    if not certain:
        return found
    if cell in ABLATED:
        found[FIXED] = Variant(make_models((without_estimation(MANOEUVRE),)))
    if cell == "R4/10":
        found[WHOLE] = Variant(make_models((MANOEUVRE._replace(split_s=NEVER_SPLIT),)))
    if cell in LAGGED:
        two = {name: make_models(own, lags=2) for name, own in branches.items()}
        found |= {f"{name}, lag {lag}": Variant(models, lag) for name, models in two.items() for lag in (1, 2)}
    return found
