"""Is the picture right? The question of a demonstration: one track for each target that a sensor can see."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import SensorInfo, TrackFrame
from trackmesh.sim.metrics import Pairs, identity_switches, lasting, match, nearest_distance, tracked_once
from trackmesh.sim.scoring import TruthTimeline, picture

LOOK_EVERY_NS = 1_000_000_000
"""Switches are looked for in frames at least this far apart."""

HOLD_LOOKS = 3
"""A track must be a target's own for as many looks in a row to count; else it was a moment's confusion of two."""


@dataclass(frozen=True)
class PictureAtEnd:
    """The last frame of a run, and the identities on the way to it.

    Attributes:
        targets: those in coverage at the end and ``settle_s`` before it.
        tracked_once: how many of them have exactly one confirmed or coasting track within the gate.
        share: ``tracked_once / targets``, NaN without a target.
        stray_tracks: tracks of the last frame with no target within the gate.
        quiet_targets: targets that never manoeuvre and were matched at least once.
        quiet_switches: how often one of them changed its track for another that it kept.
    """

    targets: int
    tracked_once: int
    share: float
    stray_tracks: int
    quiet_targets: int
    quiet_switches: int

    def as_dict(self) -> dict[str, float | int]:
        """The figures by name."""
        return asdict(self)


@dataclass(frozen=True)
class Coverage:
    """Circles (k,) that sensors can see: ``site_m`` (k, 2) and ``max_range_m`` (k,)."""

    site_m: FloatArray
    max_range_m: FloatArray

    @classmethod
    def of(cls, sensors: Iterable[SensorInfo]) -> Coverage:
        """What sensors with a site in the plane can see."""
        sited = [(s.site_enu_m[:2], s.max_range_m) for s in sensors if s.site_enu_m is not None]
        return cls(np.array([site for site, _ in sited]).reshape(-1, 2), np.array([reach for _, reach in sited]))

    def sees(self, position_m: FloatArray) -> npt.NDArray[np.bool_]:
        """Which positions (n, 2) are within the range of at least one sensor."""
        away = np.linalg.norm(position_m[:, None] - self.site_m[None], axis=2)
        return np.asarray((away < self.max_range_m).any(axis=1))


def picture_at_end(
    frames: Sequence[TrackFrame],
    truth: TruthTimeline,
    coverage: Coverage,
    quiet_ids: Iterable[int],
    *,
    gate_m: float = 500.0,
    settle_s: float = 20.0,
    warmup_s: float = 30.0,
) -> PictureAtEnd:
    """Judge the last frame that has a truth, and the identities of quiet targets after ``warmup_s``.

    A track counts for the target it is nearest to, so that two targets close together with a track each are right.

    Raises:
        TrackmeshError: no frame lies within the truth's time.
    """
    inside = [frame for frame in frames if truth.first_ns <= frame.t_ns <= truth.last_ns]
    if not inside:
        raise TrackmeshError("No frame of the tracks lies within the time of the truth.")
    last = max(inside, key=lambda frame: frame.t_ns)
    ids, position_m = _targets(truth, last.t_ns)
    tracks_m = picture(last).position_m
    wanted = _settled(truth, coverage, last.t_ns, settle_s, ids, position_m)
    once = tracked_once(position_m, tracks_m, gate_m)[wanted]
    quiet = _quiet_pairs(inside, truth, set(quiet_ids), gate_m, truth.first_ns + round(warmup_s * 1e9))
    return PictureAtEnd(
        targets=len(once),
        tracked_once=int(once.sum()),
        share=float(once.mean()) if len(once) else float("nan"),
        stray_tracks=int((nearest_distance(tracks_m, position_m) >= gate_m).sum()),
        quiet_targets=len(np.unique(quiet.target_id)),
        quiet_switches=identity_switches(lasting(quiet, HOLD_LOOKS)),
    )


def _settled(
    truth: TruthTimeline,
    coverage: Coverage,
    t_ns: int,
    settle_s: float,
    ids: IntArray,
    position_m: FloatArray,
) -> npt.NDArray[np.bool_]:
    earlier_ids, earlier_m = _targets(truth, max(truth.first_ns, t_ns - round(settle_s * 1e9)))
    known = np.isin(ids, earlier_ids[coverage.sees(earlier_m)])
    return np.asarray(known & coverage.sees(position_m))


def _targets(truth: TruthTimeline, t_ns: int) -> tuple[IntArray, FloatArray]:
    there = truth.at(t_ns)
    assert there is not None
    return there[0], there[1][:, :2]


def _quiet_pairs(
    frames: Sequence[TrackFrame], truth: TruthTimeline, quiet_ids: set[int], gate_m: float, warm_ns: int
) -> Pairs:
    parts, looked_ns = list[Pairs](), -LOOK_EVERY_NS
    for frame in sorted(frames, key=lambda frame: frame.t_ns):
        if frame.t_ns < max(warm_ns, looked_ns + LOOK_EVERY_NS):
            continue
        looked_ns = frame.t_ns
        ids, position_m = _targets(truth, frame.t_ns)
        shown = picture(frame)
        best = match(position_m, shown.position_m, gate_m)
        quiet = np.isin(ids[best.target], list(quiet_ids))
        who, whom = ids[best.target][quiet], shown.track_id[best.track][quiet]
        parts.append(Pairs(np.full(len(who), len(parts)), who, whom, best.distance_m[quiet]))
    none = np.zeros(0, np.int64)
    return (
        Pairs(*(np.concatenate([none, *column]) for column in zip(*parts, strict=True)))
        if parts
        else Pairs(none, none, none, np.zeros(0))
    )
