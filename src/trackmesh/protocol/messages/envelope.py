"""The envelope in which every answer to a query travels.

``ok`` carries one message (``schema_name`` names it, ``payload`` is it); ``error`` a code and a sentence; ``end``
closes every answer with the count of the ``ok`` before it, so that a service that died half-way is told from one that
was done.
"""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import model_validator
from pydantic_core import PydanticCustomError

from trackmesh.protocol.messages.base import Count, TopMessage


class Envelope(TopMessage):
    """One reply to a query."""

    kind: Literal["ok", "error", "end"]
    schema_name: str | None = None
    payload: dict[str, Any] | None = None
    code: str | None = None
    detail: str | None = None
    count: Count | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed = {"ok": ("schema_name", "payload"), "error": ("code", "detail"), "end": ("count",)}[self.kind]
        for name in needed:
            if getattr(self, name) is None:
                raise PydanticCustomError("missing_field", "{kind} needs {name}", {"kind": self.kind, "name": name})
        return self
