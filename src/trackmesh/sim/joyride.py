"""The Joyride recording as plots and truth: a ship's radar follows one boat in hard manoeuvres, GNSS on both.

Source: the data of "Multi-target tracking with multiple models and visibility verified on maritime radar data" (the
VIMMJIPDA tracker; Trondheim, CC0), a MATLAB file: ``time`` (k, 1) in s, ``measurements`` (k, 1) cells of (n, 2) north
and east in m with rows of inf that mean nothing, ``target`` and ``telemetron`` (k, 4) the north, its rate, east and its
rate of the boat and of the ship that carries the radar. One entry a turn of the antenna; all its plots carry one time.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter, Tick
from trackmesh.protocol.messages import Message, PlotBatch, ScanPart, SensorInfo, TruthFrame

PERIOD_S = 2.5
P_DETECT = 0.92
MAX_RANGE_M = 2200.0
SIGMA_RANGE_M, SIGMA_BEARING_RAD, SIGMA_EXTENT_M = 5.0, np.deg2rad(1.0), 6.6
"""The radar as the authors' tracker describes it: errors in range, in bearing, and alike in all directions."""

BOAT_SPEED_MPS = 10.0
"""Typical of a fast boat. A plot is of some moment within the turn: its boat was up to half a turn's way elsewhere."""

SENSOR = SensorInfo(
    sensor_id="joyride-radar",
    kind="position",
    period_s=PERIOD_S,
    p_detect=P_DETECT,
    max_range_m=MAX_RANGE_M,
    sigma={"east_m": 15.0, "north_m": 15.0},
)
_TABLES = {"time": 1, "target": 4, "telemetron": 4}


class Joyride:
    """The recording.

    Attributes:
        t_ns: (k,) times. target, ship: (k, 4) north, its rate, east and its rate.
        plots_m: k arrays (n, 2) of east and north.

    Raises:
        TrackmeshError: the file cannot be read or is not what it should be.
    """

    def __init__(self, path: Path) -> None:
        tables = _read(path)
        self.t_ns: IntArray = np.round(tables["time"][:, 0] * 1e9).astype(np.int64)
        self.target, self.ship = tables["target"], tables["telemetron"]
        self.plots_m = [_plots_m(cell, path) for cell in tables["measurements"].ravel()]

    def records(self) -> Iterator[Message]:
        """The radar and its turns; an empty turn has no time, so a tick goes before it."""
        yield SENSOR
        for seq, (t_ns, plots_m, ship) in enumerate(zip(self.t_ns.tolist(), self.plots_m, self.ship, strict=True)):
            if not len(plots_m):
                yield Tick(t_ns=t_ns)
            yield PlotBatch(
                sensor_id=SENSOR.sensor_id,
                boot_id="recording",
                seq=seq,
                t_ns=np.full(len(plots_m), t_ns),
                columns=["east_m", "north_m"],
                values=plots_m,
                variances=plot_variances_m2(plots_m - ship[[2, 0]]),
                scan=ScanPart(index=seq, sector=0, sectors=1),
            )

    def truth(self) -> Iterator[TruthFrame]:
        """Where the boat was at the time of each turn."""
        for t_ns, boat in zip(self.t_ns.tolist(), self.target, strict=True):
            yield TruthFrame(
                scenario_id="joyride", t_ns=t_ns, id=np.ones(1, np.int64), state=boat[[2, 0, 3, 1]].reshape(1, 4)
            )


def plot_variances_m2(from_ship_m: FloatArray) -> FloatArray:
    """Variances (n, 2) east and north of plots at (n, 2) from the radar.

    Errors in range and bearing turned into the plane, those alike in all directions, and the boat's way within a turn
    at unknown course, uniform over (v T)^2 / 12. Correlation is left out.
    """
    range_m = np.hypot(*from_ship_m.T)
    along = from_ship_m / np.maximum(range_m, 1.0)[:, None]
    cross = along[:, ::-1]
    polar = (along * SIGMA_RANGE_M) ** 2 + (cross * (SIGMA_BEARING_RAD * range_m)[:, None]) ** 2
    return np.asarray(polar + SIGMA_EXTENT_M**2 + (BOAT_SPEED_MPS * PERIOD_S) ** 2 / 12.0, np.float64)


def convert_joyride(path: Path, path_plots: Path, path_truth: Path | None = None) -> tuple[int, int]:
    """Write PLOTS.jsonl and, where wanted, TRUTH.jsonl; returns the numbers of batches and of plots.

    Raises:
        TrackmeshError: a file cannot be read or written.
    """
    recording = Joyride(path)
    with RecordWriter(path_plots) as out:
        for record in recording.records():
            out.write(record)
    if path_truth is not None:
        with RecordWriter(path_truth) as out:
            for frame in recording.truth():
                out.write(frame)
    return len(recording.plots_m), sum(map(len, recording.plots_m))


def _plots_m(cell: Any, path: Path) -> FloatArray:
    north_east = np.asarray(cell, np.float64)
    if north_east.size == 0:
        return np.zeros((0, 2))
    if north_east.ndim != 2 or north_east.shape[1] != 2:
        raise TrackmeshError(f"{path} is not the Joyride recording: measurements must be rows of north and east.")
    return np.ascontiguousarray(north_east[np.isfinite(north_east).all(axis=1)][:, ::-1])


def _read(path: Path) -> dict[str, Any]:
    import scipy.io

    try:
        with path.open("rb") as file:
            content: dict[str, Any] = scipy.io.loadmat(file)
    except OSError as error:
        raise TrackmeshError(f"Cannot read {path}: {error.strerror}.") from None
    except Exception:
        # The reader of MATLAB files raises whatever it stumbles over.
        raise TrackmeshError(f"{path} is no MATLAB file.") from None
    tables = {name: content.get(name) for name in (*_TABLES, "measurements")}
    for name, columns in _TABLES.items():
        table = tables[name]
        if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != columns or table.dtype.kind != "f":
            raise TrackmeshError(f"{path} is not the Joyride recording: {name} must be numbers in {columns} columns.")
        if not np.isfinite(table).all():
            raise TrackmeshError(f"{path} is not the Joyride recording: {name} holds numbers that are not finite.")
        if name == "time" and table.min(initial=0.0) < 0.0:
            raise TrackmeshError(f"{path} is not the Joyride recording: time must not be negative.")
    if len({len(table) if table is not None else -1 for table in tables.values()}) != 1:
        raise TrackmeshError(f"{path} is not the Joyride recording: its tables must be equally long.")
    return tables
