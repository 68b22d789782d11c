"""Simulated or surveyed truth, for scoring only."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import model_validator
from pydantic_core import PydanticCustomError

from trackmesh.protocol.arrays import ArrayField, FloatArray, IntArray
from trackmesh.protocol.messages.base import Id, TopMessage, UnixNs


class TruthFrame(TopMessage):
    """Where the targets are at ``t_ns``: ``state`` has 4 columns (position, velocity) or 6 (and acceleration)."""

    scenario_id: Id
    t_ns: UnixNs
    id: Annotated[IntArray, ArrayField("<i8", ("n",))]
    state: Annotated[FloatArray, ArrayField("<f8", ("n", None))]

    @model_validator(mode="after")
    def _columns(self) -> Self:
        if len(self.id) == 0:
            # JSON does not tell how many columns nothing has.
            self._make_empty("state", (0, 4))
        elif self.state.shape[1] not in (4, 6):
            raise PydanticCustomError("wrong_length", "state must have 4 or 6 columns")
        return self
