"""The tag engine: ranges in, pictures out. Pure: no network, no clock; the same inputs give the same frames.

The way of a batch: what cannot be used is left out and counted, signal strengths become ranges (``input``), ranges wait
for earlier ones of other networks (``reorder_s``), then each tag takes its own in order of time, instant by instant
(``life``). Time comes with the data, and as ticks when no data comes.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import GONE, LOCATED, LOST, UNSURE, Geodetic, RangeBatch, SensorInfo, TagFrame
from trackmesh.services.tags import life, table
from trackmesh.services.tags.frames import join, make_frame
from trackmesh.services.tags.hypotheses import grown as grown_blocks
from trackmesh.services.tags.input import Inputs
from trackmesh.services.tags.readers import Readers
from trackmesh.services.tags.records import RANGE, Records, joined, make_rules, make_work, sizes
from trackmesh.services.tags.roll import Roll
from trackmesh.services.tags.settings import TagEngineSettings
from trackmesh.services.tags.telling import make_told, tell

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_ROWS = 64
_BLOCKS = 16
_LOOK_EVERY_S = 1.0
_ROUNDING_S = 1e-6


class Unit(NamedTuple):
    """Who the engine is, in frames."""

    unit_id: str = "main"
    boot_id: str = "offline"


class TagEngine:
    """One unit's picture of tags.

    Attributes:
        readers: as far as they are known.
        inputs: what has been learnt of signal strengths.
        counters: what happened, by name (``ranges``, ``unknown_reader``, ``absurd_ranges``, ``restarts``, ...).
    """

    def __init__(self, settings: TagEngineSettings, unit: Unit, origin: Geodetic | None = None) -> None:
        self.settings = settings
        self.unit = unit
        self.readers = Readers(origin, settings.tag_height_m, settings.range_sigma_m)
        self.counters: Counter[str] = Counter()
        self.inputs = Inputs(settings, self.readers, self.counters)
        self._rules = make_rules(settings.description())
        self._work = make_work(self._rules)
        self._manners = settings.manners()
        self._seq = 0
        self._gone: list[TagFrame] = []
        self._begin()

    def _begin(self) -> None:
        """No tags, no time."""
        self._tags = table.make_tags(self._rules, _ROWS, _BLOCKS)
        self._roll = Roll(self.settings.max_tags)
        self._waiting: Records = np.empty(0, RANGE)
        self._epoch_ns: int | None = None
        self._now_s = 0.0
        self._frame_s = self._looked_s = -np.inf

    @property
    def now_ns(self) -> int | None:
        """The engine's time: the newest that data or ticks have told; None before any."""
        return None if self._epoch_ns is None else self._to_ns(self._now_s)

    def reader(self, info: SensorInfo) -> bool:
        """Take note of a reader, new or moved; whether anything has changed. Other sensors are none of ours."""
        return info.kind == "ranging" and self.readers.add(info)

    def drop_reader(self, reader_id: str) -> bool:
        """A reader is there no longer, its ranges are those of an unknown one; whether it was known."""
        return self.readers.drop(reader_id)

    def ranges(self, batch: RangeBatch) -> TagFrame | None:
        """Take a batch of ranges; the new picture, unless the last one is too recent."""
        if len(batch.t_ns):
            self._note_time(int(batch.t_ns.min()), int(batch.t_ns.max()))
            t_s = (batch.t_ns - (self._epoch_ns or 0)) / 1e9
            self._waiting = joined(self._waiting, self.inputs.ranges(batch, t_s, self._roll))
            self._make_room()
            self._take(self._now_s - self.settings.reorder_s)
        return self._due_frame(self.settings.frame_period_s)

    def tick(self, t_ns: int) -> TagFrame | None:
        """Let time advance without data; a picture now and then."""
        self._note_time(t_ns, t_ns)
        self._take(self._now_s - self.settings.reorder_s)
        self._end_waiting()
        if self._now_s - self._looked_s >= _LOOK_EVERY_S:
            self._looked_s = self._now_s
            self._forget()
        return self._due_frame(max(self.settings.idle_frame_s, self.settings.frame_period_s))

    def figures(self) -> dict[str, float]:
        """Present values for the status."""
        rows = table.rows_in(self._tags, table.SEVERAL, table.LOCATED)
        status = self._status(rows)
        out = {"tags": len(rows), "readers": len(self.readers.infos)}
        out |= {
            name: int((status == s).sum()) for name, s in (("unsure", UNSURE), ("located", LOCATED), ("lost", LOST))
        }
        out["waiting"] = len(table.rows_in(self._tags, table.HEARD))
        figures = {name: float(value) for name, value in out.items()}
        for network, law in self.inputs.losses.items():
            figures |= {f"rssi_exponent.{network}": law.exponent, f"rssi_1m_dbm.{network}": law.power_1m_dbm}
        return figures

    def counts(self) -> dict[str, int]:
        """All that was counted since the start."""
        own = dict(zip(table.COUNTED, self._tags.counts.tolist(), strict=True))
        return {name: self.counters[name] + own.get(name, 0) for name in {**self.counters, **own}}

    # --- taking ---

    def _take(self, until_s: float) -> None:
        """Let the tags take what has waited up to this time."""
        ripe = self._waiting["t_s"] <= until_s
        z, self._waiting = self._waiting[ripe], self._waiting[~ripe]
        z = z[np.lexsort((z["reader"], z["t_s"], z["row"]))]
        done = 0
        while done < len(z):
            done += life.take_ranges(
                self._tags, self._rules[0], self._manners, self.readers.place, z[done:], self._work[0]
            )
            self._make_room()

    def _end_waiting(self) -> None:
        row = 0
        while row < len(self._tags.life):
            row = life.end_waiting(
                self._tags, self._rules[0], self._manners, self.readers.place, self._now_s, row, self._work[0]
            )
            self._make_room()

    def _make_room(self) -> None:
        """Rows for all tags of the roll, and at least one block for a tag at several places."""
        if self._roll.size > len(self._tags.life):
            self._tags = table.grown(self._tags, self._rules, 2 * self._roll.size)
        if not self._tags.blocks.top[0]:
            self._tags = self._tags._replace(blocks=grown_blocks(self._tags.blocks, self._rules))

    def _forget(self) -> None:
        """Let tags go that were not heard for long; a frame tells it of those that had a place."""
        silent_s = self._now_s - self._tags.life["last_s"]
        state = self._tags.life["state"]
        placed = np.isin(state, (table.SEVERAL, table.LOCATED))
        limit_s = np.where(placed, self.settings.forget_s, self.settings.lost_s)
        rows = np.flatnonzero((state != table.FREE) & (silent_s > limit_s))
        told = rows[placed[rows]]
        if len(told):
            self._gone.append(self._frame_of(told, np.full(len(told), GONE, np.uint8)))
        for row in rows.tolist():
            table.forget(self._tags, row)
        self._roll.release(rows)
        self.counters["gone"] += len(told)

    # --- the picture ---

    def _due_frame(self, period_s: float) -> TagFrame | None:
        # A little less: times of a regular rhythm differ in their last digits.
        if self._epoch_ns is None or self._now_s - self._frame_s < period_s - _ROUNDING_S:
            return None
        self._frame_s = self._now_s
        rows = table.rows_in(self._tags, table.SEVERAL, table.LOCATED)
        frame = self._frame_of(rows, self._status(rows))
        if self._gone:
            frame, self._gone = join(frame, self._gone), []
        self._seq += 1
        return frame

    def _status(self, rows: IntArray) -> npt.NDArray[np.uint8]:
        lost = self._now_s - self._tags.life["last_s"][rows] > self.settings.lost_s
        several = self._tags.life["state"][rows] == table.SEVERAL
        return np.where(lost, LOST, np.where(several, UNSURE, LOCATED)).astype(np.uint8)

    def _frame_of(self, rows: IntArray, status: npt.NDArray[np.uint8]) -> TagFrame:
        told = make_told(len(rows), sizes(self._rules)[1])
        tell(self._tags, self._rules[0], rows, self._now_s, self.settings.heard_s, self._work[0], told)
        updated = np.rint(self._tags.life["last_s"][rows] * 1e9).astype(np.int64) + (self._epoch_ns or 0)
        header: dict[str, object] = {
            "unit_id": self.unit.unit_id,
            "boot_id": self.unit.boot_id,
            "seq": self._seq,
            "t_ns": self._to_ns(self._now_s),
            "origin": self.readers.origin,
        }
        names = [self._roll.names[row] for row in rows.tolist()]
        return make_frame(header, names, status, told, self.readers.names, updated)

    # --- time ---

    def _note_time(self, first_ns: int, last_ns: int) -> None:
        """Advance to ``last_ns``; time that lies far back is that of a clock that was set, and all begins anew."""
        back_ns = self.settings.clock_back_s * 1e9
        if self._epoch_ns is not None and last_ns < self._to_ns(self._now_s) - back_ns:
            self.counters["clock_set_back"] += 1
            self._leave()
        if self._epoch_ns is None:
            self._epoch_ns = first_ns - first_ns % 1_000_000_000
            self._now_s = (last_ns - self._epoch_ns) / 1e9
        self._now_s = max(self._now_s, (last_ns - self._epoch_ns) / 1e9)

    def _leave(self) -> None:
        """Every tag is gone, and so is time; the counts stay."""
        rows = table.rows_in(self._tags, table.SEVERAL, table.LOCATED)
        if len(rows):
            self._gone.append(self._frame_of(rows, np.full(len(rows), GONE, np.uint8)))
        counts = self._tags.counts
        self._begin()
        self._tags.counts[:] = counts

    def _to_ns(self, t_s: float) -> int:
        return round(t_s * 1e9) + (self._epoch_ns or 0)
