"""Heights of tracks: a scalar filter each, height and climb rate, beside the filter of the plane.

x = [height_m, climb_mps], constant climb with a white acceleration of density q:
F = [[1, dt], [0, 1]], Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]] (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2);
a height z of variance r is z = [1, 0] x + noise.

Late heights are filtered as if they had come in order. Each row keeps its last heights in a short ring and the filter
as it was before them (the base); a late one is put at its place and the ring filtered again. A full ring gives its
oldest height to the base; what is older than the base is refused.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.plots import Plots, empty_plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

RING = 16
"""Heights that a track keeps."""

NOBODY = -1

_T, _HEIGHT, _CLIMB, _HH, _HC, _CC = range(6)


class Heights(NamedTuple):
    """The height filters of n rows, with rings of k heights.

    A filter is (6,): its time, height, climb rate, and the variances [hh, hc, cc].

    Attributes:
        uid: (n,) whose height it is: the number of a track, or -1. A row means nothing to any other track.
        head, base: (n, 6) the filter at the last height, and before those of the ring.
        ring: (n, k, 3) times, heights and variances, in order of time; ring_n: (n,) how many.
    """

    uid: IntArray
    head: FloatArray
    base: FloatArray
    ring: FloatArray
    ring_n: IntArray


def make_heights(n: int, k: int = RING) -> Heights:
    """Height filters of n rows without heights."""
    empty = np.full(n, NOBODY, np.int64)
    return Heights(empty, np.zeros((n, 6)), np.zeros((n, 6)), np.zeros((n, k, 3)), np.zeros(n, np.int64))


def join_rows(first: Heights, second: Heights) -> Heights:
    """The rows of both."""
    return Heights(*(np.concatenate(both) for both in zip(first, second, strict=True)))


@kernel
def predict(f: FloatArray, t_s: float, q_m2ps3: float) -> None:
    """Move a filter (6,) on to ``t_s``, in place; not back."""
    dt = t_s - f[_T]
    if dt <= 0.0:
        return
    f[_T] = t_s
    f[_HEIGHT] += dt * f[_CLIMB]
    f[_HH] += dt * (2.0 * f[_HC] + dt * f[_CC]) + q_m2ps3 * dt * dt * dt / 3.0
    f[_HC] += dt * f[_CC] + q_m2ps3 * dt * dt / 2.0
    f[_CC] += q_m2ps3 * dt


@kernel
def update(f: FloatArray, height_m: float, variance_m2: float) -> None:
    """Kalman update of a filter (6,) with a height of its own time, in place."""
    s = f[_HH] + variance_m2
    nu, height_gain, climb_gain = height_m - f[_HEIGHT], f[_HH] / s, f[_HC] / s
    f[_HEIGHT] += height_gain * nu
    f[_CLIMB] += climb_gain * nu
    f[_CC] -= climb_gain * f[_HC]
    f[_HC] *= variance_m2 / s
    f[_HH] *= variance_m2 / s


@kernel
def feed(h: Heights, rows: IntArray, uid: IntArray, plots: Plots, q_m2ps3: float, sigma_climb_mps: float) -> BoolArray:
    """Feed the height of plot k to row ``rows[k]`` of track ``uid[k]``, in order or late.

    A row that was another track's begins anew. Rows below 0 and plots without a height are passed over.

    Returns:
        (m,) False where a height is older than the row's base.
    """
    taken = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        i, plot = rows[k], plots[k]
        if i < 0 or not np.isfinite(plot.height_variance_m2):
            continue
        if h.uid[i] != uid[k]:
            _begin(h, i, uid[k], plot.t_s, plot.height_m, plot.height_variance_m2, sigma_climb_mps)
        else:
            taken[k] = _feed_one(h, i, plot.t_s, plot.height_m, plot.height_variance_m2, q_m2ps3)
    return taken


@kernel
def _begin(h: Heights, i: int, uid: int, t_s: float, height_m: float, variance_m2: float, sigma_climb: float) -> None:
    h.uid[i], h.ring_n[i] = uid, 0
    f = h.base[i]
    f[_T], f[_HEIGHT], f[_CLIMB] = t_s, height_m, 0.0
    f[_HH], f[_HC], f[_CC] = variance_m2, 0.0, sigma_climb * sigma_climb
    h.head[i] = f


@kernel
def _feed_one(h: Heights, i: int, t_s: float, height_m: float, variance_m2: float, q: float) -> bool:
    if t_s < h.base[i, _T]:
        return False
    place = int(h.ring_n[i])
    while place > 0 and h.ring[i, place - 1, 0] > t_s:
        h.ring[i, place] = h.ring[i, place - 1]
        place -= 1
    h.ring[i, place, 0], h.ring[i, place, 1], h.ring[i, place, 2] = t_s, height_m, variance_m2
    h.ring_n[i] += 1
    if t_s >= h.head[i, _T]:
        _take(h.head[i], h.ring[i, place], q)
    else:
        h.head[i] = h.base[i]
        for k in range(h.ring_n[i]):
            _take(h.head[i], h.ring[i, k], q)
    if h.ring_n[i] == h.ring.shape[1]:
        _shorten(h, i, q)
    return True


@kernel
def _take(f: FloatArray, told: FloatArray, q: float) -> None:
    predict(f, told[0], q)
    update(f, told[1], told[2])


@kernel
def _shorten(h: Heights, i: int, q: float) -> None:
    _take(h.base[i], h.ring[i, 0], q)
    h.ring_n[i] -= 1
    for k in range(h.ring_n[i]):
        h.ring[i, k] = h.ring[i, k + 1]


@kernel
def estimate(
    h: Heights, rows: IntArray, uid: IntArray, t_s: FloatArray, q_m2ps3: float
) -> tuple[FloatArray, FloatArray]:
    """Heights (m,) and their variances (m,) at times (m,), nothing changed; the variance is infinite where unknown.

    A time before the row's last height is answered by filtering its ring up to then; before its base nothing is known.
    """
    height, variance = np.zeros(len(rows)), np.full(len(rows), np.inf)
    f = np.empty(6)
    for k in range(len(rows)):
        i = rows[k]
        if h.uid[i] != uid[k] or t_s[k] < h.base[i, _T]:
            continue
        if t_s[k] >= h.head[i, _T]:
            f[:] = h.head[i]
        else:
            f[:] = h.base[i]
            for j in range(h.ring_n[i]):
                if h.ring[i, j, 0] > t_s[k]:
                    break
                _take(f, h.ring[i, j], q_m2ps3)
        predict(f, t_s[k], q_m2ps3)
        height[k], variance[k] = f[_HEIGHT], f[_HH]
    return height, variance


class HeightTracks:
    """The heights of a layer's tracks; rows are made as they are needed.

    Args:
        q_m2ps3: acceleration noise density of climb and descent.
        sigma_climb_mps: climb rate of a new track, one sigma.
    """

    def __init__(self, q_m2ps3: float, sigma_climb_mps: float) -> None:
        self._q_m2ps3 = q_m2ps3
        self._sigma_climb_mps = sigma_climb_mps
        self.rows = make_heights(0)

    @property
    def any(self) -> bool:
        """Whether a height was ever told."""
        return len(self.rows.uid) > 0

    def feed(self, rows: IntArray, uid: IntArray, plots: Plots) -> None:
        """Feed the height of plot k, where it has one, to row ``rows[k]``, which is that of track ``uid[k]``."""
        if not len(rows) or not np.isfinite(plots["height_variance_m2"]).any():
            return
        self._grow(int(rows.max()) + 1)
        feed(self.rows, rows, uid, plots, self._q_m2ps3, self._sigma_climb_mps)

    def feed_from(self, source: int, target: int, source_uid: int, target_uid: int) -> None:
        """One track takes the heights that another remembers, or all that is known of it if it has none itself."""
        if source >= len(self.rows.uid) or self.rows.uid[source] != source_uid:
            return
        self._grow(target + 1)
        h = self.rows
        if h.uid[target] == target_uid:
            n = int(h.ring_n[source])
            plots = empty_plots((n,))
            plots["t_s"], plots["height_m"], plots["height_variance_m2"] = h.ring[source, :n].T
            self.feed(np.full(n, target), np.full(n, target_uid), plots)
            return
        for values in h:
            values[target] = values[source]
        h.uid[target] = target_uid

    def estimate(self, rows: IntArray, uid: IntArray, t_s: float) -> tuple[FloatArray, FloatArray]:
        """Heights (m,) and variances (m,) of tracks at a time; the variance is infinite where none is known."""
        if not len(rows) or not self.any:
            return np.zeros(len(rows)), np.full(len(rows), np.inf)
        self._grow(int(rows.max()) + 1)
        return estimate(self.rows, rows, uid, np.full(len(rows), t_s), self._q_m2ps3)

    def arrays(self, rows: IntArray) -> dict[str, npt.NDArray[Any]]:
        """All that rows hold, by name, with room for these rows: to be read and, in rows, to be written."""
        if len(rows):
            self._grow(int(rows.max()) + 1)
        return self.rows._asdict()

    def _grow(self, n: int) -> None:
        have = len(self.rows.uid)
        if n > have:
            self.rows = join_rows(self.rows, make_heights(max(n, 2 * have) - have, self.rows.ring.shape[1]))
