"""The frames of other units as they come from the bus: decoded, of now, and counted where they are wrong."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator

from trackmesh.protocol.bus import Sample
from trackmesh.protocol.codec import decode
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.keys import last_chunk
from trackmesh.protocol.messages import SensorHealth, TrackFrame
from trackmesh.services.fusion.inputs import Inputs
from trackmesh.services.fusion.settings import FusionSettings
from trackmesh.services.runtime import ServiceRuntime

_FRAMES_WAITING = 64


class InputFeed:
    """Subscriptions to the tracks of the inputs; a lost frame is none to fetch, the next one says it all again."""

    def __init__(self, runtime: ServiceRuntime, settings: FusionSettings) -> None:
        self._runtime = runtime
        self._settings = settings
        self._alive: set[str] = set()
        self._refused: Counter[str] = Counter()
        self._subscriptions = [
            runtime.closing(runtime.bus.subscribe(runtime.keys.tracks(unit), capacity=_FRAMES_WAITING))
            for unit in settings.inputs
        ]

    def frames(self) -> Iterator[TrackFrame]:
        """Those that came since the last call, unit by unit."""
        for subscription in self._subscriptions:
            while (sample := subscription.receive(timeout_s=0)) is not None:
                try:
                    yield self._read(sample)
                except RefusedMessage as error:
                    self.refuse(last_chunk(sample.key), error)

    def refuse(self, unit: str, error: RefusedMessage) -> None:
        """Count a frame that is not taken."""
        self._refused[unit] += 1
        self._runtime.counters.refuse(error.reason)
        self._runtime.log.debug("refused: %s", error)

    def note_alive(self, unit: str, alive: bool) -> None:
        """Take note of a unit that came or went; its tracks are left to their age."""
        if unit in self._settings.inputs:
            (self._alive.add if alive else self._alive.discard)(unit)
            self._runtime.log.info("input %s %s", unit, "is there" if alive else "is gone")

    def health(self, inputs: Inputs) -> list[SensorHealth]:
        """The inputs as sensors: ``batches`` are frames, ``plots`` the tracks in them."""
        return [self._health(unit, inputs) for unit in self._settings.inputs]

    def _health(self, unit: str, inputs: Inputs) -> SensorHealth:
        stream = inputs.stream(unit)
        return SensorHealth(
            sensor_id=unit,
            alive=unit in self._alive,
            plots=stream.rows,
            batches=stream.batches,
            gaps=stream.gaps,
            duplicates=stream.duplicates,
            refused=self._refused[unit],
            last_seq=max(stream.seq, 0),
            last_t_ns=stream.last_t_ns,
        )

    def _read(self, sample: Sample) -> TrackFrame:
        frame = decode(sample.payload, TrackFrame, sample.encoding)
        if frame.unit_id != last_chunk(sample.key):
            raise RefusedMessage("wrong_unit", f"{sample.key} brought tracks of {frame.unit_id}.")
        if self._settings.clock == "wall":
            self._check_time(frame)
        return frame

    def _check_time(self, frame: TrackFrame) -> None:
        ahead_s = (frame.t_ns - time.time_ns()) / 1e9
        if ahead_s > self._settings.max_ahead_s:
            raise RefusedMessage("future", f"A frame of {frame.unit_id} lies {ahead_s:.1f} s in the future.")
        if -ahead_s > self._settings.max_age_s:
            raise RefusedMessage("past", f"A frame of {frame.unit_id} is {-ahead_s:.1f} s old.")
