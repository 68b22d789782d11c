"""Survey logs in CSV as batches of scans: columns by name, one row a sample.

Coordinates may be large (eastings, northings): a common origin is taken off, which is told. Headings turn the sensor.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import ValidationError

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.codec import refusal
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import EmiGeometry, EmiOptions, EmiReceiver, EmiScanBatch, EmiTransmitter

FARTHEST_M = 1e3
"""Places may lie so far from the origin of a batch."""


@dataclass(frozen=True)
class Columns:
    """Which columns hold what.

    Attributes:
        x, y, z: place in metres; without z the sensor is at height 0.
        fields: for each channel the columns of its components, in the order of the receivers' components.
        scan: rows with the same value belong to one scan; None: all are one.
        heading_deg: clockwise from the y axis, of the sensor's own y axis; None: it does not turn.
        pitch_deg, roll_deg: nose up, and right side down, after the heading.
    """

    x: str
    y: str
    z: str | None
    fields: tuple[tuple[str, ...], ...]
    scan: str | None = None
    heading_deg: str | None = None
    pitch_deg: str | None = None
    roll_deg: str | None = None

    @property
    def all(self) -> list[str]:
        """Every column that is needed."""
        single = (self.x, self.y, self.z, self.scan, self.heading_deg, self.pitch_deg, self.roll_deg)
        return [*(name for name in single if name is not None), *(name for field in self.fields for name in field)]


class Setup(NamedTuple):
    """What a log does not tell: the coils, the unit of the field, its noise (None: estimated), the wanted options."""

    transmitter: EmiTransmitter
    receivers: list[EmiReceiver]
    field_unit: Literal["T", "nT", "pT", "arbitrary"]
    sigma: float | None
    options: EmiOptions


class Converted(NamedTuple):
    """Batches of a log, the origin (2,) that was taken off, and how many rows had no place."""

    batches: list[EmiScanBatch]
    origin_m: FloatArray
    without_place: int


def read_log(path: Path, columns: Columns, setup: Setup, *, delimiter: str = ",") -> Converted:
    """The scans of a log; a batch each, since each has places of its own.

    Field values that are empty or no numbers are missing ones; rows without a place are left out.

    Raises:
        TrackmeshError: the file cannot be read, lacks a column, or holds no sample; the components do not fit.
    """
    needed = sum(receiver.n_components for receiver in setup.receivers)
    for field in columns.fields:
        if len(field) != needed:
            names = ", ".join(field)
            raise TrackmeshError(f"A channel has {len(field)} columns ({names}), where the receivers give {needed}.")
    groups = _groups(path, columns, delimiter)
    places = {name: np.array([row[:3] for row in rows]) for name, rows in groups.items()}
    sound = {name: np.isfinite(place).all(1) for name, place in places.items()}
    there = [place[sound[name]] for name, place in places.items() if sound[name].any()]
    if not there:
        raise TrackmeshError(f"{path} holds no row with a place.")
    origin = _origin(np.concatenate(there))
    batches: dict[str, EmiScanBatch] = {}
    for name, rows in groups.items():
        if sound[name].any():
            ident = _ident(path, name, batches.keys())
            batches[ident] = _batch(ident, np.array(rows)[sound[name]], origin, columns, setup)
    return Converted([*batches.values()], origin, sum(int((~mask).sum()) for mask in sound.values()))


def quaternions(heading_deg: FloatArray, pitch_deg: FloatArray, roll_deg: FloatArray) -> FloatArray:
    """Attitude (n, 4) w, x, y, z of a sensor whose y axis is its nose and whose x axis is its right side."""
    yaw, pitch, roll = (0.5 * np.radians(angle) for angle in (-heading_deg, pitch_deg, roll_deg))
    turn = [np.cos(yaw), np.zeros_like(yaw), np.zeros_like(yaw), np.sin(yaw)]
    nose = [np.cos(pitch), np.sin(pitch), np.zeros_like(pitch), np.zeros_like(pitch)]
    side = [np.cos(roll), np.zeros_like(roll), np.sin(roll), np.zeros_like(roll)]
    return np.stack(_product(_product(turn, nose), side), 1)


def _product(a: Sequence[FloatArray], b: Sequence[FloatArray]) -> list[FloatArray]:
    return [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]


def _groups(path: Path, columns: Columns, delimiter: str) -> dict[str, list[list[float]]]:
    """Rows x, y, z, heading, pitch, roll, then the fields, by the name of their scan."""
    groups: dict[str, list[list[float]]] = {}
    for row in _rows(path, columns, delimiter):
        numbers = [_number(row, columns.x), _number(row, columns.y), _number(row, columns.z, 0.0)]
        numbers += [_number(row, name, 0.0) for name in (columns.heading_deg, columns.pitch_deg, columns.roll_deg)]
        numbers += [_number(row, name) for field in columns.fields for name in field]
        groups.setdefault(row[columns.scan] if columns.scan else "", []).append(numbers)
    return groups


def _rows(path: Path, columns: Columns, delimiter: str) -> Iterator[dict[str, str]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, delimiter=delimiter, skipinitialspace=True)
            names = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = names
            if missing := [name for name in columns.all if name not in names]:
                raise TrackmeshError(f"{path} has no column {missing[0]!r}; it has {', '.join(names) or 'none'}.")
            for row in reader:
                yield {name: value or "" for name, value in row.items() if isinstance(name, str)}
    except OSError as error:
        raise TrackmeshError(f"Cannot read {path}: {error.strerror}.") from None
    except (UnicodeDecodeError, csv.Error):
        raise TrackmeshError(f"{path} is no CSV file.") from None


def _number(row: dict[str, str], name: str | None, without: float = math.nan) -> float:
    if name is None:
        return without
    try:
        value = float(row[name])
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _origin(place_m: FloatArray) -> FloatArray:
    """Round numbers that bring places (n, 3) near to zero; zero where they are."""
    flat = place_m[:, :2]
    if np.abs(flat).max() <= FARTHEST_M:
        return np.zeros(2)
    middle = 0.5 * (flat.min(0) + flat.max(0))
    return np.asarray(np.round(middle / 100.0) * 100.0)


def _ident(path: Path, name: str, taken: Collection[str]) -> str:
    """A batch's id: the file's name, and that of the scan, as far as ids allow; one that is not taken."""
    text = f"{path.stem}-{name}" if name else path.stem
    allowed = "".join(c if (c.isalnum() and c.isascii()) or c in "_-" else "-" for c in text.lower())
    ident = allowed.strip("-_")[:56] or "scan"
    return ident if ident not in taken else f"{ident}-{len(taken)}"


def _batch(ident: str, rows: FloatArray, origin_m: FloatArray, columns: Columns, setup: Setup) -> EmiScanBatch:
    place, angles, values = rows[:, :3], rows[:, 3:6], rows[:, 6:]
    turning = any((columns.heading_deg, columns.pitch_deg, columns.roll_deg))
    several, n_channels = len(setup.receivers) > 1, len(columns.fields)
    field = values.reshape(len(rows), n_channels, -1).transpose(1, 0, 2)[None]
    try:
        geometry = EmiGeometry(
            positions_m=place - np.array([*origin_m, 0.0]),
            transmitter=setup.transmitter,
            receiver=EmiReceiver() if several else setup.receivers[0],
            receivers=setup.receivers if several else None,
            attitude=quaternions(*np.nan_to_num(angles).T) if turning else None,
        )
        return EmiScanBatch(
            batch_id=ident,
            geometry=geometry,
            field=np.ascontiguousarray(field),
            field_unit=setup.field_unit,
            sigma=setup.sigma,
            options=setup.options,
            channels=["+".join(names)[:64] for names in columns.fields] if n_channels > 1 else None,
        )
    except ValidationError as error:
        raise refusal(f"Scan {ident}", error) from None
