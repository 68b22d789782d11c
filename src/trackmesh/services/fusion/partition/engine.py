"""The engine of one of several units: it tracks its area and a band around it, and tells of the tracks that it owns.

As pure as the one it is made of: what other units tell, and who of them is alive, are inputs like plots.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import (
    COASTING,
    CONFIRMED,
    ENDED,
    TENTATIVE,
    BandFrame,
    Geodetic,
    PlotBatch,
    RefinedFrame,
    Registration,
    SensorInfo,
    TrackFrame,
    TrackQuery,
)
from trackmesh.services.estimation.plots import Plots
from trackmesh.services.fusion import frames
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.foreign_frames import read
from trackmesh.services.fusion.partition.areas import EVERYWHERE, Area
from trackmesh.services.fusion.partition.band import Sender, Share
from trackmesh.services.fusion.partition.neighbours import Neighbour, Neighbours, Ourselves
from trackmesh.services.fusion.partition.ownership import Depths, Held, Ownership
from trackmesh.services.fusion.partition.pairing import KEPT, NO_KEY, plot_keys
from trackmesh.services.fusion.partition.priors import Priors
from trackmesh.services.fusion.sensors import Sensor
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.snapshot import Snapshot, named, under

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_SEED_SCORE = 20.0
_JOIN_CYCLES = 2
_LATE = 1.5


class PartitionedEngine(FusionEngine):
    """One of several units' tracker.

    Frames and answers hold the tracks that it owns; ``band_message`` is what its neighbours have to be told.

    Attributes:
        neighbours: the other units.
        ownership: who owns which track.
    """

    def __init__(self, settings: EngineSettings, unit: Unit, share: Share, origin: Geodetic | None = None) -> None:
        super().__init__(settings, unit, origin)
        self.share = share
        ours = Ourselves(unit.unit_id, unit.number, share.started_t_ns, share.place)
        self.neighbours = Neighbours(ours, "standby" if share.standby else "joining")
        cycle_ns = round(settings.cycle_s * 1e9)
        self.ownership = Ownership(unit.number, self._picture.numbers, cycle_ns)
        self._stitching.ours = self.ownership.owned
        self._priors = Priors(self.corrections, self.counters)
        self._area = Area(EVERYWHERE)
        self._alive: frozenset[str] | None = None
        self._heard_others_s: float | None = None
        self._cycles = self._band_seq = 0
        self._band: BandFrame | None = None

    # --- what other units tell ---

    def alive(self, units: frozenset[str]) -> None:
        """Which other units are alive: go on with the tracks of those that are gone, as far as they are ours now."""
        if units == self._alive:
            return
        if self._alive is None:
            self._cycles = 0
        self._alive = units
        gone = self.neighbours.now_alive(units)
        self._new_area()
        for one in gone:
            self._inherit(one)
        if gone and self.neighbours.owning():
            self._pull()

    def band(self, told: BandFrame) -> None:
        """Take what a neighbour tells of its tracks near the border.

        Raises:
            RefusedMessage: it is out of sequence, of our own number, of another plane, or tells a track twice.
        """
        if len(np.unique(told.track_id)) < len(told.track_id):
            raise RefusedMessage("duplicate_track", f"A band message of {told.unit_id} tells a track twice.")
        ours, theirs = self.origin, told.area.origin
        if ours is not None and theirs is not None and ours != theirs:
            raise RefusedMessage("other_origin", f"The unit {told.unit_id} has another origin of the plane than this.")
        one, changed = self.neighbours.hear(told)
        self.counters["band_messages"] += 1
        if changed:
            self._new_area()
        # What others share with others is far from here; a late message tells where its tracks were.
        near = self._area.depth(told.state[:, :2].astype(np.float64)) > -_LATE * self.share.width_m
        if one.alive and near.any():
            self._adopt(told, one)

    def neighbour_tracks(self, frame: TrackFrame) -> None:
        """Take note of a neighbour's picture."""
        self.neighbours.hear_tracks(frame)

    def neighbour_registration(self, told: Registration) -> None:
        """Take note of what a neighbour knows of its sensors."""
        self.neighbours.hear_registration(told)
        self._priors.compare(told, self.neighbours)

    # --- what is told ---

    def band_message(self) -> BandFrame | None:
        """What the neighbours have to be told, once after every cycle."""
        told, self._band = self._band, None
        return told

    def wants(self, info: SensorInfo) -> bool:
        """Whether a sensor can see anything of our area or the band around it."""
        sensor = self.sensors.get(info.sensor_id)
        if info.kind != "radar" or sensor is None:
            return True
        return bool(self._area.depth(sensor.site[None])[0] > -(self.share.width_m + info.max_range_m))

    def query(self, query: TrackQuery) -> TrackFrame:
        """As of any engine, of the tracks that are ours."""
        return self._owned_only(super().query(query))

    def refined(self) -> RefinedFrame | None:
        """As of any engine, of the tracks that are ours."""
        frame = super().refined()
        if frame is None:
            return None
        ours = self.ownership.owned(frame.track_id)
        names = ("track_id", "state_t_ns", "state", "covariance")
        return frame.model_copy(update={name: getattr(frame, name)[ours] for name in names}) if ours.any() else None

    def figures(self) -> dict[str, float]:
        """As of any engine; ``tracks`` are ours, ``shadows`` those of others, ``units_active`` who owns areas."""
        of_all = super().figures()
        owners = len(self.neighbours.owners()) + self.neighbours.owning()
        owned = float(self.ownership.owned(self._system.life.link[self._confirmed()]).sum())
        return of_all | {
            "tracks": owned,
            "shadows": of_all["tracks"] - owned,
            "units_active": float(owners),
            "owning": float(self.neighbours.owning()),
            "band_width_m": self.share.width_m,
        }

    # --- plots ---

    def sensor(self, info: SensorInfo) -> None:
        """As of any engine; its clutter is counted where plots are taken."""
        before = self.sensors.get(info.sensor_id)
        super().sensor(info)
        sensor = self.sensors[info.sensor_id]
        if sensor is not before:
            self._limit(sensor)

    def _take(self, sensor: Sensor, batch: PlotBatch, plots: Plots) -> None:
        plots["key"] = plot_keys(batch.sensor_id, batch.boot_id, batch.seq, len(plots))
        near = self._area.depth(plots["z"]) > -self.share.width_m
        self.counters["plots_elsewhere"] += int((~near).sum())
        if near.any():
            super()._take(sensor, batch, plots[near])
        else:
            self._time.advance(float(plots["t_s"].max()))
            sensor.saw_nothing(1.0 / batch.scan.sectors if batch.scan else 1.0)
            self._cycle_if_due()

    def _limit(self, sensor: Sensor) -> None:
        within = None if self._area.everywhere else self._within
        for clutter in (sensor.local_clutter, sensor.system_clutter):
            clutter.limit(within)

    def _within(self, points: FloatArray) -> BoolArray:
        return np.asarray(self._area.depth(points) > -self.share.width_m)

    def _new_area(self) -> None:
        self._area = self.neighbours.area()
        for sensor in self.sensors.values():
            self._limit(sensor)

    # --- the cycle ---

    def _cycle_if_due(self) -> None:
        due = self._time.now_s - self._cycle_s >= self.settings.cycle_s
        super()._cycle_if_due()
        if not due:
            return
        self.ownership.cycle += 1
        self._cycles += 1
        self._join()
        for change in self._priors.take(self.sensors, self.neighbours):
            self._correct(change)
        if self.neighbours.owning():
            self._pull()
        else:
            self._known()
        self._band = self._band_now()

    def _join(self) -> None:
        """Own the area once our tracks are those of the units that looked after it, or at once where none did."""
        if self.neighbours.state != "joining" or self._alive is None or self._cycles <= _JOIN_CYCLES:
            return
        if self._heard_others_s is None:
            self._heard_others_s = self._time.now_s
        waited_s = self._time.now_s - self._heard_others_s
        if self.neighbours.alone() or waited_s >= self.share.confirm_s:
            self.neighbours.state = "active"
            self._new_area()

    def _pull(self) -> None:
        rows = self._known()
        taken = self.ownership.pull(self._system.life.link[rows], self._depths(rows), self.neighbours.indices())
        self.counters["taken_over"] += taken

    def _known(self) -> IntArray:
        """Confirmed rows, all of them known to the ownership, as are the lost tracks."""
        rows = self._confirmed()
        self.ownership.known(np.concatenate([self._system.life.link[rows], self._stitching.numbers]))
        return rows

    def _confirmed(self) -> IntArray:
        rows = self._system.rows
        return np.asarray(rows[self._system.life.confirmed[rows]])

    def _depths(self, rows: IntArray) -> Depths:
        return Depths(self._area.depth(self._where(rows)), self.share.width_m, self.share.handover_m)

    def _where(self, rows: IntArray) -> FloatArray:
        x = self._system.filters.mean[rows]
        dt_s = np.maximum(self._time.now_s - self._system.filters.t_s[rows], 0.0)
        return np.asarray(x[:, :2] + dt_s[:, None] * x[:, 2:])

    def _due_frame(self, period_s: float) -> TrackFrame | None:
        if self.neighbours.owning():
            self._note_births()
        frame = super()._due_frame(period_s)
        return None if frame is None else self._owned_only(frame)

    def _note_births(self) -> None:
        """What is born far from every border is ours at once."""
        rows = self._confirmed()
        new = rows[~np.isin(self._system.life.link[rows], self.ownership.claims.ident)]
        if len(new):
            self._known()
            self.ownership.born(self._system.life.link[new], self._depths(new))

    def _owned_only(self, frame: TrackFrame) -> TrackFrame:
        ours = self.ownership.owned(frame.track_id)
        tentative = frame.status == TENTATIVE
        if tentative.any() and self.neighbours.owning():
            ours[tentative] = self._area.depth(frame.state[tentative, :2]) >= 0.0
        ended = frame.status == ENDED
        ours[ended] &= ~np.isin(frame.track_id[ended], frame.track_id[~ended])
        kept = frames.take(frame, ours)
        return kept.model_copy(update={"epoch": self.ownership.epochs(kept.track_id)})

    # --- the band ---

    def _held(self, rows: IntArray) -> Held:
        life = self._system.life
        first, last = self._time.to_ns_array(life.first_s[rows]), self._time.to_ns_array(life.last_s[rows])
        return Held(life.link[rows], self._keys(rows), first, last)

    def _keys(self, rows: IntArray) -> IntArray:
        """Keys (n, KEPT) of the last plots of rows, the youngest last."""
        arrays = self._system.filters.arrays()
        place = arrays["ring_n"][rows][:, None] - KEPT + np.arange(KEPT)
        keys = arrays["ring"]["key"][rows[:, None], np.maximum(place, 0)]
        return np.asarray(np.where(place >= 0, keys, NO_KEY))

    def _adopt(self, told: BandFrame, one: Neighbour) -> None:
        rows = self._known()
        held = self._held(rows)
        ident = self.ownership.hear(held, told, one.index, one.number, self._time.to_ns(self._time.now_s))
        changed = ident != held.ident
        if not changed.any():
            return
        life = self._system.life
        life.link[rows[changed]] = ident[changed]
        # Whoever adopts an id adopts its age: of two ids of one target the older one stays.
        theirs = np.isin(told.track_id, ident[changed])
        for track, first_ns in zip(told.track_id[theirs].tolist(), told.first_t_ns[theirs].tolist(), strict=True):
            row = rows[ident == track]
            life.first_s[row] = np.minimum(life.first_s[row], self._time.to_s(first_ns))
        self._stitching.forget(ident[changed])
        self.counters["adopted"] += int(changed.sum())

    def _band_now(self) -> BandFrame:
        rows = self._confirmed()
        rows = rows[self._near_others(rows)]
        held = self._held(rows)
        x, P, _ = self._system.predict(rows, np.maximum(self._system.filters.t_s[rows], self._time.now_s))
        owner, epoch = self.ownership.owned(held.ident), self.ownership.epochs(held.ident)
        self._band_seq += 1
        sender = Sender(self.unit, self.origin, self.share, self.neighbours.state)
        now_ns = self._time.to_ns(self._time.now_s)
        return sender.message(self._band_seq - 1, now_ns, held, owner, epoch, x, P)

    def _near_others(self, rows: IntArray) -> BoolArray:
        """Rows that others may track too: those in the band, and what is ours though it is beyond."""
        if not self.neighbours.told_of():
            return np.zeros(len(rows), np.bool_)
        where, width_m = self._where(rows), self.share.width_m
        owned = self.ownership.owned(self._system.life.link[rows])
        depth = self._area.depth(where)
        later = self.neighbours.area_with_joining()
        if later is not None:
            depth = np.minimum(depth, later.depth(where))
        return np.asarray((depth < width_m) & (owned | (depth > -width_m)))

    # --- units that are gone, and restarts ---

    def _inherit(self, gone: Neighbour) -> None:
        """Go on with the tracks of a unit that died, as far as they are in our area now and not ours already."""
        frame = self.neighbours.pop_tracks(gone.unit_id)
        if frame is None or not self.neighbours.owning():
            return
        try:
            told = read(frame, self.unit.unit_id)
        except RefusedMessage as error:
            self.counters[f"takeover_{error.reason}"] += 1
            return
        held = np.concatenate([self._system.life.link[self._confirmed()], self._stitching.numbers])
        new = (self._area.depth(told.x[:, :2]) >= 0.0) & ~np.isin(told.ident, held)
        if not new.any():
            return
        live = (frame.status == CONFIRMED) | (frame.status == COASTING)
        t_s = self._time.to_s(frame.t_ns)
        first_s = self._time.to_s_array(told.first_ns[new])
        rows = self._system.seed(told.x[new], told.P[new], t_s, first_s, _SEED_SCORE)
        # They have as long to be seen again as if they had just been seen.
        self._system.life.last_s[rows] = self._time.now_s
        self._system.life.link[rows] = told.ident[new]
        self._known()
        self.ownership.inherit(told.ident[new], frame.epoch[live][new].astype(np.int64))
        self.counters["inherited"] += len(rows)

    def snapshot(self) -> Snapshot | None:
        """As of any engine, with the epochs of the tracks."""
        kept = super().snapshot()
        if kept is None:
            return None
        claims = self.ownership.claims
        arrays = named("partition", {"ident": claims.ident, "epoch": claims.epoch})
        return kept._replace(arrays=kept.arrays | arrays)

    def _restore(self, kept: Snapshot) -> None:
        super()._restore(kept)
        ours = under("partition", kept.arrays)
        if ours:
            self.ownership.restore(ours["ident"], ours["epoch"])
