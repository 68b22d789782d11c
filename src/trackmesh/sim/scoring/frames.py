"""One frame against the truth at its time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.sim.metrics import (
    Match,
    SiapCount,
    Switches,
    gospa_with_switching,
    match,
    mean,
    nearest_target,
    nees,
    nees_band,
    rmse,
    siap_count,
)
from trackmesh.sim.scoring.picture import Picture


class ScoreRules(NamedTuple):
    """How frames are scored.

    Attributes:
        c_m: cut-off of GOSPA and OSPA.
        switch_m: what a change of assignment costs in GOSPA with switching.
        gate_m: a track farther from every target is spurious in SIAP.
    """

    c_m: float
    switch_m: float
    gate_m: float


class FrameScore(NamedTuple):
    """One frame; NaN where there is nothing to average.

    Attributes:
        t_ns: when. scored: whether it is after the warm-up.
        targets, tracks: how many there are. matched: pairs nearer than the cut-off.
        gospa_m, localisation_m2, missed, false: gospa^2 = localisation + (missed + false) c^2 / 2.
        ospa_m: OSPA.
        switching: changes of assignment since the frame before, see ``Switches``; gospa_switching_m: with their cost,
            gospa^2 + switching * cost^2. id_switches: targets followed by another track than before.
        rmse_m, rmse_velocity_mps: of the matched tracks.
        nees, nees_low, nees_high: mean normalised error squared of the matched positions, 2 if the covariance is right,
            and between which values it then lies with 95 %.
        nees_state: the same of position and velocity together, 4 if the covariance is right.
        siap_completeness, siap_ambiguity, siap_spuriousness, siap_position_m, siap_velocity_mps: see ``Siap``.
    """

    t_ns: int
    scored: bool
    targets: int
    tracks: int
    matched: int
    gospa_m: float
    localisation_m2: float
    missed: int
    false: int
    ospa_m: float
    switching: float
    gospa_switching_m: float
    id_switches: int
    rmse_m: float
    rmse_velocity_mps: float
    nees: float
    nees_low: float
    nees_high: float
    nees_state: float
    siap_completeness: float
    siap_ambiguity: float
    siap_spuriousness: float
    siap_position_m: float
    siap_velocity_mps: float


class Compared(NamedTuple):
    """Targets and tracks of a frame, who is matched with whom (k,), and how far they are off.

    Attributes:
        present: (n,) ids of the targets.
        target_id, track_id, distance_m, velocity_error_mps, nees, nees_state: (k,) of the matched pairs.
        best: the matching. counts: for SIAP.
        near_target_id, near_track_id: (m,) which track is with which target in SIAP.
    """

    present: IntArray
    target_id: IntArray
    track_id: IntArray
    distance_m: FloatArray
    velocity_error_mps: FloatArray
    nees: FloatArray
    nees_state: FloatArray
    best: Match
    counts: SiapCount
    near_target_id: IntArray
    near_track_id: IntArray


def compare(ids: IntArray, states: FloatArray, shown: Picture, rules: ScoreRules) -> Compared:
    """Match targets, ids (n,) and states (n, 4), with the tracks that are shown."""
    best = match(states[:, :2], shown.position_m, rules.c_m)
    found = np.concatenate([shown.position_m, shown.velocity_mps], axis=1)
    error = found[best.track] - states[best.target]
    near, away_m = nearest_target(states[:, :2], shown.position_m, rules.gate_m)
    own = near >= 0
    wrong_mps = np.zeros(len(near))
    wrong_mps[own] = np.linalg.norm(shown.velocity_mps[own] - states[near[own], 2:], axis=1)
    return Compared(
        present=ids,
        target_id=ids[best.target],
        track_id=shown.track_id[best.track],
        distance_m=best.distance_m,
        velocity_error_mps=np.hypot(error[:, 2], error[:, 3]),
        nees=nees(error[:, :2], shown.covariance_m2[best.track]),
        nees_state=nees(error, shown.state_covariance[best.track]),
        best=best,
        counts=siap_count(near, away_m, wrong_mps, len(ids)),
        near_target_id=ids[near[own]],
        near_track_id=shown.track_id[own],
    )


def frame_score(t_ns: int, scored: bool, found: Compared, changed: Switches, rules: ScoreRules) -> FrameScore:
    """The figures of one frame."""
    parts, counts, matched = found.best.gospa(), found.counts, len(found.target_id)
    low, high = nees_band(matched, 2)
    return FrameScore(
        t_ns=t_ns,
        scored=scored,
        targets=found.best.n_targets,
        tracks=found.best.n_tracks,
        matched=matched,
        gospa_m=parts.total_m,
        localisation_m2=parts.localisation,
        missed=parts.missed,
        false=parts.false,
        ospa_m=found.best.ospa(),
        switching=changed.assignments,
        gospa_switching_m=gospa_with_switching(parts, changed.assignments, rules.switch_m),
        id_switches=changed.identities,
        rmse_m=rmse(found.distance_m),
        rmse_velocity_mps=rmse(found.velocity_error_mps),
        nees=mean(found.nees),
        nees_low=float(low),
        nees_high=float(high),
        nees_state=mean(found.nees_state),
        siap_completeness=_ratio(counts.tracked, counts.targets),
        siap_ambiguity=_ratio(counts.assigned, counts.tracked),
        siap_spuriousness=_ratio(counts.tracks - counts.assigned, counts.tracks),
        siap_position_m=_ratio(counts.position_m, counts.assigned),
        siap_velocity_mps=_ratio(counts.velocity_mps, counts.assigned),
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
