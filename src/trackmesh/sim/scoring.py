"""Recorded or live pictures scored against the truth.

A frame is scored as it stands: the confirmed and coasting tracks it holds, at its own time. Two methods exist,
since two are in use: ``score_tracks`` (simulated truth, all targets known, GOSPA cut-off of a kilometre) and
``score_nearest`` (recordings in which only some of what is seen has a truth).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import COASTING, CONFIRMED, TrackFrame, TruthFrame
from trackmesh.sim.metrics import (
    Match,
    Pairs,
    continuity,
    identity_switches,
    match,
    nearest_distance,
    nees,
    purity,
    rmse,
)

CHI2_2_95 = 5.991464547107979
"""95 % of a chi-square variable of two degrees of freedom lie below."""

Progress = Callable[[int], None]


class Picture(NamedTuple):
    """The confirmed and coasting tracks (n,) of a frame.

    Attributes:
        track_id: (n,).
        position_m, velocity_mps: (n, 2).
        covariance_m2: (n, 2, 2) of the position.
        coasting: (n,) whether the track is without plots.
    """

    track_id: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    covariance_m2: FloatArray
    coasting: npt.NDArray[np.bool_]


class FrameScore(NamedTuple):
    """One frame: its time, how many targets and tracks there are, and how far apart they are."""

    t_ns: int
    targets: int
    tracks: int
    gospa_m: float
    ospa_m: float
    localisation_m2: float
    missed: int
    false: int


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

    def as_dict(self) -> dict[str, float | int]:
        """The figures by name."""
        return asdict(self)


@dataclass(frozen=True)
class NearestSummary:
    """A run scored by the nearest track of each target with a truth.

    Attributes:
        frames: how many were scored.
        tracks: how many different tracks were shown.
        gospa_m, false: means over the frames; what is real but has no truth counts as false.
        coverage: share of targets with a track nearer than ``c_m``; ``rmse_m`` is of those.
    """

    c_m: float
    frames: int
    tracks: int
    gospa_m: float
    false: float
    coverage: float
    rmse_m: float

    def as_dict(self) -> dict[str, float | int]:
        """The figures by name."""
        return asdict(self)


class TruthTimeline:
    """The truth at any time between its first and its last frame.

    Raises:
        TrackmeshError: there is no frame.
    """

    def __init__(self, frames: Iterable[TruthFrame]) -> None:
        self.frames = sorted(frames, key=lambda frame: frame.t_ns)
        if not self.frames:
            raise TrackmeshError("The truth holds no frame, so there is nothing to score against.")
        self._t_ns = [frame.t_ns for frame in self.frames]
        self.first_ns, self.last_ns = self._t_ns[0], self._t_ns[-1]

    def nearest(self, t_ns: int) -> TruthFrame:
        """The frame nearest in time, the earlier of two."""
        i = bisect_left(self._t_ns, t_ns)
        around = self.frames[max(0, i - 1) : i + 1]
        return min(around, key=lambda frame: abs(frame.t_ns - t_ns))

    def at(self, t_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Ids (n,) and states (n, 4) at ``t_ns``, or None outside the truth's time.

        Between two frames: the targets of both; positions by the cubic that has the right positions and
        velocities at either end, velocities linear.
        """
        if not self.first_ns <= t_ns <= self.last_ns:
            return None
        i = bisect_left(self._t_ns, t_ns)
        after = self.frames[i]
        if after.t_ns == t_ns:
            return after.id, after.state[:, :4]
        before = self.frames[i - 1]
        ids, a, b = np.intersect1d(before.id, after.id, return_indices=True)
        step_s = (after.t_ns - before.t_ns) * 1e-9
        part = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)
        return ids, _interpolate(before.state[a, :4], after.state[b, :4], step_s, part)


class Scorer:
    """Scores frames one by one as they come, and sums them up.

    ``warmup_s`` counts from the truth's first frame; frames before its end tell who followed whom, and no more.
    """

    def __init__(self, truth: TruthTimeline, c_m: float = 1000.0, warmup_s: float = 40.0) -> None:
        self._truth = truth
        self._c_m = c_m
        self._warm_ns = truth.first_ns + round(warmup_s * 1e9)
        self._without_truth = 0
        self._scores: list[FrameScore] = []
        self._shown: set[int] = set()
        self._pairs: list[_FramePairs] = []

    def add(self, frame: TrackFrame) -> FrameScore | None:
        """Score one frame; None where there is no truth."""
        truth = self._truth.at(frame.t_ns)
        if truth is None:
            self._without_truth += 1
            return None
        ids, states = truth
        shown = picture(frame)
        best = match(states[:, :2], shown.position_m, self._c_m)
        warm = frame.t_ns >= self._warm_ns
        self._pairs.append(_frame_pairs(best, ids, states, shown, warm))
        score = _frame_score(frame.t_ns, best)
        if warm:
            self._scores.append(score)
            self._shown.update(shown.track_id.tolist())
        return score

    def summary(self) -> ScoreSummary:
        """What the frames so far come to."""
        scores = np.array([score[1:] for score in self._scores], np.float64).reshape(-1, 7)
        targets, _, gospa_m, ospa_m, localisation, missed, false = scores.T
        pairs = [_pairs_of(self._pairs, warm_only=warm_only) for warm_only in (False, True)]
        every, warm = pairs
        counted = np.array([frame.warm for frame in self._pairs], np.bool_)
        normalised = np.concatenate([np.zeros(0)] + [f.nees for f in self._pairs if f.warm])
        wrong_mps = np.concatenate([np.zeros(0)] + [f.velocity_error_mps for f in self._pairs if f.warm])
        return ScoreSummary(
            c_m=self._c_m,
            frames=len(scores),
            without_truth=self._without_truth,
            tracks=len(self._shown),
            gospa_m=_mean(gospa_m),
            localisation_m2=_mean(localisation),
            missed=_mean(missed),
            false=_mean(false),
            ospa_m=_mean(ospa_m),
            rmse_m=rmse(warm.distance_m),
            rmse_velocity_mps=rmse(wrong_mps),
            nees=_mean(normalised),
            within_95=_mean(normalised < CHI2_2_95),
            coverage=len(warm.frame) / float(targets.sum()) if targets.sum() else float("nan"),
            id_switches=identity_switches(every, counted),
            purity=purity(warm),
            continuity=continuity(warm),
        )


def score_tracks(
    frames: Iterable[TrackFrame],
    truth: Iterable[TruthFrame],
    c_m: float = 1000.0,
    warmup_s: float = 40.0,
    progress: Progress | None = None,
) -> ScoreSummary:
    """Score frames against the truth interpolated to their times; see ``ScoreSummary`` for what is computed.

    ``progress`` is called with the number of frames done.

    Raises:
        TrackmeshError: the truth is empty.
    """
    scorer = Scorer(TruthTimeline(truth), c_m, warmup_s)
    for done, frame in enumerate(frames, 1):
        scorer.add(frame)
        if progress is not None:
            progress(done)
    return scorer.summary()


def score_nearest(frames: Iterable[TrackFrame], truth: Iterable[TruthFrame], c_m: float = 30.0) -> NearestSummary:
    """Score frames, one a batch of plots, against the truth frame nearest in time.

    A target is seen in a frame where some track is nearer than ``c_m``; one track may serve two targets. It is the
    method for recordings in which only some of the boats that the sensors see carry a receiver.

    Raises:
        TrackmeshError: the truth is empty.
    """
    timeline, shown = TruthTimeline(truth), set[int]()
    gospa_m, false, distance = list[float](), list[int](), list[FloatArray]()
    for frame in frames:
        tracks = picture(frame)
        targets_m = timeline.nearest(frame.t_ns).state[:, :2]
        parts = match(targets_m, tracks.position_m, c_m).gospa()
        gospa_m.append(parts.total_m)
        false.append(parts.false)
        distance.append(nearest_distance(targets_m, tracks.position_m))
        shown.update(tracks.track_id.tolist())
    every = np.concatenate([np.zeros(0), *distance])
    return NearestSummary(
        c_m=c_m,
        frames=len(gospa_m),
        tracks=len(shown),
        gospa_m=_mean(np.array(gospa_m)),
        false=_mean(np.array(false)),
        coverage=_mean(every < c_m),
        rmse_m=rmse(every[every < c_m]),
    )


def picture(frame: TrackFrame) -> Picture:
    """The confirmed and coasting tracks of a frame."""
    shown = np.flatnonzero((frame.status == CONFIRMED) | (frame.status == COASTING))
    state, upper = frame.state[shown], frame.covariance[shown].astype(np.float64)
    # The upper triangle of a 6 x 6 matrix, row by row: P00 P01 .. P05, P11 ..
    covariance = upper[:, [0, 1, 1, 6]].reshape(-1, 2, 2)
    coasting = np.asarray(frame.status[shown] == COASTING)
    return Picture(frame.track_id[shown], state[:, :2], state[:, 2:4], covariance, coasting)


class _FramePairs(NamedTuple):
    warm: bool
    target_id: IntArray
    track_id: IntArray
    distance_m: FloatArray
    velocity_error_mps: FloatArray
    nees: FloatArray


def _frame_pairs(best: Match, ids: IntArray, states: FloatArray, shown: Picture, warm: bool) -> _FramePairs:
    error = shown.position_m[best.track] - states[best.target, :2]
    wrong = shown.velocity_mps[best.track] - states[best.target, 2:]
    return _FramePairs(
        warm,
        ids[best.target],
        shown.track_id[best.track],
        best.distance_m,
        np.hypot(wrong[:, 0], wrong[:, 1]),
        nees(error, shown.covariance_m2[best.track]),
    )


def _frame_score(t_ns: int, best: Match) -> FrameScore:
    parts = best.gospa()
    return FrameScore(
        t_ns,
        best.n_targets,
        best.n_tracks,
        parts.total_m,
        best.ospa(),
        parts.localisation,
        parts.missed,
        parts.false,
    )


def _pairs_of(frames: list[_FramePairs], *, warm_only: bool) -> Pairs:
    kept = [(k, frame) for k, frame in enumerate(frames) if frame.warm or not warm_only]
    none = np.zeros(0, np.int64)
    return Pairs(
        np.concatenate([none] + [np.full(len(frame.target_id), k) for k, frame in kept]),
        np.concatenate([none] + [frame.target_id for _, frame in kept]),
        np.concatenate([none] + [frame.track_id for _, frame in kept]),
        np.concatenate([np.zeros(0)] + [frame.distance_m for _, frame in kept]),
    )


def _interpolate(before: FloatArray, after: FloatArray, step_s: float, part: float) -> FloatArray:
    u, v = part, 1.0 - part
    position = (
        v * v * (1.0 + 2.0 * u) * before[:, :2]
        + u * u * (1.0 + 2.0 * v) * after[:, :2]
        + step_s * u * v * (v * before[:, 2:] - u * after[:, 2:])
    )
    return np.concatenate([position, v * before[:, 2:] + u * after[:, 2:]], axis=1)


def _mean(values: npt.NDArray[np.generic]) -> float:
    return float(np.mean(values.astype(np.float64))) if values.size else float("nan")
