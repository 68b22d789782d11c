"""The engine without a network: a recording, or a black box, to frames."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from pydantic import ValidationError

from trackmesh.protocol.errors import RefusedMessage, TrackmeshError
from trackmesh.protocol.files import RegistrationRecord, Tick, UnitRecord
from trackmesh.protocol.messages import Geodetic, Message, PlotBatch, RefinedFrame, SensorInfo, TrackFrame
from trackmesh.services.fusion import snapshot
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.intake import Intake
from trackmesh.services.fusion.settings import EngineSettings


class OfflineRun:
    """One pass over the records of a file.

    A black box names unit, inputs and settings itself; any other recording is tracked by ``settings``, and the tracks
    in it of the units that ``inputs`` names are taken as well.

    Attributes:
        on_refined: given the refined states of every frame, where the settings keep a lag.
        refused: batches and frames refused, by reason.
        plots: plots taken.
    """

    def __init__(
        self,
        settings: EngineSettings,
        unit_id: str = "offline",
        unit_number: int = 0,
        origin: Geodetic | None = None,
        inputs: Sequence[str] = (),
    ) -> None:
        self._settings = settings
        self._unit = Unit(unit_id, unit_number)
        self._origin = origin
        self._inputs = tuple(inputs)
        self._intake = Intake(0, 0)
        self._registration: RegistrationRecord | None = None
        self._state: str | None = None
        self.engine: FusionEngine | None = None
        self.on_refined: Callable[[RefinedFrame], None] | None = None
        self.refused: Counter[str] = Counter()
        self.plots = 0

    def frames(self, records: Iterable[Message]) -> Iterator[TrackFrame]:
        """The frames that the records give, in order.

        Raises:
            TrackmeshError: a record is not one of an input, or the settings of a black box are not of this version.
        """
        for record in records:
            frame = self._take(record)
            if frame is not None:
                yield frame
                self._tell_refined()

    def _tell_refined(self) -> None:
        refined = self._running().refined() if self.on_refined else None
        if self.on_refined and refined is not None:
            self.on_refined(refined)

    def _take(self, record: Message) -> TrackFrame | None:
        if isinstance(record, UnitRecord):
            self._begin(record)
        elif isinstance(record, Geodetic):
            self._origin = record
        elif isinstance(record, SensorInfo):
            self._running().sensor(record)
        elif isinstance(record, Tick):
            return self._running().tick(record.t_ns)
        elif isinstance(record, PlotBatch):
            return self._plots(record)
        elif isinstance(record, TrackFrame):
            return self._tracks(record)
        else:
            raise TrackmeshError(f"A {type(record).__name__} is no input of the tracker.")
        return None

    def _plots(self, batch: PlotBatch) -> TrackFrame | None:
        engine = self._running()
        try:
            self._intake.check(batch, None)
            frame = engine.plots(batch)
        except RefusedMessage as error:
            self.refused[error.reason] += 1
            return None
        self.plots += len(batch.t_ns)
        return frame

    def _tracks(self, frame: TrackFrame) -> TrackFrame | None:
        try:
            return self._running().tracks(frame)
        except RefusedMessage as error:
            self.refused[error.reason] += 1
            return None

    def _begin(self, record: UnitRecord) -> None:
        try:
            self._settings = EngineSettings.model_validate(record.settings)
        except ValidationError:
            raise TrackmeshError("The black box was recorded with settings of another version of trackmesh.") from None
        self._unit = Unit(record.unit_id, record.unit_number, record.boot_id, record.first_track_number)
        self._inputs = tuple(record.inputs)
        self._registration = record.registration
        self._state = record.state

    def _running(self) -> FusionEngine:
        if self.engine is None:
            self.engine = FusionEngine(self._settings, self._unit, self._origin, self._inputs)
            if self._state is not None:
                # The run began with the tracks of the one before it.
                self.engine.restore(snapshot.from_bytes(base64.b64decode(self._state)))
            if self._registration is not None:
                # As old as it was at the start of the recorded run, which wrote that moment into it.
                self.engine.corrections.restore(self._registration, self._registration.t_ns)
        return self.engine
