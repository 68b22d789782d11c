"""Messages for tests, short to write."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trackmesh.protocol.messages import EmiGeometry, EmiResult, EmiScanBatch, EmiTransmitter, SensorInfo, TrackFrame


def frame(
    ids: Sequence[int] = (),
    *,
    unit: str = "main",
    boot: str = "b",
    seq: int = 0,
    t_ns: int = 1_000,
    epoch: int = 0,
    status: int = 1,
) -> TrackFrame:
    """Tracks that stand at east = id, north = epoch."""
    n = len(ids)
    state = np.zeros((n, 6))
    state[:, 0], state[:, 1] = ids, epoch
    return TrackFrame(
        unit_id=unit,
        boot_id=boot,
        seq=seq,
        t_ns=t_ns,
        track_id=np.array(ids, np.int64),
        epoch=np.full(n, epoch, np.uint32),
        status=np.full(n, status, np.uint8),
        state=state,
        covariance=np.tile(np.arange(21, dtype=np.float32), (n, 1)),
        model_probability=np.ones((n, 1)),
        models=["cv"],
        sensors=[],
        members=np.zeros((n, 0), np.int64),
        updated_t_ns=np.full(n, t_ns),
        first_t_ns=np.zeros(n, np.int64),
    )


def sensor_info(sensor: str = "north", period_s: float = 4.0) -> SensorInfo:
    return SensorInfo(
        sensor_id=sensor,
        kind="radar",
        site_enu_m=[0.0, 0.0, 0.0],
        period_s=period_s,
        p_detect=0.9,
        max_range_m=1e5,
        sigma={"range_m": 50.0, "azimuth_rad": 1e-3},
    )


def scans(n: int) -> EmiScanBatch:
    return EmiScanBatch(
        batch_id="area",
        geometry=EmiGeometry(positions_m=np.zeros((2, 3)), transmitter=EmiTransmitter(radius_m=0.5)),
        field=np.zeros((n, 1, 2, 3)),
        field_unit="nT",
    )


def emi_result(index: int) -> EmiResult:
    return EmiResult(batch_id="area", index=index, status="no_target")
