"""The black box: all inputs of the engine, in the order in which it took them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from trackmesh.protocol.files import RecordWriter, RegistrationRecord, Tick, UnitRecord
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo, TrackFrame
from trackmesh.services.fusion.engine import Unit
from trackmesh.services.fusion.settings import EngineSettings


def unit_record(
    unit: Unit,
    settings: EngineSettings,
    registration: RegistrationRecord | None = None,
    state: bytes | None = None,
    inputs: Sequence[str] = (),
) -> UnitRecord:
    """The first line of a black box."""
    return UnitRecord(
        unit_id=unit.unit_id,
        unit_number=unit.number,
        boot_id=unit.boot_id,
        first_track_number=unit.first_track,
        inputs=list(inputs),
        settings=settings.model_dump(mode="json"),
        registration=registration,
        state=base64.b64encode(state).decode() if state is not None else None,
    )


class BlackBox:
    """Writes a file that ``trackmesh track`` turns into exactly the frames that were published.

    Raises:
        TrackmeshError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        unit: Unit,
        settings: EngineSettings,
        origin: Geodetic | None,
        registration: RegistrationRecord | None = None,
        state: bytes | None = None,
        inputs: Sequence[str] = (),
    ) -> None:
        self._writer = RecordWriter(path)
        self._writer.write(unit_record(unit, settings, registration, state, inputs))
        if origin is not None:
            self._writer.write(origin)

    def take(self, record: SensorInfo | PlotBatch | TrackFrame | Tick) -> None:
        """Record an input."""
        self._writer.write(record)

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
