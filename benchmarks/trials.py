"""What a tracker is put through: the peers' scenario as messages in order of arrival, and what can be done to it.

A trial knows which target every plot is of, as the scenario tells; what is done to plots keeps that. Changes are
functions from trial to trial, so that hardships can be put together.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks import peer_scenario
from benchmarks.peer_scenario import START_NS
from trackmesh.protocol.messages import PlotBatch, SensorInfo

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CLUTTER = -1
NORTH, EAST = "north", "east"
"""The two radars of the scenario: the first stands at the origin and turns in 4 s, the second 41 km away in 5 s."""


class Feed(NamedTuple):
    """A batch: when the sensor looked, when it arrives, the truth's row (n,) that each plot is of, or ``CLUTTER``."""

    t_s: float
    arrival_s: float
    batch: PlotBatch
    target: IntArray

    def only(self, keep: npt.NDArray[np.bool_]) -> Feed:
        """The plots that are kept, in a batch that is sent even where none is."""
        rows = {"t_ns": self.batch.t_ns[keep], "values": self.batch.values[keep]}
        return self._replace(batch=self.batch.model_copy(update=rows), target=self.target[keep])


class Kept(NamedTuple):
    """Between which times which targets should keep their identity; ``targets`` None: all."""

    before_s: float
    after_s: float
    targets: IntArray | None = None


@dataclass(frozen=True)
class Trial:
    """One scene for the engine.

    Attributes:
        truth_t_s: (k,) and truth (k, n, 4) [east, veast, north, vnorth], as the scenario has them.
        sensors: known to the engine before the first batch.
        feeds: what arrives, in order.
        kept: where identities are looked at.
        ticks_s: times at which the clock ticks though nothing arrives.
        bias: of each sensor, what it measures too much, in its first two columns. bias_from_s: since when.
        lives_s: from when until when each target is there (n, 2); None: all are, always.
    """

    truth_t_s: FloatArray
    truth: FloatArray
    sensors: tuple[SensorInfo, ...]
    feeds: tuple[Feed, ...]
    kept: tuple[Kept, ...]
    ticks_s: tuple[float, ...] = ()
    bias: dict[str, FloatArray] = field(default_factory=dict)
    bias_from_s: float = 0.0
    lives_s: FloatArray | None = None

    @property
    def duration_s(self) -> float:
        """How long the truth is."""
        return float(self.truth_t_s[-1])

    @property
    def targets(self) -> int:
        """How many there are."""
        return int(self.truth.shape[1])

    def there(self, t_s: float) -> IntArray:
        """Rows of the targets that are there at a time."""
        if self.lives_s is None:
            return np.arange(self.targets)
        return np.flatnonzero((self.lives_s[:, 0] <= t_s) & (t_s < self.lives_s[:, 1]))

    def state_at(self, t_s: float) -> FloatArray:
        """Truth states (n, 4) [east, north, veast, vnorth] at a time, linear between those that are known."""
        i = int(np.clip(np.searchsorted(self.truth_t_s, t_s), 1, len(self.truth_t_s) - 1))
        t0, t1 = self.truth_t_s[i - 1], self.truth_t_s[i]
        w = (t_s - t0) / (t1 - t0)
        between = (1 - w) * self.truth[i - 1] + w * self.truth[i]
        return np.asarray(between[:, [0, 2, 1, 3]], np.float64)


def trial(
    seed: int,
    duration_s: float = 300.0,
    n_targets: int = 50,
    sectors: int = 1,
    *,
    radars: dict[str, float] | None = None,
    rearrange: peer_scenario.Rearrange | None = None,
) -> Trial:
    """The scenario as it is, or with other parameters of the radars or another truth; identities from a fifth of it."""
    case = peer_scenario.make(seed, n_targets, sectors, duration_s, radars=radars, rearrange=rearrange)
    pairs = zip(case.scenario.scans, case.batches, strict=True)
    feeds = tuple(Feed(scan.time_s, scan.time_s, batch, scan.target.astype(np.int64)) for scan, batch in pairs)
    kept = Kept(0.2 * duration_s, duration_s - 5.0)
    return Trial(case.scenario.truth_t, case.scenario.truth, tuple(case.sensors), feeds, (kept,))


# --- what can go wrong with sensors ---


def biased(given: Trial, sensor_id: str, range_m: float, azimuth_deg: float, from_s: float = 0.0) -> Trial:
    """A radar measures so much too much, since a time."""
    wrong = np.array([range_m, np.deg2rad(azimuth_deg)])

    def shift(feed: Feed) -> Feed:
        if feed.batch.sensor_id != sensor_id or feed.t_s < from_s:
            return feed
        values = feed.batch.values.copy()
        values[:, :2] += wrong
        values[:, 1] %= 2.0 * np.pi
        return feed._replace(batch=feed.batch.model_copy(update={"values": values}))

    feeds = tuple(map(shift, given.feeds))
    return replace(given, feeds=feeds, bias=given.bias | {sensor_id: wrong}, bias_from_s=from_s)


def silent(given: Trial, from_s: float, until_s: float, *sensor_ids: str) -> Trial:
    """Sensors, or all, send nothing for a time; the clock ticks on every second."""

    def heard(feed: Feed) -> bool:
        return not from_s <= feed.t_s < until_s or bool(sensor_ids and feed.batch.sensor_id not in sensor_ids)

    ticks = () if sensor_ids else tuple(np.arange(from_s + 1.0, until_s, 1.0).tolist())
    return replace(given, feeds=tuple(filter(heard, given.feeds)), ticks_s=given.ticks_s + ticks)


def unseen(given: Trial, from_s: float, until_s: float, targets: IntArray) -> Trial:
    """No sensor detects these targets for a time."""

    def without(feed: Feed) -> Feed:
        return feed.only(~np.isin(feed.target, targets)) if from_s <= feed.t_s < until_s else feed

    return replace(given, feeds=tuple(map(without, given.feeds)))


def coming_and_going(given: Trial, seed: int) -> Trial:
    """A third of the targets comes later, another third goes before the end, at any time of the middle four fifths."""
    rng, n = np.random.default_rng([seed, 6]), given.targets
    lives, order = np.tile([0.0, np.inf], (n, 1)), rng.permutation(n)
    when = rng.uniform(0.1, 0.9, n) * given.duration_s
    come, go = order[: n // 3], order[n // 3 : 2 * (n // 3)]
    lives[come, 0], lives[go, 1] = when[come], when[go]

    def there(feed: Feed) -> Feed:
        from_s, until_s = lives[feed.target].T
        return feed.only((feed.target == CLUTTER) | ((from_s <= feed.t_s) & (feed.t_s < until_s)))

    stay = order[2 * (n // 3) :]
    kept = tuple(one._replace(targets=np.sort(stay)) for one in given.kept)
    return replace(given, feeds=tuple(map(there, given.feeds)), lives_s=lives, kept=kept)


def late(given: Trial, seed: int, most_s: float) -> Trial:
    """Every batch is on its way for a time between none and ``most_s``, so that some overtake others.

    The engine's clock is at the arrival when it takes a batch, as that of a live unit.
    """
    delay = np.random.default_rng([seed, 1]).uniform(0.0, most_s, len(given.feeds))
    moved = [f._replace(arrival_s=f.arrival_s + d) for f, d in zip(given.feeds, delay.tolist(), strict=True)]
    moved = [f for f in moved if f.arrival_s <= given.duration_s]
    return replace(given, feeds=tuple(sorted(moved, key=lambda f: f.arrival_s)))


def with_positions(given: Trial, seed: int, period_s: float, sigma_m: float, p_detect: float) -> Trial:
    """A third sensor that measures positions everywhere, without clutter."""
    rng = np.random.default_rng([seed, 2])
    info = SensorInfo(
        sensor_id="positions", kind="position", period_s=period_s, p_detect=p_detect, max_range_m=120e3,
        sigma={"east_m": sigma_m, "north_m": sigma_m},
    )  # fmt: skip
    feeds = list(given.feeds)
    for seq, t_s in enumerate(np.arange(0.3, given.duration_s, period_s).tolist()):
        seen = np.flatnonzero(rng.random(given.targets) < p_detect)
        place = given.state_at(t_s)[seen, :2] + rng.normal(0.0, sigma_m, (len(seen), 2))
        batch = PlotBatch(
            sensor_id=info.sensor_id, boot_id="bench", seq=seq, columns=["east_m", "north_m"], values=place,
            t_ns=np.full(len(seen), START_NS + round(t_s * 1e9)),
        )  # fmt: skip
        feeds.append(Feed(t_s, t_s, batch, seen))
    feeds.sort(key=lambda feed: feed.arrival_s)
    return replace(given, sensors=(*given.sensors, info), feeds=tuple(feeds))


# --- how targets can fly ---


def in_pairs(seed: int, apart_m: float) -> peer_scenario.Rearrange:
    """Every second target flies beside the one before it, always ``apart_m`` away in a direction of its own."""

    def rearrange(_: FloatArray, truth: FloatArray) -> FloatArray:
        pairs = truth.shape[1] // 2
        angle = np.random.default_rng([seed, 3]).uniform(0.0, 2.0 * np.pi, pairs)
        out = truth.copy()
        out[:, 1 : 2 * pairs : 2] = truth[:, 0 : 2 * pairs : 2]
        out[:, 1 : 2 * pairs : 2, 0] += apart_m * np.sin(angle)
        out[:, 1 : 2 * pairs : 2, 2] += apart_m * np.cos(angle)
        return out

    return rearrange


class Crossing(NamedTuple):
    """Pair k, of the targets 2 k and 2 k + 1, meets at ``t_s`` (k,), its courses ``angle`` (k,) apart."""

    t_s: FloatArray
    angle: FloatArray
    offset_m: FloatArray


def crossings(seed: int, pairs: int, duration_s: float, miss_m: float = 100.0) -> Crossing:
    """Meetings between 80 s and 50 s before the end, at 20 to 40 degrees, at most ``miss_m`` apart."""
    rng = np.random.default_rng([seed, 4])
    t_s = rng.uniform(min(80.0, 0.4 * duration_s), duration_s - 50.0, pairs)
    angle = np.deg2rad(rng.uniform(20.0, 40.0, pairs)) * rng.choice([-1.0, 1.0], pairs)
    miss, way = rng.uniform(0.0, miss_m, pairs), rng.uniform(0.0, 2.0 * np.pi, pairs)
    return Crossing(t_s, angle, miss[:, None] * np.stack([np.sin(way), np.cos(way)], axis=1))


def crossing(meet: Crossing) -> peer_scenario.Rearrange:
    """Every second target's flight, turned and shifted as a whole so that it meets the one before it."""

    def rearrange(t_s: FloatArray, truth: FloatArray) -> FloatArray:
        out = truth.copy()
        for k, (when, angle) in enumerate(zip(meet.t_s.tolist(), meet.angle.tolist(), strict=True)):
            step = int(np.searchsorted(t_s, when))
            one, other = truth[:, 2 * k], truth[:, 2 * k + 1]
            course = [np.arctan2(state[step, 1], state[step, 3]) for state in (one, other)]
            turn = _turn(course[0] + angle - course[1])
            place = (other[:, [0, 2]] - other[step, [0, 2]]) @ turn.T + one[step, [0, 2]] + meet.offset_m[k]
            out[:, 2 * k + 1, [0, 2]], out[:, 2 * k + 1, 1::2] = place, other[:, 1::2] @ turn.T
        return out

    return rearrange


def _turn(clockwise: float) -> FloatArray:
    c, s = np.cos(clockwise), np.sin(clockwise)
    return np.array([[c, s], [-s, c]])
