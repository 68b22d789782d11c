"""The two-radar scenario of the peer study, where it is beside the repository, as batches of ours."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from trackmesh.protocol.messages import ENDED, PlotBatch, ScanPart, SensorInfo, TrackFrame

PEERS = Path(__file__).resolve().parents[2] / "shared" / "peers"
START_NS = 1_700_000_000_000_000_000

Rearrange = Callable[[Any, Any], Any]
"""Makes another truth (k, n, 4) of the times (k,) and the truth that the scenario draws."""


class Case(NamedTuple):
    """One run: the scenario, its sensors and batches as messages."""

    scenario: Any
    sensors: list[SensorInfo]
    batches: list[PlotBatch]

    @property
    def plots(self) -> int:
        """How many plots there are."""
        return sum(len(b.t_ns) for b in self.batches)


def available() -> bool:
    """Whether the peer study is there."""
    return (PEERS / "scenario.py").exists()


def make(
    seed: int,
    n_targets: int = 50,
    sectors: int = 1,
    duration_s: float = 300.0,
    *,
    radars: dict[str, float] | None = None,
    rearrange: Rearrange | None = None,
) -> Case:
    """The scenario as messages; plots carry the time of their batch, as the peers saw them.

    ``radars`` changes parameters of both radars (``p_detect``, ``clutter_per_scan``); ``rearrange`` makes another truth
    of the scenario's before it is observed.
    """
    module = _module("scenario")
    both = tuple(replace(radar, **radars or {}) for radar in module.RADARS)
    with _truth(module, rearrange):
        scenario = module.make(seed, n_targets=n_targets, sectors=sectors, duration_s=duration_s, radars=both)
    batches = [_batch(scenario.radars[s.radar], seq, s, sectors) for seq, s in enumerate(scenario.scans)]
    return Case(scenario, [_sensor(r) for r in scenario.radars], batches)


def score(case: Case, frames: list[TrackFrame]) -> dict[str, float]:
    """The peers' own score: GOSPA, OSPA, RMSE, missed, false, identity switches."""
    shown = []
    for frame in frames:
        live = frame.status != ENDED
        shown.append(((frame.t_ns - START_NS) / 1e9, frame.track_id[live].tolist(), frame.state[live, :2]))
    result: dict[str, float] = _module("score").score(shown, case.scenario)
    return result


def _module(name: str) -> ModuleType:
    # The peers' modules import each other by plain names.
    if str(PEERS) not in sys.path:
        sys.path.insert(0, str(PEERS))
    spec = importlib.util.spec_from_file_location(f"peers_{name}", PEERS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules.get(spec.name) or importlib.util.module_from_spec(spec)
    if spec.name not in sys.modules:
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    return module


@contextmanager
def _truth(module: ModuleType, rearrange: Rearrange | None) -> Iterator[None]:
    """The scenario takes no truth from outside: for the time of the block it draws another one."""
    drawn = module.make_truth

    def rearranged(*args: Any, **kwargs: Any) -> Any:
        t_s, truth = drawn(*args, **kwargs)
        return t_s, truth if rearrange is None else rearrange(t_s, truth)

    module.make_truth = rearranged  # type: ignore[attr-defined]
    try:
        yield
    finally:
        module.make_truth = drawn  # type: ignore[attr-defined]


def _sensor(radar: Any) -> SensorInfo:
    return SensorInfo(
        sensor_id=radar.name,
        kind="radar",
        site_enu_m=[radar.east, radar.north, 0.0],
        period_s=radar.period_s,
        p_detect=radar.p_detect,
        max_range_m=radar.max_range_m,
        sigma={"range_m": radar.sigma_range_m, "azimuth_rad": radar.sigma_azimuth_rad},
    )


def _batch(radar: Any, seq: int, scan: Any, sectors: int) -> PlotBatch:
    n = len(scan.range_m)
    turn, sector = divmod(round((scan.time_s - radar.offset_s) / radar.period_s * sectors), sectors)
    return PlotBatch(
        sensor_id=radar.name,
        boot_id="bench",
        seq=seq,
        t_ns=np.full(n, START_NS + round(scan.time_s * 1e9)),
        columns=["range_m", "azimuth_rad"],
        # Right above a radar noise can make a range negative, which no radar measures.
        values=np.stack([np.abs(scan.range_m), scan.azimuth_rad], axis=1).reshape(n, 2),
        scan=ScanPart(index=turn, sector=sector, sectors=sectors),
    )
