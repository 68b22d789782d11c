"""Real processes for tests: started, watched, frozen, killed, and all gone at the end."""

from __future__ import annotations

import contextlib
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def free_port() -> int:
    """A port nobody listens at.

    Below those that the kernel gives to outgoing connections: while its router is down, a client that tries to connect
    to such a port may be given that very port, and then occupies it.
    """
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = 15.0) -> None:
    """Fails with ``what`` if the condition does not come true in time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"{what}: not within {timeout_s:g} s")
        time.sleep(0.01)


class Process:
    """One child process; what it prints goes to a file."""

    def __init__(self, arguments: list[str], log: Path, within: Sequence[str] = ()) -> None:
        self.arguments = arguments
        self._log = log
        command = [*within, sys.executable, *arguments]
        with log.open("ab") as out:
            self._popen = subprocess.Popen(
                command, stdout=out, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, cwd=ROOT
            )

    @property
    def output(self) -> str:
        return self._log.read_text(encoding="utf-8")

    @property
    def running(self) -> bool:
        return self._popen.poll() is None

    def wait_for(self, text: str, timeout_s: float = 20.0) -> None:
        def seen() -> bool:
            if text not in self.output and not self.running:
                pytest.fail(f"{self.arguments} ended before it said {text!r}:\n{self.output}")
            return text in self.output

        wait_until(seen, f"{self.arguments} says {text!r}", timeout_s)

    def send(self, number: signal.Signals) -> None:
        self._popen.send_signal(number)

    def kill(self) -> None:
        """SIGKILL, and wait."""
        if self.running:
            self._popen.kill()
        self._popen.wait()

    def stop(self, number: signal.Signals = signal.SIGTERM, timeout_s: float = 15.0) -> int:
        """Ask to stop; the exit code."""
        self.send(number)
        return self._popen.wait(timeout_s)


class Processes:
    """Those of one test."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._all: list[Process] = []

    def start(self, *arguments: str, within: Sequence[str] = ()) -> Process:
        """Start ``python`` with arguments, from the root of the repository; ``within`` as a ``Host`` has it."""
        process = Process(list(arguments), self._directory / f"{len(self._all)}.log", within)
        self._all.append(process)
        return process

    def router(self, port: int | None = None) -> RouterProcess:
        """Start a router, and wait until it listens."""
        return RouterProcess(self, port or free_port())

    def close(self) -> None:
        for process in self._all:
            process.kill()


class RouterProcess:
    """A router that can be killed and started again at the same endpoint."""

    def __init__(self, processes: Processes, port: int) -> None:
        self._processes = processes
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self.process = self._start()

    def restart(self) -> None:
        self.process.kill()
        self.process = self._start()

    def _start(self) -> Process:
        process = self._processes.start("-m", "trackmesh.services.router", "--listen", self.endpoint)
        process.wait_for("ready after")
        return process


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    """Start processes with it; all are killed after the test."""
    started = Processes(tmp_path)
    yield started
    started.close()


@pytest.fixture(scope="module")
def router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RouterProcess]:
    """A router for the tests of one file; not to be killed by them."""
    started = Processes(tmp_path_factory.mktemp("router"))
    yield started.router()
    started.close()
