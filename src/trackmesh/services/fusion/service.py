"""The fusion service: plots from the bus, the engine, pictures to the bus. One thread owns the engine."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator

from trackmesh.protocol.buffer import Buffer
from trackmesh.protocol.bus import Query, Sample, Subscription
from trackmesh.protocol.codec import decode, encode, encoding, open_envelope
from trackmesh.protocol.errors import QueryFailed, RefusedMessage, TrackmeshError
from trackmesh.protocol.files import Tick
from trackmesh.protocol.keys import kind_and_id, last_chunk
from trackmesh.protocol.messages import PlotBatch, SensorHealth, SensorInfo, TrackFrame, TrackQuery
from trackmesh.protocol.serving import answers
from trackmesh.services.fusion.black_box import BlackBox
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.input_feed import InputFeed
from trackmesh.services.fusion.intake import Intake
from trackmesh.services.fusion.keeping import Keeper
from trackmesh.services.fusion.partition.feed import PartitionFeed, partitioned_engine
from trackmesh.services.fusion.partition.sensor_plots import SensorPlots
from trackmesh.services.fusion.partition.warm_up import warm_up as warm_up_partition
from trackmesh.services.fusion.picture import TRACK_EPOCH_MS
from trackmesh.services.fusion.rates import Rates
from trackmesh.services.fusion.settings import FusionSettings
from trackmesh.services.fusion.warm_up import warm_up
from trackmesh.services.runtime import Health, ServiceRuntime
from trackmesh.services.sensor_watch import Limits, SensorWatch

KIND = "fusion"
# After an outage the plots of all of it come at once, and so do the frames; not every client is back by then.
_FRAMES_KEPT = 128
_PLOTS_WAITING = 4096
_BATCHES_HELD = 64
_SENSORS_HELD = 256
_ASK_EVERY_S = 0.5
_INPUTS_EVERY_S = 0.05


class FusionService:
    """A unit at work on a runtime; ``start`` declares everything, the runtime stops it."""

    def __init__(self, runtime: ServiceRuntime, settings: FusionSettings) -> None:
        self.runtime = runtime
        self.settings = settings
        self._started_ns = time.time_ns()
        first = self._started_ns // 1_000_000 - TRACK_EPOCH_MS
        self.unit = Unit(settings.unit_id, settings.unit_number, runtime.boot_id, first)
        self.engine = self._new_engine()
        self.intake = Intake(int(settings.max_age_s * 1e9), int(settings.max_ahead_s * 1e9))
        self._of_now = settings.clock == "wall"
        self._rates = Rates(settings.max_batches_per_s, settings.max_plots_per_s)
        limits = Limits(settings.clock_limit_s, settings.clock_drift_limit_ppm)
        self._watch = SensorWatch(limits, self._of_now, tuple(settings.sensors))
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._held: dict[str, deque[PlotBatch]] = {}
        self._answered: Buffer[SensorInfo] = Buffer(_SENSORS_HELD)
        self._tick_due_s = 0.0
        self._inputs: InputFeed | None = None
        self._partition: PartitionFeed | None = None
        self._keeper = Keeper(settings, runtime.log, runtime.counters.count)
        self._black_box: BlackBox | None = None

    def _new_engine(self) -> FusionEngine:
        if self.settings.partition is not None:
            return partitioned_engine(self.settings, self.unit, self._started_ns)
        return FusionEngine(self.settings.engine, self.unit, self.settings.origin, self.settings.inputs)

    def start(self) -> None:
        """Compile, subscribe, serve, and be ready."""
        runtime, keys = self.runtime, self.runtime.keys
        self.engine, state = self._keeper.engine(self._new_engine, self.intake)
        biases = self._keeper.restore_biases(self.engine) if state is None else None
        if self.settings.black_box is not None:
            self._black_box = BlackBox(
                self.settings.black_box, self.unit, self.settings.engine, self.settings.origin, biases, state,
                self.settings.inputs,
            )  # fmt: skip
            runtime.on_exit(self._black_box.close)
        runtime.set_state("compiling")
        started = time.monotonic()
        warm_up(self.settings.engine, inputs=bool(self.settings.inputs))
        if self.settings.partition is not None:
            warm_up_partition(self.settings.engine)
        runtime.log.info("kernels ready after %.1f s", time.monotonic() - started)
        self._frames = runtime.bus.publisher(keys.tracks(self.unit.unit_id), history=_FRAMES_KEPT)
        self._refined = runtime.bus.publisher(keys.refined(self.unit.unit_id), history=_FRAMES_KEPT)
        self._biases = runtime.bus.publisher(keys.registration(self.unit.unit_id), history=1)
        runtime.on_exit(self._keeper.write_waiting)
        runtime.on_exit(lambda: self._keeper.keep(self.engine, self.intake, now=True))
        # The engine's thread may publish until it has ended.
        runtime.on_exit(self._frames.close)
        runtime.on_exit(self._refined.close)
        runtime.on_exit(self._biases.close)
        self._tokens = runtime.closing(runtime.bus.watch_alive(keys.live("*", "*")))
        self._infos = runtime.closing(runtime.bus.subscribe(keys.sensor("*"), history=True))
        self._plots = self._subscribe_to_plots()
        self._watch.began_ns = time.time_ns()
        if self.settings.inputs:
            self._inputs = InputFeed(runtime, self.settings)
        runtime.health = self.health
        runtime.closing(runtime.bus.serve(keys.service("tracks", self.unit.unit_id), self.answer))
        runtime.spawn("engine", self._run)
        runtime.spawn("asker", self._ask_unknown)
        if self.settings.state_file is not None:
            runtime.spawn("state", lambda: self._keeper.write_states(runtime.stopping))
        runtime.set_state("ready")

    def _subscribe_to_plots(self) -> Subscription | SensorPlots:
        runtime = self.runtime
        if self.settings.partition is not None:
            self._partition = PartitionFeed(runtime, self.settings, self._lock, _PLOTS_WAITING)
            return self._partition.plots
        plots = runtime.bus.subscribe(runtime.keys.plots("*"), history=True, capacity=_PLOTS_WAITING, fair=True)
        return runtime.closing(plots)

    def answer(self, query: Query) -> Iterator[tuple[bytes, str]]:
        """Answer a ``TrackQuery`` with one ``TrackFrame``; an empty payload asks for all tracks."""

        def frames(asked: TrackQuery) -> Iterator[TrackFrame]:
            self.runtime.counters.count("queries")
            with self._lock:
                frame = self.engine.query(asked)
            yield frame

        return answers(query, TrackQuery, frames, self.runtime.counters.refuse)

    def health(self) -> Health:
        """Sensors and figures for the status."""
        with self._lock:
            figures = self.engine.figures()
            counters = dict(self.engine.counters)
            if isinstance(self._plots, SensorPlots):
                self._watch.follow(self._plots.sensors, time.time_ns())
            notices = self._watch.notices(self._alive, time.time_ns())
            sensors = [self._sensor_health(sensor_id) for sensor_id in sorted(self.intake.streams)]
            sensors += self._inputs.health(self.engine.inputs) if self._inputs else []
        figures |= {f"engine.{name}": float(value) for name, value in counters.items()}
        figures["batches_dropped_here"] = float(self._plots.dropped)
        return Health(figures, sensors, notices)

    # --- the engine's thread ---

    def _run(self) -> None:
        # Kept tracks must grow old before plots come that could be taken for theirs.
        self._tick_if_due()
        others = self._inputs or self._partition
        patience_s = min(self.settings.tick_s, _INPUTS_EVERY_S) if others else self.settings.tick_s
        while not self.runtime.stopping.is_set():
            self._drain()
            sample = self._plots.receive(timeout_s=patience_s)
            if sample is not None:
                self._on_plots(sample)
            self._tick_if_due()

    def _drain(self) -> None:
        while (event := self._tokens.receive(timeout_s=0)) is not None:
            kind, ident = kind_and_id(event.key)
            if kind == "sensor" and self._wanted(ident):
                (self._alive.add if event.alive else self._alive.discard)(ident)
                self.runtime.log.info("sensor %s %s", ident, "is there" if event.alive else "is gone")
            elif kind == KIND and (others := self._inputs or self._partition):
                others.note_alive(ident, event.alive)
        while (sample := self._infos.receive(timeout_s=0)) is not None:
            self._on_info(sample)
        while (info := self._answered.receive(timeout_s=0)) is not None:
            self._take_info(info)
        for frame in self._inputs.frames() if self._inputs else ():
            self._take_tracks(frame)
        if self._partition is not None:
            self._partition.exchange(self.engine)

    def _on_info(self, sample: Sample) -> None:
        if not self._wanted(last_chunk(sample.key)):
            return
        try:
            info = decode(sample.payload, SensorInfo, sample.encoding)
            if info.sensor_id != last_chunk(sample.key):
                raise RefusedMessage("wrong_sensor", f"{sample.key} brought the sensor {info.sensor_id}.")
            if info.sensor_id not in self.engine.sensors and len(self.engine.sensors) >= self.settings.max_sensors:
                raise RefusedMessage("too_many_sensors", f"There are {self.settings.max_sensors} sensors already.")
        except RefusedMessage as error:
            self._refuse(last_chunk(sample.key), error)
            return
        self._take_info(info)

    def _take_info(self, info: SensorInfo) -> None:
        known = self.engine.sensors.get(info.sensor_id)
        if known is None or known.info != info:
            self._record(info)
            with self._lock:
                self.engine.sensor(info)
                self._watch.expect(info.sensor_id, info.period_s, time.time_ns())
            self.runtime.log.info("sensor %s: %s, every %g s", info.sensor_id, info.kind, info.period_s)
        for batch in self._held.pop(info.sensor_id, ()):
            self._take_batch(batch)

    def _on_plots(self, sample: Sample) -> None:
        sensor_id = last_chunk(sample.key)
        if not self._wanted(sensor_id):
            return
        now_ns, now_s = time.time_ns(), time.monotonic()
        try:
            batch = self._read_batch(sensor_id, sample, now_s)
            self._note_heard(batch, now_ns)
            if self._of_now and not self._rates.plots(sensor_id, len(batch.t_ns), now_s):
                raise RefusedMessage("too_fast", f"Sensor {sensor_id} sends more plots than it may.")
            self.intake.check(batch, now_ns if self._of_now else None)
        except RefusedMessage as error:
            self._refuse(sensor_id, error)
            return
        self._watch.took(sensor_id, now_ns)
        if sensor_id in self.engine.sensors:
            self._take_batch(batch)
        else:
            self._hold(batch)

    def _read_batch(self, sensor_id: str, sample: Sample, now_s: float) -> PlotBatch:
        # Before it is decoded: who floods must cost nothing.
        if self._of_now and not self._rates.message(sensor_id, now_s):
            raise RefusedMessage("too_fast", f"Sensor {sensor_id} sends more batches than it may.")
        batch = decode(sample.payload, PlotBatch, sample.encoding, self.settings.max_batch_bytes)
        if batch.sensor_id != sensor_id:
            raise RefusedMessage("wrong_sensor", f"{sample.key} brought plots of {batch.sensor_id}.")
        self._check_room(sensor_id)
        return batch

    def _note_heard(self, batch: PlotBatch, now_ns: int) -> None:
        sectors = batch.scan.sectors if batch.scan is not None else 1
        newest_ns = int(batch.t_ns.max()) if len(batch.t_ns) else None
        with self._lock:
            self._watch.heard(batch.sensor_id, newest_ns, sectors, now_ns)
        if (sensor := self.engine.sensors.get(batch.sensor_id)) is not None:
            self._rates.expect(batch.sensor_id, sectors / sensor.info.period_s)

    def _check_room(self, sensor_id: str) -> None:
        unknown = sensor_id not in self.engine.sensors and sensor_id not in self._held
        if unknown and len(self._held) >= _SENSORS_HELD:
            raise RefusedMessage("too_many_sensors", f"Too many sensors are unknown already, {sensor_id} is left out.")

    def _take_batch(self, batch: PlotBatch) -> None:
        self._record(batch)
        try:
            with self._lock:
                frame = self.engine.plots(batch)
        except RefusedMessage as error:
            self._refuse(batch.sensor_id, error)
            return
        self._tick_due_s = time.monotonic() + self.settings.tick_s
        self.runtime.counters.count("batches")
        self.runtime.counters.count("plots", len(batch.t_ns))
        self._publish(frame)
        if frame is not None and len(batch.t_ns) and self._of_now:
            self.runtime.latencies.record((time.time_ns() - int(batch.t_ns.max())) / 1e9)

    def _take_tracks(self, frame: TrackFrame) -> None:
        assert self._inputs is not None
        self._record(frame)
        try:
            with self._lock:
                ours = self.engine.tracks(frame)
        except RefusedMessage as error:
            self._inputs.refuse(frame.unit_id, error)
            return
        self._publish(ours)

    def _wanted(self, sensor_id: str) -> bool:
        return not self.settings.sensors or sensor_id in self.settings.sensors

    def _tick_if_due(self) -> None:
        if not self._of_now or time.monotonic() < self._tick_due_s:
            return
        self._tick_due_s = time.monotonic() + self.settings.tick_s
        t_ns = time.time_ns()
        self._record(Tick(t_ns=t_ns))
        with self._lock:
            frame = self.engine.tick(t_ns)
        self._publish(frame)

    def _publish(self, frame: TrackFrame | None) -> None:
        if frame is not None:
            self._frames.put(encode(frame), encoding(frame))
            self.runtime.counters.count("frames")
            # Only this thread changes the engine.
            self._keeper.keep(self.engine, self.intake)
            refined, biases = self.engine.refined(), self.engine.registration()
            if refined is not None:
                self._refined.put(encode(refined), encoding(refined))
            if biases is not None:
                self._biases.put(encode(biases), encoding(biases))

    def _record(self, record: SensorInfo | PlotBatch | TrackFrame | Tick) -> None:
        if self._black_box is None:
            return
        try:
            self._black_box.take(record)
        except TrackmeshError as error:
            # The picture matters more than its record.
            self.runtime.log.error("the black box ends here: %s", error)
            self.runtime.counters.count("black_box_failures")
            self._black_box = None

    # --- sensors not yet known ---

    def _hold(self, batch: PlotBatch) -> None:
        """Keep the plots of a sensor of which nothing is known yet, and have it asked who it is."""
        held = self._held.setdefault(batch.sensor_id, deque())
        held.append(batch)
        if len(held) > _BATCHES_HELD:
            held.popleft()
            detail = f"Nothing is known of sensor {batch.sensor_id}: it must publish its SensorInfo."
            self._refuse(batch.sensor_id, RefusedMessage("unknown_sensor", detail))

    def _ask_unknown(self) -> None:
        """Ask sensors whose plots are held who they are; in a thread of its own, since they may not answer."""
        while not self.runtime.stopping.wait(_ASK_EVERY_S):
            for sensor_id in list(self._held):
                if self.runtime.stopping.is_set():
                    return
                for reply in self.runtime.bus.query(self.runtime.keys.sensor(sensor_id), timeout_s=_ASK_EVERY_S):
                    self._take_answer(sensor_id, reply)

    def _take_answer(self, sensor_id: str, reply: Sample) -> None:
        try:
            info = open_envelope(reply.payload, reply.encoding, SensorInfo)
        except (RefusedMessage, QueryFailed) as error:
            self.runtime.log.warning("sensor %s gave no information: %s", sensor_id, error)
            return
        if isinstance(info, SensorInfo) and info.sensor_id == sensor_id:
            self._answered.offer(info)

    # --- counting ---

    def _refuse(self, sensor_id: str, error: RefusedMessage) -> None:
        self.runtime.counters.refuse(error.reason)
        self._watch.refused(sensor_id, error.reason)
        if sensor_id in self.intake.streams or sensor_id in self.engine.sensors:
            self.intake.stream(sensor_id).refused += 1
        self.runtime.log.debug("refused: %s", error)

    def _sensor_health(self, sensor_id: str) -> SensorHealth:
        stream, sensor = self.intake.streams[sensor_id], self.engine.sensors.get(sensor_id)
        clock = self._watch.clock(sensor_id)
        return SensorHealth(
            sensor_id=sensor_id,
            alive=sensor_id in self._alive,
            plots=stream.plots,
            batches=stream.batches,
            gaps=stream.gaps,
            duplicates=stream.duplicates,
            refused=stream.refused,
            last_seq=max(stream.seq, 0),
            last_t_ns=stream.last_t_ns,
            clutter_density=sensor.system_clutter.whole() if sensor else None,
            silent_since_ns=self._watch.silent_since_ns(sensor_id, time.time_ns()),
            clock_offset_s=clock.offset_s,
            clock_drift_ppm=clock.drift_ppm,
        )


def run(settings: FusionSettings) -> int:
    """Be a fusion service until told to stop; the exit code."""
    return ServiceRuntime(KIND, settings).run(lambda runtime: FusionService(runtime, settings).start())
