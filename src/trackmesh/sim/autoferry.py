"""The Autoferry recordings as plots and truth: a ferry's radar and lidar among instrumented boats.

Source: Autoferry sensor fusion dataset (Trondheim 2021, CC0), "Heterogeneous multi-sensor tracking for an autonomous
surface vehicle in a littoral environment", Ocean Engineering 2022. A file ``scenarioN_detections.json`` lists what each
sensor saw, in order of arrival; entry k of ``scenarioN_groundTruth.json`` tells where the boats were then. Radar and
lidar give north and east from the own ship, stored as a row of norths and a row of easts, as one bare pair, or as an
empty list. The system plane has its origin at the recordings' common reference point.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter, Tick
from trackmesh.protocol.messages import Geodetic, Message, PlotBatch, ScanPart, SensorInfo, TruthFrame
from trackmesh.protocol.messages.base import Finite

ORIGIN = Geodetic(latitude_deg=63.4389029083, longitude_deg=10.39908278, height_m=39.923)
LIDAR, RADAR = 1, 2
"""The recordings' numbers of the two sensors that give positions; the others are cameras."""

VELOCITY_BASE_S = 0.5
"""A boat's velocity is its way over this time before and after."""

T = TypeVar("T")
Pair = Annotated[list[Finite], Field(min_length=2, max_length=2)]


def _sensor(name: str, period_s: float, p_detect: float, max_range_m: float, sigma_m: float) -> SensorInfo:
    return SensorInfo(
        sensor_id=name,
        kind="position",
        period_s=period_s,
        p_detect=p_detect,
        max_range_m=max_range_m,
        sigma={"east_m": sigma_m, "north_m": sigma_m},
    )


SENSORS = {
    RADAR: _sensor("autoferry-radar", 1.0 / 0.6, 0.85, 500.0, 7.0),
    LIDAR: _sensor("autoferry-lidar", 0.5, 0.6, 130.0, 2.0),
}


class Detection(BaseModel):
    """One entry of a detections file; positions are north, east."""

    sensorID: int
    time: Annotated[float, Field(ge=0.0, le=4.0e9)]
    ownshipPosition: Pair
    measurement: Finite | list[Finite] | list[list[Finite]]

    @property
    def t_ns(self) -> int:
        """UTC nanoseconds."""
        return round(self.time * 1e9)

    def positions_m(self) -> FloatArray:
        """East, north (m, 2) of what was seen, in the system plane.

        Raises:
            ValueError: the measurement is not two rows of one length.
        """
        seen = np.array(self.measurement, np.float64)
        rows = seen.reshape(2, -1) if seen.size else np.zeros((2, 0))
        return np.asarray((rows.T + np.array(self.ownshipPosition))[:, ::-1], np.float64)


class Boat(BaseModel):
    """Where one boat was; position is north, east, down."""

    targetID: int
    time: Annotated[float, Field(ge=0.0, le=4.0e9)]
    position: Annotated[list[Finite], Field(min_length=3, max_length=3)]


class Autoferry:
    """One scenario of the recordings.

    Raises:
        TrackmeshError: a file is missing or is not what it should be; the sentence says which and why.
    """

    def __init__(self, detections: Path) -> None:
        self.detections = _read(detections, TypeAdapter(list[Detection]))
        beside = detections.with_name(detections.name.replace("_detections", "_groundTruth"))
        self.boats = _read(beside, TypeAdapter(list[list[Boat]]))
        if beside == detections or len(self.boats) != len(self.detections):
            raise TrackmeshError(f"{beside} does not belong to {detections}: the numbers of entries differ.")
        number = re.search(r"\d+", detections.name)
        self.scenario_id = f"autoferry-{number.group() if number else 'recording'}"

    def records(self) -> Iterator[Message]:
        """Origin, sensors and batches in order of arrival; an empty batch has no time, so a tick goes before it."""
        yield ORIGIN
        yield from SENSORS.values()
        seq = dict.fromkeys(SENSORS, 0)
        for number, detection in enumerate(self.detections):
            if detection.sensorID in SENSORS:
                batch = self._batch(number, detection, seq[detection.sensorID])
                seq[detection.sensorID] += 1
                if not len(batch.t_ns):
                    yield Tick(t_ns=detection.t_ns)
                yield batch

    def truth(self) -> Iterator[TruthFrame]:
        """The boats at the time of each entry, in order of time, where the file says that they were."""
        paths = self._paths()
        entries = zip(self.detections, self.boats, strict=True)
        for detection, boats in sorted(entries, key=lambda entry: entry[0].time):
            states = [
                [boat.position[1], boat.position[0], *_velocity(*paths[boat.targetID], detection.time)]
                for boat in boats
            ]
            yield TruthFrame(
                scenario_id=self.scenario_id,
                t_ns=detection.t_ns,
                id=np.array([boat.targetID for boat in boats], np.int64),
                state=np.array(states, np.float64).reshape(-1, 4),
            )

    def _batch(self, number: int, detection: Detection, seq: int) -> PlotBatch:
        try:
            values = detection.positions_m()
        except ValueError:
            raise TrackmeshError(
                f"The measurement of entry {number} is not a row of norths and a row of easts."
            ) from None
        return PlotBatch(
            sensor_id=SENSORS[detection.sensorID].sensor_id,
            boot_id="recording",
            seq=seq,
            t_ns=np.full(len(values), detection.t_ns),
            columns=["east_m", "north_m"],
            values=values,
            scan=ScanPart(index=seq, sector=0, sectors=1),
        )

    def _paths(self) -> dict[int, tuple[FloatArray, FloatArray]]:
        """Times and positions [east, north] of each boat's fixes."""
        fixes: dict[int, dict[float, list[float]]] = {}
        for boat in (boat for boats in self.boats for boat in boats):
            fixes.setdefault(boat.targetID, {})[boat.time] = [boat.position[1], boat.position[0]]
        return {
            target: (np.array(sorted(fix)), np.array([fix[t] for t in sorted(fix)])) for target, fix in fixes.items()
        }


def convert_autoferry(detections: Path, path_plots: Path, path_truth: Path | None = None) -> tuple[int, int]:
    """Write PLOTS.jsonl and, where wanted, TRUTH.jsonl; returns the numbers of batches and of plots.

    Raises:
        TrackmeshError: a file cannot be read or written.
    """
    recording, n_batches, n_plots = Autoferry(detections), 0, 0
    with RecordWriter(path_plots) as out:
        for record in recording.records():
            out.write(record)
            if isinstance(record, PlotBatch):
                n_batches, n_plots = n_batches + 1, n_plots + len(record.t_ns)
    if path_truth is not None:
        with RecordWriter(path_truth) as out:
            for frame in recording.truth():
                out.write(frame)
    return n_batches, n_plots


def _velocity(t_s: FloatArray, position_m: FloatArray, at_s: float) -> list[float]:
    span = np.clip([at_s - VELOCITY_BASE_S, at_s + VELOCITY_BASE_S], t_s[0], t_s[-1])
    if span[1] <= span[0]:
        return [0.0, 0.0]
    ends = [np.interp(span, t_s, position_m[:, axis]) for axis in (0, 1)]
    return [float((late - early) / (span[1] - span[0])) for early, late in ends]


def _read(path: Path, kind: TypeAdapter[T]) -> T:
    try:
        return kind.validate_json(path.read_bytes())
    except OSError as error:
        raise TrackmeshError(f"Cannot read {path}: {error.strerror}.") from None
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(step) for step in first["loc"])
        at = f" at {where}" if where else ""
        raise TrackmeshError(f"{path} is no Autoferry recording: {first['msg']}{at}.") from None
