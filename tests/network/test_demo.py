"""``trackmesh demo`` as a person runs it: to its end, interrupted, and killed; nothing of it stays behind."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.network.processes import Processes, free_port, wait_until
from tests.network.realm import write_scenario

from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import TrackFrame, TruthFrame

COMPILING_S = 200.0
CHILDREN = {"router", "fusion", "emi", "tags", "radar-north", "radar-east", "readers", "truth"}
OF_TAGS = {"tags", "readers"}


class Demo:
    """A demo at a port of its own, by which all its processes are known."""

    def __init__(self, processes: Processes, folder: Path, *arguments: str) -> None:
        self.folder = folder
        port = free_port()
        self._endpoint = f"tcp/127.0.0.1:{port}"
        self.process = processes.start(
            *("-m", "trackmesh.services.cli.main", "demo", "--port", str(port), "--out", str(folder), *arguments)
        )

    def children(self) -> list[int]:
        """Process ids of what it has started and what still runs."""
        listed = subprocess.run(["ps", "-A", "-ww", "-o", "pid=,args="], capture_output=True, text=True, check=True)
        return [int(line.split()[0]) for line in listed.stdout.splitlines() if self._endpoint in line]

    def wait_for_tracks(self) -> None:
        """Until all processes of a scenario without tags run and a track is confirmed."""

        def there() -> bool:
            assert self.process.running, self.process.output
            tracks = self.folder / "tracks.jsonl"
            return tracks.exists() and b'"status":[1' in tracks.read_bytes()

        wait_until(there, "tracks come", COMPILING_S)
        assert len(self.children()) == len(CHILDREN - OF_TAGS)

    def close(self) -> None:
        self.process.kill()
        for pid in self.children():
            os.kill(pid, signal.SIGKILL)


Start = Callable[..., Demo]


@pytest.fixture
def start(processes: Processes, tmp_path: Path) -> Iterator[Start]:
    started: list[Demo] = []

    def demo(*arguments: str) -> Demo:
        started.append(Demo(processes, tmp_path / "demo", *arguments))
        return started[-1]

    yield demo
    for one in started:
        one.close()


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    """A scenario with tracks after a few seconds."""
    return write_scenario(tmp_path)


@pytest.mark.timeout(COMPILING_S + 120)
def test_the_demo_runs_to_its_end(start: Start) -> None:
    demo = start("--seconds", "12")
    wait_until(lambda: not demo.process.running, "the demo ends", COMPILING_S + 60.0)
    assert demo.process.stop() == 0, demo.process.output
    assert "targets in coverage" in demo.process.output and "3 scans inverted, 3 targets" in demo.process.output
    assert "8 of 8 located" in demo.process.output
    assert {path.name for path in demo.folder.glob("*.log")} == {f"{name}.log" for name in CHILDREN}
    assert (demo.folder / "tracks.png").read_bytes().startswith(b"\x89PNG")
    frames = list(read_records(demo.folder / "tracks.jsonl", TrackFrame))
    truth = list(read_records(demo.folder / "truth.jsonl", TruthFrame))
    assert len(frames) > 50 and len(truth) > 10
    # The first line says who recorded it; a good one is left by a unit that was stopped in order.
    assert len(list(read_records(demo.folder / "black-box.jsonl"))) > 100
    assert demo.children() == []
    for log in demo.folder.glob("*.log"):
        assert "WARNING" not in (text := log.read_text()) and "ERROR" not in text and "Traceback" not in text, text


@pytest.mark.timeout(COMPILING_S + 60)
def test_ctrl_c_ends_it_in_order(start: Start, quick: Path) -> None:
    demo = start("--seconds", "0", "--scenario", str(quick))
    demo.wait_for_tracks()
    assert demo.process.stop(signal.SIGINT, 30.0) == 0, demo.process.output
    assert "picture, recordings and logs in" in demo.process.output
    assert (demo.folder / "tracks.png").exists()
    assert demo.children() == []


def test_ctrl_c_at_the_start_too(start: Start) -> None:
    demo = start()
    wait_until((demo.folder / "emi.log").exists, "the first processes are started", 30.0)
    assert demo.process.stop(signal.SIGINT, 100.0) == 0, demo.process.output
    assert demo.process.output.splitlines()[-1].startswith("stopped before the first picture")
    assert demo.children() == []


@pytest.mark.timeout(COMPILING_S + 60)
def test_its_processes_do_not_outlive_it_when_it_is_killed(start: Start, quick: Path) -> None:
    demo = start("--seconds", "0", "--scenario", str(quick))
    demo.wait_for_tracks()
    demo.process.kill()
    wait_until(lambda: not demo.children(), "its processes have ended", 15.0)
    assert "stopping: SIGTERM" in (demo.folder / "fusion.log").read_text()


def test_a_port_that_is_taken_is_one_sentence(start: Start, processes: Processes, tmp_path: Path) -> None:
    port = int(processes.router().endpoint.rpartition(":")[2])
    arguments = ("demo", "--port", str(port), "--out", str(tmp_path / "second"))
    second = processes.start("-m", "trackmesh.services.cli.main", *arguments)
    wait_until(lambda: not second.running, "the demo gives up", 60.0)
    assert second.stop() == 1
    assert second.output.count("\n") == 1 and "cannot listen at" in second.output
