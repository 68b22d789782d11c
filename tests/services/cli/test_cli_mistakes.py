"""A mistake is told in one sentence: exit code 2 for the way a command is used, 1 for what it is given."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.services.cli.conftest import Run

NOBODY = ("--connect", "tcp/127.0.0.1:1")

FILES = {
    "text.jsonl": "hello\n",
    "list.jsonl": "[1, 2]\n",
    "half.jsonl": '{"type":"plots","sensor_id":"a"}\n',
    "unknown.jsonl": '{"type":"plot"}\n',
    "truth.jsonl": '{"type":"truth","scenario_id":"x","t_ns":1,"id":[1],"state":[[0,0,0,0]]}\n',
    "tick.jsonl": '{"type":"tick","t_ns":1}\n',
    "broken.toml": "realm = \n",
    "unknown.toml": "[engine]\nspeed = 3\n",
    "wrong.toml": "[engine]\ngate = -1\n",
    "scenario.toml": "duration_s = 5\n",
    "half.json": "{",
    "half.json5": "{mode: 'client', connect: {endpoints: 7}}",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "bytes.jsonl").write_bytes(b"\xff\xfe\x00\x01")
    monkeypatch.chdir(tmp_path)
    return tmp_path


USAGE = [
    "",
    "sing",
    "track",
    "track plots.jsonl",
    "track plots.jsonl --out x.jsonl --loud",
    "score tracks.jsonl",
    "score tracks.jsonl truth.jsonl --c=0",
    "score tracks.jsonl truth.jsonl --switch=-1",
    "score tracks.jsonl truth.jsonl --nearest --csv scores.csv",
    "sim",
    "sim radar --seed=-1",
    "sim radar --start-ns soon",
    "sim record plots.jsonl --seconds=-1",
    "convert",
    "convert pictures x.jpg",
    "demo --seconds=-3",
    "demo --seconds long",
    "demo --port 70000",
    "fusion --clock moon",
    "fusion --unit-number 4096",
    "fusion --log-level loud",
    "emi --workers 0",
    "tracks --bbox 1,2,3",
    "tracks --bbox a,b,c,d",
    "tracks --bbox 1,2,3,nan",
    "tracks --bbox-deg 48,11,49",
    "tracks --at noon",
    "tracks --at +",
    "tracks --at=-5",
    "tracks --at 1e30",
    "tracks --max-age=-1",
    "tracks --id x",
    "play plots.jsonl --speed=-1",
    "watch --seconds=-1",
]


@pytest.mark.parametrize("line", USAGE)
def test_a_wrong_use_is_exit_code_2(run: Run, folder: Path, line: str) -> None:
    result = run(*line.split())
    assert result.exit_code == 2, result.output
    assert "Usage: " in result.output
    if line:
        assert "Traceback" not in result.output
    assert not list(folder.glob("x.*"))


MISTAKES = [
    # Files.
    ("track none.jsonl --out x.jsonl", "Cannot read none.jsonl: No such file or directory."),
    ("track . --out x.jsonl", "Cannot read .: Is a directory."),
    ("track text.jsonl --out x.jsonl", "text.jsonl, line 1: No JSON"),
    ("track list.jsonl --out x.jsonl", "list.jsonl, line 1: A line must be a JSON object."),
    ("track half.jsonl --out x.jsonl", "half.jsonl, line 1: PlotBatch."),
    ("track unknown.jsonl --out x.jsonl", "unknown.jsonl, line 1: Unknown type 'plot'"),
    ("track bytes.jsonl --out x.jsonl", "bytes.jsonl is not a text file."),
    ("track truth.jsonl --out x.jsonl", "A TruthFrame is no input of the tracker."),
    ("track tick.jsonl --out none/x.jsonl", "Cannot write none/x.jsonl: No such file or directory."),
    ("score truth.jsonl truth.jsonl", "truth.jsonl, line 1: a line of type tracks is expected, not truth."),
    ("score none.jsonl truth.jsonl", "Cannot read none.jsonl"),
    ("plot none.jsonl", "Cannot read none.jsonl"),
    ("plot tick.jsonl", "a line of type tracks is expected, not tick."),
    ("invert none.jsonl --local", "Cannot read none.jsonl"),
    ("invert truth.jsonl --local", "a line of type emi_scan is expected, not truth."),
    (f"play none.jsonl {' '.join(NOBODY)}", "Cannot read none.jsonl"),
    (f"play tick.jsonl {' '.join(NOBODY)}", "No router answers"),
    ("convert autoferry none.json --out x.jsonl", "Cannot read none.json"),
    ("convert autoferry half.json --out x.jsonl", "half.json is no Autoferry recording"),
    # Settings and scenarios.
    ("track tick.jsonl --out x.jsonl --config none.toml", "Cannot read none.toml"),
    ("track tick.jsonl --out x.jsonl --config broken.toml", "broken.toml is no TOML"),
    ("track tick.jsonl --out x.jsonl --config unknown.toml", "Unknown setting engine.speed in unknown.toml."),
    ("track tick.jsonl --out x.jsonl --config wrong.toml", "The setting engine.gate in wrong.toml is wrong"),
    ("fusion --config none.toml", "Cannot read none.toml"),
    ("fusion --unit-id West", "The setting unit_id is wrong"),
    ("sim record x.jsonl --scenario nowhere", "There is no scenario 'nowhere'"),
    ("sim record x.jsonl --scenario broken.toml", "The scenario 'broken' is not valid TOML"),
    ("sim record x.jsonl --scenario scenario.toml", "The scenario 'scenario' is not valid: "),
    ("sim radar --radar south", "has no radar 'south'; it has north, east."),
    ("demo --scenario nowhere", "There is no scenario 'nowhere'"),
    ("demo --out text.jsonl/out", "Cannot make the folder text.jsonl/out: Not a directory."),
    ("router --config none.json5", "no such file"),
    ("schema Plot", "There is no message 'Plot'; there are SensorInfo, PlotBatch,"),
    # The network.
    (f"tracks {' '.join(NOBODY)}", "No router answers at tcp/127.0.0.1:1; start one with `trackmesh router`."),
    (f"status {' '.join(NOBODY)}", "No router answers"),
    (f"watch {' '.join(NOBODY)}", "No router answers"),
    ("tracks --connect nowhere", "The Zenoh setting connect/endpoints = ['nowhere'] is wrong"),
    ("tracks --realm A/B", "The setting realm is wrong"),
    ("tracks --id=-4", "TrackQuery.track_ids.0: "),
]


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who asks for a router that is not there gives up soon."""
    monkeypatch.setenv("TRACKMESH_CONNECT_TIMEOUT_S", "0.3")


@pytest.mark.usefixtures("hasty", "folder")
@pytest.mark.parametrize(("line", "sentence"), MISTAKES)
def test_what_is_wrong_is_one_sentence_and_exit_code_1(run: Run, line: str, sentence: str) -> None:
    result = run(*line.split())
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    # What a service logs comes with time and level; either way it is one line, however long.
    (told,) = result.stderr.splitlines()
    assert sentence in told
    assert result.stdout == ""


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("TRACKMESH_UNIT_NUMBER", "4096", "The setting unit_number in the environment is wrong"),
        ("TRACKMESH_ENGINE__GATE", "wide", "The setting engine.gate in the environment is wrong"),
        ("TRACKMESH_ENGINE__SPEED", "3", "Unknown setting engine.speed in the environment."),
        ("TRACKMESH_ENGINE", "{", "A TRACKMESH_* variable cannot be read"),
    ],
)
def test_a_wrong_variable_is_told(
    run: Run, monkeypatch: pytest.MonkeyPatch, name: str, value: str, sentence: str
) -> None:
    monkeypatch.setenv(name, value)
    result = run("track", "tick.jsonl", "--out", "x.jsonl")
    assert result.exit_code == 1
    (told,) = result.stderr.splitlines()
    assert sentence in told


def test_a_router_that_is_not_there_is_given_up_soon(run: Run) -> None:
    # Far below the half minute that a service waits; the deadline is that of the test.
    assert run("tracks", *NOBODY).exit_code == 1


@pytest.mark.process
def test_a_sentence_stays_on_one_line_in_a_narrow_pipe(
    process: Callable[..., subprocess.CompletedProcess[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    done = process("schema", "Plot")
    assert done.returncode == 1 and done.stdout == b""
    (line,) = done.stderr.splitlines()
    assert line.startswith(b"trackmesh: There is no message 'Plot'; there are ") and len(line) > 100


@pytest.mark.process
def test_a_reader_that_leaves_early_is_no_error() -> None:
    code = "import sys; sys.stdout.write('x' * 300_000); sys.argv = ['trackmesh', 'schema']"
    code += "; from trackmesh.services.cli.main import main; main()"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stderr is not None
        child.stdout.read(10)
        child.stdout.close()
        said = child.stderr.read()
        assert child.wait(60) == 1
    assert said == b""


@pytest.mark.process
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk_is_one_sentence(process: Callable[..., subprocess.CompletedProcess[bytes]]) -> None:
    done = process("sim", "record", "/dev/full", "--seconds", "5")
    assert (done.returncode, done.stdout) == (1, b"")
    (line,) = done.stderr.splitlines()
    assert line.startswith(b"trackmesh: ") and line.endswith(b"No space left on device.")
