from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.sim.studies.alpha_beta import PRINTED, Cell, best_k_end, judged, run, simulated_pick
from trackmesh.sim.studies.result import StudyResult, study_row

EXACT = [Cell(25, 10, 0.5), Cell(25, 15, 0.5), Cell(25, 35, 0.5), Cell(25, 15, 2), Cell(25, 15, 6)]
SHARED = [Cell(25, 0.1, 0.5), Cell(400, 0.1, 1)]


@pytest.fixture(scope="module")
def study() -> StudyResult:
    return run()


def ours(study: StudyResult, cell: Cell) -> dict[str, object]:
    table = "1" if cell.variance_w == 25 else "2"
    wanted = (table, f"{cell.variance_v:g}", f"T={cell.dt_s:g}")
    return next(r for r in study.rows if (r["table"], r["row"], r["column"]) == wanted)


@pytest.mark.parametrize("cell", EXACT, ids=str)
def test_five_values_of_the_paper_are_met(study: StudyResult, cell: Cell) -> None:
    row = ours(study, cell)
    assert row["ours"] == row["paper"] == PRINTED[cell]


def test_one_is_met_within_one(study: StudyResult) -> None:
    assert ours(study, Cell(25, 0.1, 1))["ours"] in (10, 11)


@pytest.mark.parametrize("cell", SHARED, ids=str)
def test_two_that_share_a_lambda_are_one_and_on_the_flat_ground(study: StudyResult, cell: Cell) -> None:
    assert cell.lambda_ == pytest.approx(SHARED[0].lambda_)
    assert ours(study, cell)["ours"] == ours(study, SHARED[0])["ours"]
    j = judged(cell)
    assert 15 <= j.low <= j.best <= j.high <= 28
    assert j.low <= PRINTED[cell] <= j.high


def test_the_tables_are_whole_and_labelled(study: StudyResult) -> None:
    assert len(study.rows) == 120
    assert len({(r["table"], r["row"], r["column"]) for r in study.rows}) == 120
    assert {r["column"] for r in study.rows} == {f"T={v}" for v in ("0.5", "1", "2", "6", "10", "12")}
    assert {r["row"] for r in study.rows} == {"0.1", "0.5", "1", "2", "5", "10", "15", "20", "28", "35"}
    assert sum(r["paper"] is not None for r in study.rows) == len(PRINTED) == 8
    assert all(r["ours_std"] == 0.0 and r["runs"] == 0 for r in study.rows)


def test_k_end_follows_lambda_alone() -> None:
    # Sixteen times sigma_w^2 and twice T leave lambda as it is.
    small, large = best_k_end(25.0), best_k_end(400.0)
    np.testing.assert_array_equal(small[:, 0], large[:, 1])
    np.testing.assert_array_equal(small[:, 1], large[:, 2])


def test_what_the_paper_says_is_judged(study: StudyResult) -> None:
    claims = next(t for t in study.tables if t.title.startswith("What the text"))
    holds = {text: verdict for text, _, verdict in claims.rows}
    assert sum(v == "yes" for v in holds.values()) == 6
    assert holds["fig. 4: 7 costs 1.5 m and 1 m/s more than 26"] == "no"
    assert all(len(row) == len(table.header) for table in study.tables for row in table.rows)
    assert any("26 and 16: both cannot be matched" in note for note in study.notes)


def test_the_procedure_of_the_paper_scatters_about_the_computed_value() -> None:
    picks = [simulated_pick(Cell(25, 10, 0.5), np.random.default_rng(seed)) for seed in range(5)]
    assert set(picks) <= {6, 7, 8}
    assert simulated_pick(Cell(25, 15, 6), np.random.default_rng(1)) == 2


def test_runs_give_the_spread_of_the_cells_the_paper_names(tmp_path: Path) -> None:
    shares: list[float] = []
    found = run(tmp_path / "new", runs=2, progress=shares.append)
    assert [r["runs"] for r in found.rows if r["paper"] is not None] == [2] * 8
    assert {r["runs"] for r in found.rows if r["paper"] is None} == {0}
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len(found.pictures) == 2
    for picture in found.pictures:
        pixels = imread(picture)
        assert min(pixels.shape[:2]) > 600
        assert len(np.unique(pixels[::3, ::3, :3].reshape(-1, 3), axis=0)) > 100


def test_pictures_that_cannot_be_written_are_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TrackmeshError, match="Cannot write"):
        run(tmp_path / "file")


def test_rows_are_json(study: StudyResult, tmp_path: Path) -> None:
    study.write_json(tmp_path / "rows.json")
    read = json.loads((tmp_path / "rows.json").read_text())
    assert read == study.rows
    assert list(read[0]) == ["table", "row", "column", "paper", "ours", "ours_std", "runs"]


def test_a_result_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(TrackmeshError, match="Cannot write"):
        StudyResult().write_json(tmp_path / "no" / "rows.json")
    bad = StudyResult([study_row("1", "a", "b", paper=None, ours=float("nan"))])
    with pytest.raises(TrackmeshError, match="not a finite number"):
        bad.write_json(tmp_path / "rows.json")
    assert not (tmp_path / "rows.json").exists()
