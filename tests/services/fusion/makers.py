"""Scenes for the fusion tests: sensors, targets on straight lines, the batches that sensors send of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.messages import PlotBatch, ScanPart, SensorInfo, TrackFrame
from trackmesh.services.estimation.bank import make_models
from trackmesh.services.estimation.filters import velocity_models
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.estimation.plots import Plots, make_plots
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.layer import Layer, Look
from trackmesh.services.fusion.life import Rules
from trackmesh.services.fusion.settings import EngineSettings

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

START_NS = 1_700_000_000 * 10**9
ENDED, COASTING, CONFIRMED, TENTATIVE = 3, 2, 1, 0
POLAR, PLANE, GEODETIC = ["range_m", "azimuth_rad"], ["east_m", "north_m"], ["latitude_deg", "longitude_deg"]
RULES = Rules(
    confirm_score=12.0, confirm_hits=3, score_cap=30.0, drop_score=-2.0, drop_fall=6.0, max_misses=3,
    tentative_age_s=9.0, coast_s=15.0, end_fall=1000.0,
)  # fmt: skip


def ns(t_s: float) -> int:
    """Seconds of a scene as Unix nanoseconds."""
    return START_NS + round(t_s * 1e9)


# --- sensors ---


def radar(sensor_id: str = "north", east_m: float = 0.0, north_m: float = 0.0, **change: Any) -> SensorInfo:
    """A good air surveillance radar in the plane."""
    known: dict[str, Any] = {
        "site_enu_m": [east_m, north_m, 0.0], "period_s": 4.0, "p_detect": 0.9, "max_range_m": 120e3,
        "sigma": {"range_m": 50.0, "azimuth_rad": 1.5e-3},
    }  # fmt: skip
    return SensorInfo(sensor_id=sensor_id, kind="radar", **known | change)


def position_sensor(sensor_id: str = "ais", **change: Any) -> SensorInfo:
    """A sensor that measures positions in the plane and stands nowhere."""
    known: dict[str, Any] = {
        "period_s": 2.0, "p_detect": 0.9, "max_range_m": 120e3, "sigma": {"east_m": 30.0, "north_m": 30.0},
    }  # fmt: skip
    return SensorInfo(sensor_id=sensor_id, kind="position", **known | change)


NORTH = radar("north")
EAST = radar("east", 40e3, 10e3, period_s=5.0)


# --- what they send ---


def batch(
    sensor_id: str, t_s: float | FloatArray, values: FloatArray, columns: list[str] = PLANE, **change: Any
) -> PlotBatch:
    """Plots as they are; one time for all, or a time each."""
    rows = np.asarray(values, float).reshape(-1, len(columns))
    t_ns = np.array([ns(t) for t in np.broadcast_to(t_s, len(rows)).tolist()], np.int64)
    known: dict[str, Any] = {"boot_id": "test", "seq": 0, "columns": columns, "values": rows, "t_ns": t_ns}
    return PlotBatch(sensor_id=sensor_id, **known | change)


def seen(info: SensorInfo, t_s: float | FloatArray, place: FloatArray, noise: FloatArray, **change: Any) -> PlotBatch:
    """Places (n, 2) in the plane as the sensor tells them, with errors of ``noise`` (n, 2) sigmas."""
    place = np.asarray(place, float).reshape(-1, 2)
    if info.kind != "radar":
        return batch(info.sensor_id, t_s, place + noise * [info.sigma["east_m"], info.sigma["north_m"]], **change)
    assert info.site_enu_m is not None
    east, north = (place - info.site_enu_m[:2]).T
    range_m = np.hypot(east, north) + info.sigma["range_m"] * noise[:, 0]
    azimuth = (np.arctan2(east, north) + info.sigma["azimuth_rad"] * noise[:, 1]) % (2 * np.pi)
    return batch(info.sensor_id, t_s, np.stack([range_m, azimuth], axis=1), POLAR, **change)


class Fleet(NamedTuple):
    """Targets on straight lines: start (n, 2) metres, velocity (n, 2) m/s."""

    start: FloatArray
    velocity: FloatArray

    def at(self, t_s: float | FloatArray) -> FloatArray:
        """Places (n, 2) at one time for all, or a time each."""
        return self.start + np.asarray(t_s).reshape(-1, 1) * self.velocity


def fleet(*targets: tuple[float, float, float, float]) -> Fleet:
    """Targets as (east, north, veast, vnorth)."""
    state = np.array(targets, float).reshape(-1, 4)
    return Fleet(state[:, :2], state[:, 2:])


FAR_APART = fleet((30e3, 20e3, 100, 40), (-20e3, 45e3, -60, 120), (15e3, -40e3, 10, -150), (-35e3, -30e3, 180, 20))

ONE = fleet((30e3, 20e3, 100.0, 40.0))


def scans(
    info: SensorInfo, targets: Fleet, until_s: float, *, offset_s: float = 0.0, seed: int = 1, p_detect: float = 1.0
) -> Iterator[PlotBatch]:
    """Whole looks, all plots of one look at one time."""
    rng = np.random.default_rng(seed)
    for seq, t in enumerate(np.arange(offset_s, until_s, info.period_s).tolist()):
        noise = rng.standard_normal((len(targets.start), 2))
        kept = rng.random(len(targets.start)) < p_detect
        yield seen(info, t, targets.at(t)[kept], noise[kept], seq=seq)


def sector_scans(info: SensorInfo, targets: Fleet, until_s: float, sectors: int, seed: int = 1) -> Iterator[PlotBatch]:
    """A turning beam: plots at the time at which the beam passes, by sectors; empty ones are left out."""
    rng = np.random.default_rng(seed)
    site = np.array((info.site_enu_m or [0.0, 0.0])[:2])
    for turn in range(int(until_s / info.period_s)):
        begin = turn * info.period_s
        t = np.full(len(targets.start), begin)
        for _ in range(6):
            east, north = (targets.at(t) - site).T
            t = begin + info.period_s * (np.arctan2(east, north) % (2 * np.pi)) / (2 * np.pi)
        part = np.minimum(((t - begin) / info.period_s * sectors).astype(int), sectors - 1)
        noise = rng.standard_normal((len(t), 2))
        for sector in sorted(set(part.tolist())):
            here = part == sector
            scan = ScanPart(index=turn, sector=sector, sectors=sectors)
            yield seen(info, t[here], targets.at(t)[here], noise[here], seq=turn * sectors + sector, scan=scan)


def in_time_order(*streams: Iterable[PlotBatch]) -> list[PlotBatch]:
    """The batches of several sensors as they arrive."""
    return sorted((b for stream in streams for b in stream), key=lambda b: int(b.t_ns.max()))


# --- engines and frames ---


def engine(*sensors: SensorInfo, **settings: Any) -> FusionEngine:
    out = FusionEngine(EngineSettings(**settings), Unit("main", 3, "test", 1))
    for info in sensors:
        out.sensor(info)
    return out


def drive(tracker: FusionEngine, batches: Iterable[PlotBatch]) -> list[TrackFrame]:
    """The frames that batches give, each checked by the rules of the protocol."""
    frames = [frame for frame in (tracker.plots(b) for b in batches) if frame is not None]
    for frame in frames:
        assert decode(encode(frame), TrackFrame) == frame
    return frames


def ids(frame: TrackFrame, *status: int) -> set[int]:
    """Track ids in a frame, of these statuses or of all."""
    keep = np.isin(frame.status, status) if status else np.ones(len(frame.status), bool)
    return set(frame.track_id[keep].tolist())


def live(frame: TrackFrame) -> set[int]:
    return ids(frame, CONFIRMED, COASTING)


def nearest(frame: TrackFrame, place: FloatArray) -> tuple[int, float]:
    """Index in the frame of the track nearest to a place, and how far it is."""
    distance = np.linalg.norm(frame.state[:, :2] - place, axis=1)
    k = int(distance.argmin())
    return k, float(distance[k])


def short_run() -> list[list[float]]:
    """Two radars, four targets, 20 s with one batch late and out of order: the states and more of every frame."""
    batches = in_time_order(scans(NORTH, FAR_APART, 20.0), scans(EAST, FAR_APART, 20.0, offset_s=0.7, seed=2))
    batches[4], batches[5] = batches[5], batches[4]
    tracker = engine(NORTH, EAST, publish_tentative=True)
    out = []
    for f in drive(tracker, batches):
        parts = f.track_id - (3 << 41), f.state.ravel(), f.model_probability.ravel(), f.members.ravel()
        out.append([float(v) for part in parts for v in part])
    return out


# --- layers ---


class ImmLayer(Layer):
    """A layer of which a test may look at the filters."""

    filters: ImmTracks


def layer(rules: Rules = RULES, sensors: int = 1, ring: int = 6, rows: int = 64) -> ImmLayer:
    models = make_models((velocity_models([10.0, 500.0], [30.0, 15.0]),))
    return ImmLayer(ImmTracks(models, rows, ring, 150.0), rules, sensors, 16.0)


def look(t_s: float, **change: Any) -> Look:
    """A whole look of a radar at the middle of the plane."""
    known = Look(
        sensor=0, t_s=t_s, site=np.zeros(2), max_range_m=120e3, period_s=4.0, p_detect=0.9, whole=True, margin_s=0.0,
        lately_s=np.inf, clutter_density=np.array(1e-9), reference_density=1e-9,
    )  # fmt: skip
    return known._replace(**change)


def plots(t_s: float | FloatArray, place: FloatArray, sigma_m: float = 50.0) -> Plots:
    return make_plots(place, [sigma_m**2, 0.0, sigma_m**2], t_s)


def confirm(bank: Layer, *place: tuple[float, float], until_s: float = 12.0) -> list[int]:
    """Rows of tracks that stand at these places and were confirmed by ``until_s``, a look every four seconds."""
    for t in np.arange(0.0, until_s + 1, 4.0).tolist():
        done = bank.step(plots(t, np.array(place)), look(t), t)
    assert bank.life.confirmed[done.row].all()
    return [int(row) for row in done.row]


# --- what lies beside the repository ---

SHARED = Path(__file__).resolve().parents[3] / ".." / "shared"


def peers_folder() -> Path:
    """The folder of the benchmark that the peers were measured with."""
    folder = SHARED / "peers"
    if not (folder / "scenario.py").exists():
        pytest.skip("the peers' benchmark is not here")
    return folder
