"""Commands of tags that need no network: simulate, locate, convert."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.services.cli.conftest import SHARED, Run

from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import TagFrame

PLAZA = SHARED / "data" / "plaza" / "Plaza1.mat"


@pytest.fixture(scope="module")
def folder(good: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of the hall: ranges.jsonl, truth.jsonl, and tags.jsonl as it is located."""
    folder = tmp_path_factory.mktemp("hall")
    made = good("sim", "ranges", folder / "ranges.jsonl", folder / "truth.jsonl", "--seconds", 20, "--seed", 2)
    assert "ranges of rfid19, seed 2" in made.stderr
    located = good("locate", folder / "ranges.jsonl", folder / "truth.jsonl", "--out", folder / "tags.jsonl")
    assert "tag-1" in located.stdout and "RMS m" in located.stdout
    return folder


def test_the_errors_are_told_as_json_too(good: Run, folder: Path) -> None:
    (score,) = json.loads(good("locate", folder / "ranges.jsonl", folder / "truth.jsonl", "--json").stdout)
    assert score["tag"] == "tag-1" and score["located"] > 0.95
    assert score["rms_m"] < 3.0 and 0.3 < score["nees"] < 3.0


def test_a_configuration_counts(good: Run, folder: Path, tmp_path: Path) -> None:
    config = tmp_path / "slow.toml"
    config.write_text("[engine]\nframe_period_s = 5.0\n")
    result = good("locate", folder / "ranges.jsonl", "--config", config)
    assert result.stderr.startswith("4 frames") and result.stdout == ""


def test_frames_are_written(folder: Path) -> None:
    frames = list(read_records(folder / "tags.jsonl", TagFrame))
    assert len(frames) > 80


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("locate missing.jsonl", "Cannot read missing.jsonl"),
        ("locate {}/truth.jsonl", "A TruthFrame is no input of the tag engine"),
        ("locate {0}/ranges.jsonl {0}/ranges.jsonl", "a line of type truth is expected"),
        ("convert plaza {}/ranges.jsonl --out x.jsonl", "no MATLAB file"),
        ("sim ranges x.jsonl --scenario many", r"has no [tags] section"),
        ("sim radar --scenario rfid19", "has no targets and no radars"),
        ("tags --readers missing.toml --connect tcp/127.0.0.1:1", "No router answers"),
    ],
)
def test_a_mistake_is_one_sentence(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRACKMESH_CONNECT_TIMEOUT_S", "0.5")
    result = run(*command.format(folder).split())
    assert result.exit_code == 1
    assert sentence in result.stderr and "Traceback" not in result.output


@pytest.mark.skipif(not PLAZA.exists(), reason="the Plaza recording is not here")
def test_plaza_is_converted(good: Run, tmp_path: Path) -> None:
    out, truth = tmp_path / "ranges.jsonl", tmp_path / "truth.jsonl"
    assert "3529 ranges" in good("convert", "plaza", PLAZA, "--out", out, "--truth", truth).stderr
    assert out.exists() and truth.exists()
