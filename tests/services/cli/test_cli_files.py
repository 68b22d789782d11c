"""The commands that need no network, one after the other as a person uses them."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.services.cli.conftest import ROOT, SHARED, Run

from trackmesh.protocol.files import from_line, read_records
from trackmesh.protocol.messages import MESSAGES, EmiResult, TrackFrame
from trackmesh.sim.scenario import load_scenario

AUTOFERRY = SHARED / "data" / "autoferry" / "scenario2_detections.json"


# --- schema


def test_the_schema_of_every_message_is_json(good: Run) -> None:
    every = json.loads(good("schema").stdout)
    assert set(every) == set(MESSAGES)
    for ident, kind in MESSAGES.items():
        one = json.loads(good("schema", kind.__name__).stdout)
        assert one == every[ident]
        assert one["title"] == kind.__name__ and one["type"] == "object" and one["properties"]


# --- record, track, score, plot


def test_recording_and_tracking_give_the_same_bytes_again(good: Run, recording: Path, tmp_path: Path) -> None:
    assert good("sim", "record", tmp_path / "plots.jsonl", tmp_path / "truth.jsonl", "--seconds", 60).stdout == ""
    assert good("track", tmp_path / "plots.jsonl", "--out", tmp_path / "tracks.jsonl").stdout == ""
    for name in ("plots.jsonl", "truth.jsonl", "tracks.jsonl"):
        assert (tmp_path / name).read_bytes() == (recording / name).read_bytes(), name


def test_another_seed_is_another_recording(good: Run, recording: Path, tmp_path: Path) -> None:
    good("sim", "record", tmp_path / "plots.jsonl", "--seconds", 60, "--seed", 2)
    assert (tmp_path / "plots.jsonl").read_bytes() != (recording / "plots.jsonl").read_bytes()


def test_settings_reach_the_engine(good: Run, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "blind.toml").write_text("[engine]\nconfirm_score = 1e6\nscore_cap = 2e6\n")
    config = ("--config", tmp_path / "blind.toml")
    good("track", recording / "plots.jsonl", "--out", tmp_path / "tracks.jsonl", *config)
    frames = [f for f in read_records(tmp_path / "tracks.jsonl", TrackFrame) if isinstance(f, TrackFrame)]
    assert frames and not any(len(frame.track_id) for frame in frames)


def test_the_score_of_a_recording(good: Run, recording: Path) -> None:
    files = (recording / "tracks.jsonl", recording / "truth.jsonl")
    figures = json.loads(good("score", *files, "--json").stdout)
    assert all(value is not None and math.isfinite(value) for value in figures.values())
    assert 0 < figures["gospa_m"] < 1000 and figures["coverage"] > 0.95 and figures["tracks"] == 40
    table = good("score", *files).stdout
    assert "gospa_m" in table and "id_switches" in table


def test_scores_over_time_as_a_table_and_a_picture(good: Run, recording: Path, tmp_path: Path) -> None:
    files, table, picture = (
        (recording / "tracks.jsonl", recording / "truth.jsonl"),
        tmp_path / "s.csv",
        tmp_path / "s.png",
    )
    figures = json.loads(good("score", *files, "--csv", table, "--plot", picture, "--json").stdout)
    names, *rows = [line.split(",") for line in table.read_text().splitlines()]
    scored = [dict(zip(names, row, strict=True)) for row in rows if row[names.index("scored")] == "1"]
    assert len(scored) == figures["frames"]
    for name in ("gospa_m", "gospa_switching_m", "ospa_m"):
        mean = sum(float(row[name]) for row in scored) / len(scored)
        assert mean == pytest.approx(figures[name], rel=1e-6)
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 10_000
    dear = json.loads(good("score", *files, "--switch", 0, "--gate", 1, "--json").stdout)
    assert dear["gospa_switching_m"] == figures["gospa_m"]
    assert dear["siap_spuriousness"] > 0.9 and dear["gospa_m"] == figures["gospa_m"]


def test_figures_that_do_not_exist_are_null(good: Run, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "blind.toml").write_text("[engine]\nconfirm_score = 1e6\nscore_cap = 2e6\n")
    blind = tmp_path / "tracks.jsonl"
    good("track", recording / "plots.jsonl", "--out", blind, "--config", tmp_path / "blind.toml")
    text = good("score", blind, recording / "truth.jsonl", "--json").stdout
    figures = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert figures["rmse_m"] is None and figures["coverage"] == 0


def test_nothing_to_score_is_told(run: Run, recording: Path) -> None:
    result = run("score", recording / "tracks.jsonl", recording / "truth.jsonl", "--warmup", 100)
    assert result.exit_code == 1 and "No frame of" in result.stderr and "Traceback" not in result.stderr


def test_the_picture_of_a_recording(good: Run, recording: Path, tmp_path: Path) -> None:
    picture = tmp_path / "tracks.png"
    arguments = (recording / "tracks.jsonl", recording / "truth.jsonl", "--plots", recording / "plots.jsonl")
    assert good("plot", *arguments, "--out", picture).stdout == ""
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 10_000


def test_a_picture_that_cannot_be_made_is_told(run: Run, recording: Path, tmp_path: Path) -> None:
    for name in ("none/tracks.png", "tracks.xyz"):
        result = run("plot", recording / "tracks.jsonl", "--out", tmp_path / name)
        assert result.exit_code == 1
        assert result.stderr.startswith("trackmesh: Cannot ") and result.stderr.count("\n") == 1


# --- a recording of real sensors


@pytest.mark.skipif(not AUTOFERRY.exists(), reason="the Autoferry recordings are not here")
def test_boats_in_a_harbour(good: Run, tmp_path: Path) -> None:
    plots, truth, tracks = (tmp_path / name for name in ("plots.jsonl", "truth.jsonl", "tracks.jsonl"))
    good("convert", "autoferry", AUTOFERRY, "--out", plots, "--truth", truth)
    good("track", plots, "--config", ROOT / "examples" / "harbour.toml", "--out", tracks)
    figures = json.loads(good("score", tracks, truth, "--nearest", "--c", 30, "--json").stdout)
    assert figures["rmse_m"] <= 5.5
    assert figures["coverage"] >= 0.95


# --- EMI


def test_buried_targets_are_found_where_they_lie(good: Run, tmp_path: Path) -> None:
    scans, written = tmp_path / "scans.jsonl", tmp_path / "results.jsonl"
    assert good("sim", "emi", scans).stdout == ""
    shown = good("invert", scans, "--local", "--json", "--out", written).stdout
    assert shown == written.read_text()
    results = [result for result in map(from_line, shown.splitlines()) if isinstance(result, EmiResult)]
    buried = load_scenario("two-radars").emi
    assert buried is not None and len(results) == len(buried.targets)
    for result, target in zip(results, buried.targets, strict=True):
        assert result.status == "ok"
        assert math.dist(result.targets[0].position_m, target.position_m) < 0.05
    table = good("invert", scans, "--local").stdout
    assert "3 scans" in table and table.count(" ok ") == 3


# --- what programs read stays readable


@pytest.mark.process
def test_into_a_pipe_there_is_no_progress_and_no_colour(
    process: Callable[..., subprocess.CompletedProcess[bytes]], recording: Path, tmp_path: Path
) -> None:
    plots, tracks, truth = recording / "plots.jsonl", tmp_path / "tracks.jsonl", recording / "truth.jsonl"
    track = process("track", plots, "--out", tracks)
    score = process("score", tracks, truth, "--json")
    for done in (track, score):
        assert done.returncode == 0, done.stderr
        assert b"\x1b" not in done.stdout + done.stderr
    assert (track.stdout, track.stderr.count(b"\n"), score.stderr) == (b"", 1, b"")
    assert json.loads(score.stdout)["frames"] > 0
    same = tracks.read_bytes() == (recording / "tracks.jsonl").read_bytes()
    assert same  # not compared by pytest: a diff of two long files takes minutes


# --- help


def test_the_help_tells_each_command_in_a_whole_sentence(good: Run) -> None:
    for group in ((), ("sim",), ("convert",)):
        text = good(*group, "--help").stdout
        commands = text.split("Commands:\n")[1].strip().splitlines()
        assert commands
        for line in commands:
            assert line.rstrip().endswith(".") and not line.rstrip().endswith("..."), line
            name = line.split()[0]
            assert good(*group, name, "--help").stdout.startswith(f"Usage: {' '.join(('trackmesh', *group, name))}")


def test_the_version(good: Run) -> None:
    assert good("--version").stdout.startswith("trackmesh 0.")
