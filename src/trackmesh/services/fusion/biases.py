"""The words of registration: its rules, what it tells, what it keeps over restarts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import bias
from trackmesh.services.estimation.bias import COMPONENTS, Geometry, Known
from trackmesh.services.estimation.bias_filter import BiasFilter, block

FloatArray = npt.NDArray[np.float64]
Kind = Literal["polar", "position"]

COLUMNS: dict[Kind, list[str]] = {"polar": ["range_m", "azimuth_rad"], "position": ["east_m", "north_m"]}
"""Names of the first two biases of a sensor; the third is its time offset."""

_LISTS = ("sensors", "kinds", "locked", "pairs", "jumps")
_ARRAYS = ("prior", "bias", "applied")
_UNTOUCHED, _WELL_KNOWN, _ALMOST_NOTHING = 0.9, 0.25, 0.01


class RegistrationRules(NamedTuple):
    """Constants of registration.

    Attributes:
        prior_range_m, prior_azimuth_rad, prior_position_m, prior_time_offset_s: one sigma of biases before any data;
            0 for what is known to be right, as time offsets are by default.
        walk_m, walk_azimuth_rad, walk_time_offset_s: how biases wander, one sigma per square root of a second.
        free_period_s, locked_period_s: least time between two updates by one pair of sensors.
        correlation_s: differences of two local tracks this far apart in time are correlated by 1/e.
        outlier_distance: pairs with a larger D weigh less, by this over D.
        jump_distance, jump_pairs: a median D above this, with at least so many pairs, is a jump.
        jump_share: part of the prior variance that a jump gives back.
        lock_m, lock_range_m: locked when the 1-sigma shift at this range is below this, at both sensors of a pair.
        lock_difference: lock also where only the difference of two sensors is known so well, as of two on one mast.
        significance: a correction is applied, or changed, only where it is so many times its own 1-sigma error.
        step_share: what is applied follows the estimate when they are this share of ``lock_m`` apart at that range.
        step_speed_mps: speed of the target in that, for time offsets.
        start_tracks, start_after_s: a global start is wanted when two sensors have had so many tracks each for so long
            without pairs.
    """

    prior_range_m: float = 300.0
    prior_azimuth_rad: float = float(np.deg2rad(0.6))
    prior_position_m: float = 100.0
    prior_time_offset_s: float = 0.0
    walk_m: float = 1.0
    walk_azimuth_rad: float = float(np.deg2rad(0.002))
    walk_time_offset_s: float = 0.002
    free_period_s: float = 2.0
    locked_period_s: float = 8.0
    correlation_s: float = 8.0
    outlier_distance: float = 6.0
    jump_distance: float = 4.2
    jump_pairs: int = 4
    jump_share: float = 0.25
    lock_m: float = 100.0
    lock_range_m: float = 50_000.0
    lock_difference: bool = False
    significance: float = 2.0
    step_share: float = 0.1
    step_speed_mps: float = 200.0
    start_tracks: int = 8
    start_after_s: float = 20.0

    def prior(self, kind: Kind) -> FloatArray:
        """One sigma (3,) of the biases of a sensor before any data."""
        first = [self.prior_range_m, self.prior_azimuth_rad] if kind == "polar" else [self.prior_position_m] * 2
        return np.array([*first, self.prior_time_offset_s])

    def walk(self, kind: Kind) -> FloatArray:
        """How the biases (3,) of a sensor wander, one sigma per square root of a second."""
        second = self.walk_azimuth_rad if kind == "polar" else self.walk_m
        return np.array([self.walk_m, second, self.walk_time_offset_s])


class Change(NamedTuple):
    """What is applied to a sensor's plots has changed.

    Attributes:
        kind: "locked" the first time, "jumped" after a jump, "reset" when the sensor became another, else "moved".
        geometry: of the sensor, for which the biases are meant.
        before, after: (3,) the bias applied until now, and from now on.
        shift_m: length of the change at ``lock_range_m``.
    """

    sensor_id: str
    kind: Literal["locked", "moved", "jumped", "reset"]
    geometry: Geometry
    before: FloatArray
    after: FloatArray
    shift_m: float


class Estimate(NamedTuple):
    """What is known of one sensor's bias, as ``SensorBias`` tells it, and why it may not be more.

    Attributes:
        columns, bias, covariance: names, (2,), (2, 2).
        time_offset_s, time_offset_variance_s2: zeros where it is not estimated.
        locked: it is applied.
        pairs: pairs of tracks it rests on, counted each time one was used.
        jumps: sudden changes noticed.
        observable: (3,) whether the data tell each bias; true of what needs no telling.
        notes: which they do not, and why.
    """

    sensor_id: str
    columns: list[str]
    bias: FloatArray
    covariance: FloatArray
    time_offset_s: float
    time_offset_variance_s2: float
    locked: bool
    pairs: int
    jumps: int
    observable: list[bool]
    notes: list[str]


class KnownSensor:
    """A sensor of the filter: what it is, what is applied to it, what happened to it."""

    def __init__(self, sensor_id: str, kind: Kind) -> None:
        self.sensor_id = sensor_id
        self.kind: Kind = kind
        self.announced = False
        self.applied = np.zeros(COMPONENTS)
        self.locked = False
        self.pairs = 0
        self.jumps = 0
        self.jumped_s = -np.inf

    @property
    def columns(self) -> list[str]:
        """Names of its biases."""
        return [*COLUMNS[self.kind], "time_offset_s"]


def numbers(value: Any, shape: tuple[int, ...], name: str) -> FloatArray:
    """``value`` as finite floats of this shape.

    Raises:
        ValueError: it is no such thing.
    """
    try:
        result = np.array(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers") from None
    if result.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}, not {result.shape}")
    if not np.isfinite(result).all():
        raise ValueError(f"{name} must be finite")
    return result


def moved(change: Change, at: FloatArray, site_m: FloatArray | None = None) -> FloatArray:
    """Positions (n, 2) that were corrected by ``change.before``, as ``change.after`` corrects them.

    Args:
        change: what has changed.
        at: (n, 2), or (n, 4) with velocities: without them time offsets are left out.
        site_m: (n, 2) from where each was measured, if that was not where the sensor stands now.
    """
    raw = at[:, :2] - shift_from(change.geometry, site_m, at, -change.before)
    return np.asarray(raw - shift_from(change.geometry, site_m, np.concatenate([raw, at[:, 2:]], axis=1), change.after))


def shift_from(geometry: Geometry, site_m: FloatArray | None, at: FloatArray, biases: FloatArray) -> FloatArray:
    """``bias.shift`` of positions (n, 2 or 4) measured from sites (n, 2); None: from that of the geometry."""
    if site_m is None:
        return bias.shift(geometry, at, biases)
    off = np.concatenate([at[:, :2] - site_m, at[:, 2:]], axis=1)
    return bias.shift(Geometry(geometry.polar, np.zeros(2)), off, biases)


# --- what cannot be told ---


def notes(sensors: Sequence[KnownSensor], sensor: int, known: Known) -> dict[int, str]:
    """Of the biases (by component) of a sensor that the data do not tell, why."""
    one = sensors[sensor]
    told = {}
    for c, name in enumerate(one.columns):
        if known.remaining[COMPONENTS * sensor + c] > 0.0:
            reason = "no pairs with another sensor yet" if not one.pairs else _reason(sensors, sensor, c, known)
            if reason:
                told[c] = f"{name}: {reason}"
    return told


def _reason(sensors: Sequence[KnownSensor], sensor: int, component: int, known: Known) -> str | None:
    i = COMPONENTS * sensor + component
    remaining = known.remaining[i]
    if remaining > _UNTOUCHED:
        return "the data tell nothing of it"
    # What remains lies where only the prior speaks: it is known but for a sum that it shares with others.
    if remaining > _ALMOST_NOTHING and known.held[i] > 0.5 * remaining:
        others = np.abs(known.tie[i]).copy()
        others[block(sensor)] = 0.0
        if others.any():
            return f"known only in relation to {sensors[int(np.argmax(others)) // COMPONENTS].sensor_id}"
    return "little more is known than before" if remaining > _WELL_KNOWN else None


# --- what is kept over restarts ---


def packed(sensors: Sequence[KnownSensor], state: BiasFilter) -> dict[str, Any]:
    """All that is to be kept, as arrays and plain types."""
    return {
        "sensors": [s.sensor_id for s in sensors],
        "kinds": [s.kind for s in sensors],
        "prior": state.prior.reshape(-1, COMPONENTS).copy(),
        "bias": state.beta.reshape(-1, COMPONENTS).copy(),
        "covariance": state.P.copy(),
        "applied": np.array([s.applied for s in sensors]).reshape(-1, COMPONENTS),
        "locked": [s.locked for s in sensors],
        "pairs": [s.pairs for s in sensors],
        "jumps": [s.jumps for s in sensors],
    }


def unpacked(data: Mapping[str, Any], rules: RegistrationRules) -> tuple[list[KnownSensor], BiasFilter]:
    """What ``packed`` was given, from arrays or lists; where the sensors stand they must tell again.

    Raises:
        ValueError: it is no such thing; the sentence says why.
    """
    missing = {*_LISTS, *_ARRAYS, "covariance"} - set(data)
    if missing:
        raise ValueError(f"{min(missing)} is missing")
    ids, kinds, locked, pairs, jumps = (_listed(data, name) for name in _LISTS)
    n = len(ids)
    if {len(kinds), len(locked), len(pairs), len(jumps)} != {n}:
        raise ValueError("kinds, locked, pairs and jumps must be as many as sensors")
    prior, beta, applied = (numbers(data[name], (n, COMPONENTS), name) for name in _ARRAYS)
    P = numbers(data["covariance"], (COMPONENTS * n, COMPONENTS * n), "covariance")
    _check(ids, kinds, locked, [*pairs, *jumps], prior)
    _check_covariance(P, prior.ravel())
    sensors, state = [], BiasFilter()
    for k in range(n):
        sensor = KnownSensor(ids[k], cast("Kind", kinds[k]))
        sensor.applied, sensor.locked, sensor.pairs, sensor.jumps = applied[k], locked[k], pairs[k], jumps[k]
        sensors.append(sensor)
        state.add(Geometry(sensor.kind == "polar", np.zeros(2)), prior[k], rules.walk(sensor.kind))
    state.beta, state.P = beta.ravel(), P
    return sensors, state


def _listed(data: Mapping[str, Any], name: str) -> list[Any]:
    if not isinstance(data[name], list):
        raise ValueError(f"{name} must be a list")
    return cast("list[Any]", data[name])


def _check(ids: list[Any], kinds: list[Any], locked: list[Any], counts: list[Any], prior: FloatArray) -> None:
    if not all(isinstance(one, str) for one in ids) or len(set(ids)) != len(ids):
        raise ValueError("sensors must be different names")
    if not all(isinstance(kind, str) and kind in COLUMNS for kind in kinds):
        raise ValueError("kinds must be polar or position")
    if not all(isinstance(one, bool) for one in locked):
        raise ValueError("locked must be true or false")
    if not all(type(count) is int and count >= 0 for count in counts):
        raise ValueError("pairs and jumps must be counts")
    if (prior < 0.0).any():
        raise ValueError("prior must not be negative")


def _check_covariance(P: FloatArray, prior: FloatArray) -> None:
    free = prior > 0.0
    if P[~free].any() or P[:, ~free].any():
        raise ValueError("covariance must be zero where the prior is")
    if not np.array_equal(P, P.T):
        raise ValueError("covariance must be symmetric")
    try:
        np.linalg.cholesky(P[np.ix_(free, free)])
    except np.linalg.LinAlgError:
        raise ValueError("covariance must be positive definite") from None
