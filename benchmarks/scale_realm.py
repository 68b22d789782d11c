"""A whole realm in one process: units, sensors and targets by the thousand, and what each unit costs.

python -m benchmarks.scale_realm                                  10 units, 50 sensors, 20 000 targets: some minutes
python -m benchmarks.scale_realm --units 4 --targets 4000 --seconds 40 --json out.json --plot out.png

Units stand in a grid of square areas; sensors in a finer grid, with a range such that every target is seen by three.
All turn in 5 s, Pd 0.9, 20 false plots a turn. Targets fly straight at 80 to 250 m/s and turn back at the rim. What a
unit costs is the time of this process in its engine, in the codec for its frames, and in the messages of its band.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks.peer_scenario import START_NS
from benchmarks.trials import FloatArray, IntArray
from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.merging import without_doubles
from trackmesh.protocol.messages import BandFrame, PlotBatch, ScanPart, SensorInfo, TrackFrame
from trackmesh.services.fusion.engine import Unit
from trackmesh.services.fusion.partition.areas import Place
from trackmesh.services.fusion.partition.band import Share
from trackmesh.services.fusion.partition.engine import PartitionedEngine
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.sim.metrics import match

PERIOD_S, P_DETECT, CLUTTER, SEEN_BY = 5.0, 0.9, 20, 3
SIGMA_M, SIGMA_RAD = 50.0, 0.0014
CUT_OFF_M = 1000.0
_FEWEST_RADARS = 2


class World(NamedTuple):
    """Targets that fly straight within a rectangle, and radars in a grid over it."""

    size_m: FloatArray
    start: FloatArray
    velocity: FloatArray
    sites: FloatArray
    range_m: float

    def at(self, t_s: float) -> FloatArray:
        """Positions (n, 2); at the rim targets turn back."""
        folded = np.mod(self.start + t_s * self.velocity, 2.0 * self.size_m)
        return np.asarray(np.minimum(folded, 2.0 * self.size_m - folded))

    def covered(self, t_s: float) -> npt.NDArray[np.bool_]:
        """Which targets (n,) are in the range of two radars or more, and have been for a minute."""
        seen = np.full(len(self.start), 99)
        for when_s in (t_s, max(t_s - 60.0, 0.0)):
            place, count = self.at(when_s), np.zeros(len(self.start), np.int64)
            for site in self.sites:
                count += np.hypot(*(place - site).T) < self.range_m
            seen = np.minimum(seen, count)
        return np.asarray(seen >= _FEWEST_RADARS)

    def infos(self) -> list[SensorInfo]:
        """The radars."""
        return [
            SensorInfo(
                sensor_id=f"radar-{k}", kind="radar", site_enu_m=[*site, 0.0], period_s=PERIOD_S, p_detect=P_DETECT,
                max_range_m=self.range_m, sigma={"range_m": SIGMA_M, "azimuth_rad": SIGMA_RAD},
            )
            for k, site in enumerate(self.sites.tolist())
        ]  # fmt: skip

    def batches(self, rng: np.random.Generator, seconds: float) -> Iterator[tuple[float, PlotBatch]]:
        """Turns of all radars in order of time."""
        n = len(self.sites)
        offset = np.arange(n) * PERIOD_S / n
        for turn in range(int(seconds / PERIOD_S)):
            for k in range(n):
                t_s = turn * PERIOD_S + float(offset[k])
                yield t_s, self._batch(rng, k, turn, t_s)

    def _batch(self, rng: np.random.Generator, k: int, turn: int, t_s: float) -> PlotBatch:
        off = self.at(t_s) - self.sites[k]
        distance = np.hypot(off[:, 0], off[:, 1])
        seen = np.flatnonzero((distance < self.range_m) & (rng.random(len(off)) < P_DETECT))
        azimuth = np.arctan2(off[seen, 0], off[seen, 1])
        values = np.stack([distance[seen], azimuth], axis=1) + rng.normal(size=(len(seen), 2)) * [SIGMA_M, SIGMA_RAD]
        false = rng.poisson(CLUTTER)
        noise = np.stack([self.range_m * np.sqrt(rng.random(false)), rng.uniform(0, 2 * np.pi, false)], axis=1)
        values = rng.permutation(np.concatenate([values, noise]))
        values[:, 0], values[:, 1] = np.abs(values[:, 0]), values[:, 1] % (2 * np.pi)
        return PlotBatch(
            sensor_id=f"radar-{k}", boot_id="one", seq=turn, t_ns=np.full(len(values), START_NS + round(t_s * 1e9)),
            columns=["range_m", "azimuth_rad"], values=values, scan=ScanPart(index=turn, sector=0, sectors=1),
        )  # fmt: skip


def make_world(columns: int, rows: int, side_m: float, sensors: int, targets: int, seed: int) -> World:
    """A world of columns x rows square areas of this side."""
    rng = np.random.default_rng(seed)
    size_m = np.array([columns, rows]) * side_m
    # Sensors in a grid as square as can be.
    fitting = [k for k in range(1, sensors + 1) if sensors % k == 0]
    wide = min(fitting, key=lambda k: abs(np.log(k * k / sensors * size_m[1] / size_m[0])))
    high = sensors // wide
    grid = np.stack(np.meshgrid((np.arange(wide) + 0.5) / wide, (np.arange(high) + 0.5) / high), axis=-1).reshape(-1, 2)
    course, speed = rng.uniform(0.0, 2.0 * np.pi, targets), rng.uniform(80.0, 250.0, targets)
    return World(
        size_m, rng.uniform(0.0, 1.0, (targets, 2)) * size_m,
        speed[:, None] * np.stack([np.sin(course), np.cos(course)], axis=1),
        grid * size_m, float(np.sqrt(SEEN_BY * size_m.prod() / (np.pi * sensors))),
    )  # fmt: skip


@dataclass
class Member:
    """A unit at work, and what it cost after the start."""

    engine: PartitionedEngine
    place: Place
    last: TrackFrame | None = None
    engine_s: float = 0.0
    codec_s: float = 0.0
    band_s: float = 0.0
    batch_s: list[float] = field(default_factory=list)
    heard: int = 0
    band_bytes: int = 0
    frame_bytes: int = 0
    band_tracks: list[int] = field(default_factory=list)


class Costs(NamedTuple):
    """Of a run: figures of the realm, and of each unit."""

    realm: dict[str, float]
    units: list[dict[str, float]]
    places: list[list[float]]


def run(world: World, places: list[Place], seconds: float, settled_s: float, seed: int, say: bool = False) -> Costs:
    """All of it; costs are counted after ``settled_s``."""
    settings = EngineSettings(frame_period_s=1.0)
    width_m = 8000.0
    members = {}
    for k, place in enumerate(places):
        unit = Unit(f"unit-{k + 1}", k + 1, "one", 1)
        engine = PartitionedEngine(settings, unit, Share(place, width_m, 1000.0, 15.0, started_t_ns=k))
        members[unit.unit_id] = Member(engine, place)
    for name, member in members.items():
        member.engine.alive(frozenset(members) - {name})
    infos = {info.sensor_id: info for info in world.infos()}
    rng = np.random.default_rng([seed, 1])
    scored: list[tuple[int, int, int, int]] = []
    follows = np.full(len(world.start), -1)
    next_score_s, switches, doubles = settled_s, 0, 0
    for t_s, batch in world.batches(rng, seconds):
        counted = t_s >= settled_s
        for name, member in members.items():
            _give(member, infos[batch.sensor_id], batch, counted)
            told = member.engine.band_message()
            if told is not None:
                _tell(members, name, told, counted)
        if t_s >= next_score_s:
            next_score_s += 5.0
            found, followed, twice = _score(world, t_s, members)
            scored.append(found)
            doubles += twice
            both = (follows >= 0) & (followed >= 0)
            switches += int((both & (follows != followed)).sum())
            follows = np.where(followed >= 0, followed, follows)
            if say:
                print(
                    f"{t_s:6.1f} s  shown {found[0]}, missed {found[1]}, false {found[2]}", file=sys.stderr, flush=True
                )
    return _costs(world, members, seconds - settled_s, np.array(scored), switches, doubles)


def _give(member: Member, info: SensorInfo, batch: PlotBatch, counted: bool) -> None:
    engine = member.engine
    if info.sensor_id not in engine.sensors:
        reach = member.engine.share.width_m + info.max_range_m
        site = np.array(info.site_enu_m)[None, :2]
        # Before a unit knows its neighbours it would want all of them.
        if np.hypot(*(site[0] - member.place.centre_m)) > reach + _HALF_DIAGONAL * _side(member):
            return
        engine.sensor(info)
    if not engine.wants(info):
        return
    began = time.process_time()
    frame = engine.plots(batch)
    took = time.process_time() - began
    if frame is not None:
        member.last = frame
        began = time.process_time()
        data = encode(frame)
        if counted:
            member.codec_s += time.process_time() - began
            member.frame_bytes += len(data)
    if counted:
        member.engine_s += took
        member.batch_s.append(took)
        member.heard += len(batch.t_ns)


_HALF_DIAGONAL = 0.71
_SIDES: dict[int, float] = {}


def _side(member: Member) -> float:
    return _SIDES.get(0, 200e3)


def _tell(members: dict[str, Member], name: str, told: BandFrame, counted: bool) -> None:
    sender = members[name]
    began = time.process_time()
    data = encode(told)
    sender_s = time.process_time() - began
    if counted:
        sender.band_s += sender_s
        sender.band_bytes += len(data)
        sender.band_tracks.append(len(told.track_id))
    for other, member in members.items():
        if other == name:
            continue
        began = time.process_time()
        try:
            member.engine.band(decode(data, BandFrame, encoding(told)))
        except RefusedMessage:
            continue
        if counted:
            member.band_s += time.process_time() - began


def _picture(members: dict[str, Member], t_s: float) -> tuple[IntArray, FloatArray]:
    """Ids (n,) and positions (n, 2) at a time; frames are up to a second old, each of its own time."""
    last = without_doubles([one.last for one in members.values() if one.last is not None])
    age_s = [t_s - (one.t_ns - START_NS) / 1e9 for one in last]
    place = [one.state[:, :2] + age * one.state[:, 2:4] for one, age in zip(last, age_s, strict=True)]
    return np.concatenate([one.track_id for one in last]), np.concatenate(place)


def _score(world: World, t_s: float, members: dict[str, Member]) -> tuple[tuple[int, int, int, int], IntArray, int]:
    ident, state = _picture(members, t_s)
    best = match(world.at(t_s), state, CUT_OFF_M)
    followed = np.full(len(world.start), -1)
    followed[best.target] = ident[best.track]
    missed = int((followed[world.covered(t_s)] < 0).sum())
    told = sum(len(one.last.track_id) for one in members.values() if one.last is not None)
    parts = best.gospa()
    return (len(ident), missed, parts.false, len(best.track)), followed, told - len(ident)


def _costs(
    world: World, members: dict[str, Member], counted_s: float, scored: Any, switches: int, doubles: int
) -> Costs:
    rows = []
    for member in members.values():
        figures, engine = member.engine.figures(), member.engine
        batch_s = np.array(member.batch_s) if member.batch_s else np.zeros(1)
        rows.append(
            {
                "tracks": figures["tracks"] + figures["shadows"],
                "owned": figures["tracks"],
                "sensors": float(len(engine.sensors)),
                "plots_heard_per_s": member.heard / counted_s,
                "core_share": (member.engine_s + member.codec_s + member.band_s) / counted_s,
                "engine_share": member.engine_s / counted_s,
                "band_share": member.band_s / counted_s,
                "batch_p50_ms": 1e3 * float(np.percentile(batch_s, 50)),
                "batch_p99_ms": 1e3 * float(np.percentile(batch_s, 99)),
                "band_kB_per_s": member.band_bytes / counted_s / 1e3,
                "band_tracks": float(np.mean(member.band_tracks)) if member.band_tracks else 0.0,
                "frames_MB_per_s": member.frame_bytes / counted_s / 1e6,
            }
        )
    shown, missed, false, matched = scored.mean(axis=0)
    realm = {
        "units": float(len(members)),
        "sensors": float(len(world.sites)),
        "targets": float(len(world.start)),
        "shown": float(shown),
        "missed": float(missed),
        "false": float(false),
        "switches_per_1000_track_minutes": 1e3 * switches / (matched * counted_s / 60.0),
        "doubles": doubles / len(scored),
        "cores": sum(row["core_share"] for row in rows),
        "memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }
    return Costs(realm, rows, [one.place.centre_m.tolist() for one in members.values()])


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--columns", type=int, default=5)
    ask.add_argument("--rows", type=int, default=2)
    ask.add_argument("--side-km", type=float, default=200.0)
    ask.add_argument("--sensors", type=int, default=50)
    ask.add_argument("--targets", type=int, default=20_000)
    ask.add_argument("--seconds", type=float, default=60.0)
    ask.add_argument("--settled", type=float, default=30.0, help="costs are counted after so many seconds")
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--json", type=Path, metavar="FILE")
    ask.add_argument("--plot", type=Path, metavar="FILE.png")
    given = ask.parse_args()
    side_m = given.side_km * 1e3
    _SIDES[0] = side_m
    world = make_world(given.columns, given.rows, side_m, given.sensors, given.targets, given.seed)
    places = [
        Place(np.array([(column + 0.5) * side_m, (row + 0.5) * side_m]))
        for row in range(given.rows)
        for column in range(given.columns)
    ]
    began = time.perf_counter()
    costs = run(world, places, given.seconds, given.settled, given.seed, say=True)
    print(f"radar range {world.range_m / 1e3:.0f} km; {time.perf_counter() - began:.0f} s for {given.seconds:g} s")
    for name, value in costs.realm.items():
        print(f"{name:34} {value:.4g}")
    for name in costs.units[0]:
        values = [one[name] for one in costs.units]
        print(f"{name:34} mean {np.mean(values):.4g}, largest {np.max(values):.4g}")
    if given.json:
        given.json.write_text(json.dumps(costs._asdict(), indent=1), encoding="utf-8")
    if given.plot:
        from benchmarks.scale_realm_chart import draw

        draw(costs.units, costs.places, given.side_km, given.plot)


if __name__ == "__main__":
    main()
