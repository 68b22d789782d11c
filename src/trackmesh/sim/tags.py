"""What readers hear of tags: the ranges of one tick, as a pure function of scenario, seed and tick.

Each tick draws from a random stream of its own, so any process computes the same ranges in any order.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.messages import RangeBatch, SensorInfo, TruthFrame
from trackmesh.sim.scenario import Scenario, Tags
from trackmesh.sim.tag_paths import TagPaths

TAG_STREAM = 4
"""Spawn key of the readers' random numbers, apart from those of truth and radars."""


class Heard(NamedTuple):
    """The ranges (k,) of one tick: which tag, which reader, metres, and whether it came round a corner."""

    tag: IntArray
    reader: IntArray
    range_m: FloatArray
    nlos: np.ndarray[tuple[int], np.dtype[np.bool_]]


class TagWorld:
    """The tags of a scenario and what is heard of them; everything follows from scenario and seed.

    Raises ScenarioError where the scenario has no tags.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        self.tags: Tags = scenario.heard_tags()
        self.seed = seed
        self.paths = TagPaths(self.tags)
        self.readers = np.array([reader.site_enu_m for reader in self.tags.readers], float)
        self.reader_names = [reader.id for reader in self.tags.readers]
        self.tag_names = [tag_name(k + 1) for k in range(self.tags.count)]

    def heard(self, tick: int) -> Heard:
        """What the readers hear at a tick."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(TAG_STREAM, tick)))
        return hear(self.tags, self.readers, self.paths.positions(tick * self.tags.tick_s), rng)

    def batch(self, tick: int, *, boot_id: str, seq: int, start_ns: int) -> RangeBatch:
        """The message of a tick; ``start_ns`` is when the scenario began."""
        heard = self.heard(tick)
        rssi = self.tags.rssi
        return RangeBatch(
            network_id=self.tags.network_id,
            boot_id=boot_id,
            seq=seq,
            t_ns=np.full(len(heard.tag), start_ns + round(tick * self.tags.tick_s * 1e9), np.int64),
            tags=self.tag_names,
            readers=self.reader_names,
            tag=heard.tag.astype(np.uint32),
            reader=heard.reader.astype(np.uint32),
            range_m=None if rssi else heard.range_m,
            rssi_dbm=None if rssi is None else strength(heard.range_m, rssi.power_1m_dbm, rssi.exponent),
        )

    def batches(self, *, boot_id: str, start_ns: int, first_tick: int = 0, first_seq: int = 0) -> Iterator[RangeBatch]:
        """The messages of all ticks without end, from ``first_tick``."""
        for tick, seq in zip(count(first_tick), count(first_seq), strict=False):
            yield self.batch(tick, boot_id=boot_id, seq=seq, start_ns=start_ns)

    def truth_frame(self, t_s: float, start_ns: int) -> TruthFrame:
        """Where the tags really are; tag k of the messages has the id k."""
        # Velocities from a millisecond before and after.
        at, before, after = (self.paths.positions(t_s + dt_s) for dt_s in (0.0, -1e-3, 1e-3))
        state = np.concatenate([at, (after - before) / 2e-3], axis=1)
        t_ns = start_ns + round(t_s * 1e9)
        return TruthFrame(scenario_id=truth_id(self.scenario), t_ns=t_ns, id=np.arange(1, len(at) + 1), state=state)


def hear(tags: Tags, readers: FloatArray, at: FloatArray, rng: np.random.Generator) -> Heard:
    """What readers (R, 2) hear of tags at (n, 2) in one tick.

    A range has the noise of the scenario, and of signal strengths their log-normal one; a reader hears what is within
    its reach, by the true distance for ranges, by the apparent one for signal strengths, which is its threshold.
    """
    d = np.hypot(at[:, None, 0] - readers[:, 0], at[:, None, 1] - readers[:, 1])
    noise, chance, corner = rng.standard_normal(d.shape), rng.random(d.shape), rng.random(d.shape)
    nlos = corner < tags.nlos_share
    extra = np.where(nlos, rng.exponential(tags.nlos_m, d.shape), 0.0)
    if tags.rssi is None:
        z, within = d + tags.sigma_range_m * noise + extra, d <= tags.max_range_m
    else:
        spread = np.log(10.0) * tags.rssi.noise_db / (10.0 * tags.rssi.exponent)
        z = d * np.exp(spread * noise) + extra
        within = z <= tags.max_range_m
    tag, reader = np.nonzero(within & (chance < tags.p_detect))
    return Heard(tag, reader, z[tag, reader], nlos[tag, reader])


def strength(range_m: FloatArray, power_1m_dbm: float, exponent: float) -> FloatArray:
    """Signal strengths that mean these ranges."""
    return np.asarray(power_1m_dbm - 10.0 * exponent * np.log10(np.maximum(range_m, 0.01)))


def tag_name(number: int) -> str:
    """Name of a tag in messages; its truth has the number."""
    return f"tag-{number}"


def truth_id(scenario: Scenario) -> str:
    """Scenario id of the truth of the tags, apart from that of targets."""
    return f"{scenario.name}-tags"[:64]


def reader_infos(scenario: Scenario) -> list[SensorInfo]:
    """Who the readers are."""
    tags = scenario.heard_tags()
    return [
        SensorInfo(
            sensor_id=reader.id,
            kind="ranging",
            site_enu_m=[*reader.site_enu_m, 0.0],
            period_s=tags.tick_s,
            p_detect=tags.p_detect,
            max_range_m=tags.max_range_m,
            sigma={"range_m": tags.sigma_range_m},
        )
        for reader in tags.readers
    ]
