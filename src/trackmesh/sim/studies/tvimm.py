"""The study of TV-IMM: the published comparison anew, part by part."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from trackmesh.sim.studies import tvimm_benchmark, tvimm_paper
from trackmesh.sim.studies.result import StudyResult

Part = Callable[[Path | None, int, Callable[[float], None]], StudyResult]

PARTS: tuple[Part, ...] = (tvimm_paper.compare, tvimm_benchmark.compare)
"""Each gives its own tables, rows, notes and pictures, from the folder of pictures, the runs (0: its own choice) and
whom to tell the share that is done."""


def run(plots: Path | None = None, runs: int = 0, progress: Callable[[float], None] | None = None) -> StudyResult:
    """All parts of the study, one after the other.

    Args:
        plots: folder of the pictures, made where missing; None for none.
        runs: Monte-Carlo runs; 0 for as many as each part needs.
        progress: is told the share that is done.

    Raises:
        TrackmeshError: a picture cannot be drawn.
    """
    say, result = progress or (lambda _: None), StudyResult()
    for i, part in enumerate(PARTS):
        found = part(plots, runs, partial(_tell, say, i))
        result.rows += found.rows
        result.notes += found.notes
        result.tables += found.tables
        result.pictures += found.pictures
    return result


def _tell(say: Callable[[float], None], done: int, share: float) -> None:
    """The share of all parts that is done, when so many are and this share of the next."""
    say((done + share) / len(PARTS))
