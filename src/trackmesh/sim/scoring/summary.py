"""What a whole run comes to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.sim.metrics import (
    Cover,
    Pairs,
    Siap,
    continuity,
    identity_switches,
    mean,
    nees_band,
    purity,
    rmse,
    siap,
)
from trackmesh.sim.scoring.frames import Compared, FrameScore, ScoreRules

CHI2_2_95 = 5.991464547107979
"""95 % of a chi-square variable of two degrees of freedom lie below."""

MOSTLY = 0.8
"""A target is mostly tracked if it is matched in so many of its frames."""


@dataclass(frozen=True)
class ScoreSummary:
    """A whole run after its warm-up; means are over frames, NaN where there is nothing to average.

    Attributes:
        frames: how many were scored; ``without_truth`` lie outside the truth's time and were not.
        tracks: how many different tracks were shown.
        gospa_m: mean GOSPA (p = 2, alpha = 2); ``localisation_m2``, ``missed`` and ``false`` are the means of its
            parts: gospa^2 = localisation + (missed + false) c^2 / 2 in each frame.
        ospa_m: mean OSPA (p = 2).
        rmse_m, rmse_velocity_mps: of the matched tracks.
        nees: mean normalised error squared of the matched positions, 2 if the covariance is right; ``within_95`` is the
            share below the 95 % bound.
        coverage: share of targets matched.
        id_switches: how often a target was matched with another track than before.
        purity: share of matches in which a track follows its main target; ``continuity`` of those in which a target
            is followed by its main track.
        gospa_switching_m: mean GOSPA with changes of assignment, each at the cost ``switch_m``; ``switching`` is how
            many there are a frame.
        mostly_tracked: share of targets that are matched in at least 80 % of their frames.
        nees_low, nees_high: between which the mean NEES of one frame lies with 95 %, for as many matches as a frame has
            in the median; ``nees_in_band`` is the share of frames in which it lies within the frame's own band: 0.95
            if the covariance is right.
        nees_state: mean NEES of position and velocity together, 4 if the covariance is right.
        siap_completeness, siap_ambiguity, siap_spuriousness, siap_position_m, siap_velocity_mps, siap_number_changes,
            siap_changes_per_h, siap_longest_segment: see ``Siap``; its gate is ``gate_m``.
    """

    c_m: float
    frames: int
    without_truth: int
    tracks: int
    gospa_m: float
    localisation_m2: float
    missed: float
    false: float
    ospa_m: float
    rmse_m: float
    rmse_velocity_mps: float
    nees: float
    within_95: float
    coverage: float
    id_switches: int
    purity: float
    continuity: float
    switch_m: float
    gospa_switching_m: float
    switching: float
    mostly_tracked: float
    nees_low: float
    nees_high: float
    nees_in_band: float
    nees_state: float
    gate_m: float
    siap_completeness: float
    siap_ambiguity: float
    siap_spuriousness: float
    siap_position_m: float
    siap_velocity_mps: float
    siap_number_changes: int
    siap_changes_per_h: float
    siap_longest_segment: float

    def as_dict(self) -> dict[str, float | int]:
        """The figures by name."""
        return asdict(self)


def summarise(
    scores: Sequence[FrameScore], compared: Sequence[Compared], rules: ScoreRules, without_truth: int, tracks: int
) -> ScoreSummary:
    """Sum up all frames, the warm-up among them: it tells who was followed by whom, and no more."""
    counted = np.array([score.scored for score in scores], np.bool_)
    warm = [score for score in scores if score.scored]
    found = [one for one, score in zip(compared, scores, strict=True) if score.scored]
    pairs = pairs_of(found)
    normalised, targets = _joined([one.nees for one in found]), sum(score.targets for score in warm)
    low, high = nees_band(np.median([score.matched for score in warm]) if warm else 0, 2)
    air = _air_picture(warm, found)
    return ScoreSummary(
        c_m=rules.c_m,
        frames=len(warm),
        without_truth=without_truth,
        tracks=tracks,
        gospa_m=mean([score.gospa_m for score in warm]),
        localisation_m2=mean([score.localisation_m2 for score in warm]),
        missed=mean([score.missed for score in warm]),
        false=mean([score.false for score in warm]),
        ospa_m=mean([score.ospa_m for score in warm]),
        rmse_m=rmse(pairs.distance_m),
        rmse_velocity_mps=rmse(_joined([one.velocity_error_mps for one in found])),
        nees=mean(normalised),
        within_95=mean(normalised < CHI2_2_95),
        coverage=len(pairs.frame) / targets if targets else float("nan"),
        id_switches=identity_switches(pairs_of(compared), counted),
        purity=purity(pairs),
        continuity=continuity(pairs),
        switch_m=rules.switch_m,
        gospa_switching_m=mean([score.gospa_switching_m for score in warm]),
        switching=mean([score.switching for score in warm]),
        mostly_tracked=_mostly_tracked(found),
        nees_low=float(low),
        nees_high=float(high),
        nees_in_band=mean([s.nees_low <= s.nees <= s.nees_high for s in warm if s.matched]),
        nees_state=mean(_joined([one.nees_state for one in found])),
        gate_m=rules.gate_m,
        siap_completeness=air.completeness,
        siap_ambiguity=air.ambiguity,
        siap_spuriousness=air.spuriousness,
        siap_position_m=air.position_m,
        siap_velocity_mps=air.velocity_mps,
        siap_number_changes=air.number_changes,
        siap_changes_per_h=air.changes_per_h,
        siap_longest_segment=air.longest_segment,
    )


def pairs_of(found: Sequence[Compared]) -> Pairs:
    """The matched pairs of frames, numbered from 0."""
    return Pairs(
        _numbers([one.target_id for one in found]),
        _joined_ids([one.target_id for one in found]),
        _joined_ids([one.track_id for one in found]),
        _joined([one.distance_m for one in found]),
    )


def presence(found: Sequence[Compared]) -> Cover:
    """Which target was there in which frame; as its own track."""
    ids = _joined_ids([one.present for one in found])
    return Cover(_numbers([one.present for one in found]), ids, ids)


def _air_picture(scores: Sequence[FrameScore], found: Sequence[Compared]) -> Siap:
    cover = Cover(
        _numbers([one.near_target_id for one in found]),
        _joined_ids([one.near_target_id for one in found]),
        _joined_ids([one.near_track_id for one in found]),
    )
    t_s = np.array([(score.t_ns - scores[0].t_ns) * 1e-9 for score in scores])
    return siap([one.counts for one in found], cover, t_s, presence(found))


def _mostly_tracked(found: Sequence[Compared]) -> float:
    there, lived = np.unique(_joined_ids([one.present for one in found]), return_counts=True)
    matched, often = np.unique(_joined_ids([one.target_id for one in found]), return_counts=True)
    share = np.zeros(len(there))
    place = np.searchsorted(there, matched)
    share[place] = often / lived[place]
    return mean(share >= MOSTLY)


def _numbers(columns: Sequence[IntArray]) -> IntArray:
    return np.repeat(np.arange(len(columns)), [len(column) for column in columns]).astype(np.int64)


def _joined_ids(columns: Sequence[IntArray]) -> IntArray:
    return np.concatenate([np.zeros(0, np.int64), *columns])


def _joined(columns: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([np.zeros(0), *columns])
