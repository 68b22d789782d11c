"""The tracks of another unit as we know them: they are nobody's filter here, only moved to the time at which asked.

A track counts while its own last plot is younger than ``coast_s``, however often it is told: what units tell each
other cannot keep a target alive that no sensor sees. It leaves when its sender ends it, or when that time is over.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.extrapolation import extrapolate
from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.fusion.foreign_frames import Told

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

NOBODY = -1


class Rows(NamedTuple):
    """n foreign tracks.

    Attributes:
        ident, x, P, updated_ns, first_ns, coasting, fit, height_m, height_m2, echo: as told last, see ``Told``; P with
            the unit's own error.
        t_s: (n,) of the state.
        number: (n,) ours for the test of pairs, never used twice.
        partner: (n,) number of what in our picture it belongs to, or nobody.
        link: (n,) public id where it stands in our picture without a system track, or nobody.
        alone: (n,) association cycles without a partner.
    """

    ident: IntArray
    x: FloatArray
    P: FloatArray
    updated_ns: IntArray
    first_ns: IntArray
    coasting: BoolArray
    fit: FloatArray
    height_m: FloatArray
    height_m2: FloatArray
    echo: BoolArray
    t_s: FloatArray
    number: IntArray
    partner: IntArray
    link: IntArray
    alone: IntArray

    def take(self, which: BoolArray | IntArray) -> Rows:
        """Some of them."""
        return Rows._make(values[which] for values in self)

    def at(self, t_s: float, q_m2ps3: float) -> tuple[FloatArray, FloatArray]:
        """States (n, 4) and covariances (n, 4, 4) at a time, under an acceleration noise of this density."""
        return extrapolate(self.x, self.P, self.t_s, t_s, q_m2ps3)


class ForeignTracks:
    """Those of one unit.

    Args:
        coast_s: how old the last plot of a track may be.
        error_m: error of positions that the sender's covariances do not know, one sigma per axis.
        new_numbers: gives so many numbers never used before.

    Attributes:
        rows: the tracks. What the composition notes in them (``partner``, ``link``, ``alone``) is written in place.
    """

    def __init__(self, coast_s: float, error_m: float, new_numbers: Callable[[int], IntArray]) -> None:
        self._coast_ns = round(coast_s * 1e9)
        self._error_m2 = error_m**2
        self._new_numbers = new_numbers
        self.rows = _new(_NOTHING, 0.0)

    def tell(self, told: Told, t_s: float, now_ns: int) -> Rows:
        """Take what a frame of time ``t_s`` tells; returns those that end by it, as they were."""
        fresh = now_ns - told.updated_ns <= self._coast_ns
        live = told._replace(**{name: getattr(told, name)[fresh] for name in _PER_TRACK})
        ended = self._remove(np.isin(self.rows.ident, told.ended) & ~np.isin(self.rows.ident, live.ident))
        news = _new(live, t_s)
        news.P[:, range(2), range(2)] += self._error_m2
        where = index_of(news.ident, self.rows.ident)
        known = where >= 0
        for name in (*_PER_TRACK, "t_s"):
            getattr(self.rows, name)[known] = getattr(news, name)[where[known]]
        added = np.ones(len(news.ident), np.bool_)
        added[where[known]] = False
        news.number[added] = self._new_numbers(int(added.sum()))
        self.rows = Rows(*(np.concatenate(pair) for pair in zip(self.rows, news.take(added), strict=True)))
        return ended

    def restore(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Go on with the ``rows`` of an earlier run, by their names.

        Raises:
            KeyError, ValueError: they are no such rows.
        """
        rows = Rows(**{name: arrays[name] for name in Rows._fields})
        for name, empty in self.rows._asdict().items():
            if getattr(rows, name).shape != (len(rows.ident), *empty.shape[1:]):
                raise ValueError("no rows of foreign tracks")
        self.rows = rows

    def expire(self, now_ns: int) -> Rows:
        """Let go those whose last plot is too old; returns them as they were."""
        return self._remove(now_ns - self.rows.updated_ns > self._coast_ns)

    def _remove(self, gone: BoolArray) -> Rows:
        out = self.rows.take(gone)
        if gone.any():
            self.rows = self.rows.take(~gone)
        return out


_PER_TRACK = ("ident", "x", "P", "updated_ns", "first_ns", "coasting", "fit", "height_m", "height_m2", "echo")

_NO_INT, _NO_BOOL = np.empty(0, np.int64), np.empty(0, np.bool_)
_NOTHING = Told(
    _NO_INT, np.empty((0, 4)), np.empty((0, 4, 4)), _NO_INT, _NO_INT, _NO_BOOL, np.empty(0), np.empty(0), np.empty(0),
    _NO_BOOL, _NO_INT,
)  # fmt: skip


def _new(told: Told, t_s: float) -> Rows:
    n = len(told.ident)
    known = [getattr(told, name).copy() for name in _PER_TRACK]
    ours = [np.full(n, t_s), *(np.full(n, NOBODY, np.int64) for _ in range(3)), np.zeros(n, np.int64)]
    return Rows._make(known + ours)
