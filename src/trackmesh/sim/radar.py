"""What a rotating radar sees: the plots of one sector, as a pure function of scenario, seed, turn and sector.

The beam stands at north at ``offset_s + k period_s`` and turns clockwise; a target is looked at when the beam passes
it. Each sector draws from a random stream of its own, so any process computes the same plots in any order.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.messages import PlotBatch, ScanPart, SensorInfo
from trackmesh.sim.scenario import Radar, Scenario
from trackmesh.sim.truth import Truth, World

RADAR_STREAM = 2
"""Spawn key of the radars' random numbers, apart from those of the truth."""

COLUMNS = ["range_m", "azimuth_rad"]
FULL_TURN_RAD = 2.0 * np.pi
BEAM_ITERATIONS = 8


@dataclass(frozen=True)
class Crossings:
    """The targets (n,) that the beam passes in one turn, in the order in which it does.

    Attributes:
        t_s: when.
        range_m, azimuth_rad: where they are then, free of error.
        ids: which they are.
        sector: (n,) the sector of the turn.
    """

    t_s: FloatArray
    range_m: FloatArray
    azimuth_rad: FloatArray
    ids: IntArray
    sector: IntArray


@dataclass(frozen=True)
class SectorPlots:
    """The plots (n,) of one sector in order of time; ``ids`` is the target of each, or -1 for clutter."""

    t_s: FloatArray
    range_m: FloatArray
    azimuth_rad: FloatArray
    ids: IntArray


def beam_crossings(scenario: Scenario, radar: Radar, truth: Truth, turn: int) -> Crossings:
    """The targets within range that the beam passes in turn ``turn``.

    Solves t = t_turn + period azimuth(t) / 2 pi by fixed-point iteration, for the azimuth as it is and one turn
    on and back: near north a target may be passed twice in a turn, or not at all.
    """
    begin_s = radar.offset_s + turn * radar.period_s
    middle_s, end_s = begin_s + 0.5 * radar.period_s, begin_s + radar.period_s
    there = np.flatnonzero((truth.born_s < end_s) & (truth.dies_s > begin_s))
    rows = np.tile(there, 3)
    winding = np.repeat([-1.0, 0.0, 1.0], len(there))
    site_m = np.array(radar.position_m(scenario.origin)[:2])
    _, azimuth = _polar(truth, site_m, rows, np.full(len(rows), middle_s))
    unwound = azimuth + FULL_TURN_RAD * winding
    for _ in range(BEAM_ITERATIONS):
        t_s = begin_s + radar.period_s * unwound / FULL_TURN_RAD
        _, azimuth = _polar(truth, site_m, rows, t_s)
        step = azimuth - unwound
        unwound = unwound + step - FULL_TURN_RAD * np.round(step / FULL_TURN_RAD)
    t_s = begin_s + radar.period_s * unwound / FULL_TURN_RAD
    range_m, azimuth = _polar(truth, site_m, rows, t_s)
    passed = (t_s >= begin_s) & (t_s < end_s) & (range_m < radar.max_range_m)
    passed &= (truth.born_s[rows] <= t_s) & (t_s < truth.dies_s[rows])
    kept = np.flatnonzero(passed)
    kept = kept[np.argsort(t_s[kept], kind="stable")]
    sector = np.floor((t_s[kept] - begin_s) / radar.period_s * radar.sectors).astype(np.int64)
    return Crossings(
        t_s[kept],
        range_m[kept],
        azimuth[kept],
        truth.ids[rows[kept]],
        np.clip(sector, 0, radar.sectors - 1),
    )


def sector_plots(radar: Radar, crossings: Crossings, seed: int, turn: int, sector: int) -> SectorPlots:
    """The plots of one sector: targets detected with their errors, and clutter uniform in area."""
    rng = np.random.default_rng(
        np.random.SeedSequence(seed, spawn_key=(RADAR_STREAM, zlib.crc32(radar.id.encode()), turn, sector))
    )
    passed = np.flatnonzero(crossings.sector == sector)
    seen = passed[rng.random(len(passed)) < radar.p_detect]
    noise_m, noise_rad = rng.standard_normal((2, len(seen)))
    range_m = crossings.range_m[seen] + radar.bias_range_m + radar.sigma_range_m * noise_m
    azimuth = crossings.azimuth_rad[seen] + radar.bias_azimuth_rad + radar.sigma_azimuth_rad * noise_rad
    n_false = rng.poisson(radar.clutter_per_scan / radar.sectors)
    false_range_m = radar.max_range_m * np.sqrt(rng.random(n_false))
    false_part = (sector + rng.random(n_false)) / radar.sectors
    begin_s = radar.offset_s + turn * radar.period_s
    t_s = np.concatenate([crossings.t_s[seen], begin_s + radar.period_s * false_part])
    order = np.argsort(t_s, kind="stable")
    return SectorPlots(
        t_s[order],
        np.abs(np.concatenate([range_m, false_range_m]))[order],
        _wrap(np.concatenate([azimuth, FULL_TURN_RAD * false_part]))[order],
        np.concatenate([crossings.ids[seen], np.full(n_false, -1)])[order],
    )


class DueBatch(NamedTuple):
    """A batch, and the time (UTC ns) at which the beam has left its sector and it can be sent."""

    due_ns: int
    batch: PlotBatch


def radar_batches(
    world: World, radar: Radar, *, boot_id: str, start_ns: int, after_s: float = 0.0, first_seq: int = 0
) -> Iterator[DueBatch]:
    """All batches of a radar without end, from the first sector that ends after ``after_s``."""
    first_turn, first_sector = sector_at(radar, after_s)
    seq = count(first_seq)
    for turn in count(first_turn):
        truth = world.truth(radar.offset_s + (turn + 1) * radar.period_s)
        crossings = beam_crossings(world.scenario, radar, truth, turn)
        for sector in range(first_sector if turn == first_turn else 0, radar.sectors):
            plots = sector_plots(radar, crossings, world.seed, turn, sector)
            batch = plot_batch(radar, plots, turn, sector, boot_id=boot_id, seq=next(seq), start_ns=start_ns)
            yield DueBatch(start_ns + round(sector_end_s(radar, turn, sector) * 1e9), batch)


def sector_end_s(radar: Radar, turn: int, sector: int) -> float:
    """When the beam leaves a sector: seconds from the scenario's start, when its batch can be sent."""
    return radar.offset_s + radar.period_s * (turn + (sector + 1) / radar.sectors)


def sector_at(radar: Radar, t_s: float) -> tuple[int, int]:
    """The first turn and sector that end after ``t_s``."""
    passed = max(0, int(np.floor((t_s - radar.offset_s) / radar.period_s * radar.sectors)))
    return divmod(passed, radar.sectors)


def sensor_info(scenario: Scenario, radar: Radar) -> SensorInfo:
    """What the radar tells of itself; it knows nothing of its biases."""
    return SensorInfo(
        sensor_id=radar.id,
        kind="radar",
        site_enu_m=list(radar.position_m(scenario.origin)),
        period_s=radar.period_s,
        p_detect=radar.p_detect,
        max_range_m=radar.max_range_m,
        sigma={"range_m": radar.sigma_range_m, "azimuth_rad": radar.sigma_azimuth_rad},
    )


def plot_batch(
    radar: Radar, plots: SectorPlots, turn: int, sector: int, *, boot_id: str, seq: int, start_ns: int
) -> PlotBatch:
    """The message of one sector; ``start_ns`` is when the scenario began."""
    return PlotBatch(
        sensor_id=radar.id,
        boot_id=boot_id,
        seq=seq,
        t_ns=start_ns + np.rint(plots.t_s * 1e9).astype(np.int64),
        columns=COLUMNS,
        values=np.stack([plots.range_m, plots.azimuth_rad], axis=1),
        scan=ScanPart(index=turn, sector=sector, sectors=radar.sectors),
    )


def _polar(truth: Truth, site_m: FloatArray, rows: IntArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    east, north = (truth.states(rows, t_s)[:, :2] - site_m).T
    return np.hypot(east, north), _wrap(np.arctan2(east, north))


def _wrap(angle_rad: FloatArray) -> FloatArray:
    wrapped = np.mod(angle_rad, FULL_TURN_RAD)
    # The remainder of a tiny negative angle rounds to a full turn.
    return np.where(wrapped >= FULL_TURN_RAD, 0.0, wrapped)
