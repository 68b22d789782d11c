"""Induction scans on the command line: a survey log read, inverted and drawn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from trackmesh.protocol.files import from_line, read_records
from trackmesh.protocol.messages import EmiResult, EmiScanBatch
from trackmesh.sim.emi import channel_field_nt, grid_positions, random_targets, survey_geometry

Run = Callable[..., Result]
COIL = ("--radius", 0.5, "--current", 20)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two anomalies as a towed sensor would write them, far from the origin of its grid."""
    truth, rng = random_targets(2, 4, spread_m=0.4), np.random.default_rng(2)
    geometry = survey_geometry((3.0, 3.0), 0.25)
    path, lines = tmp_path / "field.csv", ["easting,northing,anomaly,bx,by,bz"]
    for i in range(2):
        field = channel_field_nt(geometry, truth.position_m[i], truth.tensor_m3[i : i + 1])[0]
        field = field + 0.01 * np.abs(field).max() * rng.normal(size=field.shape)
        for place, b in zip(grid_positions((3.0, 3.0), 0.25), field, strict=True):
            lines.append(f"{456100 + 10 * i + place[0]:.3f},{5321000 + place[1]:.3f},{i},{b[0]},{b[1]},{b[2]}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_survey_log_becomes_targets_and_pictures(good: Run, log: Path, tmp_path: Path) -> None:
    scans, pictures = tmp_path / "scans.jsonl", tmp_path / "pictures"
    columns = ("--x", "easting", "--y", "northing", "--field", "bx,by,bz", "--scan", "anomaly")
    said = good("convert", "emi-csv", log, "--out", scans, *columns, *COIL).stderr
    assert "2 scans, 338 samples" in said and "places are from x = 456100 m, y = 5321000 m" in said
    assert [b.batch_id for b in read_records(scans, EmiScanBatch) if isinstance(b, EmiScanBatch)] == [
        "field-0",
        "field-1",
    ]
    shown = good("invert", scans, "--local", "--json", "--plot", pictures).stdout
    results = [result for result in map(from_line, shown.splitlines()) if isinstance(result, EmiResult)]
    truth = random_targets(2, 4, spread_m=0.4).position_m
    for i, result in enumerate(results):
        assert result.status == "ok"
        np.testing.assert_allclose(result.targets[0].position_m, truth[i] + np.array([10.0 * i, 0.0, 0.0]), atol=0.05)
    assert sorted(p.name for p in pictures.iterdir()) == ["field-0-0.png", "field-1-0.png"]


def test_worker_processes_give_the_same(good: Run, tmp_path: Path) -> None:
    scans = tmp_path / "scans.jsonl"
    good("sim", "emi", scans)
    alone = good("invert", scans, "--local", "--json").stdout
    assert good("invert", scans, "--local", "--json", "--processes", 2).stdout == alone


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        ("--x east --y northing --field bx,by,bz", 1, "has no column 'east'; it has easting, northing,"),
        ("--x easting --y northing --field bx,by", 1, "A channel has 2 columns (bx, by), where the receivers give 3"),
        ("--x easting --y northing --field bx,by,bz --receiver 0,0", 2, "must be 3 numbers"),
        ("--x easting --y northing --field bx,by,bz --current 0", 1, "current_a"),
        ("--x easting --y northing --field bx,by,bz --sigma -1", 1, "sigma"),
        ("--x easting --y northing", 2, "--field"),
    ],
)
def test_mistakes_are_told(run: Run, log: Path, tmp_path: Path, arguments: str, code: int, sentence: str) -> None:
    given = arguments.split()
    coil = COIL[:2] if "--current" in given else COIL
    result = run("convert", "emi-csv", log, "--out", tmp_path / "x.jsonl", *coil, *given)
    assert result.exit_code == code
    assert sentence in " ".join(result.stderr.split())


def test_scans_whose_geometry_is_only_named_cannot_be_inverted_here(run: Run, good: Run, tmp_path: Path) -> None:
    scans, named = tmp_path / "scans.jsonl", tmp_path / "named.jsonl"
    good("sim", "emi", scans)
    (batch,) = read_records(scans, EmiScanBatch)
    assert isinstance(batch, EmiScanBatch)
    from trackmesh.protocol.files import to_line

    named.write_text(to_line(batch.model_copy(update={"geometry": None, "geometry_id": "abc"})) + "\n")
    result = run("invert", named, "--local")
    assert result.exit_code == 1
    assert "brings no geometry, only its name abc" in result.stderr
