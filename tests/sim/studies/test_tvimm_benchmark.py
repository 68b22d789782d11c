from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from matplotlib.image import imread

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.services.estimation.bank import Models
from trackmesh.services.estimation.filters import FilterName
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.sim.studies import tvimm, tvimm_benchmark
from trackmesh.sim.studies.result import StudyResult
from trackmesh.sim.studies.tvimm_benchmark import SETS, compare, filters_of

FILTERS = ("imm", "tvimm-dirichlet", "tvimm-paper", "tvimm")


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    return compare(tmp_path_factory.mktemp("study") / "new", 40, lambda _: None)


def ours(study: StudyResult, name: str, row: str) -> dict[str, float]:
    """A row of a table, by filter."""
    return {str(r["column"]): float(str(r["ours"])) for r in study.rows if (r["table"], r["row"]) == (name, row)}


def served(name: FilterName) -> Models:
    """The models of a filter, as the service has them unless it is told otherwise."""
    system = EngineSettings(filter=name).system_tracks(1)
    assert isinstance(system, ImmTracks)
    return system.models


def generator(models: Models) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    r = len(models.kind)
    return np.asarray(models.rate[0] * (models.jump[0, 0] - np.eye(r)))


@pytest.mark.parametrize("name", SETS)
def test_models_are_kept_for_a_second_with_95_in_100(name: str) -> None:
    models = filters_of(name)["imm"]
    stay = scipy.linalg.expm(generator(models))
    np.testing.assert_allclose(np.diag(stay), 0.95, atol=1e-12)
    np.testing.assert_allclose(stay[0, 1:], 0.05 / (len(stay) - 1), atol=1e-12)
    assert np.isinf(models.prior_count).all()


def test_transitions_are_learned_as_the_service_does() -> None:
    learned = served("tvimm-dirichlet")
    for name in SETS:
        learning = filters_of(name)["tvimm-dirichlet"]
        assert learning.prior_count.tolist() == learned.prior_count.tolist() == [20.0]
        assert (learning.memory_s, learning.reference_s) == (learned.memory_s, learned.reference_s)


@pytest.mark.parametrize("name", SETS)
def test_filters_of_a_set_differ_by_what_they_are_called_after(name: str) -> None:
    filters = filters_of(name)
    assert tuple(filters) == FILTERS
    for other in ("tvimm-dirichlet", "tvimm-paper"):
        np.testing.assert_array_equal(filters[other].numbers, filters["imm"].numbers)
        np.testing.assert_array_equal(filters[other].jump, filters["imm"].jump)
    assert [int(f.printed) for f in filters.values()] == [0, 0, 1, 0]
    np.testing.assert_array_equal(filters["tvimm"].numbers, served("tvimm").numbers)


def test_the_turns_are_known_and_to_both_sides() -> None:
    numbers = filters_of("C")["imm"].numbers
    np.testing.assert_allclose(np.degrees(numbers[:, 1]), [0.0, 6.0, -6.0])
    assert not numbers[:, 2].any()
    np.testing.assert_allclose(numbers[:, 0], [0.25, 64.0, 64.0])


@pytest.mark.parametrize("name", SETS)
def test_learned_transitions_cost_nothing_and_the_published_form_diverges(shown: StudyResult, name: str) -> None:
    rmse, anees = ours(shown, name, "rmse"), ours(shown, name, "anees")
    assert rmse["tvimm-dirichlet"] <= 1.01 * rmse["imm"]
    assert anees["tvimm-dirichlet"] <= 1.15 * anees["imm"]
    assert rmse["tvimm-paper"] > 2.0 * rmse["imm"]
    assert anees["tvimm-paper"] > 10.0
    assert rmse["tvimm"] < rmse["imm"]


def test_errors_are_those_measured_before(shown: StudyResult) -> None:
    """By other simulations of the same target and models."""
    for name, want in (("A", 20.49), ("B", 19.53), ("C", 20.51)):
        assert ours(shown, name, "rmse")["imm"] == pytest.approx(want, rel=0.04)
    for name, sure, covered in (("A", 0.77, 0.957), ("B", 1.02, 0.934), ("C", 1.04, 0.914)):
        assert ours(shown, name, "anees")["imm"] == pytest.approx(sure, rel=0.08)
        assert ours(shown, name, "cov95")["imm"] == pytest.approx(covered, abs=0.015)


def test_rows_are_labelled_and_json(shown: StudyResult, tmp_path: Path) -> None:
    shown.write_json(tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())
    labels = {(r["table"], r["row"], r["column"]) for r in rows}
    assert labels == {(t, r, c) for t in SETS for r in ("rmse", "anees", "cov95") for c in FILTERS}
    assert len(rows) == len(labels)
    assert all(r["paper"] is None and r["runs"] == 40 and 0.0 < r["ours_std"] < r["ours"] for r in rows)


def test_tables_and_notes_tell_the_same(shown: StudyResult) -> None:
    assert all(len(row) == len(table.header) for table in shown.tables for row in table.rows)
    assert [row[-1] for row in shown.tables[1].rows] == ["yes"] * 6
    rmse = ours(shown, "C", "rmse")
    assert f"{rmse['tvimm-paper']:.0f} m with sets A, B and C" in shown.notes[0]
    assert f"{rmse['imm']:.2f} (" in shown.tables[0].rows[8][2]


def test_the_picture_shows_something(shown: StudyResult, tmp_path: Path) -> None:
    assert [p.name for p in shown.pictures] == ["tvimm_benchmark.png"]
    pixels = imread(shown.pictures[0])
    assert min(pixels.shape[:2]) > 600
    assert len(np.unique(pixels[::3, ::3, :3].reshape(-1, 3), axis=0)) > 100
    (tmp_path / "file").write_text("")
    with pytest.raises(TrackmeshError, match="Cannot write"):
        compare(tmp_path / "file", 1, lambda _: None)


def test_it_is_the_second_part_of_the_study() -> None:
    shares: list[float] = []
    found = tvimm.run(runs=2, progress=shares.append)
    assert tvimm.PARTS[1] is tvimm_benchmark.compare
    assert {r["table"] for r in found.rows} == {"1", "2", "A", "B", "C"}
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
