"""Registration: the biases of all sensors of a unit, learnt from pairs of their local tracks, and when to apply them.

Signs and components are those of ``services.estimation.bias``: measured = true + J beta, so what ``shift`` gives is
subtracted from measured positions. Local tracks stay in the raw frame of their sensor. What is estimated serves at
once in the test between local tracks (``difference``), but plots are corrected only once it is good enough (locked),
and then in steps: what is applied stays until the estimate has moved away from it, and each step is told as a
``Change``, so that whatever was corrected before can be moved along (``biases.moved``).

Pure: no clock; the same calls give the same numbers. A sensor that was never announced is a KeyError.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import bias
from trackmesh.services.estimation.bias import COMPONENTS, Geometry, Tracks
from trackmesh.services.estimation.bias_filter import BiasFilter, Pairs, Seen, block
from trackmesh.services.fusion import biases
from trackmesh.services.fusion.biases import Change, Estimate, Kind, KnownSensor, RegistrationRules

FloatArray = npt.NDArray[np.float64]

_ONE_JUMP_S = 30.0
_SAME_TIME_S = 1e-3


class _Waiting(NamedTuple):
    """Pairs that wait for ``settle``: what they count as a repetition, variances that a global start adds before."""

    pairs: Pairs
    weight: float
    opening: FloatArray | None


class Registration:
    """The biases of all sensors of a unit. Sensors are named by their ids."""

    def __init__(self, rules: RegistrationRules | None = None) -> None:
        self.rules = rules or RegistrationRules()
        self._filter = BiasFilter()
        self._sensors: list[KnownSensor] = []
        self._index: dict[str, int] = {}
        self._t_s = -np.inf
        self._last_s: dict[tuple[int, int], float] = {}
        self._lost: dict[tuple[int, int], tuple[float, float]] = {}
        self._waiting: list[_Waiting] = []
        self._changes: list[Change] = []

    # --- sensors ---

    def announce(
        self, sensor_id: str, kind: Kind, site_m: npt.ArrayLike = (0.0, 0.0), prior: npt.ArrayLike | None = None
    ) -> None:
        """Add a sensor, or take over where a known one stands now; its bias lives on.

        Args:
            sensor_id: its name.
            kind: what it measures. A known sensor that changes it, or its prior, begins anew.
            site_m: (2,) in the plane; of no importance for a position sensor.
            prior: (3,) one sigma of its biases, where they are not those of the rules; zeros for a reference.

        Raises:
            ValueError: the kind, the site or the prior is no such thing.
        """
        if kind not in biases.COLUMNS:
            raise ValueError("kind must be polar or position")
        geometry = Geometry(kind == "polar", biases.numbers(site_m, (2,), "site_m"))
        sigma = biases.numbers(self.rules.prior(kind) if prior is None else prior, (COMPONENTS,), "prior")
        if (sigma < 0.0).any():
            raise ValueError("prior must not be negative")
        k = self._index.setdefault(sensor_id, len(self._sensors))
        if k == len(self._sensors):
            self._sensors.append(KnownSensor(sensor_id, kind))
            self._filter.add(geometry, sigma, self.rules.walk(kind))
        elif self._sensors[k].kind != kind or not np.array_equal(self._filter.prior[block(k)], sigma):
            self._begin_anew(k, kind)
            self._filter.replace(k, geometry, sigma, self.rules.walk(kind))
        self._filter.geometries[k] = geometry
        self._sensors[k].announced = True

    def _begin_anew(self, k: int, kind: Kind) -> None:
        sensor = KnownSensor(self._sensors[k].sensor_id, kind)
        if self._sensors[k].applied.any():
            self._changes.append(self._change(k, "reset", sensor.applied))
        self._sensors[k] = sensor
        self._last_s = {pair: t_s for pair, t_s in self._last_s.items() if k not in pair}
        self._waiting = [one for one in self._waiting if k not in one.pairs[:2]]

    # --- what it is for ---

    def shift(
        self, sensor_id: str, at: FloatArray, *, applied: bool = True, site_m: FloatArray | None = None
    ) -> FloatArray:
        """J beta (n, 2): what has to be subtracted from measured positions; zeros until the sensor is locked.

        Args:
            sensor_id: who measured.
            at: (n, 2) measured positions, or (n, 4) with velocities: without them the time offset is left out, for
                plots whose times were corrected by ``time_offset_s``.
            applied: False for the shift by the present estimate, locked or not.
            site_m: (n, 2) from where each was measured, if that was not where the sensor stands now.
        """
        k = self._index[sensor_id]
        present = self._sensors[k].applied if applied else self._filter.bias(k)
        return biases.shift_from(self._filter.geometries[k], site_m, at, present)

    def covariance(self, sensor_id: str, at: FloatArray) -> FloatArray:
        """Covariances (n, 2, 2) of the shift by the present estimate, locked or not. Arguments as of ``shift``."""
        return self._filter.shift_covariance(self._index[sensor_id], at)

    def time_offset_s(self, sensor_id: str) -> float:
        """What has to be added to the times of a sensor's plots; 0 until it is locked."""
        return float(self._sensors[self._index[sensor_id]].applied[2])

    def geometry(self, sensor_id: str) -> Geometry:
        """How a sensor measures."""
        return self._filter.geometries[self._index[sensor_id]]

    def locked(self, sensor_id: str) -> bool:
        """Whether the sensor is corrected."""
        return self._sensors[self._index[sensor_id]].locked

    def difference(self, a: str, b: str, at_a: FloatArray, at_b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (n, 2) and covariance (n, 2, 2) of J_a beta_a - J_b beta_b: how tracks of one target should differ.

        By the present estimate, locked or not: what is badly known widens the gate. ``at_a`` and ``at_b``, (n, 2) or
        (n, 4), are the raw tracks of the pairs.
        """
        mean = self._filter.shift(self._index[a], at_a) - self._filter.shift(self._index[b], at_b)
        return mean, self.difference_covariance(a, b, at_a, at_b)

    def difference_covariance(self, a: str, b: str, at_a: FloatArray, at_b: FloatArray) -> FloatArray:
        """The covariance of ``difference`` alone, for whoever has both shifts already."""
        return self._filter.difference_covariance(self._index[a], at_a, self._index[b], at_b)

    def suppose(self, sensor_id: str, beta: FloatArray, P: FloatArray) -> Change:
        """Take over what another unit knows of a sensor, (3,) and (3, 3), and apply it at once; the change."""
        k = self._index[sensor_id]
        self._filter.suppose(k, beta, P)
        change = self._change(k, "moved", self._filter.bias(k).copy())
        self._sensors[k].applied, self._sensors[k].locked = change.after, True
        return change

    def pairs(self, sensor_id: str) -> int:
        """How many pairs of tracks have told of a sensor."""
        return self._sensors[self._index[sensor_id]].pairs

    # --- what it learns from ---

    def due(self, a: str, b: str, t_s: float) -> bool:
        """Whether pairs of these two sensors are wanted at this time."""
        i, j = self._key(a, b)
        well = self._sensors[i].locked and self._sensors[j].locked and self._well_known(i, j)
        period_s = self.rules.locked_period_s if well else self.rules.free_period_s
        return t_s - self._last_s.get((i, j), -np.inf) >= period_s - _SAME_TIME_S

    def update(
        self, a: str, b: str, x_a: FloatArray, P_a: FloatArray, x_b: FloatArray, P_b: FloatArray, t_s: float
    ) -> bool:
        """Hand over the declared pairs of two sensors: raw states (n, 4) and covariances (n, 4, 4), row by row.

        They are used by the next ``settle``. Whether they were wanted, and any was usable.
        """
        return self.due(a, b, t_s) and self._take(self._key(a, b), {a: (x_a, P_a), b: (x_b, P_b)}, t_s)

    def lost(self, a: str, b: str, tracks_a: int, tracks_b: int, t_s: float) -> bool:
        """Whether a global start of two sensors is worth its cost now; to be asked once every association cycle.

        It is when both have had enough tracks for a while (rules) and not enough pairs of them came. The while is
        twice as long after each time that this was answered by yes.
        """
        key = self._key(a, b)
        if min(tracks_a, tracks_b) < self.rules.start_tracks:
            self._lost.pop(key, None)
            return False
        since_s, wait_s = self._lost.setdefault(key, (t_s, self.rules.start_after_s))
        if t_s - since_s < wait_s - _SAME_TIME_S:
            return False
        self._lost[key] = t_s, 2.0 * wait_s
        return True

    def begin(
        self,
        a: str,
        b: str,
        found: tuple[FloatArray, FloatArray],
        x_a: FloatArray,
        P_a: FloatArray,
        x_b: FloatArray,
        P_b: FloatArray,
        t_s: float,
    ) -> bool:
        """As ``update``, with the pairs and the biases ((2,) of a, (2,) of b) that a global start found.

        The filter is opened as far as these biases are from the present ones, so that the pairs are no outliers to it.
        """
        opening = np.zeros(len(self._filter.beta))
        for sensor_id, one in zip((a, b), found, strict=True):
            k = self._index[sensor_id]
            opening[block(k)][:2] = (np.asarray(one) - self._filter.bias(k)[:2]) ** 2
        return self._take(self._key(a, b), {a: (x_a, P_a), b: (x_b, P_b)}, t_s, opening)

    def _take(
        self,
        key: tuple[int, int],
        tracks: Mapping[str, tuple[FloatArray, FloatArray]],
        t_s: float,
        opening: FloatArray | None = None,
    ) -> bool:
        good = np.logical_and.reduce([_usable(x, P) for x, P in tracks.values()])
        if not good.any():
            return False
        if good.sum() >= self.rules.jump_pairs:
            self._lost.pop(key, None)
        of = {self._index[name]: (x[good], P[good]) for name, (x, P) in tracks.items()}
        pairs = Pairs(*key, *(Tracks(self._filter.geometries[k], *of[k]) for k in key))
        weight = bias.repetition(max(0.0, t_s - self._last_s.get(key, -np.inf)), self.rules.correlation_s)
        self._waiting.append(_Waiting(pairs, weight, opening))
        self._last_s[key] = t_s
        return True

    def settle(self, t_s: float) -> list[Change]:
        """Use all that was handed over since the last call, as one update; to be called once every association cycle.

        Returns what changed in the corrections that are applied, at most once a sensor.
        """
        self._filter.drift(max(0.0, t_s - self._t_s) if np.isfinite(self._t_s) else 0.0)
        self._t_s = max(t_s, self._t_s)
        waiting, self._waiting = self._waiting, []
        if waiting:
            before = self._filter.beta
            seen = [self._filter.seen(one.pairs) for one in waiting]
            opened = self._open(waiting, seen)
            self._filter.learn(seen, [self._weights(*one) for one in zip(waiting, seen, strict=True)])
            self._count([one.pairs for one in waiting], opened, before)
            self._lock([one.pairs for one in waiting])
        changes, self._changes = self._changes + self._apply(), []
        return changes

    def _open(self, waiting: Sequence[_Waiting], seen: Sequence[Seen]) -> set[int]:
        """Widen what is known, where a global start says so and at sensors whose pairs do not fit; which those are."""
        opened: set[int] = set()
        more = np.zeros(len(self._filter.beta))
        for one, rows in zip(waiting, seen, strict=True):
            if one.opening is not None:
                more = np.maximum(more, np.pad(one.opening, (0, len(more) - len(one.opening))))
            elif self._misfit(rows):
                opened |= {one.pairs.i, one.pairs.j}
        for k in sorted(opened):
            more[block(k)] += self.rules.jump_share * self._filter.prior[block(k)] ** 2
        self._filter.open(more)
        return opened

    def _misfit(self, seen: Seen) -> bool:
        distances = self._filter.distances(seen)
        return len(distances) >= self.rules.jump_pairs and bool(np.median(distances) > self.rules.jump_distance)

    def _weights(self, waiting: _Waiting, seen: Seen) -> FloatArray:
        """Of rows: less for outliers, for what is a repetition, and where more than two sensors see the targets.

        Of K sensors only K - 1 differences are independent: with equal noise each of the K (K - 1) / 2 pairs counts
        for 2 / K.
        """
        fit = np.minimum(1.0, self.rules.outlier_distance / np.maximum(self._filter.distances(seen), 1e-9))
        sharing = len(self._partners(seen.pairs.i) & self._partners(seen.pairs.j))
        return np.asarray(fit * waiting.weight * 2.0 / (2.0 + sharing))

    def _partners(self, k: int) -> set[int]:
        since_s = self._t_s - 1.5 * self.rules.locked_period_s
        return {i + j - k for (i, j), t_s in self._last_s.items() if k in (i, j) and t_s >= since_s}

    # --- what is applied ---

    def _count(self, pairs: Sequence[Pairs], opened: set[int], before: FloatArray) -> None:
        for one in pairs:
            self._sensors[one.i].pairs += len(one.of_i.x)
            self._sensors[one.j].pairs += len(one.of_i.x)
        # That pairs do not fit does not say which sensor jumped; the estimate that moves does.
        moved_m = {k: self._length(k, (self._filter.beta - before)[block(k)]) for k in opened}
        for k, size_m in moved_m.items():
            sensor = self._sensors[k]
            fresh = self._t_s - sensor.jumped_s > _ONE_JUMP_S
            if sensor.locked and fresh and size_m >= 0.5 * max(moved_m.values()):
                sensor.jumps += 1
                sensor.jumped_s = self._t_s

    def _lock(self, pairs: Sequence[Pairs]) -> None:
        """Lock both sensors of pairs that are known well enough."""
        for k in {k for one in pairs for k in (one.i, one.j) if self._well_known(one.i, one.j)}:
            self._sensors[k].locked = True

    def _well_known(self, i: int, j: int) -> bool:
        lock_m, range_m = self.rules.lock_m, self.rules.lock_range_m
        if max(self._filter.spread(i, range_m), self._filter.spread(j, range_m)) < lock_m:
            return True
        return self.rules.lock_difference and self._filter.difference_spread(i, j, range_m) < lock_m

    def _apply(self) -> list[Change]:
        changes = []
        rules = self.rules
        for k, sensor in enumerate(self._sensors):
            after = self._filter.bias(k).copy()
            # What is smaller than its own error is no bias: to correct by it would only add that error. Where only a
            # difference is known, that says nothing.
            spread_m = self._filter.spread(k, rules.lock_range_m)
            doubt_m = rules.significance * spread_m if spread_m < rules.lock_m else 0.0
            if sensor.locked and self._length(k, after - sensor.applied) > max(
                rules.step_share * rules.lock_m, doubt_m
            ):
                jumped, first = sensor.jumped_s == self._t_s, not sensor.applied.any()
                changes.append(self._change(k, "locked" if first else "jumped" if jumped else "moved", after))
                sensor.applied = after
        return changes

    def _change(self, k: int, kind: Literal["locked", "moved", "jumped", "reset"], after: FloatArray) -> Change:
        sensor = self._sensors[k]
        size_m = self._length(k, after - sensor.applied)
        return Change(sensor.sensor_id, kind, self._filter.geometries[k], sensor.applied, after, size_m)

    # --- what it tells ---

    def messages(self) -> list[Estimate]:
        """The present estimate of every announced sensor, in the order in which they came."""
        known = bias.known(self._filter.P, self._filter.prior)
        return [self._estimate(k, known) for k, sensor in enumerate(self._sensors) if sensor.announced]

    def _estimate(self, k: int, known: bias.Known) -> Estimate:
        sensor, beta, P = self._sensors[k], self._filter.bias(k), self._filter.covariance(k)
        notes = biases.notes(self._sensors, k, known)
        return Estimate(
            sensor_id=sensor.sensor_id,
            columns=sensor.columns[:2],
            bias=beta[:2].copy(),
            covariance=P[:2, :2].copy(),
            time_offset_s=float(beta[2]),
            time_offset_variance_s2=float(P[2, 2]),
            locked=sensor.locked,
            pairs=sensor.pairs,
            jumps=sensor.jumps,
            observable=[c not in notes for c in range(COMPONENTS)],
            notes=list(notes.values()),
        )

    def snapshot(self) -> dict[str, Any]:
        """All that is to be kept over a restart, as arrays and plain types."""
        return biases.packed(self._sensors, self._filter)

    def restore(self, data: Mapping[str, Any], age_s: float = 0.0) -> None:
        """Take over a snapshot, before the first sensor is announced.

        Args:
            data: what ``snapshot`` gave; arrays may be lists.
            age_s: how long ago; biases have wandered since.

        Raises:
            ValueError: it is no snapshot, or sensors are known already; nothing is changed then.
        """
        if self._sensors:
            raise ValueError("a snapshot is restored before the first sensor")
        if not 0.0 <= age_s < np.inf:
            raise ValueError("age_s must be a time that has passed")
        self._sensors, self._filter = biases.unpacked(data, self.rules)
        self._index = {sensor.sensor_id: k for k, sensor in enumerate(self._sensors)}
        self._filter.drift(age_s)

    def _key(self, a: str, b: str) -> tuple[int, int]:
        i, j = self._index[a], self._index[b]
        if i == j:
            raise ValueError("a pair needs two sensors")
        return min(i, j), max(i, j)

    def _length(self, k: int, change: FloatArray) -> float:
        length_m = bias.length(change, self._filter.geometries[k].polar, self.rules.lock_range_m)
        return float(np.hypot(length_m, change[2] * self.rules.step_speed_mps))


def _usable(x: FloatArray, P: FloatArray) -> npt.NDArray[np.bool_]:
    finite = np.isfinite(x).all(axis=1) & np.isfinite(P).all(axis=(1, 2))
    return np.asarray(finite & bias.positive_definite(P[:, :2, :2]))
