"""The wire: encode, decode and validate batches of plots, plots a second on one core.

Beside it the same plots as a list of row models, one pydantic object a plot: what the columns are for.

python -m benchmarks.wire
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Annotated

import msgpack
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.messages import PlotBatch

SIZES = (1, 18, 100, 1000)
REPEATS = 9
LEAST_S = 0.1
PEER = "list of pydantic rows, msgpack"


class PlotRow(BaseModel):
    """One plot as a model of its own, with the same bounds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    t_ns: Annotated[int, Field(ge=0, le=2**63 - 1)]
    range_m: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
    azimuth_rad: Annotated[float, Field(ge=-np.pi, le=2 * np.pi, allow_inf_nan=False)]


class RowBatch(BaseModel):
    """A batch as a list of rows."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sensor_id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    boot_id: str
    seq: Annotated[int, Field(ge=0)]
    plots: list[PlotRow]


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``."""
    for n in SIZES:
        ours, peer = measured(_both_ways(batch(n)), n), measured(_rows_both_ways(n), n)
        print(f"wire n={n}: {_line(ours)}; rows {_line(peer)}")
        yield _row(f"n={n}", float(np.median(ours)), float(np.median(peer)))
    full = measured(_both_ways(batch(100, variances=True)), 100)
    print(f"wire n=100 with variances: {_line(full)}")
    yield _row("n=100 with variances", float(np.median(full)), None)


def _row(case: str, value: float, peer_value: float | None) -> dict[str, object]:
    peer, ratio = (PEER, value / peer_value) if peer_value else (None, None)
    return {
        "bench": "wire", "case": case, "value": value, "unit": "plots/s per core",
        "peer": peer, "peer_value": peer_value, "ratio": ratio,
    }  # fmt: skip


def measured(work: Callable[[], object], plots: int) -> list[float]:
    """Plots a CPU second, of each repeat."""
    work()
    started = time.process_time()
    work()
    rounds = max(1, round(LEAST_S / max(time.process_time() - started, 1e-6)))
    speeds = []
    for _ in range(REPEATS):
        started = time.process_time()
        for _ in range(rounds):
            work()
        speeds.append(rounds * plots / (time.process_time() - started))
    return speeds


def batch(n: int, *, variances: bool = False) -> PlotBatch:
    """Plots of a radar."""
    rng = np.random.default_rng(0)
    return PlotBatch(
        sensor_id="north",
        boot_id="0123456789abcdef",
        seq=1,
        t_ns=1_700_000_000_000_000_000 + np.arange(n),
        columns=["range_m", "azimuth_rad"],
        values=np.stack([rng.uniform(1e3, 1e5, n), rng.uniform(0, 6, n)], axis=1),
        variances=np.tile([2500.0, 1e-6], (n, 1)) if variances else None,
    )


def _both_ways(message: PlotBatch) -> Callable[[], object]:
    kind = encoding(PlotBatch)
    assert decode(encode(message), PlotBatch, kind) == message
    return lambda: decode(encode(message), PlotBatch, kind)


def _rows_both_ways(n: int) -> Callable[[], object]:
    columns = batch(n)
    plots = [
        PlotRow(t_ns=t, range_m=r, azimuth_rad=a)
        for t, (r, a) in zip(columns.t_ns.tolist(), columns.values.tolist(), strict=True)
    ]
    message = RowBatch(sensor_id="north", boot_id=columns.boot_id, seq=1, plots=plots)
    return lambda: RowBatch.model_validate(msgpack.unpackb(msgpack.packb(message.model_dump())), strict=True)


def _line(speeds: list[float]) -> str:
    return f"{np.median(speeds):,.0f} plots/s (min {min(speeds):,.0f}, max {max(speeds):,.0f}, {len(speeds)} repeats)"


if __name__ == "__main__":
    for _ in rows():
        pass
