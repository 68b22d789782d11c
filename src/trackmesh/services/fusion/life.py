"""The life of tracks: hits, misses, confirmation and end, as kernels over rows.

| status | entered | left |
|---|---|---|
| tentative | one plot that no track took | confirmed, or dropped |
| confirmed | score above ``confirm_score`` and ``confirm_hits`` plots | lost: see below |

A tentative track is dropped when its score is below ``drop_score`` or ``drop_fall`` below its best, after
``max_misses`` misses in a row, or ``tentative_age_s`` after its last plot. A confirmed one is lost ``coast_s`` after
its last plot, or when its score is ``end_fall`` below its best: it lives on clutter.

The score is a log-likelihood ratio of track against clutter: a hit adds ln(Pd / (2 pi lambda)) - (ln|S| + D)/2, a miss
adds ln(1 - Pd) (Sittler 1964; Bar-Shalom, Willett and Tian 2011, section 7.5).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.plots import Plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

NEVER = -1e18
"""A time before all times."""


class Life(NamedTuple):
    """What is known of n rows apart from their filters; the last axis of ``seen_s`` and ``looked_s`` is the sensor.

    Attributes:
        uid: number of the track within its bank, never used twice.
        alive, confirmed: flags.
        score, best: log-likelihood ratio and its maximum.
        hits, misses: plots taken; misses in a row.
        first_s, last_s: times of the first and the last plot.
        seen_s: (n, s) last plot of each sensor. looked_s: (n, s) last look of each sensor already judged.
        link: on a local row, uid of the system track that took its last plots; on a system row, the published id.
        link_n: how many plots in a row.
        member: (n, s) on a system row: uid of the member local track of each sensor, or -1.
    """

    uid: IntArray
    alive: BoolArray
    confirmed: BoolArray
    score: FloatArray
    best: FloatArray
    hits: IntArray
    misses: IntArray
    first_s: FloatArray
    last_s: FloatArray
    seen_s: FloatArray
    looked_s: FloatArray
    link: IntArray
    link_n: IntArray
    member: IntArray


class Rules(NamedTuple):
    """Constants of the life of tracks; see the table above."""

    confirm_score: float
    confirm_hits: int
    score_cap: float
    drop_score: float
    drop_fall: float
    max_misses: int
    tentative_age_s: float
    coast_s: float
    end_fall: float


def make_life(n: int, s: int) -> Life:
    """Life of n empty rows and s sensors."""
    whole, real = np.zeros(n, np.int64), np.zeros(n)
    return Life(
        uid=np.full(n, -1, np.int64),
        alive=np.zeros(n, np.bool_),
        confirmed=np.zeros(n, np.bool_),
        score=real.copy(),
        best=real.copy(),
        hits=whole.copy(),
        misses=whole.copy(),
        first_s=real.copy(),
        last_s=real.copy(),
        seen_s=np.full((n, s), NEVER),
        looked_s=np.full((n, s), NEVER),
        link=np.full(n, -1, np.int64),
        link_n=whole.copy(),
        member=np.full((n, s), -1, np.int64),
    )


@kernel
def born(life: Life, rows: IntArray, uid: int, t_s: FloatArray, sensor: int) -> None:
    """Start tentative tracks in ``rows``, numbered from ``uid``, each from a plot of ``sensor`` at ``t_s``."""
    for k in range(len(rows)):
        i = rows[k]
        life.uid[i] = uid + k
        life.alive[i] = True
        life.confirmed[i] = False
        life.score[i] = life.best[i] = 0.0
        life.hits[i], life.misses[i] = 1, 0
        life.first_s[i] = life.last_s[i] = t_s[k]
        life.seen_s[i, :] = NEVER
        # No sensor is blamed for looks before the track began.
        life.looked_s[i, :] = t_s[k]
        life.seen_s[i, sensor] = t_s[k]
        life.link[i], life.link_n[i] = -1, 0
        life.member[i, :] = -1


@kernel
def hit(life: Life, rules: Rules, rows: IntArray, fed: BoolArray, plots: Plots, gain: FloatArray, sensor: int) -> None:
    """Row k took plot k of ``sensor`` where it was ``fed``; ``gain`` is added to its score."""
    for k in range(len(rows)):
        if not fed[k]:
            continue
        i, t_s = rows[k], plots[k].t_s
        life.hits[i] += 1
        life.misses[i] = 0
        life.last_s[i] = max(life.last_s[i], t_s)
        life.first_s[i] = min(life.first_s[i], t_s)
        life.seen_s[i, sensor] = max(life.seen_s[i, sensor], t_s)
        life.looked_s[i, sensor] = max(life.looked_s[i, sensor], t_s)
        life.score[i] = min(life.score[i] + gain[k], rules.score_cap)
        life.best[i] = max(life.best[i], life.score[i])


@kernel
def miss(
    life: Life,
    rows: IntArray,
    mean: FloatArray,
    t_state_s: FloatArray,
    t_s: float,
    sensor: int,
    site: FloatArray,
    max_range_m: float,
    lately_s: float,
    period_s: float,
    margin_s: float,
    whole: bool,
    log_miss: float,
) -> int:
    """Judge the looks of ``sensor`` up to time ``t_s`` at rows that it can see and that took no plot of it.

    A radar (``lately_s`` infinite) sees what is within ``max_range_m`` of its ``site``; any other sensor sees what it
    has seen within ``lately_s``. Where the batch is a ``whole`` look, a row is judged when half a period has passed
    since its last judged look; where it is a sector, when a period and ``margin_s`` have, so that a plot one sector
    late is no miss.

    Args:
        mean, t_state_s: (all rows, 4), (all rows,) mean states and their times, to extrapolate.

    Returns:
        how many missed.
    """
    missed = 0
    for i in rows:
        since = t_s - life.looked_s[i, sensor]
        due = since > 0.5 * period_s if whole else since > period_s + margin_s
        if not due:
            continue
        if np.isfinite(lately_s):
            visible = t_s - life.seen_s[i, sensor] < lately_s
        else:
            dt = t_s - t_state_s[i]
            de, dn = mean[i, 0] + dt * mean[i, 2] - site[0], mean[i, 1] + dt * mean[i, 3] - site[1]
            visible = np.hypot(de, dn) < max_range_m
        far_behind = whole or since > 3.0 * period_s
        life.looked_s[i, sensor] = t_s if far_behind else life.looked_s[i, sensor] + period_s
        if visible:
            life.misses[i] += 1
            life.score[i] += log_miss
            missed += 1
    return missed


@kernel
def judge(
    life: Life, rules: Rules, rows: IntArray, t_s: float, confirmed: IntArray, ended: IntArray
) -> tuple[int, int]:
    """Confirm, drop and end rows at time ``t_s``.

    Args:
        confirmed, ended: buffers for the rows newly confirmed, and for those that ended (of either status).

    Returns:
        how many of each.
    """
    n_confirmed = n_ended = 0
    for i in rows:
        age = t_s - life.last_s[i]
        if life.confirmed[i]:
            over = age > rules.coast_s or life.score[i] < life.best[i] - rules.end_fall
        elif life.score[i] > rules.confirm_score and life.hits[i] >= rules.confirm_hits:
            life.confirmed[i] = True
            confirmed[n_confirmed] = i
            n_confirmed += 1
            over = False
        else:
            over = (
                life.score[i] < rules.drop_score
                or life.misses[i] >= rules.max_misses
                or life.score[i] < life.best[i] - rules.drop_fall
                or age > rules.tentative_age_s
            )
        if over:
            life.alive[i] = False
            ended[n_ended] = i
            n_ended += 1
    return n_confirmed, n_ended


def tie(life: Life, local_row: int, system_uid: int) -> None:
    """A local row's plots are those of a system track from now on."""
    life.link[local_row], life.link_n[local_row] = system_uid, 5


@kernel
def share(life: Life, local_rows: IntArray, system_uid: IntArray) -> None:
    """Count shared plots: local row k took a plot that the system track ``system_uid[k]`` (-1: none) took too."""
    for k in range(len(local_rows)):
        i = local_rows[k]
        if system_uid[k] < 0:
            life.link_n[i] = max(life.link_n[i] - 1, 0)
        elif life.link[i] == system_uid[k]:
            life.link_n[i] = min(life.link_n[i] + 1, 5)
        else:
            life.link[i], life.link_n[i] = system_uid[k], 1
