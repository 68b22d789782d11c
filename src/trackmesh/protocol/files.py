"""The JSON-lines files: one object a line, ``"type"`` first, then the fields of the message.

``PLOTS.jsonl`` holds ``unit``, ``origin``, ``sensor``, ``plots`` and ``tick`` in order of arrival; ``RANGES.jsonl``
likewise, with ``ranges`` for plots, and ``gone``; ``TRACKS.jsonl`` holds ``tracks``, ``TAGS.jsonl`` ``tags``;
``TRUTH.jsonl`` holds ``truth``; ``SCANS.jsonl`` holds ``emi_scan``; results of an inversion are ``emi_result``.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self, TextIO

from pydantic import Field

from trackmesh.protocol.codec import from_object
from trackmesh.protocol.errors import RefusedMessage, TrackmeshError
from trackmesh.protocol.messages import (
    EmiResult,
    EmiScanBatch,
    Geodetic,
    Message,
    PlotBatch,
    RangeBatch,
    RefinedFrame,
    SensorInfo,
    TagFrame,
    TrackFrame,
    TruthFrame,
)
from trackmesh.protocol.messages.base import BootId, Id, UnixNs


class Tick(Message):
    """Time passed without data (a line of a black box)."""

    t_ns: UnixNs


class Gone(Message):
    """A sensor that is there no longer (a line of a black box)."""

    sensor_id: Id


class RegistrationRecord(Message):
    """What a unit knew of its sensors' biases at a time, kept over restarts."""

    t_ns: UnixNs
    state: dict[str, Any]


class UnitRecord(Message):
    """Who recorded a black box, and with which settings: what is needed to give the same frames again."""

    unit_id: Id
    unit_number: Annotated[int, Field(ge=0, le=4095)]
    boot_id: BootId
    first_track_number: Annotated[int, Field(ge=0, lt=2**41)]
    inputs: list[Id] = []
    settings: dict[str, Any]
    registration: RegistrationRecord | None = None
    state: str | None = None


Record = Message
RECORD_TYPES: dict[str, type[Message]] = {
    "unit": UnitRecord,
    "registration": RegistrationRecord,
    "origin": Geodetic,
    "sensor": SensorInfo,
    "plots": PlotBatch,
    "ranges": RangeBatch,
    "gone": Gone,
    "tick": Tick,
    "tracks": TrackFrame,
    "tags": TagFrame,
    "refined": RefinedFrame,
    "truth": TruthFrame,
    "emi_scan": EmiScanBatch,
    "emi_result": EmiResult,
}
_NAMES = {kind: name for name, kind in RECORD_TYPES.items()}


def to_line(record: Message) -> str:
    """One line of a file, without its newline."""
    body = record.model_dump_json()
    return f'{{"type":"{_NAMES[type(record)]}",{body[1:]}'


def from_line(line: str) -> Message:
    """The record of one line.

    Raises:
        RefusedMessage: the line is no record.
    """
    try:
        fields = json.loads(line)
    except ValueError as error:
        raise RefusedMessage("malformed", f"No JSON: {error}.") from None
    except RecursionError:
        raise RefusedMessage("malformed", "No JSON of ours: it is nested too deeply.") from None
    if not isinstance(fields, dict):
        raise RefusedMessage("malformed", "A line must be a JSON object.")
    name = fields.pop("type", None)
    kind = RECORD_TYPES.get(name) if isinstance(name, str) else None
    if kind is None:
        raise RefusedMessage("wrong_schema", f"Unknown type {name!r}, expected one of {', '.join(RECORD_TYPES)}.")
    return from_object(fields, kind)


def read_records(path: Path, *wanted: type[Message]) -> Iterator[Message]:
    """The records of a file in order; ``wanted`` kinds only, where given (others are then an error).

    Raises:
        TrackmeshError: the file cannot be read, or a line is wrong; the sentence names file and line.
    """
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                if line.strip():
                    yield _record(path, number, line, wanted)
    except OSError as error:
        raise TrackmeshError(f"Cannot read {path}: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise TrackmeshError(f"{path} is not a text file.") from None


def _record(path: Path, number: int, line: str, wanted: tuple[type[Message], ...]) -> Message:
    try:
        record = from_line(line)
    except RefusedMessage as error:
        raise TrackmeshError(f"{path}, line {number}: {error}") from None
    if wanted and not isinstance(record, wanted):
        kinds = " or ".join(_NAMES[k] for k in wanted)
        raise TrackmeshError(f"{path}, line {number}: a line of type {kinds} is expected, not {_NAMES[type(record)]}.")
    return record


class RecordWriter:
    """Writes records to a file, a line each, flushed at every line so that a killed process loses none."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file: TextIO = path.open("w", encoding="utf-8")
        except OSError as error:
            raise TrackmeshError(f"Cannot write {path}: {error.strerror}.") from None

    def write(self, record: Message) -> None:
        """Append one record.

        Raises:
            TrackmeshError: it cannot be written (the disk is full).
        """
        try:
            self._file.write(to_line(record) + "\n")
            self._file.flush()
        except OSError as error:
            raise TrackmeshError(f"Cannot write {self._path}: {error.strerror}.") from None

    def close(self) -> None:
        """Close the file; what could not be written before is not tried again."""
        with contextlib.suppress(OSError):
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def replace_with(path: Path, record: Message) -> None:
    """Make a file hold this one record; whoever reads it meanwhile sees the old one or the new one, whole.

    Raises:
        TrackmeshError: it cannot be written.
    """
    beside = path.with_name(path.name + ".new")
    try:
        beside.write_text(to_line(record) + "\n", encoding="utf-8")
        beside.replace(path)
    except OSError as error:
        raise TrackmeshError(f"Cannot write {path}: {error.strerror or error}.") from None
