"""Many tracks: filters with a short memory of plots, so that late plots replay exactly.

Each row of ``Filters`` holds one track: the head state at its last plot, the same filter ``k`` plots ago (the lagged
state), and the ring of plots in between, in time order. Stored state moves only when a plot is fed; prediction is
read-only, to any time, per track. A late plot is put into the ring at its place and the head is filtered again from the
lagged state: the result is what filtering in order would have given. A plot older than the lagged state is refused.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.imm import Models, filter_plot, interact, moment_match
from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Filters(NamedTuple):
    """The filters of n rows (r models, d states, rings of k plots); a row means nothing before ``begin``.

    Attributes:
        x, P, mu, counts, t_s: head: (n, r, d), (n, r, d, d), (n, r), (n, r, r), (n,).
        lag_x, lag_P, lag_mu, lag_counts, lag_t_s: the lagged state, likewise.
        ring_z, ring_R, ring_t_s, ring_sensor, ring_n: plots after the lagged state: (n, k, 2), (n, k, 3), (n, k),
            (n, k), (n,).
        mean: (n, d) mean state of the head.
        spread: (n, 3) greatest variance of position, its covariance with velocity, and variance of velocity, for a
            quick bound of where the track can be.
    """

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    counts: FloatArray
    t_s: FloatArray
    lag_x: FloatArray
    lag_P: FloatArray
    lag_mu: FloatArray
    lag_counts: FloatArray
    lag_t_s: FloatArray
    ring_z: FloatArray
    ring_R: FloatArray
    ring_t_s: FloatArray
    ring_sensor: IntArray
    ring_n: IntArray
    mean: FloatArray
    spread: FloatArray


def make_filters(n: int, r: int, k: int, d: int = 4) -> Filters:
    """Filters with n empty rows, r models and rings of k plots."""
    whole = {"ring_sensor": (n, k), "ring_n": (n,)}
    state = {"x": (n, r, d), "P": (n, r, d, d), "mu": (n, r), "counts": (n, r, r), "t_s": (n,)}
    real: dict[str, tuple[int, ...]] = state | {f"lag_{name}": shape for name, shape in state.items()}
    real |= {"ring_z": (n, k, 2), "ring_R": (n, k, 3), "ring_t_s": (n, k), "mean": (n, d), "spread": (n, 3)}
    arrays: dict[str, npt.NDArray[Any]] = {name: np.zeros(shape) for name, shape in real.items()}
    return Filters(**arrays | {name: np.zeros(shape, np.int64) for name, shape in whole.items()})


@kernel
def begin(
    models: Models,
    f: Filters,
    rows: IntArray,
    z: FloatArray,
    R: FloatArray,
    t_s: FloatArray,
    sigma_v_mps: float,
) -> None:
    """Start tracks in ``rows`` from single plots: at the plot, at rest, with ``sigma_v_mps`` per axis of velocity."""
    r, d = f.x.shape[1:]
    for k in range(len(rows)):
        i = rows[k]
        for j in range(r):
            f.x[i, j, :] = 0.0
            f.P[i, j, :, :] = 0.0
            f.x[i, j, 0], f.x[i, j, 1] = z[k, 0], z[k, 1]
            f.P[i, j, 0, 0], f.P[i, j, 1, 1] = R[k, 0], R[k, 2]
            f.P[i, j, 0, 1] = f.P[i, j, 1, 0] = R[k, 1]
            for a in range(2, d):
                f.P[i, j, a, a] = sigma_v_mps**2
            f.mu[i, j] = models.mu0[j]
        f.counts[i] = 0.0
        f.t_s[i] = t_s[k]
        _copy_head_to_lag(f, i)
        f.ring_n[i] = 0
        _summarise(f, i)


@kernel
def feed(
    models: Models,
    f: Filters,
    rows: IntArray,
    z: FloatArray,
    R: FloatArray,
    t_s: FloatArray,
    sensor: int,
) -> BoolArray:
    """Feed plot k to row ``rows[k]``, in order or late; False where the plot is older than the row's lagged state."""
    r, d = f.x.shape[1:]
    pi, mx, mP = np.empty((r, r)), np.empty((r, d)), np.empty((r, d, d))
    taken = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        i = rows[k]
        if t_s[k] >= f.t_s[i]:
            _insert(models, f, i, z[k], R[k], t_s[k], sensor, pi, mx, mP)
            filter_plot(models, f.x[i], f.P[i], f.mu[i], f.counts[i], t_s[k] - f.t_s[i], z[k], R[k], pi, mx, mP)
            f.t_s[i] = t_s[k]
        elif t_s[k] >= f.lag_t_s[i]:
            _insert(models, f, i, z[k], R[k], t_s[k], sensor, pi, mx, mP)
            _replay(models, f, i, pi, mx, mP)
        else:
            taken[k] = False
            continue
        _summarise(f, i)
    return taken


@kernel
def feed_ring(models: Models, f: Filters, source: int, target: int) -> None:
    """Feed the plots in the ring of row ``source`` to row ``target`` (two tracks are one target)."""
    row = np.array([target])
    for k in range(f.ring_n[source]):
        feed(
            models,
            f,
            row,
            f.ring_z[source, k : k + 1],
            f.ring_R[source, k : k + 1],
            f.ring_t_s[source, k : k + 1],
            f.ring_sensor[source, k],
        )


@kernel
def predict(
    models: Models,
    f: Filters,
    rows: IntArray,
    t_s: FloatArray,
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
) -> BoolArray:
    """Prediction of rows to their times, model by model, without changing them.

    A time before a row's last plot is answered by filtering its ring up to that time; before its lagged state there is
    no answer.

    Args:
        rows: (m,) rows. t_s: (m,) times.
        x, P, mu: (m, r, d), (m, r, d, d), (m, r), written.

    Returns:
        (m,) whether there is an answer.
    """
    r, d = f.x.shape[1:]
    pi, mx, mP, counts = np.empty((r, r)), np.empty((r, d)), np.empty((r, d, d)), np.empty((r, r))
    known = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        i = rows[k]
        if t_s[k] >= f.t_s[i]:
            x[k], P[k], mu[k], counts[:] = f.x[i], f.P[i], f.mu[i], f.counts[i]
            last = f.t_s[i]
        elif t_s[k] >= f.lag_t_s[i]:
            x[k], P[k], mu[k], counts[:] = f.lag_x[i], f.lag_P[i], f.lag_mu[i], f.lag_counts[i]
            last = f.lag_t_s[i]
            for h in range(f.ring_n[i]):
                if f.ring_t_s[i, h] > t_s[k]:
                    break
                dt = f.ring_t_s[i, h] - last
                filter_plot(models, x[k], P[k], mu[k], counts, dt, f.ring_z[i, h], f.ring_R[i, h], pi, mx, mP)
                last = f.ring_t_s[i, h]
        else:
            known[k] = False
            x[k], P[k], mu[k] = 0.0, 0.0, 0.0
            continue
        interact(models, x[k], P[k], mu[k], counts, t_s[k] - last, pi, mx, mP)
    return known


@kernel
def moments(x: FloatArray, P: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Moment-match m mixtures: (m, r, d), (m, r, d, d), (m, r) to means (m, d) and covariances (m, d, d)."""
    m, _, d = x.shape
    mean, covariance = np.empty((m, d)), np.empty((m, d, d))
    for k in range(m):
        moment_match(x[k], P[k], mu[k], mean[k], covariance[k])
    return mean, covariance


@kernel
def near(
    f: Filters, rows: IntArray, z: FloatArray, R: FloatArray, t_s: FloatArray, q_max: float, limit: float
) -> IntArray:
    """The rows that may have a plot in their gate: a generous circle around each touches the plots' bounding box."""
    m = len(z)
    east0 = north0 = early = np.inf
    east1 = north1 = late = -np.inf
    r_max = 0.0
    for j in range(m):
        east0, east1 = min(east0, z[j, 0]), max(east1, z[j, 0])
        north0, north1 = min(north0, z[j, 1]), max(north1, z[j, 1])
        early, late = min(early, t_s[j]), max(late, t_s[j])
        r_max = max(r_max, R[j, 0] + R[j, 2])
    chosen = np.empty(len(rows), np.int64)
    n = 0
    for i in rows:
        dt = (early + late) / 2.0 - f.t_s[i]
        span = abs(dt) + (late - early) / 2.0
        variance = f.spread[i, 0] + 2.0 * span * f.spread[i, 1] + span * span * f.spread[i, 2] + q_max * span**3
        speed = np.hypot(f.mean[i, 2], f.mean[i, 3])
        reach = np.sqrt(limit * (variance + r_max)) + speed * (late - early) / 2.0
        if dt < 0.0:
            reach += speed * -dt
        e, north = f.mean[i, 0] + dt * f.mean[i, 2], f.mean[i, 1] + dt * f.mean[i, 3]
        if east0 - reach <= e <= east1 + reach and north0 - reach <= north <= north1 + reach:
            chosen[n] = i
            n += 1
    return chosen[:n]


@kernel
def nearest_times(f: Filters, rows: IntArray, z: FloatArray, t_s: FloatArray) -> FloatArray:
    """The time of the plot nearest to each row, with the row moved to the plot's time: when the sensor looked at it."""
    out = np.empty(len(rows))
    for k in range(len(rows)):
        i = rows[k]
        best = np.inf
        for j in range(len(z)):
            dt = t_s[j] - f.t_s[i]
            de = z[j, 0] - f.mean[i, 0] - dt * f.mean[i, 2]
            dn = z[j, 1] - f.mean[i, 1] - dt * f.mean[i, 3]
            if de * de + dn * dn < best:
                best, out[k] = de * de + dn * dn, t_s[j]
    return out


@kernel
def _insert(
    models: Models,
    f: Filters,
    i: int,
    z: FloatArray,
    R: FloatArray,
    t_s: float,
    sensor: int,
    pi: FloatArray,
    mx: FloatArray,
    mP: FloatArray,
) -> None:
    """Put a plot into the ring in time order; when full, the oldest plot moves into the lagged state."""
    size = f.ring_t_s.shape[1]
    if f.ring_n[i] == size:
        if t_s < f.ring_t_s[i, 0]:
            _advance_lag(models, f, i, z, R, t_s, pi, mx, mP)
            return
        _advance_lag(models, f, i, f.ring_z[i, 0], f.ring_R[i, 0], f.ring_t_s[i, 0], pi, mx, mP)
        for h in range(1, size):
            _move_ring(f, i, h, h - 1)
        f.ring_n[i] -= 1
    h = f.ring_n[i]
    while h > 0 and f.ring_t_s[i, h - 1] > t_s:
        _move_ring(f, i, h - 1, h)
        h -= 1
    f.ring_z[i, h] = z
    f.ring_R[i, h] = R
    f.ring_t_s[i, h] = t_s
    f.ring_sensor[i, h] = sensor
    f.ring_n[i] += 1


@kernel
def _advance_lag(
    models: Models,
    f: Filters,
    i: int,
    z: FloatArray,
    R: FloatArray,
    t_s: float,
    pi: FloatArray,
    mx: FloatArray,
    mP: FloatArray,
) -> None:
    dt = t_s - f.lag_t_s[i]
    filter_plot(models, f.lag_x[i], f.lag_P[i], f.lag_mu[i], f.lag_counts[i], dt, z, R, pi, mx, mP)
    f.lag_t_s[i] = t_s


@kernel
def _replay(models: Models, f: Filters, i: int, pi: FloatArray, mx: FloatArray, mP: FloatArray) -> None:
    f.x[i] = f.lag_x[i]
    f.P[i] = f.lag_P[i]
    f.mu[i] = f.lag_mu[i]
    f.counts[i] = f.lag_counts[i]
    f.t_s[i] = f.lag_t_s[i]
    for h in range(f.ring_n[i]):
        dt = f.ring_t_s[i, h] - f.t_s[i]
        filter_plot(models, f.x[i], f.P[i], f.mu[i], f.counts[i], dt, f.ring_z[i, h], f.ring_R[i, h], pi, mx, mP)
        f.t_s[i] = f.ring_t_s[i, h]


@kernel
def _move_ring(f: Filters, i: int, source: int, target: int) -> None:
    f.ring_z[i, target] = f.ring_z[i, source]
    f.ring_R[i, target] = f.ring_R[i, source]
    f.ring_t_s[i, target] = f.ring_t_s[i, source]
    f.ring_sensor[i, target] = f.ring_sensor[i, source]


@kernel
def _copy_head_to_lag(f: Filters, i: int) -> None:
    f.lag_x[i] = f.x[i]
    f.lag_P[i] = f.P[i]
    f.lag_mu[i] = f.mu[i]
    f.lag_counts[i] = f.counts[i]
    f.lag_t_s[i] = f.t_s[i]


@kernel
def _summarise(f: Filters, i: int) -> None:
    """Mean state and greatest variances of the head, for ``near``."""
    r = f.mu.shape[1]
    f.mean[i] = 0.0
    for j in range(r):
        f.mean[i] += f.mu[i, j] * f.x[i, j]
    position = cross = velocity = 0.0
    for j in range(r):
        de, dn = f.x[i, j, 0] - f.mean[i, 0], f.x[i, j, 1] - f.mean[i, 1]
        dve, dvn = f.x[i, j, 2] - f.mean[i, 2], f.x[i, j, 3] - f.mean[i, 3]
        position = max(position, f.P[i, j, 0, 0] + f.P[i, j, 1, 1] + de * de + dn * dn)
        cross = max(cross, abs(f.P[i, j, 0, 2]) + abs(f.P[i, j, 1, 3]))
        velocity = max(velocity, f.P[i, j, 2, 2] + f.P[i, j, 3, 3] + dve * dve + dvn * dvn)
    f.spread[i, 0], f.spread[i, 1], f.spread[i, 2] = position, cross, velocity
