"""Scores over time, as a table for other programs."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from pathlib import Path

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.sim.scoring.frames import FrameScore


def write_series(scores: Iterable[FrameScore], path: Path) -> None:
    """One line a frame: its time in Unix nanoseconds, then all figures of ``FrameScore``; empty where there is none.

    Raises:
        TrackmeshError: the file cannot be written.
    """
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            lines = csv.writer(file, lineterminator="\n")
            lines.writerow(FrameScore._fields)
            lines.writerows([_cell(value) for value in score] for score in scores)
    except OSError as error:
        raise TrackmeshError(f"Cannot write {path}: {error.strerror or error}.") from None


def _cell(value: float) -> str:
    if isinstance(value, int):
        return str(int(value))
    return f"{value:.9g}" if math.isfinite(value) else ""
