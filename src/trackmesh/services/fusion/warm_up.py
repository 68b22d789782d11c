"""Compiles, or loads from the cache, every kernel of the engine before the first real plot."""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackQuery
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings

_SECOND_NS = 1_000_000_000


def warm_up(settings: EngineSettings) -> None:
    """Run a small scene of two sensors and three targets through an engine with these settings."""
    engine = FusionEngine(settings.model_copy(update={"cycle_s": 1.0}), Unit())
    for name in ("a", "b"):
        engine.sensor(_sensor(name))
    for k in range(8):
        for offset, name in enumerate("ab"):
            # One batch comes late, so that replay is compiled too.
            late = 3 if (k, name) == (6, "b") else 0
            engine.plots(_batch(name, k, (2 * k + offset - late) * _SECOND_NS))
    engine.query(TrackQuery(at_t_ns=100 * _SECOND_NS))
    engine.tick(1000 * _SECOND_NS)


def _sensor(name: str) -> SensorInfo:
    return SensorInfo(
        sensor_id=name, kind="radar", site_enu_m=[0.0, 0.0, 0.0], period_s=2.0, p_detect=0.9, max_range_m=1e5,
        sigma={"range_m": 50.0, "azimuth_rad": 1e-3},
    )  # fmt: skip


def _batch(name: str, seq: int, t_ns: int) -> PlotBatch:
    t = np.array([t_ns, t_ns + 1, t_ns + 2]) + 100 * _SECOND_NS
    values = np.array([[1e4, 0.5], [1.01e4, 0.5], [5e4, 3.0]])
    return PlotBatch(
        sensor_id=name, boot_id="warm-up", seq=seq, t_ns=t, columns=["range_m", "azimuth_rad"], values=values
    )  # fmt: skip
