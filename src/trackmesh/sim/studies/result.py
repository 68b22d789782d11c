"""What a study gives: rows for other programs, tables, notes and pictures for people."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from trackmesh.protocol.errors import TrackmeshError


class Table(NamedTuple):
    """A table for people: plain text, whoever shows it."""

    title: str
    header: list[str]
    rows: list[list[str]]


@dataclass
class StudyResult:
    """The result of a study.

    Attributes:
        rows: as ``study_row`` makes them.
        notes: sentences on what was compared, what agrees and what cannot.
        tables: the same and more, for people.
        pictures: files that were drawn.
    """

    rows: list[dict[str, object]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    pictures: list[Path] = field(default_factory=list)

    def write_json(self, path: Path) -> None:
        """Write the rows as a JSON list.

        Raises:
            TrackmeshError: the file cannot be written, or a value is not a finite number.
        """
        try:
            path.write_text(json.dumps(self.rows, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        except OSError as error:
            raise TrackmeshError(f"Cannot write {path}: {error.strerror or error}.") from None
        except ValueError:
            raise TrackmeshError(f"Cannot write {path}: a result is not a finite number.") from None


def study_row(
    table: str,
    row: str,
    column: str,
    *,
    paper: float | None,
    ours: float | None,
    ours_std: float | None = None,
    runs: int = 0,
) -> dict[str, object]:
    """One cell of a table of a paper beside ours; None where there is no number, 0 runs for what is not simulated."""
    return {
        "table": table,
        "row": row,
        "column": column,
        "paper": paper,
        "ours": ours,
        "ours_std": ours_std,
        "runs": runs,
    }
