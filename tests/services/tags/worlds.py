"""A small hall for the engine: readers, tags that stand or walk, batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from tests.services.tags.makers import FloatArray

from trackmesh.protocol.messages import RangeBatch, SensorInfo, TagFrame
from trackmesh.services.tags.engine import TagEngine, Unit
from trackmesh.services.tags.settings import TagEngineSettings

S = 1_000_000_000
T0 = 1_700_000_000 * S
CORNERS = {"sw": (0.0, 0.0), "se": (40.0, 0.0), "ne": (40.0, 40.0), "nw": (0.0, 40.0)}
SIGMA = 0.3


def reader(name: str, east: float, north: float, **more: Any) -> SensorInfo:
    fields: dict[str, Any] = {"period_s": 0.1, "p_detect": 0.9, "max_range_m": 60.0, "sigma": {"range_m": SIGMA}}
    return SensorInfo(sensor_id=name, kind="ranging", site_enu_m=[east, north, 0.0], **fields | more)


def batch(seq: int, rows: Sequence[tuple[float, str, str, float]], **change: Any) -> RangeBatch:
    """Ranges of (time in s, tag, reader, metres)."""
    tags, readers = sorted({r[1] for r in rows}), sorted({r[2] for r in rows})
    fields: dict[str, Any] = {
        "network_id": "hall",
        "boot_id": "boot",
        "seq": seq,
        "t_ns": np.array([T0 + round(r[0] * S) for r in rows], np.int64),
        "tags": tags,
        "readers": readers,
        "tag": np.array([tags.index(r[1]) for r in rows], np.uint32),
        "reader": np.array([readers.index(r[2]) for r in rows], np.uint32),
        "range_m": np.array([r[3] for r in rows], np.float64),
    }
    return RangeBatch(**fields | change)


class Hall:
    """An engine with four readers, and the hand that feeds it."""

    def __init__(self, readers: dict[str, tuple[float, float]] | None = None, **settings: Any) -> None:
        given = {"frame_period_s": 0.0, "reorder_s": 0.0, "range_sigma_m": SIGMA} | settings
        self.engine = TagEngine(TagEngineSettings(**given), Unit())
        self.places = dict(CORNERS if readers is None else readers)
        for name, place in self.places.items():
            self.engine.reader(reader(name, *place))
        self.rng = np.random.default_rng(11)
        self.seq = 0

    def rows(
        self, t_s: float, tag: str, place: tuple[float, float], readers: Sequence[str] = (), noise: float = SIGMA
    ) -> list[tuple[float, str, str, float]]:
        """Ranges of one tag at one time to these readers, or to all."""
        names = list(readers) or list(self.places)
        d = [float(np.hypot(*np.subtract(place, self.places[name]))) for name in names]
        return [(t_s, tag, name, max(m + noise * self.rng.normal(), 0.0)) for name, m in zip(names, d, strict=True)]

    def put(self, rows: Sequence[tuple[float, str, str, float]], **change: Any) -> TagFrame | None:
        self.seq += 1
        return self.engine.ranges(batch(self.seq, rows, **change))

    def stand(self, tag: str, place: tuple[float, float], begin_s: float, end_s: float) -> TagFrame:
        """A tag stands and is heard by all readers ten times a second; the last frame."""
        frame = None
        for k in range(round(10 * (end_s - begin_s))):
            frame = self.put(self.rows(begin_s + 0.1 * k, tag, place))
        assert frame is not None
        return frame

    def tick(self, t_s: float) -> TagFrame | None:
        return self.engine.tick(T0 + round(t_s * S))

    def count(self, name: str) -> int:
        return self.engine.counts().get(name, 0)


def place_of(frame: TagFrame | None, tag: str) -> FloatArray:
    """Where a frame says that a tag is."""
    assert frame is not None
    return np.asarray(frame.state[frame.tag_id.index(tag), :2])


def status_of(frame: TagFrame | None, tag: str) -> int:
    assert frame is not None
    return int(frame.status[frame.tag_id.index(tag)])
