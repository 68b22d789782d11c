"""Foreign tracks that stood in the picture and fell silent: told again by their sender, they keep their ids."""

from __future__ import annotations

import json
from typing import NamedTuple

from trackmesh.protocol.messages import TrackFrame
from trackmesh.services.fusion.foreign import Rows


class _One(NamedTuple):
    link: int
    until_ns: int
    words: TrackFrame


class Absent:
    """By unit and by the id that it gives; each has ``wait_s`` after its last plot."""

    def __init__(self, wait_s: float) -> None:
        self._wait_ns = round(wait_s * 1e9)
        self._known: dict[tuple[str, int], _One] = {}

    def kept(self) -> str:
        """All of them, a line each, for ``restore``."""
        return "\n".join(
            json.dumps([*key, one.link, one.until_ns, one.words.model_dump_json()]) for key, one in self._known.items()
        )

    def restore(self, lines: str) -> None:
        """Go on with what an earlier run had ``kept``.

        Raises:
            ValueError: it is none.
        """
        for line in lines.splitlines():
            unit, ident, link, until_ns, words = json.loads(line)
            self._known[unit, ident] = _One(link, until_ns, TrackFrame.model_validate_json(words))

    def lose(self, unit: str, rows: Rows, words: TrackFrame) -> None:
        """One track is silent; ``words`` is what has to be told should it not come back."""
        until_ns = int(rows.updated_ns[0]) + self._wait_ns
        self._known[unit, int(rows.ident[0])] = _One(int(rows.link[0]), until_ns, words)

    def back(self, unit: str, ident: int) -> int | None:
        """Our id of a track that is told again, None for any other."""
        one = self._known.pop((unit, ident), None)
        return one.link if one else None

    def end(self, unit: str, idents: list[int]) -> list[TrackFrame]:
        """Last words of those that their sender says have ended."""
        return [self._known.pop((unit, ident)).words for ident in idents if (unit, ident) in self._known]

    def gone(self, now_ns: int) -> list[TrackFrame]:
        """Last words of those for which the time is over."""
        over = [key for key, one in self._known.items() if now_ns >= one.until_ns]
        return [self._known.pop(key).words for key in over]
