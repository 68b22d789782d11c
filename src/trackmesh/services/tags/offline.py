"""The engine without a network: a recording of ranges, or a black box, to frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from pydantic import ValidationError

from trackmesh.protocol.errors import RefusedMessage, TrackmeshError
from trackmesh.protocol.files import Gone, Tick, UnitRecord
from trackmesh.protocol.messages import Geodetic, Message, PlotBatch, RangeBatch, SensorInfo, TagFrame
from trackmesh.services.streams import Streams
from trackmesh.services.tags.engine import TagEngine, Unit
from trackmesh.services.tags.settings import TagEngineSettings


class OfflineRun:
    """One pass over the records of a file.

    A black box names unit and settings itself; any other recording is followed by ``settings``. Plots of other sensors
    are passed over.

    Attributes:
        refused: batches refused, by reason.
    """

    def __init__(self, settings: TagEngineSettings, unit_id: str = "offline", origin: Geodetic | None = None) -> None:
        self._settings = settings
        self._unit = Unit(unit_id)
        self._origin = origin
        self._streams = Streams()
        self._engine: TagEngine | None = None
        self.refused: Counter[str] = Counter()

    @property
    def engine(self) -> TagEngine:
        """The engine, begun when it is first needed."""
        if self._engine is None:
            self._engine = TagEngine(self._settings, self._unit, self._origin)
        return self._engine

    def frames(self, records: Iterable[Message]) -> Iterator[TagFrame]:
        """The frames that the records give, in order.

        Raises:
            TrackmeshError: a record is not one of an input, or the settings of a black box are not of this version.
        """
        for record in records:
            frame = self._take(record)
            if frame is not None:
                yield frame

    def _take(self, record: Message) -> TagFrame | None:
        if isinstance(record, UnitRecord):
            self._begin(record)
        elif isinstance(record, Geodetic):
            self._origin = record
        elif isinstance(record, SensorInfo):
            self.engine.reader(record)
        elif isinstance(record, Gone):
            self.engine.drop_reader(record.sensor_id)
        elif isinstance(record, Tick):
            return self.engine.tick(record.t_ns)
        elif isinstance(record, RangeBatch):
            return self._ranges(record)
        elif not isinstance(record, PlotBatch):
            raise TrackmeshError(f"A {type(record).__name__} is no input of the tag engine.")
        return None

    def _ranges(self, batch: RangeBatch) -> TagFrame | None:
        try:
            self._streams.check(batch.network_id, batch.boot_id, batch.seq, batch.t_ns, None)
        except RefusedMessage as error:
            self.refused[error.reason] += 1
            return None
        return self.engine.ranges(batch)

    def _begin(self, record: UnitRecord) -> None:
        try:
            self._settings = TagEngineSettings.model_validate(record.settings)
        except ValidationError:
            raise TrackmeshError("The black box was recorded with settings of another version of trackmesh.") from None
        self._unit = Unit(record.unit_id, record.boot_id)
