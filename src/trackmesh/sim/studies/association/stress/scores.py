"""How good declared pairs are: correct of those that could be, wrong of those declared, changes of mind."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.sim.studies.association.stress.cases import WARM_UP_S
from trackmesh.sim.studies.association.stress.local_tracks import Recording
from trackmesh.sim.studies.association.stress.methods import Decided


class Score(NamedTuple):
    """Over a run after its warm-up.

    Attributes:
        correct: per cent of the moments at which both radars have a track of a target and the pair is declared.
        wrong: per cent of declared pairs that are of two targets.
        switches: times a track is given another partner than its last one, per 1000 declared pairs.
    """

    correct: float
    wrong: float
    switches: float


def score(recording: Recording, decided: list[Decided]) -> Score:
    """Score of what a method decided in a run."""
    possible = right = declared = switches = 0
    partner = np.full(recording.case.targets, -1)
    for moment, one in zip(recording.moments, decided, strict=True):
        if moment.t_s <= WARM_UP_S:
            continue
        possible += len(np.intersect1d(moment.a.target, moment.b.target, assume_unique=True))
        declared += len(one.a)
        right += int((one.a == one.b).sum())
        switches += int(((partner[one.a] >= 0) & (partner[one.a] != one.b)).sum())
        partner[one.a] = one.b
    wrong = 100.0 * (declared - right) / declared if declared else 0.0
    return Score(100.0 * right / max(possible, 1), wrong, 1000.0 * switches / max(declared, 1))
