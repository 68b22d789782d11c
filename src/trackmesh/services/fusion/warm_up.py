"""Compiles, or loads from the cache, every kernel of the engine before the first real plot."""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackQuery
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings

SECOND_NS = 1_000_000_000


def warm_up(settings: EngineSettings, inputs: bool = False) -> None:
    """Run a scene of two sensors, one of them with elevations, and three targets through an engine; maybe an input."""
    settings = settings.model_copy(update={"cycle_s": 1.0})
    engine = FusionEngine(settings, Unit(), inputs=["other"] if inputs else ())
    for name in ("a", "b"):
        engine.sensor(scene_sensor(name))
    for k in range(8):
        for offset, name in enumerate("ab"):
            # One batch comes late, so that replay is compiled too.
            late = 3 if (k, name) == (6, "b") else 0
            frame = engine.plots(scene_batch(name, k, (2 * k + offset - late) * SECOND_NS))
            if inputs and frame is not None:
                engine.tracks(frame.model_copy(update={"unit_id": "other"}))
    engine.query(TrackQuery(at_t_ns=100 * SECOND_NS))
    engine.tick(1000 * SECOND_NS)


def scene_sensor(name: str) -> SensorInfo:
    """A radar in the middle of the scene; all but the first measure elevations."""
    return SensorInfo(
        sensor_id=name, kind="radar", site_enu_m=[0.0, 0.0, 0.0], period_s=2.0, p_detect=0.9, max_range_m=1e5,
        sigma={"range_m": 50.0, "azimuth_rad": 1e-3, "elevation_rad": 1e-3},
    )  # fmt: skip


def scene_batch(name: str, seq: int, t_ns: int) -> PlotBatch:
    """Its plots of three targets."""
    t = np.array([t_ns, t_ns + 1, t_ns + 2]) + 100 * SECOND_NS
    columns = ["range_m", "azimuth_rad"] if name == "a" else ["range_m", "azimuth_rad", "elevation_rad"]
    values = np.array([[1e4, 0.5, 0.1], [1.01e4, 0.5, 0.1], [5e4, 3.0, 0.1]])[:, : len(columns)]
    return PlotBatch(sensor_id=name, boot_id="warm-up", seq=seq, t_ns=t, columns=columns, values=values)
