"""The command line as a person types it, most of it in this process."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from trackmesh.services.cli.main import app

ROOT = Path(__file__).resolve().parents[3]
SHARED = ROOT.parent / "shared"

Run = Callable[..., Result]


@pytest.fixture(autouse=True)
def no_settings_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("TRACKMESH_")]:
        if name != "TRACKMESH_CACHE":
            monkeypatch.delenv(name)


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """A service that is run here sets up the logging of the process."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.fixture(scope="session")
def run() -> Run:
    """A command in this process."""

    def invoke(*arguments: object) -> Result:
        return CliRunner().invoke(app, [str(argument) for argument in arguments], prog_name="trackmesh")

    return invoke


@pytest.fixture(scope="session")
def good(run: Run) -> Run:
    """A command that must end well; stdout is for programs, stderr holds one line at most."""

    def invoke(*arguments: object) -> Result:
        result = run(*arguments)
        assert result.exit_code == 0, result.output
        assert result.stderr.count("\n") <= 1
        return result

    return invoke


@pytest.fixture(scope="session")
def process() -> Callable[..., subprocess.CompletedProcess[bytes]]:
    """A command in a process of its own, with pipes for stdout and stderr."""

    def start(*arguments: object) -> subprocess.CompletedProcess[bytes]:
        command = [sys.executable, "-m", "trackmesh.services.cli.main", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, timeout=120, check=False, stdin=subprocess.DEVNULL)

    return start


@pytest.fixture(scope="session")
def recording(good: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a minute of two radars: plots.jsonl, truth.jsonl, and what the engine makes of it, tracks.jsonl."""
    folder = tmp_path_factory.mktemp("recording")
    good("sim", "record", folder / "plots.jsonl", folder / "truth.jsonl", "--seconds", 60)
    good("track", folder / "plots.jsonl", "--out", folder / "tracks.jsonl")
    return folder
