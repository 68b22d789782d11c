"""A deployment of real processes on this machine that can be killed, started again, and measured."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from trackmesh.protocol.client import Client
from trackmesh.protocol.errors import TrackmeshError

ROOT = Path(__file__).resolve().parents[2]
STOP_S = 10.0
READY_S = 240.0


class Usage(NamedTuple):
    """What a process holds: resident memory in MiB, open file handles, threads."""

    rss_mib: float
    handles: int
    threads: int


class Part:
    """One process of the deployment, by the same command each time it is started."""

    def __init__(self, folder: Path, name: str, command: Callable[[int], Sequence[str]], env: dict[str, str]) -> None:
        self.name = name
        self.starts = 0
        self.exit_codes: list[int] = []
        self._command = command
        self._log = folder / f"{name}.log"
        self._env = os.environ | env
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it; ``command`` is asked with the number of the start, from 0."""
        arguments = [sys.executable, "-m", *self._command(self.starts)]
        self.starts += 1
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                arguments, cwd=ROOT, env=self._env, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip

    @property
    def running(self) -> bool:
        """Whether it runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int:
        """Of the process as it runs now."""
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        """SIGKILL, and wait."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def stop(self) -> bool:
        """SIGTERM; whether it ended by itself within the deadline."""
        if self._process is None or not self.running:
            return False
        self._process.send_signal(signal.SIGTERM)
        try:
            self.exit_codes.append(self._process.wait(STOP_S))
        except subprocess.TimeoutExpired:
            self.kill()
            return False
        return True

    def usage(self) -> Usage | None:
        """What it holds now; None if it does not run."""
        return None if self._process is None else usage(self._process.pid)

    def said(self, text: str) -> int:
        """How often its log holds a text."""
        return self._log.read_text(errors="replace").count(text)


class Deployment:
    """The parts, in the order in which they were added; all are gone at the end of the block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.parts: dict[str, Part] = {}

    def add(
        self, name: str, command: Callable[[int], Sequence[str]], env: dict[str, str] | None = None, start: bool = True
    ) -> Part:
        """Add a process, and start it."""
        part = self.parts[name] = Part(self.folder, name, command, env or {})
        if start:
            part.start()
        return part

    def stop(self) -> list[str]:
        """Stop all in order, the first added last; names of those that had to be killed or failed."""
        bad = []
        for part in reversed(self.parts.values()):
            if part.running and (not part.stop() or part.exit_codes[-1] != 0):
                bad.append(part.name)
        return bad

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        for part in reversed(self.parts.values()):
            if part.running:
                part.kill()


def trackmesh(*arguments: str) -> list[str]:
    """A command of ``trackmesh`` as the arguments of ``python -m``."""
    return ["trackmesh.services.cli.main", *arguments]


def usage(pid: int | str) -> Usage | None:
    """What a process holds, as Linux tells; None if there is none."""
    folder = Path("/proc") / str(pid)
    with suppress(OSError, IndexError, ValueError):
        fields = dict(
            line.split(":", 1)
            for line in (folder / "status").read_text().splitlines()
            if line.startswith(("VmRSS", "Th"))
        )
        handles = len(list((folder / "fd").iterdir()))
        return Usage(int(fields["VmRSS"].split()[0]) / 1024.0, handles, int(fields["Threads"]))
    return None


def free_port() -> int:
    """A port nobody listens at, below those that the kernel gives to outgoing connections."""
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def wait_ready(client: Client, unit: str = "*", timeout_s: float = READY_S) -> float:
    """Wait until a fusion unit is ready; the seconds it took.

    Raises:
        TrackmeshError: it was not in time.
    """
    began_s = time.monotonic()
    with client.watch_statuses("fusion", unit) as watch:
        while (took_s := time.monotonic() - began_s) < timeout_s:
            status = watch.receive(0.5)
            if status is not None and status.state == "ready":
                return took_s
    raise TrackmeshError(f"The unit was not ready within {timeout_s:g} s.")
