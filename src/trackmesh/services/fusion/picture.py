"""The picture: system tracks as frames, with the last words of those that ended."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import ENDED, Geodetic, RefinedFrame, TrackFrame
from trackmesh.services.fusion import frames
from trackmesh.services.fusion.composition import Composition
from trackmesh.services.fusion.foreign import Rows as ForeignRows
from trackmesh.services.fusion.inputs import system_numbers
from trackmesh.services.fusion.layer import Layer
from trackmesh.services.fusion.sensors import Sensor
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.timeline import Timeline

IntArray = npt.NDArray[np.int64]

_COASTING_AFTER_PERIODS = 1.5
_TRACK_BITS = 41

TRACK_EPOCH_MS = 1_577_836_800_000
"""2020-01-01 in Unix milliseconds: track numbers begin at the milliseconds since then, so no restart repeats one."""


class Unit(NamedTuple):
    """Who the engine is: its names in frames and the numbers it gives to tracks.

    Track ids are ``number << 41 | n`` with n counting up from ``first_track``, so that they are unique over units and
    restarts; 0 stands for the milliseconds from 2020 to the first data.
    """

    unit_id: str = "main"
    number: int = 0
    boot_id: str = "offline"
    first_track: int = 0


class Picture:
    """Makes frames of the system layer, and numbers its tracks.

    Attributes:
        origin: of the system plane.
        composition: what other units' tracks add; None where there are no inputs.
        next_track: the number of the next confirmed track, 0 before the first data.
        seq: number of the next frame.
    """

    def __init__(
        self, settings: EngineSettings, unit: Unit, system: Layer, sensors: Mapping[str, Sensor], time: Timeline
    ) -> None:
        self._settings = settings
        self._unit = unit
        self._system = system
        self._sensors = sensors
        self._time = time
        self._models = settings.model_names()
        self._manoeuvre_models = settings.manoeuvre_models()
        self._ended: list[TrackFrame] = []
        self._refined_s = np.empty(0)
        self.origin: Geodetic | None = None
        self.composition: Composition | None = None
        self.next_track = unit.first_track
        self.seq = 0

    def name(self, rows: IntArray) -> None:
        """Give newly confirmed rows their public numbers."""
        if len(rows):
            self._system.life.link[rows] = self.numbers(len(rows))

    @property
    def lowest_id(self) -> int:
        """No track of this unit has a lower public number."""
        return self._unit.number << _TRACK_BITS

    def numbers(self, n: int) -> IntArray:
        """Public numbers (n,) never used before."""
        if not self.next_track and self._time.epoch_ns is not None:
            self.next_track = max(1, self._time.epoch_ns // 1_000_000 - TRACK_EPOCH_MS)
        self.next_track += n
        return self.lowest_id | (self.next_track - n + np.arange(n))

    def last_words(self, rows: IntArray) -> TrackFrame:
        """What is to be told of rows that end now."""
        frame = self._frame_of(rows, self._time.now_s, self.seq)
        return frame.model_copy(update={"status": np.full(len(rows), ENDED, np.uint8)})

    def foreign_last_words(self, unit_id: str, rows: ForeignRows) -> TrackFrame:
        """The same of tracks of another unit that stood in the picture."""
        assert self.composition is not None
        return self.composition.last_words(self._blank(self._time.now_s), unit_id, rows, self._time.now_s)

    def tell(self, words: list[TrackFrame]) -> None:
        """Put last words into the next frame."""
        self._ended += words

    def next_frame(self) -> TrackFrame:
        """The present picture, as it is published."""
        frame = self.at(self._time.now_s, self._settings.publish_tentative)
        if self._ended:
            frame = frames.join(frame, self._ended)
            self._ended = []
        self.seq += 1
        return frame

    def at(self, t_s: float, tentative: bool) -> TrackFrame:
        """The picture at a time."""
        rows = self._system.rows
        if not tentative:
            rows = rows[self._system.life.confirmed[rows]]
        rows = rows[self._system.filters.oldest_s[rows] <= t_s]
        frame = self._frame_of(rows, t_s, self.seq)
        if self.composition is None:
            return frame
        return frames.join(frame, self.composition.alone(self._blank(t_s), t_s))

    def _blank(self, t_s: float) -> TrackFrame:
        return self._frame_of(np.empty(0, np.int64), t_s, self.seq)

    def _frame_of(self, rows: IntArray, t_s: float, seq: int) -> TrackFrame:
        known = self._system.life
        x, P, mu = self._system.predict(rows, t_s)
        if self.composition is not None:
            x, P = self.composition.fuse(system_numbers(known.uid[rows]), x, P, t_s)
        state, covariance = frames.pack_states(x, P)
        height, height_variance = frames.heights(self._system, rows, t_s)
        longest = max((s.info.period_s for s in self._sensors.values()), default=1.0)
        frame = TrackFrame.model_construct(
            schema_version=1,
            unit_id=self._unit.unit_id,
            boot_id=self._unit.boot_id,
            seq=seq,
            t_ns=self._time.to_ns(t_s),
            origin=self.origin,
            track_id=np.where(known.confirmed[rows], known.link[rows], self._tentative_id(rows)),
            epoch=np.zeros(len(rows), "<u4"),
            status=frames.status_of(self._system, rows, t_s, _COASTING_AFTER_PERIODS * longest),
            state=state,
            covariance=covariance,
            height_m=height,
            height_variance_m2=height_variance,
            model_probability=mu,
            models=self._models,
            manoeuvre_fit=frames.manoeuvre_fit(mu, self._manoeuvre_models),
            sensors=list(self._sensors),
            members=known.member[rows][:, : len(self._sensors)].copy(),
            updated_t_ns=self._time.to_ns_array(known.last_s[rows]),
            first_t_ns=self._time.to_ns_array(known.first_s[rows]),
        )
        if self.composition is None:
            return frame
        return self.composition.complete(frame, system_numbers(known.uid[rows]), t_s)

    def refined(self) -> RefinedFrame | None:
        """States of ``settings.lag`` plots ago, refined by those since, of the tracks that moved on since then.

        None where there are none, or no lag is kept.
        """
        if not self._settings.lag or self._time.epoch_ns is None:
            return None
        rows = self._system.rows
        rows = rows[self._system.life.confirmed[rows]]
        x, P, t_s = self._system.refined(rows, self._settings.lag)
        told = np.full(len(self._system.life.uid), -np.inf)
        told[: len(self._refined_s)] = self._refined_s
        fresh = (t_s != told[rows]) & (self._system.life.hits[rows] > self._settings.lag)
        if not fresh.any():
            return None
        rows = rows[fresh]
        told[rows] = t_s[fresh]
        self._refined_s = told
        state, covariance = frames.pack_states(x[fresh], P[fresh])
        return RefinedFrame.model_construct(
            schema_version=1,
            unit_id=self._unit.unit_id,
            boot_id=self._unit.boot_id,
            seq=self.seq,
            t_ns=self._time.to_ns(self._time.now_s),
            lag=self._settings.lag,
            track_id=self._system.life.link[rows].copy(),
            state_t_ns=self._time.to_ns_array(t_s[fresh]),
            state=state,
            covariance=covariance,
        )

    def _tentative_id(self, rows: IntArray) -> IntArray:
        # Tentative tracks have no public number yet; theirs is of a range that confirmed ones never reach.
        return (self._unit.number << _TRACK_BITS) | (1 << (_TRACK_BITS - 1)) | self._system.life.uid[rows]
