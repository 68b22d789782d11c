"""Names of tags and the rows that hold them; rows of tags that are gone serve again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]


class Roll:
    """Which row holds which tag.

    Attributes:
        size: rows there are, in use or not. names: of each row, "" where it is nobody's.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._row: dict[str, int] = {}
        self._free: list[int] = []
        self.names: list[str] = []

    def __len__(self) -> int:
        return len(self._row)

    @property
    def size(self) -> int:
        """Rows there are, in use or not."""
        return len(self.names)

    def rows(self, names: Sequence[str]) -> IntArray:
        """Rows of tags by name; a new tag gets one, or -1 when there are as many as there may be."""
        known = self._row
        return np.array([known[name] if name in known else self._enter(name) for name in names], np.int64)

    def release(self, rows: IntArray) -> None:
        """Forget the tags of rows."""
        for row in rows.tolist():
            del self._row[self.names[row]]
            self.names[row] = ""
            self._free.append(row)

    def _enter(self, name: str) -> int:
        if len(self._row) >= self._most:
            return -1
        if self._free:
            row = self._free.pop()
            self.names[row] = name
        else:
            row = len(self.names)
            self.names.append(name)
        self._row[name] = row
        return row
