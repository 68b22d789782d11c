"""Many tracks: filters with a short memory of plots, so that late plots replay exactly.

Each row holds one track: the head (the filter at its last plot), the same filter some plots ago (the lagged state), and
the ring of plots in between, in time order. Stored state moves only when a plot is fed; prediction is read-only, to any
time, per track. A late plot is put into the ring at its place and the head is filtered again from the lagged state: the
result is what filtering in order would have given. A plot older than the lagged state is refused.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import imm, printed
from trackmesh.services.estimation.bank import Models, State, Work, make_state
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.motion import own_acceleration

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Filters(NamedTuple):
    """The filters of n rows with rings of k plots; a row means nothing before ``begin``.

    Attributes:
        head: at the last plot. lag: before the plots of the ring.
        ring_z, ring_R, ring_t_s, ring_sensor, ring_n: the plots: (n, k, 2), (n, k, 3), (n, k), (n, k), (n,).
        mean: (n, 4) mean position and velocity of the head.
        spread: (n, 3) greatest variance of position, its covariance with velocity, and variance of velocity, for a
            quick bound of where the track can be.
    """

    head: State
    lag: State
    ring_z: FloatArray
    ring_R: FloatArray
    ring_t_s: FloatArray
    ring_sensor: IntArray
    ring_n: IntArray
    mean: FloatArray
    spread: FloatArray


def make_filters(models: Models, n: int, k: int) -> Filters:
    """Filters with n empty rows and rings of k plots."""
    return Filters(
        head=make_state(models, n),
        lag=make_state(models, n),
        ring_z=np.zeros((n, k, 2)),
        ring_R=np.zeros((n, k, 3)),
        ring_t_s=np.zeros((n, k)),
        ring_sensor=np.zeros((n, k), np.int64),
        ring_n=np.zeros(n, np.int64),
        mean=np.zeros((n, 4)),
        spread=np.zeros((n, 3)),
    )


def join_rows(first: Filters, second: Filters) -> Filters:
    """The rows of both."""
    head, lag = (
        State(*(np.concatenate(both) for both in zip(a, b, strict=True)))
        for a, b in ((first.head, second.head), (first.lag, second.lag))
    )
    rest = {n: np.concatenate((getattr(first, n), getattr(second, n))) for n in Filters._fields[2:]}
    return Filters(head, lag, **rest)


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
    """Start tracks in ``rows`` from single plots, see ``imm.begin``."""
    for k in range(len(rows)):
        imm.begin(models, f.head, rows[k], z[k], R[k], t_s[k], sigma_v_mps)
        imm.copy_row(f.head, rows[k], f.lag, rows[k])
        f.ring_n[rows[k]] = 0
        _summarise(models, f, rows[k])


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
    w = imm.make_work(models, f.head.x.shape[2])
    taken = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        i = rows[k]
        if t_s[k] < f.lag.t_s[i]:
            taken[k] = False
            continue
        in_order = t_s[k] >= f.head.t_s[i]
        _insert(models, f, i, z[k], R[k], t_s[k], sensor, w)
        if in_order:
            imm.filter_plot(models, f.head, i, z[k], R[k], t_s[k], w)
        else:
            imm.copy_row(f.lag, i, f.head, i)
            _replay(models, f, i, f.head, i, np.inf, w)
        _summarise(models, f, i)
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
def predict(models: Models, f: Filters, rows: IntArray, t_s: FloatArray, out: State, mu: FloatArray) -> BoolArray:
    """Prediction of rows to their times, model by model, without changing them.

    A time before a row's last plot is answered by filtering its ring up to that time; before its lagged state there is
    no answer.

    Args:
        rows: (m,) rows. t_s: (m,) times.
        out: m rows, written. mu: (m, r) probability of every model over all branches, written.

    Returns:
        (m,) whether there is an answer.
    """
    w = imm.make_work(models, f.head.x.shape[2])
    known = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        i = rows[k]
        if t_s[k] >= f.head.t_s[i]:
            imm.copy_row(f.head, i, out, k)
        elif t_s[k] >= f.lag.t_s[i]:
            imm.copy_row(f.lag, i, out, k)
            _replay(models, f, i, out, k, t_s[k], w)
        else:
            known[k] = False
            continue
        imm.interact(models, out, k, t_s[k], w)
        imm.probabilities(models, out, k, mu[k])
    return known


@kernel
def estimates(models: Models, x: FloatArray, P: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One estimate of each of m mixtures over position and velocity: means (m, 4) and covariances (m, 4, 4).

    Moment-matched; the printed TV-IMM takes the product of its models instead.
    """
    m = len(mu)
    mean, covariance = np.empty((m, 4)), np.empty((m, 4, 4))
    for k in range(m):
        if models.printed:
            printed.product_of_gaussians(x[k], P[k], mean[k], covariance[k])
        else:
            imm.moment_match(x[k], P[k], mu[k], mean[k], covariance[k])
    return mean, covariance


@kernel
def near(
    models: Models, f: Filters, rows: IntArray, z: FloatArray, R: FloatArray, t_s: FloatArray, limit: float
) -> IntArray:
    """The rows that may have a plot in their gate: a generous circle around each touches the plots' bounding box."""
    q_max = models.numbers[:, 0].max()
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
        dt = (early + late) / 2.0 - f.head.t_s[i]
        span = abs(dt) + (late - early) / 2.0
        speed = np.hypot(f.mean[i, 2], f.mean[i, 3])
        drift = 0.5 * span * span * strongest_acceleration(models, speed)
        variance = f.spread[i, 0] + 2.0 * span * f.spread[i, 1] + span * span * f.spread[i, 2] + q_max * span**3
        variance += drift * drift
        reach = np.sqrt(limit * (variance + r_max)) + speed * (late - early) / 2.0
        if dt < 0.0:
            reach += speed * -dt
        e, north = f.mean[i, 0] + dt * f.mean[i, 2], f.mean[i, 1] + dt * f.mean[i, 3]
        if east0 - reach <= e <= east1 + reach and north0 - reach <= north <= north1 + reach:
            chosen[n] = i
            n += 1
    return chosen[:n]


@kernel
def strongest_acceleration(models: Models, speed_mps: float) -> float:
    """A bound over all models of the acceleration that their own parameters can mean."""
    most = 0.0
    for j in range(len(models.kind)):
        most = max(most, own_acceleration(models.kind[j], models.numbers[j], speed_mps))
    return most


@kernel
def nearest_times(f: Filters, rows: IntArray, z: FloatArray, t_s: FloatArray) -> FloatArray:
    """The time of the plot nearest to each row, with the row moved to the plot's time: when the sensor looked at it."""
    out = np.empty(len(rows))
    for k in range(len(rows)):
        i = rows[k]
        best = np.inf
        for j in range(len(z)):
            dt = t_s[j] - f.head.t_s[i]
            de = z[j, 0] - f.mean[i, 0] - dt * f.mean[i, 2]
            dn = z[j, 1] - f.mean[i, 1] - dt * f.mean[i, 3]
            if de * de + dn * dn < best:
                best, out[k] = de * de + dn * dn, t_s[j]
    return out


@kernel
def _insert(models: Models, f: Filters, i: int, z: FloatArray, R: FloatArray, t_s: float, sensor: int, w: Work) -> None:
    """Put a plot into the ring in time order; when full, the oldest plot moves into the lagged state."""
    size = f.ring_t_s.shape[1]
    if f.ring_n[i] == size:
        if t_s < f.ring_t_s[i, 0]:
            imm.filter_plot(models, f.lag, i, z, R, t_s, w)
            return
        imm.filter_plot(models, f.lag, i, f.ring_z[i, 0], f.ring_R[i, 0], f.ring_t_s[i, 0], w)
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
def _replay(models: Models, f: Filters, i: int, state: State, k: int, until_s: float, w: Work) -> None:
    """Filter the plots of row i's ring up to a time into row ``k`` of ``state``, which is the lagged state so far."""
    for h in range(f.ring_n[i]):
        if f.ring_t_s[i, h] > until_s:
            break
        imm.filter_plot(models, state, k, f.ring_z[i, h], f.ring_R[i, h], f.ring_t_s[i, h], w)


@kernel
def _move_ring(f: Filters, i: int, source: int, target: int) -> None:
    f.ring_z[i, target] = f.ring_z[i, source]
    f.ring_R[i, target] = f.ring_R[i, source]
    f.ring_t_s[i, target] = f.ring_t_s[i, source]
    f.ring_sensor[i, target] = f.ring_sensor[i, source]


@kernel
def _summarise(models: Models, f: Filters, i: int) -> None:
    """Mean state and greatest variances of the head, for ``near``."""
    r = len(models.kind)
    mu = np.empty(r)
    imm.probabilities(models, f.head, i, mu)
    for a in range(4):
        f.mean[i, a] = 0.0
        for j in range(r):
            f.mean[i, a] += mu[j] * f.head.x[i, j, a]
    position = cross = velocity = 0.0
    for j in range(r):
        de, dn = f.head.x[i, j, 0] - f.mean[i, 0], f.head.x[i, j, 1] - f.mean[i, 1]
        dve, dvn = f.head.x[i, j, 2] - f.mean[i, 2], f.head.x[i, j, 3] - f.mean[i, 3]
        P = f.head.P[i, j]
        position = max(position, P[0, 0] + P[1, 1] + de * de + dn * dn)
        cross = max(cross, abs(P[0, 2]) + abs(P[1, 3]))
        velocity = max(velocity, P[2, 2] + P[3, 3] + dve * dve + dvn * dvn)
    f.spread[i, 0], f.spread[i, 1], f.spread[i, 2] = position, cross, velocity
