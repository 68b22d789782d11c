"""The fusion engine: plots in, pictures out. Pure: no network, no clock; the same inputs give the same frames.

The way of a batch: the local layer of its sensor (raw plots, knows nothing of the others), the system layer (the plots
of all sensors; it makes the picture), the count of shared plots, and every ``cycle_s`` the association cycle. Time
comes with the data, and as ticks when no data comes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.errors import RefusedMessage, TrackmeshError
from trackmesh.protocol.messages import (
    Geodetic,
    PlotBatch,
    RefinedFrame,
    Registration,
    SensorInfo,
    TrackFrame,
    TrackQuery,
)
from trackmesh.services.estimation.plots import Plots
from trackmesh.services.fusion import frames, life
from trackmesh.services.fusion.biases import Change, moved
from trackmesh.services.fusion.clutter import Clutter
from trackmesh.services.fusion.composition import Composition
from trackmesh.services.fusion.corrections import Corrections
from trackmesh.services.fusion.cycle import AssociationCycle
from trackmesh.services.fusion.inputs import Inputs
from trackmesh.services.fusion.layer import Layer, Look
from trackmesh.services.fusion.life import Rules
from trackmesh.services.fusion.picture import Picture, Unit
from trackmesh.services.fusion.restart import picture_of
from trackmesh.services.fusion.sensors import Sensor
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.snapshot import Snapshot, named, under
from trackmesh.services.fusion.stitching import Stitching
from trackmesh.services.fusion.timeline import Timeline

__all__ = ["FusionEngine", "Unit"]

IntArray = npt.NDArray[np.int64]

_TENTATIVE_AGE_PERIODS = 2.2
_SEEN_LATELY_PERIODS = 5.0
_JUDGED_SECTORS_LATE = 1.5
_MISSES_TO_END = 5.2  # of a sensor that never misses one miss weighs much, and two can be an accident
_ROWS = 256


class FusionEngine:
    """One unit's tracker.

    Attributes:
        corrections: what is known of the sensors' biases.
        inputs: the units whose tracks it takes.
        counters: what happened, by name (``plots``, ``late_plots``, ``merged``, ``contradictions``, ...).
        sensors: by id, in the order in which they were first heard of.
        log_likelihood: of all plots so far under the picture, against clutter alone: the plots that tracks took by
            their predicted density over that of clutter (the declared one, else the running estimate), and the misses.
    """

    def __init__(
        self, settings: EngineSettings, unit: Unit, origin: Geodetic | None = None, inputs: Sequence[str] = ()
    ) -> None:
        self.settings = settings
        self.unit = unit
        self.counters: Counter[str] = Counter()
        self.sensors: dict[str, Sensor] = {}
        self.log_likelihood = 0.0
        self._time = Timeline()
        rules = self._rules(1.0, settings.coast_s)
        self._system = Layer(settings.system_tracks(_ROWS), rules, 1, settings.gate, settings.height_tracks())
        self._locals: list[Layer] = []
        self.corrections = Corrections(
            settings.registration_rules() if settings.registration else None, settings.right_clocks
        )
        self._registration_due = False
        self._cycle = AssociationCycle(
            self._system, self._locals, self.corrections.biases, settings.pair_test, self.counters, self._end
        )
        self._picture = Picture(settings, unit, self._system, self.sensors, self._time)
        self._picture.origin = origin
        expected = settings.input_rules()
        self.inputs = Inputs(inputs, unit.unit_id, expected, self._system, self._picture, self._time, self.counters)
        self._picture.composition = Composition(self.inputs) if inputs else None
        self._stitching = Stitching(self._system, settings.stitch_s, settings.stitch_q_m2ps3)
        self._cycle_s = -np.inf
        self._frame_s = -np.inf

    @property
    def origin(self) -> Geodetic | None:
        """Origin of the system plane: the one given, else the site of the first sensor that has one."""
        return self._picture.origin

    @property
    def now_ns(self) -> int | None:
        """The engine's time: the newest that data or ticks have told; None before any."""
        return self._time.now_ns

    def sensor(self, info: SensorInfo) -> None:
        """Take note of a sensor; a known one is replaced, its tracks live on."""
        old = self.sensors.get(info.sensor_id)
        if old is not None and old.info == info:
            return
        self._settle(info.site)
        index = old.index if old else len(self.sensors)
        s = self.settings
        sensor = Sensor(index, info, self.origin, clutter_areas=s.clutter_areas, noise_model=s.noise_model)
        if old is not None:
            sensor.take_over(old)
        self.sensors[info.sensor_id] = sensor
        self.corrections.announce(sensor.index, info, sensor.site)
        longest = max(s.info.period_s for s in self.sensors.values())
        self._system.rules = self._rules(longest, self.settings.coast_s)
        rules = self._rules(info.period_s, self.settings.local_coast_periods * info.period_s)
        if old is None:
            self._system.add_sensors(len(self.sensors))
            self._locals.append(Layer(self.settings.local_tracks(_ROWS), rules, 1, self.settings.gate))
        else:
            self._locals[sensor.index].rules = rules

    def plots(self, batch: PlotBatch) -> TrackFrame | None:
        """Take a batch of plots; the new picture, unless the last one is too recent.

        Raises:
            RefusedMessage: the sensor is unknown, or its plots cannot be placed.
        """
        sensor = self.sensors.get(batch.sensor_id)
        if sensor is None:
            raise RefusedMessage("unknown_sensor", f"Nothing is known of sensor {batch.sensor_id} yet.")
        if len(batch.t_ns):
            self._take(sensor, batch, sensor.plots(batch, self._time.to_s_array(batch.t_ns)))
        else:
            sensor.saw_nothing(1.0 / batch.scan.sectors if batch.scan else 1.0)
        return self._due_frame(self.settings.frame_period_s)

    def tracks(self, frame: TrackFrame) -> TrackFrame | None:
        """Take the tracks of another unit; a picture now and then, as from a tick: units must not chase each other.

        Raises:
            RefusedMessage: the unit is no input, or its frame is wrong (see ``Inputs.read``).
        """
        told = self.inputs.read(frame)
        self._settle(frame.origin)
        self._time.advance(self._time.to_s(frame.t_ns))
        self.inputs.tell(frame, told, self.origin)
        return self._pass_time()

    def tick(self, t_ns: int) -> TrackFrame | None:
        """Let time advance without data; a picture now and then."""
        self._time.advance(self._time.to_s(t_ns))
        return self._pass_time()

    def _pass_time(self) -> TrackFrame | None:
        confirmed, ended = self._system.judge(self._time.now_s)
        self._name(confirmed)
        self._note_lost(ended)
        for local in self._locals:
            local.judge(self._time.now_s)
        self._cycle_if_due()
        return self._due_frame(max(self.settings.idle_frame_s, self.settings.frame_period_s))

    def query(self, query: TrackQuery) -> TrackFrame:
        """The present picture, or that at ``query.at_t_ns``, as far as it is asked for; changes nothing.

        Raises:
            RefusedMessage: the query cannot be answered (no origin for a geographic box).
        """
        tentative = query.status is not None and 0 in query.status
        t_s = self._time.now_s
        if query.at_t_ns is not None and self._time.epoch_ns is not None:
            t_s = self._time.to_s(query.at_t_ns)
        return frames.select(self._picture.at(t_s, tentative), query)

    def refined(self) -> RefinedFrame | None:
        """States of ``settings.lag`` plots ago, refined by those since, of the tracks that moved on since then.

        None where there are none, or no lag is kept.
        """
        return self._picture.refined()

    def registration(self) -> Registration | None:
        """What is known of the sensors' biases, once after every association cycle."""
        if not self._registration_due:
            return None
        self._registration_due = False
        return self.corrections.message(
            self.unit.unit_id, self.unit.boot_id, self._picture.seq, self._time.to_ns(self._time.now_s)
        )

    def snapshot(self) -> Snapshot | None:
        """What is needed to go on after a restart; None before any data."""
        now_ns = self._time.now_ns
        if now_ns is None:
            return None
        arrays = named("system", self._system.kept()) | named("lost", self._stitching.kept())
        for sensor, local in zip(self.sensors.values(), self._locals, strict=True):
            arrays |= named(f"local/{sensor.index}", local.kept())
            arrays |= named(f"clutter/{sensor.index}/local", sensor.local_clutter.kept())
            arrays |= named(f"clutter/{sensor.index}/system", sensor.system_clutter.kept())
            arrays |= {f"stood/{sensor.index}": sensor.where_it_stood()}
        arrays |= named("inputs", self.inputs.kept())
        numbers = {"epoch_ns": self._time.epoch_ns, "next_track": self._picture.next_track}
        return Snapshot(
            t_ns=now_ns,
            settings=self.settings.model_dump(mode="json"),
            numbers=numbers,
            origin=self.origin,
            sensors=[sensor.info for sensor in self.sensors.values()],
            registration=self.corrections.record(now_ns),
            streams={},
            arrays=arrays,
        )

    def restore(self, kept: Snapshot) -> None:
        """Go on from what an earlier run knew, before anything else is told.

        Raises:
            TrackmeshError: it is of other settings; the engine is then of no use.
        """
        if kept.settings != self.settings.model_dump(mode="json"):
            raise TrackmeshError("The state was made with other settings.")
        try:
            self._restore(kept)
        except (KeyError, ValueError, TypeError):
            raise TrackmeshError("The state is not that of a unit with these settings.") from None

    def _restore(self, kept: Snapshot) -> None:
        self._time.epoch_ns = int(kept.numbers["epoch_ns"])
        self._time.advance(self._time.to_s(kept.t_ns))
        self._picture.next_track = max(int(kept.numbers["next_track"]), self.unit.first_track)
        self._picture.origin = kept.origin
        if kept.registration is not None:
            self.corrections.restore(kept.registration, kept.t_ns)
        for info in kept.sensors:
            self.sensor(info)
        self._system.restore(under("system", kept.arrays))
        self._stitching.restore(under("lost", kept.arrays))
        self.inputs.restore(under("inputs", kept.arrays))
        for sensor, local in zip(self.sensors.values(), self._locals, strict=True):
            local.restore(under(f"local/{sensor.index}", kept.arrays))
            sensor.local_clutter.restore(under(f"clutter/{sensor.index}/local", kept.arrays))
            sensor.system_clutter.restore(under(f"clutter/{sensor.index}/system", kept.arrays))
            sensor.stands_again(kept.arrays[f"stood/{sensor.index}"])
            self.corrections.announce(sensor.index, sensor.info, sensor.site)
        self.counters["restored"] = int(self._system.life.confirmed[self._system.rows].sum())

    def figures(self) -> dict[str, float]:
        """Present values for the status: tracks, local tracks, pairs under the sequential test."""
        rows = self._system.rows
        confirmed = int(self._system.life.confirmed[rows].sum())
        out = {
            "tracks": confirmed,
            "tentative": len(rows) - confirmed,
            "pairs": sum(len(d.row_a) for d in self._cycle.declared),
        }
        out |= {f"local_tracks.{s.info.sensor_id}": len(self._locals[s.index].rows) for s in self.sensors.values()}
        out |= self.inputs.figures()
        return {name: float(value) for name, value in (out | self._system.filters.figures()).items()}

    # --- one batch ---

    def _take(self, sensor: Sensor, batch: PlotBatch, plots: Plots) -> None:
        t_s = plots["t_s"]
        self._time.advance(float(t_s.max()))
        self.counters["plots"] += len(plots)
        oldest_s = self._time.now_s - self.settings.max_lateness_s
        if t_s.min() < oldest_s:
            self.counters["too_late_plots"] += int((t_s < oldest_s).sum())
            plots = plots[t_s >= oldest_s]
            if not len(plots):
                return
        if sensor.stood(plots["site"][0], float(plots["t_s"].max())):
            self.corrections.announce(sensor.index, sensor.info, sensor.site)
        sectors = batch.scan.sectors if batch.scan else 1
        local = self._locals[sensor.index]
        look = self._look(sensor, 0, plots, sectors, sensor.local_clutter)
        got = local.step(plots, look, self._time.now_s)
        sensor.local_clutter.add(plots, got.by_confirmed, 1.0 / sectors)
        look = self._look(sensor, sensor.index, plots, sectors, sensor.system_clutter)
        corrected = self.corrections.correct_of(sensor.index, plots)
        fed = self._system.step(corrected, look, self._time.now_s)
        sensor.system_clutter.add(plots, fed.by_confirmed, 1.0 / sectors)
        self.log_likelihood += fed.log_likelihood
        self.counters["late_plots"] += fed.late
        life.share(local.life, got.row, self._system.life.uid[fed.row])
        self._name(fed.confirmed)
        self._note_lost(fed.ended)
        self._cycle_if_due()

    def _look(self, sensor: Sensor, index: int, plots: Plots, sectors: int, clutter: Clutter) -> Look:
        info = sensor.info
        density = clutter.at(plots, 1.0 / sectors)
        return Look(
            sensor=index,
            t_s=float(plots["t_s"].max()),
            site=plots["site"][0].copy(),
            max_range_m=info.max_range_m,
            period_s=info.period_s,
            p_detect=info.p_detect,
            whole=sectors == 1,
            margin_s=_JUDGED_SECTORS_LATE * info.period_s / sectors + self.settings.lateness_s,
            lately_s=np.inf if info.kind == "radar" else _SEEN_LATELY_PERIODS * info.period_s,
            clutter_density=density,
            reference_density=info.clutter_density or clutter.whole(len(plots), 1.0 / sectors),
        )

    def _name(self, rows: IntArray) -> None:
        """Give newly confirmed system tracks their public numbers: those of lost tracks that they continue, or new."""
        if not len(rows):
            return
        taken, numbers, dropped = self._stitching.take_over(rows, self._time.now_s)
        self._system.life.link[taken] = numbers
        for row in dropped.tolist():
            self._system.drop(row)
        if self.inputs.shown:
            # What stands in the picture as a foreign track has an id already.
            self.inputs.cycle(regular=False)
        self._picture.name(rows[self._system.life.link[rows] < 0])
        self.counters["confirmed"] += len(rows) - len(taken)
        self.counters["stitched"] += len(taken)

    def _note_lost(self, ended: list[tuple[int, int, int]]) -> None:
        """Rows had no plot for too long; and tell of those of earlier whose time is over."""
        ended = self.inputs.without_heir(ended)
        if ended:
            rows = np.array([row for row, _, _ in ended], np.int64)
            self._stitching.lose(rows, self._picture.last_words(rows))
        gone = self._stitching.gone(self._time.now_s)
        self._picture.tell(gone)
        self.counters["ended"] += len(gone)

    # --- the association cycle ---

    def _cycle_if_due(self) -> None:
        if self._time.now_s - self._cycle_s < self.settings.cycle_s:
            return
        self._cycle_s = self._time.now_s
        self.counters["repairs"] = self._system.filters.repairs + sum(one.filters.repairs for one in self._locals)
        self._registration_due = self.settings.registration
        for change in self._cycle.run(list(self.sensors), self._time.now_s, self.inputs.references()):
            self._correct(change)
        self.inputs.cycle()

    def _correct(self, change: Change) -> None:
        """Plots of a sensor are corrected otherwise from now on: move what the system tracks remember of it along."""
        self.counters[f"registration_{change.kind}"] += 1
        if change.kind == "locked" and change.shift_m > self.settings.restart_shift_m:
            self._restart()
        else:
            index = self.sensors[change.sensor_id].index
            later_s = float(change.before[2] - change.after[2])
            self._system.filters.move_plots(index, lambda plots: moved(change, plots["z"], plots["site"]), -later_s)

    def _restart(self) -> None:
        """Make the picture anew from the local tracks: the tracks so far were of plots that did not fit each other."""
        for row in self._system.rows.tolist():
            self._end(row)
        found = picture_of(self._locals, self._cycle.declared)
        plots = [self.corrections.correct(one) for one in found.plots]
        rows = self._system.adopt(plots, found.score)
        self._name(rows)
        for k, row in enumerate(rows.tolist()):
            for sensor, local_row in found.members[k]:
                life.tie(self._locals[sensor].life, local_row, int(self._system.life.uid[row]))

    def _end(self, row: int) -> None:
        known = self._system.life
        if known.confirmed[row]:
            self._picture.tell([self._picture.last_words(np.array([row]))])
            self.counters["ended"] += 1
        self._system.drop(row)

    def _due_frame(self, period_s: float) -> TrackFrame | None:
        if self._time.epoch_ns is None or self._time.now_s - self._frame_s < period_s:
            return None
        self._frame_s = self._time.now_s
        self.inputs.expire()
        return self._picture.next_frame()

    def _settle(self, origin: Geodetic | None) -> None:
        """The first place that anybody tells of is the origin of the system plane, unless one was given."""
        if self.origin is None and origin is not None:
            self._picture.origin = origin
            for known in self.sensors.values():
                known.settle(origin)

    def _rules(self, period_s: float, coast_s: float) -> Rules:
        s = self.settings
        surest = max((sensor.info.p_detect for sensor in self.sensors.values()), default=0.0)
        end_fall = max(s.end_fall, _MISSES_TO_END * -float(np.log(max(1.0 - surest, 1e-3))))
        return Rules(
            s.confirm_score, s.confirm_hits, s.score_cap, s.drop_score, s.drop_fall, s.max_misses,
            _TENTATIVE_AGE_PERIODS * period_s, coast_s, end_fall,
        )  # fmt: skip
