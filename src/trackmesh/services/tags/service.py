"""The tag service: ranges from the bus, the engine, pictures to the bus. One thread owns the engine."""

from __future__ import annotations

import math
import threading
import time

from trackmesh.protocol.buffer import Buffer
from trackmesh.protocol.bus import Sample
from trackmesh.protocol.codec import decode, encode, encoding, open_envelope
from trackmesh.protocol.errors import QueryFailed, RefusedMessage, TrackmeshError
from trackmesh.protocol.files import Gone, RecordWriter, Tick, UnitRecord
from trackmesh.protocol.keys import kind_and_id, last_chunk
from trackmesh.protocol.messages import RangeBatch, SensorHealth, SensorInfo, TagFrame
from trackmesh.services.runtime import Health, ServiceRuntime
from trackmesh.services.sensor_watch import Limits, SensorWatch
from trackmesh.services.streams import Streams
from trackmesh.services.tags.engine import TagEngine, Unit
from trackmesh.services.tags.reader_file import ReaderFile
from trackmesh.services.tags.settings import TagSettings
from trackmesh.services.tags.warm_up import warm_up

KIND = "tags"
_FRAMES_KEPT = 4
_BATCHES_WAITING = 4096
_NETWORKS_HELD = 256
_ASK_EVERY_S = 1.0
_ASKED_AT_ONCE = 16
_FILE_EVERY_S = 1.0
_SILENT_AFTER_S = 5.0
_NETWORK_PERIOD_S = 1.5
_CLOCKS = Limits(offset_s=0.25, drift_ppm=100.0)


class TagService:
    """A tag service at work on a runtime; ``start`` declares everything, the runtime stops it."""

    def __init__(self, runtime: ServiceRuntime, settings: TagSettings) -> None:
        self.runtime = runtime
        self.settings = settings
        self.unit = Unit(settings.unit_id, runtime.boot_id)
        self.engine = TagEngine(settings.engine, self.unit, settings.origin)
        self.streams = Streams(int(settings.max_age_s * 1e9), int(settings.max_ahead_s * 1e9))
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._unknown: set[str] = set()
        self._answered: Buffer[SensorInfo] = Buffer(_ASKED_AT_ONCE)
        self._heard_s: dict[str, float] = {}
        self._watch = SensorWatch(_CLOCKS, settings.clock == "wall", word="network")
        self._file = ReaderFile(settings.readers) if settings.readers else None
        self._tick_due_s = self._file_due_s = 0.0
        self._black_box: RecordWriter | None = None

    def start(self) -> None:
        """Read the readers, compile, subscribe, and be ready.

        Raises:
            TrackmeshError: the file of readers, or the black box, cannot be used.
        """
        runtime, keys = self.runtime, self.runtime.keys
        self._open_black_box()
        if self._file is not None:
            self._read_file(self._file)
        runtime.set_state("compiling")
        started = time.monotonic()
        warm_up(self.settings.engine)
        runtime.log.info("kernels ready after %.1f s", time.monotonic() - started)
        self._frames = runtime.bus.publisher(keys.tags(self.unit.unit_id), history=_FRAMES_KEPT)
        # The engine's thread may publish until it has ended.
        runtime.on_exit(self._frames.close)
        self._tokens = runtime.closing(runtime.bus.watch_alive(keys.live("sensor", "*")))
        self._infos = runtime.closing(runtime.bus.subscribe(keys.sensor("*"), history=True, capacity=4096))
        self._ranges = runtime.closing(runtime.bus.subscribe(keys.ranges("*"), history=True, capacity=_BATCHES_WAITING))
        runtime.health = self.health
        runtime.spawn("engine", self._run)
        runtime.spawn("asker", self._ask_unknown)
        runtime.set_state("ready")

    def health(self) -> Health:
        """Networks and figures for the status."""
        with self._lock:
            figures, counts = self.engine.figures(), self.engine.counts()
            known = list(self.engine.readers.infos)
            notices = self._watch.notices(None, time.time_ns())
        figures |= {f"engine.{name}": float(value) for name, value in counts.items()}
        figures["readers_alive"] = float(sum(name in self._alive for name in known))
        figures["batches_dropped_here"] = float(self._ranges.dropped)
        networks = [self._network_health(name) for name in sorted(self.streams.known)]
        return Health(figures, networks, notices)

    # --- the engine's thread ---

    def _run(self) -> None:
        while not self.runtime.stopping.is_set():
            self._drain()
            sample = self._ranges.receive(timeout_s=self.settings.tick_s)
            if sample is not None:
                self._on_ranges(sample)
            self._tick_if_due()
            self._look_at_file()

    def _drain(self) -> None:
        while (event := self._tokens.receive(timeout_s=0)) is not None:
            _, ident = kind_and_id(event.key)
            (self._alive.add if event.alive else self._alive.discard)(ident)
            if ident in self.engine.readers.infos:
                self.runtime.log.info("reader %s %s", ident, "is there" if event.alive else "is gone")
        while (sample := self._infos.receive(timeout_s=0)) is not None:
            self._on_info(sample)
        while (info := self._answered.receive(timeout_s=0)) is not None:
            self._take_or_refuse(info)

    def _on_info(self, sample: Sample) -> None:
        try:
            info = decode(sample.payload, SensorInfo, sample.encoding)
            if info.sensor_id != last_chunk(sample.key):
                raise RefusedMessage("wrong_sensor", f"{sample.key} brought the sensor {info.sensor_id}.")
        except RefusedMessage as error:
            self._refuse(None, error)
            return
        self._take_or_refuse(info)

    def _take_or_refuse(self, info: SensorInfo) -> None:
        try:
            self._take_info(info)
        except RefusedMessage as error:
            self._refuse(None, error)

    def _take_info(self, info: SensorInfo) -> None:
        if info.kind != "ranging":
            return
        known = self.engine.readers.infos
        if info.sensor_id not in known and len(known) >= self.settings.max_readers:
            raise RefusedMessage("too_many_sensors", f"There are {self.settings.max_readers} readers already.")
        self._unknown.discard(info.sensor_id)
        if known.get(info.sensor_id) != info:
            self._record(info)
            with self._lock:
                self.engine.reader(info)
            self.runtime.log.info("reader %s stands at %s", info.sensor_id, info.site_enu_m or info.site)

    def _on_ranges(self, sample: Sample) -> None:
        network_id = last_chunk(sample.key)
        try:
            batch = decode(sample.payload, RangeBatch, sample.encoding, self.settings.max_batch_bytes)
            if batch.network_id != network_id:
                raise RefusedMessage("wrong_sensor", f"{sample.key} brought ranges of {batch.network_id}.")
            if network_id not in self.streams.known and len(self.streams.known) >= _NETWORKS_HELD:
                raise RefusedMessage("too_many_sensors", f"There are {_NETWORKS_HELD} networks already.")
            now_ns = time.time_ns()
            self._note_heard(batch, now_ns)
            of_now = self.settings.clock == "wall"
            self.streams.check(network_id, batch.boot_id, batch.seq, batch.t_ns, now_ns if of_now else None)
        except RefusedMessage as error:
            self._refuse(network_id, error)
            return
        self._heard_s[network_id] = time.monotonic()
        self._watch.took(network_id, now_ns)
        self._note_unknown(batch)
        self._take_batch(batch)

    def _note_heard(self, batch: RangeBatch, now_ns: int) -> None:
        with self._lock:
            self._watch.expect(batch.network_id, _NETWORK_PERIOD_S, now_ns)
            newest_ns = int(batch.t_ns.max()) if len(batch.t_ns) else None
            self._watch.heard(batch.network_id, newest_ns, 1, now_ns)

    def _take_batch(self, batch: RangeBatch) -> None:
        self._record(batch)
        with self._lock:
            frame = self.engine.ranges(batch)
        self._tick_due_s = time.monotonic() + self.settings.tick_s
        self.runtime.counters.count("batches")
        self.runtime.counters.count("ranges", len(batch.t_ns))
        self._publish(frame)
        if frame is not None and len(batch.t_ns) and self.settings.clock == "wall":
            self.runtime.latencies.record((time.time_ns() - int(batch.t_ns.max())) / 1e9)

    def _tick_if_due(self) -> None:
        if self.settings.clock != "wall" or time.monotonic() < self._tick_due_s:
            return
        self._tick_due_s = time.monotonic() + self.settings.tick_s
        t_ns = time.time_ns()
        self._record(Tick(t_ns=t_ns))
        with self._lock:
            frame = self.engine.tick(t_ns)
        self._publish(frame)

    def _publish(self, frame: TagFrame | None) -> None:
        if frame is not None:
            self._frames.put(encode(frame), encoding(frame))
            self.runtime.counters.count("frames")

    # --- the file of readers, the black box ---

    def _look_at_file(self) -> None:
        if self._file is None or time.monotonic() < self._file_due_s:
            return
        self._file_due_s = time.monotonic() + _FILE_EVERY_S
        try:
            self._read_file(self._file)
        except TrackmeshError as error:
            # The readers stand where they stood.
            self.runtime.log.error("the readers stay as they are: %s", error)
            self.runtime.counters.count("reader_file_failures")

    def _read_file(self, file: ReaderFile) -> None:
        changes = file.changes()
        if changes is None:
            return
        for info in changes[0]:
            self._take_info(info)
        for reader_id in changes[1]:
            self._record(Gone(sensor_id=reader_id))
            with self._lock:
                self.engine.drop_reader(reader_id)
            self.runtime.log.info("reader %s is in the file no longer", reader_id)

    def _open_black_box(self) -> None:
        if self.settings.black_box is None:
            return
        self._black_box = RecordWriter(self.settings.black_box)
        self.runtime.on_exit(self._black_box.close)
        self._black_box.write(
            UnitRecord(
                unit_id=self.unit.unit_id,
                unit_number=0,
                boot_id=self.unit.boot_id,
                first_track_number=0,
                settings=self.settings.engine.model_dump(mode="json"),
            )
        )
        if self.settings.origin is not None:
            self._black_box.write(self.settings.origin)

    def _record(self, record: SensorInfo | Gone | RangeBatch | Tick) -> None:
        if self._black_box is None:
            return
        try:
            self._black_box.write(record)
        except TrackmeshError as error:
            # The picture matters more than its record.
            self.runtime.log.error("the black box ends here: %s", error)
            self.runtime.counters.count("black_box_failures")
            self._black_box = None

    # --- readers not yet known ---

    def _note_unknown(self, batch: RangeBatch) -> None:
        unknown = [name for name in batch.readers if name not in self.engine.readers.infos]
        if unknown and len(self._unknown) < self.settings.max_readers:
            self._unknown.update(unknown)

    def _ask_unknown(self) -> None:
        """Ask readers whose ranges came who they are; in a thread of its own, since they may not answer."""
        while not self.runtime.stopping.wait(_ASK_EVERY_S):
            for reader_id in sorted(self._unknown)[:_ASKED_AT_ONCE]:
                if self.runtime.stopping.is_set():
                    return
                for reply in self.runtime.bus.query(self.runtime.keys.sensor(reader_id), timeout_s=_ASK_EVERY_S):
                    self._take_answer(reader_id, reply)
                self._unknown.discard(reader_id)

    def _take_answer(self, reader_id: str, reply: Sample) -> None:
        try:
            info = open_envelope(reply.payload, reply.encoding, SensorInfo)
        except (RefusedMessage, QueryFailed) as error:
            self.runtime.log.warning("reader %s gave no information: %s", reader_id, error)
            return
        if isinstance(info, SensorInfo) and info.sensor_id == reader_id:
            self._answered.offer(info)

    # --- counting ---

    def _refuse(self, network_id: str | None, error: RefusedMessage) -> None:
        self.runtime.counters.refuse(error.reason)
        if network_id is not None:
            self._watch.refused(network_id, error.reason)
        if network_id in self.streams.known:
            self.streams.known[network_id].refused += 1
        self.runtime.log.debug("refused: %s", error)

    def _network_health(self, network_id: str) -> SensorHealth:
        stream, clock = self.streams.known[network_id], self._watch.clock(network_id)
        return SensorHealth(
            sensor_id=network_id,
            alive=time.monotonic() - self._heard_s.get(network_id, -math.inf) < _SILENT_AFTER_S,
            plots=stream.rows,
            batches=stream.batches,
            gaps=stream.gaps,
            duplicates=stream.duplicates,
            refused=stream.refused,
            last_seq=max(stream.seq, 0),
            last_t_ns=stream.last_t_ns,
            silent_since_ns=self._watch.silent_since_ns(network_id, time.time_ns()),
            clock_offset_s=clock.offset_s,
            clock_drift_ppm=clock.drift_ppm,
        )


def run(settings: TagSettings) -> int:
    """Be a tag service until told to stop; the exit code."""
    return ServiceRuntime(KIND, settings).run(lambda runtime: TagService(runtime, settings).start())
