"""The units whose tracks we take: what they tell, which of it belongs to which of our tracks, under which number.

Foreign tracks never enter our filters. The sequential test runs between what stands in our picture (system tracks by
their own estimates, then the tracks of earlier inputs that have no partner) and the tracks of each input. What it
declares one is shown as one; a track that found nobody for some cycles is shown as ours, with a number of ours.

A target keeps one id through all this: where two ids meet, the older one lives on and the other is told to have ended;
where a system track ends, a foreign track that was one with it goes on under its id; and so does a foreign track that
was silent for a while.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, TrackFrame
from trackmesh.services.fusion.absent import Absent
from trackmesh.services.fusion.association import DeclaredPairs, LocalTracks
from trackmesh.services.fusion.cycle import Reference
from trackmesh.services.fusion.foreign import NOBODY, ForeignTracks, Rows
from trackmesh.services.fusion.foreign_frames import Told, moved, read
from trackmesh.services.fusion.layer import Layer
from trackmesh.services.fusion.pair_tests import PairTest
from trackmesh.services.streams import Streams

IntArray = npt.NDArray[np.int64]

_HITS_FOR_TEST = 3
_CYCLES_ALONE = 3
_NUMBERS = 2**30
"""Numbers of system tracks in the test are below, those of foreign tracks above."""


class InputRules(NamedTuple):
    """What to expect of other units.

    Attributes:
        coast_s: how old the last plot of a track may be.
        wait_s: how long after its last plot the id of a silent one is kept for it.
        q_m2ps3: acceleration noise under which their tracks are predicted.
        error_m: error of their positions that their covariances do not know, one sigma per axis.
        new_test: makes a test of pairs.
    """

    coast_s: float
    wait_s: float
    q_m2ps3: float
    error_m: float
    new_test: Callable[[], PairTest]


class Board(Protocol):
    """The picture, as far as it is needed here."""

    def numbers(self, n: int) -> IntArray:
        """Public ids (n,) never used before."""

    def last_words(self, rows: IntArray) -> TrackFrame:
        """What is to be told of system tracks that end, under the ids that they have now."""

    def foreign_last_words(self, unit_id: str, rows: Rows) -> TrackFrame:
        """What is to be told of tracks of a unit that stood in the picture and end."""

    def tell(self, words: list[TrackFrame]) -> None:
        """Put last words into the next frame."""


class _Entries(NamedTuple):
    """What stands in the picture: tracks, and for each the index of its bank, or -1 for a system track."""

    tracks: LocalTracks
    bank: IntArray


def system_numbers(uid: IntArray) -> IntArray:
    """Numbers in the test of system tracks."""
    return uid & (_NUMBERS - 1)


class Inputs:
    """All inputs of a unit.

    Attributes:
        banks: the tracks of each unit, in the order in which the settings name them.
        streams: their sequences of frames.
        rules: what to expect of them.
    """

    def __init__(
        self,
        units: Sequence[str],
        our_unit: str,
        rules: InputRules,
        system: Layer,
        board: Board,
        counters: Counter[str],
    ) -> None:
        self.rules = rules
        self.banks = {unit: ForeignTracks(rules.coast_s, rules.error_m) for unit in units}
        self.streams = Streams()
        self._our_unit = our_unit
        self._system = system
        self._board = board
        self._counters = counters
        self._tests = [rules.new_test() for _ in units]
        self._absent = Absent(rules.wait_s)
        self._next = 0
        self._rings: set[str] = set()

    @property
    def shown(self) -> bool:
        """Whether a foreign track stands in the picture by itself."""
        return any((bank.rows.link >= 0).any() for bank in self.banks.values())

    def figures(self) -> dict[str, int]:
        """Tracks of each input, and how many of them have a partner in our picture."""
        out = {}
        for unit, bank in self.banks.items():
            out[f"input_tracks.{unit}"] = len(bank.rows.ident)
            out[f"input_pairs.{unit}"] = int((bank.rows.partner >= 0).sum())
        return out

    # --- what they tell ---

    def read(self, frame: TrackFrame) -> Told:
        """What a frame tells, in the plane of its sender.

        Raises:
            RefusedMessage: it is not of an input, out of sequence, or wrong (see ``foreign_frames.read``).
        """
        unit = frame.unit_id
        if unit == self._our_unit:
            raise RefusedMessage("own_tracks", f"These are the tracks of {unit} itself.")
        if unit not in self.banks:
            raise RefusedMessage("unknown_input", f"The unit {unit} is no input of this one.")
        told = read(frame, self._our_unit)
        last = self.streams.known.get(unit)
        if last and last.boot_id == frame.boot_id and last.last_t_ns is not None and frame.t_ns < last.last_t_ns:
            raise RefusedMessage("old_frame", f"A frame of {unit} is older than the one before it.")
        self.streams.check(unit, frame.boot_id, frame.seq, np.full(len(frame.track_id), frame.t_ns), None)
        self.streams.known[unit].last_t_ns = frame.t_ns
        if self._our_unit.unit_id in frame.sensors and (frame.track_id >> TRACK_BITS >= self._our_unit.number).any():
            self._rings.add(unit)
        return told

    def tell(self, frame: TrackFrame, told: Told, origin: Geodetic | None, t_s: float, now_ns: int) -> None:
        """Take what a frame tells; ``t_s`` is its time, ``now_ns`` ours."""
        unit, bank = frame.unit_id, self.banks[frame.unit_id]
        numbers = _NUMBERS | ((self._next + np.arange(len(told.ident))) & (_NUMBERS - 1))
        self._next += len(told.ident)
        self._counters["input_frames"] += 1
        self.expire(now_ns)
        ended = bank.tell(moved(told, frame, origin), t_s, now_ns, numbers)
        for i in self._without_heir(ended):
            self._board.tell([self._board.foreign_last_words(unit, ended.take(np.array([i])))])
        self._board.tell(self._absent.end(unit, told.ended.tolist()))
        self._welcome_back(unit, bank.rows)

    def expire(self, now_ns: int) -> None:
        """Let go tracks whose last plot is too old."""
        for unit, bank in self.banks.items():
            silent = bank.expire(now_ns)
            for i in self._without_heir(silent):
                one = silent.take(np.array([i]))
                self._absent.lose(unit, one, self._board.foreign_last_words(unit, one))
        self._board.tell(self._absent.gone(now_ns))

    # --- who is whom ---

    def cycle(self, now_s: float, regular: bool = True) -> None:
        """Run the tests; out of turn (not ``regular``) it does not count how long tracks are alone."""
        entries = self._system_entries(now_s)
        for k, (bank, test) in enumerate(zip(self.banks.values(), self._tests, strict=True)):
            given = _as_tracks(bank.rows, *bank.rows.at(now_s, self.rules.q_m2ps3))
            pairs = test.cycle(entries.tracks, given, now_s)
            self._note_partners(entries, bank.rows, pairs, regular)
            entries = _with_unpaired(entries, given, bank.rows, k)

    def heirs_of(self, ended: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
        """Let foreign tracks take over the ids of ended system tracks (row, uid, id); returns those nobody took."""
        left = []
        for row, uid, link in ended:
            if self._hand_over(int(system_numbers(np.int64(uid))), link):
                self._counters["handed_over"] += 1
            else:
                left.append((row, uid, link))
        return left

    def references(self, now_s: float) -> list[Reference]:
        """The tracks of each unit, but of two that take each other's only those of the one with the lower number.

        Else both would follow each other.
        """
        found = []
        for unit, bank in self.banks.items():
            rows = bank.rows.take(~bank.rows.coasting)
            if unit not in self._rings and len(rows.ident):
                found.append(Reference(unit, _as_tracks(rows, *rows.at(now_s, self.rules.q_m2ps3))))
        return found

    def _system_entries(self, now_s: float) -> _Entries:
        life = self._system.life
        rows = self._system.rows
        rows = rows[life.confirmed[rows] & (life.hits[rows] >= _HITS_FOR_TEST)]
        x, P, _ = self._system.predict(rows, np.maximum(self._system.filters.t_s[rows], now_s))
        tracks = LocalTracks(system_numbers(life.uid[rows]), rows, x, P, *_no_bias(len(rows)))
        return _Entries(tracks, np.full(len(rows), -1, np.int64))

    def _note_partners(self, entries: _Entries, rows: Rows, pairs: DeclaredPairs, regular: bool) -> None:
        entry = np.full(len(rows.ident), NOBODY, np.int64)
        entry[pairs.b] = pairs.a
        alone = entry < 0
        rows.partner[:] = NOBODY
        rows.partner[pairs.b] = entries.tracks.number[pairs.a]
        rows.alone[:] = np.where(alone, rows.alone + regular, 0)
        for i in np.flatnonzero(~alone & (rows.link >= 0)).tolist():
            self._unite(entries, int(entry[i]), rows, i)
        new = alone & (rows.link < 0) & (rows.alone >= _CYCLES_ALONE) & ~rows.coasting & ~rows.echo
        if new.any():
            rows.link[new] = self._board.numbers(int(new.sum()))
            self._counters["shown_of_inputs"] += int(new.sum())

    def _unite(self, entries: _Entries, entry: int, rows: Rows, i: int) -> None:
        """Two ids meet: the older one lives on."""
        place, bank = int(entries.tracks.row[entry]), int(entries.bank[entry])
        held = self._system.life.link if bank < 0 else list(self.banks.values())[bank].rows.link
        one, other = int(held[place]), int(rows.link[i])
        if 0 <= one < other:
            self._board.tell([self._board.foreign_last_words(self._unit_of(rows), rows.take(np.array([i])))])
        else:
            if one >= 0:
                self._board.tell([self._words(bank, place)])
            held[place] = other
        rows.link[i] = NOBODY
        self._counters["ids_united"] += 1

    def _words(self, bank: int, place: int) -> TrackFrame:
        if bank < 0:
            return self._board.last_words(np.array([place]))
        unit = list(self.banks)[bank]
        return self._board.foreign_last_words(unit, self.banks[unit].rows.take(np.array([place])))

    def _unit_of(self, rows: Rows) -> str:
        return next(unit for unit, bank in self.banks.items() if bank.rows is rows)

    def _welcome_back(self, unit: str, rows: Rows) -> None:
        for i in np.flatnonzero((rows.link < 0) & (rows.partner < 0)).tolist():
            link = self._absent.back(unit, int(rows.ident[i]))
            if link is not None:
                rows.link[i], rows.alone[i] = link, _CYCLES_ALONE

    def _without_heir(self, gone: Rows) -> list[int]:
        """Which of the tracks that left the picture nobody follows under their ids."""
        shown = np.flatnonzero(gone.link >= 0).tolist()
        return [i for i in shown if not self._hand_over(int(gone.number[i]), int(gone.link[i]))]

    def _hand_over(self, number: int, link: int) -> bool:
        """Give the id of what had this number to the first of its partners, and that one the others."""
        heir = NOBODY
        for bank in self.banks.values():
            rows = bank.rows
            for i in np.flatnonzero(rows.partner == number).tolist():
                if heir < 0 and not rows.echo[i]:
                    rows.link[i], rows.partner[i] = link, NOBODY
                    heir = int(rows.number[i])
                else:
                    rows.partner[i] = heir
        return heir >= 0


def _as_tracks(rows: Rows, x: npt.NDArray[np.float64], P: npt.NDArray[np.float64]) -> LocalTracks:
    return LocalTracks(rows.number, np.arange(len(rows.number)), x, P, *_no_bias(len(rows.number)))


def _no_bias(n: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    return np.zeros((n, 2)), np.zeros((n, 2, 2))


def _with_unpaired(entries: _Entries, given: LocalTracks, rows: Rows, bank: int) -> _Entries:
    """The entries, and behind them the tracks of this bank that belong to none of them."""
    alone = rows.partner < 0
    if not alone.any():
        return entries
    more = LocalTracks(*(values[alone] for values in given))
    tracks = LocalTracks(*(np.concatenate(pair) for pair in zip(entries.tracks, more, strict=True)))
    return _Entries(tracks, np.concatenate([entries.bank, np.full(int(alone.sum()), bank, np.int64)]))
