"""Other units for the tests of composition: frames made by hand, and engines that hear each other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from tests.services.fusion.makers import CONFIRMED, Fleet, FloatArray, IntArray, ns

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackFrame
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings

SIGMA_M, SIGMA_MPS = 60.0, 6.0
IDENT = 7 << 41
"""Where the ids of units made by hand begin."""


def upper(P: FloatArray) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Covariances (n, 4, 4) as a frame has them."""
    full = np.zeros((len(P), 6, 6))
    full[:, :4, :4] = P
    return full[:, *np.triu_indices(6)].astype(np.float32)


def frame(t_s: float, state: FloatArray, **change: Any) -> TrackFrame:
    """Confirmed tracks (n, 4) of the unit ``other``, just seen, each axis known to 60 m and 6 m/s."""
    state = np.asarray(state, float).reshape(-1, 4)
    n = len(state)
    P = np.tile(np.diag([SIGMA_M, SIGMA_M, SIGMA_MPS, SIGMA_MPS]) ** 2, (n, 1, 1))
    known: dict[str, Any] = {
        "unit_id": "other", "boot_id": "one", "seq": round(t_s * 10), "t_ns": ns(t_s),
        "track_id": IDENT + np.arange(n), "epoch": np.zeros(n, np.uint32),
        "status": np.full(n, CONFIRMED, np.uint8), "state": np.pad(state, ((0, 0), (0, 2))), "covariance": upper(P),
        "model_probability": np.zeros((n, 0)), "models": [], "sensors": ["far"],
        "members": np.arange(n).reshape(-1, 1), "updated_t_ns": np.full(n, ns(t_s)), "first_t_ns": np.full(n, ns(0.0)),
    }  # fmt: skip
    return TrackFrame(**known | change)


class Sender:
    """A unit that tracks a fleet, with errors of the covariance that it tells; ``change`` holds for all its frames."""

    def __init__(self, fleet: Fleet, seed: int = 5, **change: Any) -> None:
        self._fleet = fleet
        self._rng = np.random.default_rng(seed)
        self._change = change

    def at(self, t_s: float, **change: Any) -> TrackFrame:
        """Its frame of this time."""
        n = len(self._fleet.start)
        error = self._rng.normal(size=(n, 4)) * [SIGMA_M, SIGMA_M, SIGMA_MPS, SIGMA_MPS]
        state = np.concatenate([self._fleet.at(t_s), self._fleet.velocity], axis=1) + error
        return frame(t_s, state, **self._change | change)


def unit(
    name: str, number: int, *sensors: SensorInfo, inputs: Sequence[str] = ("other",), **settings: Any
) -> FusionEngine:
    """An engine that takes the tracks of other units."""
    out = FusionEngine(EngineSettings(**settings), Unit(name, number, f"boot-{name}", 1), inputs=inputs)
    for info in sensors:
        out.sensor(info)
    return out


Event = tuple[float, PlotBatch | TrackFrame]


def events(batches: Iterable[PlotBatch] = (), told: Iterable[TrackFrame] = ()) -> list[Event]:
    """Plots and frames by their times."""
    every: list[Event] = [(float(b.t_ns.max()), b) for b in batches]
    every += [(float(f.t_ns), f) for f in told]
    return sorted(every, key=lambda one: one[0])


def take(engine: FusionEngine, one: PlotBatch | TrackFrame) -> TrackFrame | None:
    got = engine.plots(one) if isinstance(one, PlotBatch) else engine.tracks(one)
    if got is not None:
        assert decode(encode(got), TrackFrame) == got
    return got


def run(engine: FusionEngine, every: Iterable[Event]) -> list[TrackFrame]:
    """The frames that it gives, each checked by the rules of the protocol."""
    return [got for _, one in every if (got := take(engine, one)) is not None]


class Realm:
    """Units that hear each other at once; each unit's inputs are those of its engine.

    Attributes:
        frames: of each unit.
    """

    def __init__(self, *engines: FusionEngine) -> None:
        self.engines = {engine.unit.unit_id: engine for engine in engines}
        self.frames: dict[str, list[TrackFrame]] = {name: [] for name in self.engines}

    def plots(self, unit_id: str, batch: PlotBatch) -> None:
        self._publish(take(self.engines[unit_id], batch))

    def tick(self, t_s: float) -> None:
        for engine in self.engines.values():
            self._publish(engine.tick(ns(t_s)))

    def _publish(self, told: TrackFrame | None) -> None:
        waiting = [told] if told is not None else []
        while waiting:
            one = waiting.pop(0)
            self.frames[one.unit_id].append(one)
            for engine in self.engines.values():
                if one.unit_id in engine.inputs.banks:
                    got = take(engine, one)
                    waiting += [got] if got is not None else []


def rows_where(told: TrackFrame, condition: Callable[[TrackFrame], Any]) -> IntArray:
    """Indices of the tracks for which a condition on the arrays of a frame holds."""
    return np.flatnonzero(condition(told))
