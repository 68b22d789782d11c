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
from typing import Any, NamedTuple, Protocol

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
from trackmesh.services.fusion.timeline import Timeline
from trackmesh.services.streams import Stream, Streams

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
        reference: whether they are right but for that, so that sensors can be corrected by them.
        new_test: makes a test of pairs.
    """

    coast_s: float
    wait_s: float
    q_m2ps3: float
    error_m: float
    reference: bool
    new_test: Callable[[], PairTest]


class Board(Protocol):
    """The picture, as far as it is needed here."""

    @property
    def lowest_id(self) -> int:
        """No track of ours has a lower public id, and no unit of a lower number has a higher one."""

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
        time: Timeline,
        counters: Counter[str],
    ) -> None:
        self.rules = rules
        self.banks = {unit: ForeignTracks(rules.coast_s, rules.error_m, self._new_numbers) for unit in units}
        self.streams = Streams()
        self._our_unit = our_unit
        self._system = system
        self._board = board
        self._time = time
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

    def stream(self, unit: str) -> Stream:
        """The sequence of frames of a unit, empty if it was never heard."""
        return self.streams.known.get(unit, Stream())

    def kept(self) -> dict[str, npt.NDArray[Any]]:
        """What has to be known to go on after a restart; nothing where there are no inputs."""
        if not self.banks:
            return {}
        arrays = {f"{unit}/{name}": v for unit, bank in self.banks.items() for name, v in bank.rows._asdict().items()}
        absent = np.frombuffer(self._absent.kept().encode(), np.uint8)
        return arrays | {"next": np.array(self._next), "absent": absent}

    def restore(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Go on with what ``kept`` gave, as far as it is of units that are inputs still.

        Raises:
            KeyError, ValueError: it is none.
        """
        if not arrays:
            return
        for unit, bank in self.banks.items():
            of_unit = {name.removeprefix(f"{unit}/"): v for name, v in arrays.items() if name.startswith(f"{unit}/")}
            if of_unit:
                bank.restore(of_unit)
        self._next = int(arrays["next"])
        self._absent.restore(arrays["absent"].tobytes().decode())

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
        if self._our_unit in frame.sensors and (frame.track_id >= self._board.lowest_id).any():
            self._rings.add(unit)
        return told

    def tell(self, frame: TrackFrame, told: Told, origin: Geodetic | None) -> None:
        """Take what a frame tells, into the plane of ``origin``."""
        unit, bank = frame.unit_id, self.banks[frame.unit_id]
        self._counters["input_frames"] += 1
        self.expire()
        t_s, now_ns = self._time.to_s(frame.t_ns), self._time.to_ns(self._time.now_s)
        ended = bank.tell(moved(told, frame, origin), t_s, now_ns)
        for i in self._without_heir(ended):
            self._board.tell([self._board.foreign_last_words(unit, ended.take(np.array([i])))])
        self._board.tell(self._absent.end(unit, told.ended.tolist()))
        self._welcome_back(unit, bank.rows)

    def expire(self) -> None:
        """Let go tracks whose last plot is too old by now."""
        if not self.banks:
            return
        now_ns = self._time.to_ns(self._time.now_s)
        for unit, bank in self.banks.items():
            silent = bank.expire(now_ns)
            for i in self._without_heir(silent):
                one = silent.take(np.array([i]))
                self._absent.lose(unit, one, self._board.foreign_last_words(unit, one))
        self._board.tell(self._absent.gone(now_ns))

    # --- who is whom ---

    def cycle(self, regular: bool = True) -> None:
        """Run the tests; out of turn (not ``regular``) it does not count how long tracks are alone."""
        if not self.banks:
            return
        now_s = self._time.now_s
        entries = self._system_entries(now_s)
        for k, (bank, test) in enumerate(zip(self.banks.values(), self._tests, strict=True)):
            given = _as_tracks(bank.rows, *bank.rows.at(now_s, self.rules.q_m2ps3))
            pairs = test.cycle(entries.tracks, given, now_s)
            self._note_partners(entries, bank.rows, pairs, regular)
            entries = _with_unpaired(entries, given, bank.rows, k)

    def without_heir(self, ended: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
        """Let foreign tracks take over the ids of ended system tracks (row, uid, id); returns those nobody took."""
        if not (self.banks and ended):
            return ended
        self.expire()
        left = []
        for row, uid, link in ended:
            if self._hand_over(int(system_numbers(np.array(uid))), link):
                self._counters["handed_over"] += 1
            else:
                left.append((row, uid, link))
        return left

    def _new_numbers(self, n: int) -> IntArray:
        self._next += n
        return _NUMBERS | ((self._next - n + np.arange(n)) & (_NUMBERS - 1))

    def references(self) -> list[Reference]:
        """The tracks of each unit, where they are right; of two that take each other's those of the lower number only.

        Else both would follow each other.
        """
        found = []
        for unit, bank in self.banks.items() if self.rules.reference else ():
            rows = bank.rows.take(~bank.rows.coasting)
            if unit not in self._rings and len(rows.ident):
                tracks = _as_tracks(rows, *rows.at(self._time.now_s, self.rules.q_m2ps3))
                found.append(Reference(unit, tracks, self.rules.error_m))
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
    more = LocalTracks._make(values[alone] for values in given)
    tracks = LocalTracks(*(np.concatenate(pair) for pair in zip(entries.tracks, more, strict=True)))
    return _Entries(tracks, np.concatenate([entries.bank, np.full(int(alone.sum()), bank, np.int64)]))
