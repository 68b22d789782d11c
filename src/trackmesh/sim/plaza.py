"""The Plaza recordings as ranges and truth: a mowing robot whose radio ranges to four beacons, with RTK GPS beside it.

Source: Djugash, Hamner and Roth, "Navigating with Ranging Radios: Five Data Sets with Ground Truth", Journal of Field
Robotics 2009, as MATLAB files. Here the beacons are readers and the robot's antenna is a tag. ``TD`` holds rows of
time, antenna, beacon and range, ``TL`` beacon, x and y, ``GT`` time, x, y and heading. The rows are not all in order of
time; they are put in order, since the truth agrees with their times.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter
from trackmesh.protocol.messages import Message, RangeBatch, SensorInfo, TruthFrame
from trackmesh.sim.recording import START_NS
from trackmesh.sim.tags import tag_name

SIGMA_M = 1.0
"""Noise that is told of the ranges; it is what such radios are sold with, and not looked up in the truth."""

REACH_M = 100.0
TRUTH_PERIOD_S = 0.2
_TABLES = {"TD": 4, "TL": 3, "GT": 4}


class Plaza:
    """One Plaza recording.

    Attributes:
        ranges: (m, 4) time, antenna, beacon, metres, in order of time.
        beacons: (4, 3) beacon, x, y. path: (k, 4) time, x, y, heading.

    Raises:
        TrackmeshError: the file cannot be read or is not what it should be.
    """

    def __init__(self, path: Path) -> None:
        tables = _read(path)
        self.beacons, self.path = tables["TL"], tables["GT"]
        self.ranges = tables["TD"][np.argsort(tables["TD"][:, 0], kind="stable")]
        if not np.isin(self.ranges[:, 2], self.beacons[:, 0]).all():
            raise TrackmeshError(f"{path} holds ranges to beacons that it does not place.")
        self.scenario_id = "".join(c for c in path.stem.lower() if c.isalnum()) or "plaza"
        self._begin_s = float(min(self.ranges[0, 0], self.path[0, 0]))

    def records(self) -> Iterator[Message]:
        """Readers, and a batch a range."""
        for beacon, x, y in self.beacons.tolist():
            yield SensorInfo(
                sensor_id=_reader_name(beacon),
                kind="ranging",
                site_enu_m=[x, y, 0.0],
                period_s=1.0,
                p_detect=1.0,
                max_range_m=REACH_M,
                sigma={"range_m": SIGMA_M},
            )
        for seq, (t_s, _, beacon, metres) in enumerate(self.ranges.tolist()):
            yield RangeBatch(
                network_id=self.scenario_id,
                boot_id=self.scenario_id,
                seq=seq,
                t_ns=np.array([self.t_ns(t_s)]),
                tags=[tag_name(1)],
                readers=[_reader_name(beacon)],
                tag=np.zeros(1, np.uint32),
                reader=np.zeros(1, np.uint32),
                range_m=np.array([metres]),
            )

    def truth(self) -> Iterator[TruthFrame]:
        """Where the robot was, five times a second at most."""
        last_s = -np.inf
        for t_s, x, y, _ in self.path.tolist():
            if t_s - last_s >= 0.99 * TRUTH_PERIOD_S:
                last_s = t_s
                state = np.array([[x, y, *self._velocity(t_s)]])
                yield TruthFrame(scenario_id=self.scenario_id, t_ns=self.t_ns(t_s), id=np.array([1]), state=state)

    def positions(self, t_ns: np.ndarray[tuple[int], np.dtype[np.int64]]) -> FloatArray:
        """Where the robot was (n, 2) at times (n,)."""
        t_s = (t_ns - START_NS) / 1e9 + self._begin_s
        return np.column_stack([np.interp(t_s, self.path[:, 0], self.path[:, axis]) for axis in (1, 2)])

    def t_ns(self, t_s: float) -> int:
        """UTC nanoseconds: the recordings tell no date, so they begin when recordings of ours do."""
        return START_NS + round((t_s - self._begin_s) * 1e9)

    def _velocity(self, t_s: float) -> list[float]:
        span = np.array([t_s - 0.5, t_s + 0.5])
        return [float(np.diff(np.interp(span, self.path[:, 0], self.path[:, axis]))[0]) for axis in (1, 2)]


def convert_plaza(mat: Path, ranges: Path, truth: Path | None) -> int:
    """Write RANGES.jsonl and, where wanted, TRUTH.jsonl; returns the number of ranges.

    Raises:
        TrackmeshError: a file cannot be read or written.
    """
    plaza = Plaza(mat)
    with RecordWriter(ranges) as out:
        for record in plaza.records():
            out.write(record)
    if truth is not None:
        with RecordWriter(truth) as out:
            for frame in plaza.truth():
                out.write(frame)
    return len(plaza.ranges)


def _reader_name(beacon: float) -> str:
    return f"beacon-{beacon:.0f}"


def _read(path: Path) -> dict[str, FloatArray]:
    import scipy.io

    try:
        content: dict[str, Any] = scipy.io.loadmat(path)
    except OSError as error:
        raise TrackmeshError(f"Cannot read {path}: {error.strerror or error}.") from None
    except Exception:
        # The reader of MATLAB files raises whatever it stumbles over.
        raise TrackmeshError(f"{path} is no MATLAB file.") from None
    for name, columns in _TABLES.items():
        table = content.get(name)
        if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != columns or not len(table):
            raise TrackmeshError(f"{path} has no table {name} of {columns} columns.")
        if not np.isfinite(np.asarray(table, float)).all():
            raise TrackmeshError(f"The table {name} of {path} holds numbers that are not finite.")
    return {name: np.asarray(content[name], float) for name in _TABLES}
