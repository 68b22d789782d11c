"""Child processes of the demo: started, watched, and ended in order, none left behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from trackmesh.protocol.errors import TrackmeshError

_STOP_S = 8.0


class Children:
    """Commands of ``trackmesh`` as processes, ended at the end of the block, the first one last.

    Each has a session of its own, so that Ctrl-C reaches only us, and its log in ``folder``. If we are killed they end
    by themselves: see ``child``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: list[tuple[str, subprocess.Popen[bytes]]] = []

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Start a command of ``trackmesh``."""
        command = [sys.executable, "-m", "trackmesh.services.cli.child", *arguments]
        with (self.folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        self._running.append((name, process))

    def pid(self, name: str) -> int:
        """Process number of a running command."""
        return dict(self._running)[name].pid

    def check(self) -> None:
        """See that all run.

        Raises:
            TrackmeshError: one has ended; the sentence ends with the last line of its log.
        """
        for name, process in self._running:
            code = process.poll()
            if code is not None:
                raise TrackmeshError(f"The process {name} ended with exit code {code}: {self._last_words(name)}")

    def stop(self) -> list[str]:
        """End all; the names of those that did not end well."""
        bad = []
        # The first one is what the others speak through.
        for group in (self._running[:0:-1], self._running[:1]):
            deadline = time.monotonic() + _STOP_S
            for _, process in group:
                _signal(process, signal.SIGTERM)
            for name, process in group:
                code = _ended(process, deadline)
                if code != 0:
                    bad.append(f"{name} ({code})")
        self._running = []
        return bad

    def _last_words(self, name: str) -> str:
        lines = (self.folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing."

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.stop()


def _ended(process: subprocess.Popen[bytes], deadline_s: float) -> int:
    """The exit code, if need be that of a process that is killed at the deadline."""
    try:
        code = process.wait(max(0.1, deadline_s - time.monotonic()))
    except subprocess.TimeoutExpired:
        _signal(process, signal.SIGKILL)
        code = process.wait()
    if process.stdin is not None:
        process.stdin.close()
    return code


def _signal(process: subprocess.Popen[bytes], number: int) -> None:
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, number)
