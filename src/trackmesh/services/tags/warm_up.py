"""Compiles, or loads from the cache, every kernel of the engine before the first real range."""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.messages import RangeBatch, SensorInfo
from trackmesh.services.tags.engine import TagEngine, Unit
from trackmesh.services.tags.settings import TagEngineSettings

_SECOND_NS = 1_000_000_000
_PLACES = {"a": (0.0, 0.0), "b": (20.0, 0.0), "c": (0.0, 20.0)}


def warm_up(settings: TagEngineSettings) -> None:
    """Run a tag that three readers hear, and one that only one hears, through an engine with these settings."""
    engine = TagEngine(settings.model_copy(update={"reorder_s": 0.0}), Unit())
    for name, place in _PLACES.items():
        engine.reader(_reader(name, *place))
    for k in range(4):
        engine.ranges(_batch(k, (100 + k) * _SECOND_NS))
    engine.tick(200 * _SECOND_NS)


def _reader(name: str, east: float, north: float) -> SensorInfo:
    return SensorInfo(
        sensor_id=name, kind="ranging", site_enu_m=[east, north, 0.0], period_s=1.0, p_detect=1.0, max_range_m=100.0,
        sigma={"range_m": 1.0},
    )  # fmt: skip


def _batch(seq: int, t_ns: int) -> RangeBatch:
    return RangeBatch(
        network_id="warm-up",
        boot_id="warm-up",
        seq=seq,
        t_ns=np.full(4, t_ns),
        tags=["heard", "alone"],
        readers=list(_PLACES),
        tag=np.array([0, 0, 0, 1], np.uint32),
        reader=np.array([0, 1, 2, 0], np.uint32),
        range_m=np.array([10.0, 12.0, 13.0, 5.0]),
    )
