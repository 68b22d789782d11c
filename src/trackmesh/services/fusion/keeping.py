"""What a unit keeps over restarts: the files of its tracks and of its sensors' biases."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RegistrationRecord, read_records, replace_with
from trackmesh.services.fusion import snapshot
from trackmesh.services.fusion.engine import FusionEngine
from trackmesh.services.fusion.intake import Intake
from trackmesh.services.fusion.settings import FusionSettings
from trackmesh.services.fusion.snapshot import Snapshot

_BIASES_EVERY_S = 60.0


class Keeper:
    """Reads the files of the last run and writes those of this one; a file that cannot be written stops nothing.

    Args:
        settings: which files, how often.
        log: told what was found, and what cannot be written.
        failed: called with the name of a counter at each failure.
    """

    def __init__(self, settings: FusionSettings, log: logging.Logger, failed: Callable[[str], None]) -> None:
        self._settings = settings
        self._log = log
        self._failed = failed
        self._biases_due_s = self._state_due_s = 0.0
        self._waiting: Snapshot | None = None
        self._wanted = threading.Condition()

    def engine(self, make: Callable[[], FusionEngine], intake: Intake) -> tuple[FusionEngine, bytes | None]:
        """An engine that goes on with the kept tracks, and the state that it was made from; without one, a new engine.

        A state that cannot be used is told and left alone: the unit starts without.
        """
        path = self._settings.state_file
        if path is None or not path.exists():
            return make(), None
        restored = make()
        try:
            data = path.read_bytes()
            kept = snapshot.from_bytes(data)
            restored.restore(kept)
            intake.restore(kept.streams)
        except (TrackmeshError, OSError) as error:
            self._log.warning("starting without the tracks in %s: %s", path, error)
            self._failed("state_file_refused")
            return make(), None
        self._log.info("%d tracks from %s", restored.counters["restored"], path)
        return restored, data

    def restore_biases(self, engine: FusionEngine) -> RegistrationRecord | None:
        """Give the engine the biases of the last run; what is left of them now.

        Raises:
            TrackmeshError: the file is none of biases.
        """
        path = self._settings.registration_file
        if path is None or not path.exists():
            return None
        record = next(read_records(path, RegistrationRecord), None)
        if not isinstance(record, RegistrationRecord):
            raise TrackmeshError(f"{path} holds no registration.")
        self._log.info("biases of %d sensors from %s", len(record.state.get("sensors", [])), path)
        return engine.corrections.restore(record, time.time_ns())

    def keep(self, engine: FusionEngine, intake: Intake, *, now: bool = False) -> None:
        """Write what is due, or all; by the thread that feeds the engine. Tracks are written by ``write_states``."""
        at_s = time.monotonic()
        if now or at_s >= self._biases_due_s:
            self._biases_due_s = at_s + _BIASES_EVERY_S
            self._keep_biases(engine)
        if self._settings.state_file is not None and (now or at_s >= self._state_due_s):
            self._state_due_s = at_s + self._settings.state_every_s
            kept = engine.snapshot()
            if kept is not None:
                self._hand_over(kept._replace(streams=intake.kept()))

    def write_states(self, stopping: threading.Event) -> None:
        """Write handed over states until told to stop; in a thread of its own, since a disk may be slow."""
        while not stopping.is_set():
            with self._wanted:
                self._wanted.wait(timeout=0.25)
            self.write_waiting()

    def write_waiting(self) -> None:
        """Write the state that waits, if one does."""
        with self._wanted:
            kept, self._waiting = self._waiting, None
        if kept is None or self._settings.state_file is None:
            return
        try:
            snapshot.write(self._settings.state_file, snapshot.to_bytes(kept))
        except TrackmeshError as error:
            self._log.error("the tracks are not kept: %s", error)
            self._failed("state_file_failures")

    def _hand_over(self, kept: Snapshot) -> None:
        with self._wanted:
            self._waiting = kept
            self._wanted.notify()

    def _keep_biases(self, engine: FusionEngine) -> None:
        path, now_ns = self._settings.registration_file, engine.now_ns
        record = engine.corrections.record(now_ns) if now_ns is not None else None
        if path is None or record is None:
            return
        try:
            replace_with(path, record)
        except TrackmeshError as error:
            self._log.error("the biases are not kept: %s", error)
            self._failed("registration_file_failures")
