"""Who owns which track: an id travels with its target, and ownership is pulled by the unit into whose area it flies.

For each confirmed track a unit knows whether it owns it, in which epoch, and else who does (``source``) and when that
was last heard. The owner goes on publishing until it hears that another has taken over: a lost message makes one track
appear twice, which clients remove by its id, and never a gap.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import BandFrame
from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.fusion.partition.pairing import NEEDED, NO_KEY, pair

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

NOBODY, UNKNOWN = -1, -2
"""Sources: nobody claims the track; somebody does, but who will be told by a later message."""

_MOST_EPOCH = 2**32 - 1
GRACE, SILENT, APART = 2, 4, 2
"""Cycles that a track born near a border waits for another's id; without word of its owner; with other plots than it.
"""


class Claims(NamedTuple):
    """What is known of n tracks.

    Attributes:
        ident: public ids.
        owner: whether they are ours.
        epoch: of their ownership, which grows with every handover.
        source: number of the unit that owns them in ``Neighbours``, or nobody, or unknown.
        heard: cycle in which the source was last heard of them.
        born: cycle in which they became known.
        apart: messages in a row in which their owner told of other plots than ours.
    """

    ident: IntArray
    owner: BoolArray
    epoch: IntArray
    source: IntArray
    heard: IntArray
    born: IntArray
    apart: IntArray

    def take(self, which: IntArray | BoolArray) -> Claims:
        """Some of them."""
        return Claims._make(values[which] for values in self)

    def join(self, other: Claims) -> Claims:
        """These, and others behind them."""
        return Claims._make(np.concatenate(pair) for pair in zip(self, other, strict=True))


class Held(NamedTuple):
    """Our n confirmed tracks: ids, the keys (n, k) of their last plots, the youngest last, first and last plots."""

    ident: IntArray
    keys: IntArray
    first_t_ns: IntArray
    updated_t_ns: IntArray


class Depths(NamedTuple):
    """Distances that decide: how far (n,) our tracks are inside our area, width of the band, depth of a handover."""

    depth_m: FloatArray
    width_m: float
    handover_m: float


class Ownership:
    """The claims of a unit.

    Args:
        number: of our unit: of two owners with equal epochs the lower one stays.
        fresh: gives so many ids never used before.
        same_time_ns: plots of two tracks that are to be compared must be no further apart.

    Attributes:
        claims: of all tracks, confirmed or lost and not yet given up.
        cycle: counts.
    """

    def __init__(self, number: int, fresh: Callable[[int], IntArray], same_time_ns: int) -> None:
        self._number = number
        self._fresh = fresh
        self._same_time_ns = same_time_ns
        self.claims = _new(np.empty(0, np.int64), 0)
        self.cycle = 0

    def owned(self, ident: IntArray) -> BoolArray:
        """Whether tracks (n,) are ours."""
        where = index_of(self.claims.ident, ident)
        out = np.zeros(len(ident), np.bool_)
        out[where >= 0] = self.claims.owner[where[where >= 0]]
        return out

    def epochs(self, ident: IntArray) -> npt.NDArray[np.uint32]:
        """Epochs (n,) of tracks, 0 of unknown ones."""
        where = index_of(self.claims.ident, ident)
        known = self.claims.epoch[where] if len(self.claims.ident) else 0
        return np.where(where >= 0, np.minimum(known, _MOST_EPOCH), 0).astype(np.uint32)

    def known(self, ident: IntArray) -> None:
        """These are all the tracks there are; of new ones nobody knows the owner."""
        self.claims = self.claims.take(np.isin(self.claims.ident, ident))
        new = ident[index_of(self.claims.ident, ident) < 0]
        if len(new):
            self.claims = self.claims.join(_new(np.unique(new), self.cycle))

    def restore(self, ident: IntArray, epoch: IntArray) -> None:
        """Know these tracks and how far their epochs had come; whose they are by now has to be heard first."""
        self.claims = _new(ident, self.cycle)
        self.claims.epoch[:] = epoch

    def inherit(self, ident: IntArray, epoch: IntArray) -> None:
        """Own tracks of a unit that is gone, in epochs after theirs."""
        self.claims = self.claims.take(~np.isin(self.claims.ident, ident))
        new = _new(ident, self.cycle)
        new.owner[:], new.epoch[:] = True, epoch + 1
        self.claims = self.claims.join(new)

    def born(self, ident: IntArray, at: Depths) -> None:
        """Own new tracks so deep inside our area that no other unit can know of them."""
        where = index_of(self.claims.ident, ident)
        c = self.claims
        ours = (c.source[where] == NOBODY) & ~c.owner[where] & (at.depth_m > at.width_m)
        self._own(where[ours])

    def pull(self, ident: IntArray, at: Depths, alive: IntArray) -> int:
        """Once a cycle: take over what is ours by its place; ``alive`` are the units that own areas. How many."""
        where, c = index_of(self.claims.ident, ident), self.claims
        depth, inside = at.depth_m, at.depth_m >= 0.0
        age, silence, source = self.cycle - c.born[where], self.cycle - c.heard[where], c.source[where]
        free, named = source == NOBODY, source >= 0
        there = named & np.isin(source, alive)
        takes = free & inside & ((depth > at.width_m) | (age >= GRACE))
        takes |= free & (age >= SILENT + GRACE) & (depth > -at.handover_m)
        takes |= there & (silence > SILENT) & inside
        takes |= named & ~there & inside
        takes |= there & (silence <= 1) & (depth > at.handover_m)
        takes &= ~c.owner[where]
        self._own(where[takes])
        forgotten = ~takes & ~c.owner[where] & ~free & (silence > SILENT)
        c.source[where[forgotten]], c.born[where[forgotten]] = NOBODY, self.cycle
        return int(takes.sum())

    def hear(self, held: Held, told: BandFrame, unit: int, number: int, now_ns: int) -> IntArray:
        """Take what another unit tells of its tracks near the border; the ids (n,) that ours have from now on.

        Args:
            held: our tracks, all of them ``known``.
            told: the message.
            unit, number: of its sender: in ``Neighbours``, and in the realm.
            now_ns: our time; of a late message nothing is concluded from plots that are not common.
        """
        mine = self.claims.take(index_of(self.claims.ident, held.ident))
        others = self.claims.take(~np.isin(self.claims.ident, held.ident))
        i, j = pair(held.keys, told.plot_keys)
        self._hear_same(mine, told, i, j, unit, number)
        adopts = self._adopts(mine, held, told, i, j)
        ident = mine.ident.copy()
        i, j = i[adopts], j[adopts]
        ident[i] = told.track_id[j]
        mine.owner[i], mine.epoch[i], mine.source[i], mine.heard[i] = False, told.epoch[j], unit, self.cycle
        second = np.isin(ident, ident[i])
        second[i] = False
        self._rename(mine, ident, second)
        rows = self._unpaired(mine, ident, held, told)
        self._hear_apart(mine, ident, held, told, rows, unit, number, now_ns)
        mine.ident[:] = ident
        self.claims = mine.join(others.take(~np.isin(others.ident, ident)))
        return ident

    def _hear_same(self, mine: Claims, told: BandFrame, i: IntArray, j: IntArray, unit: int, number: int) -> None:
        """Tracks with one id in both units."""
        same = mine.ident[i] == told.track_id[j]
        i, j = i[same], j[same]
        theirs, ours, epoch = told.owner[j] == 1, mine.owner[i], told.epoch[j].astype(np.int64)
        yields = theirs & ours & ((epoch > mine.epoch[i]) | ((epoch == mine.epoch[i]) & (number < self._number)))
        follows = (theirs & ~ours) | yields
        f = i[follows]
        mine.owner[f], mine.source[f], mine.heard[f] = False, unit, self.cycle
        mine.epoch[f] = np.maximum(mine.epoch[f], epoch[follows])
        lost = i[~theirs & ~ours & (mine.source[i] == unit)]
        mine.source[lost], mine.heard[lost] = UNKNOWN, self.cycle

    def _adopts(self, mine: Claims, held: Held, told: BandFrame, i: IntArray, j: IntArray) -> BoolArray:
        """Which pairs of tracks with two ids are to have theirs from now on."""
        theirs, ours = told.owner[j] == 1, mine.owner[i]
        other = mine.ident[i] != told.track_id[j]
        first, their_first = held.first_t_ns[i], told.first_t_ns[j]
        older = (their_first < first) | ((their_first == first) & (told.track_id[j] < mine.ident[i]))
        return np.asarray(other & theirs & (~ours | older))

    def _unpaired(self, mine: Claims, ident: IntArray, held: Held, told: BandFrame) -> IntArray:
        """Rows whose ids its sender owns, without enough plots in common."""
        i, j = pair(held.keys, told.plot_keys)
        paired = i[ident[i] == told.track_id[j]]
        mine.apart[paired] = 0
        here = index_of(told.track_id, ident)
        named = np.flatnonzero(here >= 0)
        named = named[told.owner[here[named]] == 1]
        return np.asarray(named[~np.isin(named, paired)])

    def _hear_apart(
        self, mine: Claims, ident: IntArray, held: Held, told: BandFrame, rows: IntArray, unit: int, number: int,
        now_ns: int,
    ) -> None:  # fmt: skip
        """Rows with the id of a track that its sender owns, but not of the same plots: they may be of another target.

        Where both are of now and have plots enough, they are.
        """
        from_it = rows[mine.source[rows] == unit]
        mine.heard[from_it] = self.cycle
        if now_ns - told.t_ns > self._same_time_ns or not len(rows):
            return
        j = index_of(told.track_id, ident[rows])
        self._hear_stale(mine, held, told, rows, j, unit)
        apart = np.abs(held.updated_t_ns[rows] - told.updated_t_ns[j]) <= self._same_time_ns
        apart &= (held.keys[rows] != NO_KEY).sum(axis=1) >= NEEDED
        apart &= (told.plot_keys[j] != NO_KEY).sum(axis=1) >= NEEDED
        mine.apart[rows[apart]] += 1
        epoch = told.epoch[j].astype(np.int64)
        lower = (mine.epoch[rows] < epoch) | ((mine.epoch[rows] == epoch) & (number < self._number))
        apart &= (mine.apart[rows] >= APART) & (lower | ~mine.owner[rows])
        anew = np.zeros(len(ident), np.bool_)
        anew[rows[apart]] = True
        self._rename(mine, ident, anew)

    def _hear_stale(
        self, mine: Claims, held: Held, told: BandFrame, rows: IntArray, j: IntArray, unit: int
    ) -> None:  # fmt: skip
        """Of two owners of one id whose tracks have no plots in common the one that still has plots goes on.

        So it is where a unit was taken for dead for a moment: its neighbour went on with what it cannot see.
        """
        both = mine.owner[rows]
        rows, j = rows[both], j[both]
        younger_ns = held.updated_t_ns[rows] - told.updated_t_ns[j]
        epoch = told.epoch[j].astype(np.int64)
        ours = rows[younger_ns > self._same_time_ns]
        mine.epoch[ours] = np.maximum(mine.epoch[ours], epoch[younger_ns > self._same_time_ns] + 1)
        theirs = (younger_ns < -self._same_time_ns) & (epoch > mine.epoch[rows])
        yields = rows[theirs]
        mine.owner[yields], mine.source[yields], mine.heard[yields] = False, unit, self.cycle
        mine.epoch[yields] = epoch[theirs]

    def _rename(self, mine: Claims, ident: IntArray, which: BoolArray) -> None:
        """Give tracks ids of their own: another one holds theirs."""
        n = int(which.sum())
        if not n:
            return
        ident[which] = self._fresh(n)
        mine.epoch[which] = np.where(mine.owner[which], 1, 0)
        mine.source[which], mine.born[which], mine.apart[which] = NOBODY, self.cycle, 0

    def _own(self, where: IntArray) -> None:
        c = self.claims
        c.owner[where], c.source[where] = True, NOBODY
        c.epoch[where] += 1


def _new(ident: IntArray, cycle: int) -> Claims:
    n = len(ident)
    return Claims(
        ident=ident.copy(),
        owner=np.zeros(n, np.bool_),
        epoch=np.zeros(n, np.int64),
        source=np.full(n, NOBODY, np.int64),
        heard=np.full(n, cycle, np.int64),
        born=np.full(n, cycle, np.int64),
        apart=np.zeros(n, np.int64),
    )
