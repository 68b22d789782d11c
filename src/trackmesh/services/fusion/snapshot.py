"""A unit's tracks kept over a restart: the engine's state as arrays, and as one file.

What is kept: the system and the local tracks with their filters and remembered plots, lost tracks that may come back,
numbers, sensors with their clutter, the registration, and how far the batches of each sensor were taken. What is not:
the sums of the sequential tests, which are learnt again within some cycles. A state made with other settings, or by
another version, is refused whole.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.codec import from_object
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RegistrationRecord
from trackmesh.protocol.messages import Geodetic, SensorInfo

Arrays = dict[str, npt.NDArray[Any]]

VERSION = 1


class Snapshot(NamedTuple):
    """The state of an engine at ``t_ns``.

    Attributes:
        t_ns: its time.
        settings: of the engine, as JSON types.
        numbers: counts and ids, as JSON types.
        origin: of the system plane.
        sensors: in the order of the engine.
        registration: what is known of their biases.
        streams: by sensor, the boot id and the number of the last batch taken.
        arrays: of layers, by name.
    """

    t_ns: int
    settings: dict[str, Any]
    numbers: dict[str, Any]
    origin: Geodetic | None
    sensors: list[SensorInfo]
    registration: RegistrationRecord | None
    streams: dict[str, list[Any]]
    arrays: Arrays


def to_bytes(snapshot: Snapshot) -> bytes:
    """A snapshot as an uncompressed npz archive."""
    told = {
        "version": VERSION,
        "t_ns": snapshot.t_ns,
        "settings": snapshot.settings,
        "numbers": snapshot.numbers,
        "origin": snapshot.origin and snapshot.origin.model_dump(mode="json"),
        "sensors": [info.model_dump(mode="json") for info in snapshot.sensors],
        "registration": snapshot.registration and snapshot.registration.model_dump(mode="json"),
        "streams": snapshot.streams,
    }
    file = io.BytesIO()
    about = np.frombuffer(json.dumps(told).encode(), np.uint8)
    np.savez(file, allow_pickle=False, about=about, **snapshot.arrays)
    return file.getvalue()


def from_bytes(data: bytes) -> Snapshot:
    """The snapshot that ``to_bytes`` wrote.

    Raises:
        TrackmeshError: it is none, or of another version.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays: Arrays = {name: archive[name] for name in archive.files}
        told = json.loads(arrays.pop("about").tobytes())
        if told["version"] != VERSION:
            raise TrackmeshError("The state was written by another version of trackmesh.")
        return Snapshot(
            t_ns=int(told["t_ns"]),
            settings=dict(told["settings"]),
            numbers=dict(told["numbers"]),
            origin=from_object(told["origin"], Geodetic) if told["origin"] else None,
            sensors=[from_object(info, SensorInfo) for info in told["sensors"]],
            registration=from_object(told["registration"], RegistrationRecord) if told["registration"] else None,
            streams={str(name): list(last) for name, last in told["streams"].items()},
            arrays=arrays,
        )
    except TrackmeshError:
        raise
    except Exception:
        raise TrackmeshError("This is no state of a fusion unit.") from None


def write(path: Path, data: bytes) -> None:
    """Make a file hold these bytes; whoever reads it meanwhile sees the old ones or the new ones, whole.

    Raises:
        TrackmeshError: it cannot be written.
    """
    beside = path.with_name(path.name + ".new")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except OSError as error:
        raise TrackmeshError(f"Cannot write {path}: {error.strerror or error}.") from None


def named(prefix: str, arrays: Arrays) -> Arrays:
    """Arrays with their names behind a prefix."""
    return {f"{prefix}/{name}": value for name, value in arrays.items()}


def under(prefix: str, arrays: Arrays) -> Arrays:
    """The arrays behind a prefix, without it."""
    return {name[len(prefix) + 1 :]: value for name, value in arrays.items() if name.startswith(f"{prefix}/")}


def fill(target: npt.NDArray[Any], rows: npt.NDArray[np.int64], arrays: Arrays, name: str) -> None:
    """Put a kept array into rows of a living one.

    Raises:
        TrackmeshError: it is missing, or of another shape or type.
    """
    value = arrays.get(name)
    if value is None or value.dtype != target.dtype or value.shape != (len(rows), *target.shape[1:]):
        raise TrackmeshError("The state is not that of a unit with these settings.")
    target[rows] = value
