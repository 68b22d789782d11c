"""The engine put through a trial, and what comes of it, as the peers are scored: GOSPA of a kilometre, after 40 s."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from benchmarks.declared_pairs import DeclaredPairs
from benchmarks.peer_scenario import START_NS
from benchmarks.trials import Feed, FloatArray, Kept, Trial
from trackmesh.protocol.messages import ENDED, Registration, SensorBias, TrackFrame
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.sim.metrics import match, nees

WARMUP_S, START_S, CUT_OFF_M = 40.0, 15.0, 1000.0
LEARNT_AFTER_S = 120.0
"""Biases are to be known so long after they appear."""

NOBODY = -1

Shown = list[tuple[float, TrackFrame]]
Told = list[tuple[float, Registration]]


def judge(trial: Trial, settings: EngineSettings) -> dict[str, float]:
    """All figures of one run; NaN where a figure has no meaning in the trial.

    ``gospa_m``, ``rmse_m``, ``missed``, ``false``, ``missed_pct`` (of the targets), ``switches`` and ``nees`` (2 if the
    covariance is right) are of the pictures after 40 s; ``start_gospa_m`` and ``start_missed_pct`` of those from 15 to
    40 s; ``kept_pct`` is the share of targets that keep their identity; ``bias_m`` and ``bias_deg`` are the largest
    errors of the estimated biases at the end, ``bias_120_m`` and ``bias_120_deg`` 120 s after they appear;
    ``pairs_right_pct`` and ``paired_pct`` see ``DeclaredPairs``; ``shown_after_s`` and ``gone_after_s`` see
    ``life_figures``.
    """
    engine = FusionEngine(settings, Unit())
    for sensor in trial.sensors:
        engine.sensor(sensor)
    pairs = DeclaredPairs(engine)
    shown, told = drive(engine, trial, pairs)
    learnt = trial.bias_from_s + LEARNT_AFTER_S
    return {
        **picture_figures(trial, shown),
        "kept_pct": kept_pct(trial, shown),
        **life_figures(trial, shown),
        **bias_figures(trial, [(t, r) for t, r in told if t <= learnt], "bias_120"),
        **bias_figures(trial, told, "bias"),
        **pairs.figures(),
    }


def drive(engine: FusionEngine, trial: Trial, pairs: DeclaredPairs | None = None) -> tuple[Shown, Told]:
    """All pictures after batches and what was told of biases, with their times of arrival."""
    shown, told = Shown(), Told()
    for arrival_s, feed in _arrivals(trial):
        if feed is None:
            engine.tick(_ns(arrival_s))
            continue
        if arrival_s > feed.t_s:
            # A live unit's clock is never behind the arrival of what it takes.
            engine.tick(_ns(arrival_s))
        frame = engine.plots(feed.batch)
        if pairs is not None:
            pairs.note(feed)
            if arrival_s >= WARMUP_S:
                pairs.look()
        if frame is not None and len(feed.target):
            shown.append((arrival_s, frame))
        registration = engine.registration()
        if registration is not None:
            told.append((arrival_s, registration))
    return shown, told


def picture_figures(trial: Trial, shown: Shown) -> dict[str, float]:
    """What the pictures are like; see ``judge``."""
    rows, errors, starts = list[tuple[float, ...]](), list[FloatArray](), list[tuple[float, ...]]()
    switches, last = 0, np.full(trial.targets, NOBODY)
    for t_s, frame in shown:
        live = frame.status != ENDED
        there = trial.there(t_s)
        truth, state = trial.state_at(t_s)[there], frame.state[live]
        best = match(truth[:, :2], state[:, :2], CUT_OFF_M)
        followed, before = frame.track_id[live][best.track], last[there[best.target]]
        last[there[best.target]] = followed
        parts = best.gospa()
        share = 100.0 * parts.missed / max(len(there), 1)
        if t_s < WARMUP_S:
            starts += [(parts.total_m, share)] if t_s >= START_S else []
            continue
        switches += int(((before != NOBODY) & (before != followed)).sum())
        rows.append((parts.total_m, parts.missed, parts.false, share, (best.distance_m**2).sum(), len(best.track)))
        upper = frame.covariance[live][best.track].astype(float)
        error = state[best.track, :2] - truth[best.target, :2]
        errors.append(nees(error, upper[:, [0, 1, 1, 6]].reshape(-1, 2, 2)))
    gospa_m, missed, false, share, squared, matched = np.array(rows).T
    start = np.array(starts).reshape(-1, 2)
    return {
        "gospa_m": float(gospa_m.mean()),
        "rmse_m": float(np.sqrt(squared.sum() / max(matched.sum(), 1.0))),
        "switches": float(switches),
        "missed": float(missed.mean()),
        "false": float(false.mean()),
        "missed_pct": float(share.mean()),
        "nees": float(np.concatenate(errors).mean()),
        "start_gospa_m": _mean(start[:, 0]),
        "start_missed_pct": _mean(start[:, 1]),
    }


def kept_pct(trial: Trial, shown: Shown) -> float:
    """The share of targets with the same track before and after, over all that are looked at."""
    same = [np.concatenate([np.zeros(0), _kept(trial, shown, kept)]) for kept in trial.kept]
    return 100.0 * float(np.concatenate(same).mean())


def life_figures(trial: Trial, shown: Shown) -> dict[str, float]:
    """Means over targets that come or go while tracks are shown.

    ``shown_after_s``: from when a target is there until it has a track. ``gone_after_s``: from when it is gone until
    the track that followed it is shown no more. Those whose moment the run does not hold are left out.
    """
    if trial.lives_s is None:
        return {"shown_after_s": np.nan, "gone_after_s": np.nan}
    first, follower = np.full(trial.targets, np.nan), np.full(trial.targets, NOBODY)
    seen_last: dict[int, float] = {}
    for t_s, frame in shown:
        live = frame.status != ENDED
        tracks, there = frame.track_id[live], trial.there(t_s)
        seen_last.update(dict.fromkeys(tracks.tolist(), t_s))
        best = match(trial.state_at(t_s)[there, :2], frame.state[live, :2], CUT_OFF_M)
        rows = there[best.target]
        first[rows] = np.where(np.isnan(first[rows]), t_s, first[rows])
        follower[rows] = tracks[best.track]
    begin, end = trial.lives_s.T
    last = np.array([seen_last.get(int(track), np.nan) for track in follower])
    went = end < trial.duration_s
    delays = {"shown_after_s": (first - begin)[begin > 0.0], "gone_after_s": (last - end)[went]}
    return {name: _mean(delay[np.isfinite(delay)]) for name, delay in delays.items()}


def bias_figures(trial: Trial, told: Told, name: str) -> dict[str, float]:
    """Largest errors of the last biases told of radars, in metres and degrees."""
    if not told:
        return {f"{name}_m": np.nan, f"{name}_deg": np.nan}
    errors = np.array([_error(trial, told[-1][0], one) for one in told[-1][1].sensors if one.columns[0] == "range_m"])
    worst_m, worst_rad = np.abs(errors).max(axis=0)
    return {f"{name}_m": float(worst_m), f"{name}_deg": float(np.rad2deg(worst_rad))}


def _arrivals(trial: Trial) -> list[tuple[float, Feed | None]]:
    """Batches and bare ticks in order of time."""
    every: list[tuple[float, Feed | None]] = [(feed.arrival_s, feed) for feed in trial.feeds]
    every += [(t_s, None) for t_s in trial.ticks_s]
    return sorted(every, key=lambda one: one[0])


def _kept(trial: Trial, shown: Shown, kept: Kept) -> npt.NDArray[np.bool_]:
    before, after = (_followers(trial, shown, t_s) for t_s in (kept.before_s, kept.after_s))
    same = (before == after) & (before != NOBODY)
    return np.asarray(same if kept.targets is None else same[kept.targets])


def _followers(trial: Trial, shown: Shown, t_s: float) -> npt.NDArray[np.int64]:
    """The track (n,) that each target has in the last picture up to a time, or nobody."""
    who = np.full(trial.targets, NOBODY)
    until = [one for one in shown if one[0] <= t_s]
    if until:
        when, frame = until[-1]
        live = frame.status != ENDED
        best = match(trial.state_at(when)[:, :2], frame.state[live, :2], CUT_OFF_M)
        who[best.target] = frame.track_id[live][best.track]
    return who


def _error(trial: Trial, now_s: float, told: SensorBias) -> FloatArray:
    true = trial.bias.get(told.sensor_id, np.zeros(2)) if now_s >= trial.bias_from_s else np.zeros(2)
    return np.asarray(told.bias - true, np.float64)


def _ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else float(np.nan)
