"""Several units in one process: their engines, the messages between them with losses and delays, deaths and returns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from benchmarks.peer_scenario import START_NS
from benchmarks.trials import FloatArray, IntArray, Trial
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.merging import some_of, without_doubles
from trackmesh.protocol.messages import BandFrame, PlotBatch, Registration, SensorInfo, TrackFrame
from trackmesh.services.fusion import frames
from trackmesh.services.fusion.engine import Unit
from trackmesh.services.fusion.intake import Intake
from trackmesh.services.fusion.partition.areas import Place
from trackmesh.services.fusion.partition.band import Share
from trackmesh.services.fusion.partition.engine import PartitionedEngine
from trackmesh.services.fusion.settings import EngineSettings

_MS = 1_000_000


class Link(NamedTuple):
    """How band messages travel: which share of them is lost, how late they come."""

    lost: float = 0.0
    delay_s: float = 0.0


NOTHING_LOST = Link()


class Death(NamedTuple):
    """A unit dies, the others learn it a while later, and it may come back.

    Attributes:
        heirs: "frames": neighbours go on from its last picture; "band": with what they track in the band alone;
            "cold": they even forget that.
    """

    unit: str
    t_s: float
    noticed_s: float = 2.0
    back_s: float | None = None
    heirs: str = "frames"


class Cut(NamedTuple):
    """For a time no unit hears any other, while all hear the sensors."""

    from_s: float
    until_s: float


@dataclass
class Member:
    """One unit at work."""

    name: str
    engine: PartitionedEngine
    intake: Intake
    dead: bool = False
    last: TrackFrame | None = None
    seconds: float = 0.0


@dataclass
class Realm:
    """Units and what is on its way between them.

    Attributes:
        told: all band messages.
        died_with: ids of the tracks that the dead unit told last, and nobody else.
    """

    units: dict[str, Member]
    link: Link
    rng: np.random.Generator
    make: Callable[[str, int], PartitionedEngine]
    sensors: Sequence[SensorInfo]
    waiting: list[tuple[float, str, BandFrame | TrackFrame | Registration]] = field(default_factory=list)
    told: list[BandFrame] = field(default_factory=list)
    cut: bool = False
    died_with: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    def tell_alive(self, known: frozenset[str]) -> None:
        """Everybody learns who is alive."""
        for member in self.living():
            member.engine.alive(known - {member.name})

    def living(self) -> list[Member]:
        """Those that are not dead."""
        return [one for one in self.units.values() if not one.dead]

    def deliver(self, t_s: float) -> None:
        """What has arrived by now."""
        due = [one for one in self.waiting if one[0] <= t_s]
        self.waiting = [one for one in self.waiting if one[0] > t_s]
        for _, target, message in due:
            member = self.units[target]
            if member.dead:
                continue
            try:
                if isinstance(message, BandFrame):
                    member.engine.band(message)
                elif isinstance(message, TrackFrame):
                    member.engine.neighbour_tracks(message)
                else:
                    member.engine.neighbour_registration(message)
            except RefusedMessage:
                member.engine.counters["refused"] += 1

    def take(self, t_s: float, batch: PlotBatch, times: int = 1) -> None:
        """Every unit hears a batch, perhaps several times; what it tells goes on its way."""
        for member in self.living():
            for _ in range(times):
                try:
                    member.intake.check(batch, None)
                except RefusedMessage:
                    continue
                frame = member.engine.plots(batch)
                if frame is not None:
                    member.last = frame
                    self._send(member, t_s, frame)
            told = member.engine.band_message()
            if told is not None:
                self.told.append(told)
                self._send(member, t_s, told)
            known = member.engine.registration()
            if known is not None:
                self._send(member, t_s, known)

    def _send(self, sender: Member, t_s: float, message: BandFrame | TrackFrame | Registration) -> None:
        for name in self.units:
            if name == sender.name or self.cut:
                continue
            if isinstance(message, BandFrame):
                if self.rng.random() >= self.link.lost:
                    self.waiting.append((t_s + self.link.delay_s, name, message))
            else:
                self.waiting.append((t_s, name, message))

    def picture(self, t_s: float) -> TrackFrame | None:
        """The union of the last frames of the units that are alive, doubles removed."""
        last = [one.last for one in self.living() if one.last is not None]
        if not last:
            return None
        whole = without_doubles(last)
        return frames.join(whole[0], whole[1:]) if len(whole) > 1 else whole[0]


def make_realm(
    trial: Trial,
    places: Sequence[Place],
    settings: EngineSettings,
    *,
    width_m: float = 10_000.0,
    handover_m: float = 1000.0,
    link: Link = NOTHING_LOST,
    seed: int = 0,
    kind: type[PartitionedEngine] = PartitionedEngine,
    standby: bool = False,
) -> Realm:
    """Units ``unit-1``, ``unit-2``, ... at these places; with ``standby`` one more that stands by for the first."""
    every = {f"unit-{k + 1}": (k + 1, place) for k, place in enumerate(places)}
    if standby:
        every["standby"] = (len(places) + 1, places[0])

    def make(name: str, boot: int) -> PartitionedEngine:
        number, place = every[name]
        share = Share(place, width_m, handover_m, 15.0, name == "standby", number + boot)
        first = (START_NS // _MS - 1_577_836_800_000) + 1_000_000 * boot
        engine = kind(settings, Unit(name, number, f"boot-{boot}", first), share)
        for info in trial.sensors:
            engine.sensor(info)
        return engine

    units = {name: Member(name, make(name, 0), Intake(0, 0)) for name in every}
    realm = Realm(units, link, np.random.default_rng([seed, 7]), make, trial.sensors)
    realm.tell_alive(frozenset(units))
    return realm


class HardBorder(PartitionedEngine):
    """The control: each unit shows what is on its side, under its own ids, whatever others tell."""

    def band(self, told: BandFrame) -> None:
        """Hear of the neighbour's area alone."""
        empty = np.zeros(len(told.track_id), np.bool_)
        rows = {name: getattr(told, name)[empty] for name in _BAND_ROWS}
        super().band(told.model_copy(update=rows))

    def _owned_only(self, frame: TrackFrame) -> TrackFrame:
        return some_of(frame, self._area.depth(frame.state[:, :2]) >= 0.0)


_BAND_ROWS = ("track_id", "owner", "epoch", "first_t_ns", "updated_t_ns", "plot_keys", "state", "covariance")

Shown = list[tuple[float, TrackFrame]]


class Run(NamedTuple):
    """What came of a run: merged pictures, and for each how many tracks are told twice under one id."""

    shown: Shown
    doubles: FloatArray
    realm: Realm


def drive(realm: Realm, trial: Trial, death: Death | None = None, times: int = 1, cut: Cut | None = None) -> Run:
    """All batches of a trial through all units; the merged picture after each."""
    shown: Shown = []
    doubles: list[float] = []
    steps = _steps(death) + _cut_steps(cut)
    for feed in trial.feeds:
        while steps and steps[0][0] <= feed.arrival_s:
            steps.pop(0)[1](realm)
        realm.deliver(feed.arrival_s)
        realm.take(feed.arrival_s, feed.batch, times)
        picture = realm.picture(feed.arrival_s)
        if picture is not None and len(feed.target):
            shown.append((feed.arrival_s, picture))
            ids = np.concatenate([m.last.track_id for m in realm.living() if m.last is not None])
            doubles.append(float(len(ids) - len(np.unique(ids))))
    return Run(shown, np.array(doubles), realm)


def _steps(death: Death | None) -> list[tuple[float, Callable[[Realm], None]]]:
    if death is None:
        return []

    def die(realm: Realm) -> None:
        one = realm.units[death.unit]
        if one.last is not None:
            others = [other.last.track_id for other in realm.living() if other is not one and other.last is not None]
            realm.died_with = np.setdiff1d(one.last.track_id, np.concatenate([np.empty(0, np.int64), *others]))
        one.dead, one.last = True, None

    def learn(realm: Realm) -> None:
        for member in realm.living():
            if death.heirs != "frames":
                member.engine.neighbours.pop_tracks(death.unit)
            if death.heirs == "cold":
                _forget(member.engine)
        realm.tell_alive(frozenset(one.name for one in realm.living()))

    def come_back(realm: Realm) -> None:
        realm.units[death.unit] = Member(death.unit, realm.make(death.unit, 1), Intake(0, 0))
        realm.tell_alive(frozenset(one.name for one in realm.living()))

    steps: list[tuple[float, Callable[[Realm], None]]] = [(death.t_s, die), (death.t_s + death.noticed_s, learn)]
    if death.back_s is not None:
        steps.append((death.back_s, come_back))
    return steps


def _cut_steps(cut: Cut | None) -> list[tuple[float, Callable[[Realm], None]]]:
    if cut is None:
        return []

    def apart(realm: Realm) -> None:
        realm.cut, realm.waiting = True, []
        for member in realm.living():
            member.engine.alive(frozenset())

    def together(realm: Realm) -> None:
        realm.cut = False
        realm.tell_alive(frozenset(one.name for one in realm.living()))

    return [(cut.from_s, apart), (cut.until_s, together)]


def _forget(engine: PartitionedEngine) -> None:
    """As if no neighbour had ever told a unit of its tracks: what is not ours has new numbers."""
    life = engine._system.life
    rows = engine._confirmed()
    theirs = rows[~engine.ownership.owned(life.link[rows])]
    life.link[theirs] = engine._picture.numbers(len(theirs))
