from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, KalmanFilter
from matplotlib.image import imread
from scipy.stats import multivariate_normal

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.sim.studies import tvimm as study_of_tvimm
from trackmesh.sim.studies.result import StudyResult, Table, study_row
from trackmesh.sim.studies.tvimm_filters import (
    P_START,
    TRANSITIONS,
    Bank,
    FloatArray,
    Model,
    filter_all,
    imm,
    imm_step,
    kalman,
    mix,
    tvimm,
    tvimm_step,
)
from trackmesh.sim.studies.tvimm_paper import compare, least_error
from trackmesh.sim.studies.tvimm_scores import Score, Scores, joined, scored, simulate_scores
from trackmesh.sim.studies.tvimm_setting import (
    FILTERS,
    MANOEUVRING,
    SCENARIOS,
    STATIC,
    Scenario,
    fitted_models,
    printed_models,
    simulate,
    stacked,
)

EXPECTED_M = {"1": (0.381, 0.340, 0.268, 0.373), "2": (0.270, 0.343, 0.236, 0.269)}
"""Means with the printed parameters, simulated before and apart from this."""

both_scenarios = pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=lambda s: s.name)


@pytest.fixture(scope="module")
def scores() -> Scores:
    return simulate_scores(500, lambda _: None)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    return compare(tmp_path_factory.mktemp("study") / "new", 20, lambda _: None)


def one_run(scenario: Scenario, models: tuple[Model, Model]) -> tuple[FloatArray, FloatArray]:
    return simulate(scenario, 3, np.random.default_rng(7), steps=40).measured(models)


@pytest.mark.parametrize("table", SCENARIOS)
def test_eight_means_are_those_of_the_printed_parameters(scores: Scores, table: str) -> None:
    means = [scores[table, "own", name].mean for name in FILTERS]
    np.testing.assert_allclose(means, EXPECTED_M[table], rtol=0.03)


@pytest.mark.parametrize("table", SCENARIOS)
def test_tvimm_is_below_both_models_as_printed(scores: Scores, table: str) -> None:
    first, second, best, other = (scores[table, "own", name] for name in FILTERS)
    assert best.mean < 0.95 * min(first.mean, second.mean, other.mean)
    assert np.all(best.over_time < np.minimum(first.over_time, second.over_time))


def test_the_conventional_imm_is_between_the_models_when_the_target_manoeuvres(scores: Scores) -> None:
    first, second, _, other = (scores["1", "own", name].mean for name in FILTERS)
    assert second < other < first
    assert scores["2", "own", "imm"].mean == pytest.approx(scores["2", "own", "model 1"].mean, rel=0.02)


def test_one_filter_with_both_measurements_does_as_well_or_better(scores: Scores) -> None:
    for table in SCENARIOS:
        best = min(scores[table, "stacked", name].mean for name in ("model 1", "model 2"))
        assert max(best, scores[table, "stacked", "imm"].mean) < scores[table, "own", "tvimm"].mean


def test_the_product_is_consistent_for_independent_measurements_only(scores: Scores) -> None:
    for table in SCENARIOS:
        assert scores[table, "own", "tvimm"].nees == pytest.approx(2.0, rel=0.07)
        assert scores[table, "stacked", "tvimm"].nees == pytest.approx(4.0, rel=0.06)
        assert scores[table, "stacked", "imm"].nees == pytest.approx(2.0, rel=0.12)
        assert scores[table, "shared", "tvimm"].nees > 3.3
        better = min(scores[table, "shared", name].mean for name in ("model 1", "model 2"))
        assert scores[table, "shared", "tvimm"].mean > better


def test_matched_models_alone_are_consistent(scores: Scores) -> None:
    matched = [("1", "own", "model 1"), ("1", "own", "model 2"), ("2", "own", "model 1"), ("1", "stacked", "model 1")]
    for key in matched:
        assert scores[key].nees == pytest.approx(2.0, rel=0.03)


def test_the_fitted_example_is_nearer_to_the_tables_but_not_sound(scores: Scores) -> None:
    assert scores["1", "fitted", "model 2"].mean == pytest.approx(0.299, rel=0.03)
    assert scores["2", "fitted", "model 2"].mean == pytest.approx(0.624, rel=0.04)
    assert scores["2", "fitted", "model 2"].nees > 50.0


def test_no_filter_can_have_the_printed_error_of_model_2(scores: Scores) -> None:
    over_all, settled = least_error(printed_models(MANOEUVRING)[1])
    assert 0.279 < least_error(printed_models(MANOEUVRING)[1], 20)[0] < over_all < settled
    assert settled == pytest.approx(0.336, abs=5e-4)
    assert settled == pytest.approx(scores["1", "own", "model 2"].over_time[50:].mean(), rel=0.01)


@both_scenarios
@pytest.mark.parametrize("j", [0, 1])
def test_single_models_are_the_textbook_kalman_filter(scenario: Scenario, j: int) -> None:
    models = printed_models(scenario)
    z = one_run(scenario, models)[j]
    track = kalman(models[j], z, scenario.start)
    for run in range(z.shape[1]):
        oracle = textbook_filter(models[j], scenario)
        for k, z_k in enumerate(z[:, run]):
            oracle.predict()
            oracle.update(z_k)
            np.testing.assert_allclose(track.x[k, run], oracle.x, rtol=0, atol=1e-10)
            np.testing.assert_allclose(track.P[k, 0], oracle.P, rtol=0, atol=1e-10)


@both_scenarios
def test_the_conventional_imm_is_the_textbook_one_where_models_measure_alike(scenario: Scenario) -> None:
    models = stacked(printed_models(scenario))
    z = np.concatenate(one_run(scenario, printed_models(scenario)), axis=-1)
    track = imm(models, (z, z), scenario.start)
    for run in range(z.shape[1]):
        filters = [textbook_filter(model, scenario) for model in models]
        oracle = IMMEstimator(filters, [0.5, 0.5], TRANSITIONS)
        for k, z_k in enumerate(z[:, run]):
            oracle.predict()
            oracle.update(z_k)
            np.testing.assert_allclose(track.x[k, run], oracle.x, rtol=0, atol=1e-9)
            np.testing.assert_allclose(track.P[k, run], oracle.P, rtol=0, atol=1e-9)


@both_scenarios
def test_tvimm_is_the_equations_one_by_one(scenario: Scenario) -> None:
    models = printed_models(scenario)
    z = one_run(scenario, models)
    track = tvimm(models, z, scenario.start)
    for run in range(3):
        for k, (x, P) in enumerate(printed_equations(models, [z_j[:, run] for z_j in z], scenario)):
            np.testing.assert_allclose(track.x[k, run], x, rtol=0, atol=1e-9)
            np.testing.assert_allclose(track.P[k, run], P, rtol=0, atol=1e-9)


@both_scenarios
def test_probabilities_of_the_paper_depend_on_how_sure_the_models_are_and_not_on_the_plot(scenario: Scenario) -> None:
    models = printed_models(scenario)
    bank = start_bank(scenario, 3)
    for z_k in zip(*one_run(scenario, models), strict=True):
        bank, _, _ = tvimm_step(models, bank, z_k)
        apart = bank.x[:, 0] - bank.x[:, 1]
        inverse = np.linalg.inv(bank.P)
        expected = 0.5 * np.einsum("na,nab,nb->n", apart, inverse[:, 0] - inverse[:, 1], apart)
        np.testing.assert_allclose(bank.log_mu[:, 0] - bank.log_mu[:, 1], expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(np.exp(bank.log_mu).sum(axis=1), 1.0, rtol=1e-12)
        np.testing.assert_allclose(np.exp(bank.log_pi).sum(axis=2), 1.0, rtol=1e-12)


@pytest.mark.parametrize("step", [tvimm_step, imm_step])
def test_models_far_apart_leave_everything_finite(step: Callable[..., tuple[Bank, FloatArray, FloatArray]]) -> None:
    models = printed_models(MANOEUVRING)
    bank = start_bank(MANOEUVRING, 2)
    for z_k in ([np.full((2, 2), 1e5), np.zeros((2, 4))], [np.zeros((2, 2)), np.full((2, 4), -1e5)]) * 3:
        bank, x, P = step(models, bank, z_k)
        assert all(np.isfinite(a).all() for a in (x, P, bank.x, bank.P))
        assert not np.isnan(bank.log_mu).any() and not np.isnan(bank.log_pi).any()
        assert np.linalg.eigvalsh(P).min() > 0.0


def test_mixing_keeps_the_first_two_moments() -> None:
    models, bank = printed_models(MANOEUVRING), start_bank(MANOEUVRING, 3)
    for z_k in zip(*one_run(MANOEUVRING, models), strict=True):
        bank, _, _ = imm_step(models, bank, z_k)
    mixed = mix(bank)
    prior = np.exp(bank.log_mu)[:, None] @ np.exp(bank.log_pi)
    before, after = (moments(w, *m) for w, m in ((np.exp(bank.log_mu), (bank.x, bank.P)), (prior[:, 0], mixed)))
    np.testing.assert_allclose(after, before, rtol=1e-12, atol=1e-12)
    assert filter_all(models, *mixed, z_k)[2].shape == (3, 2)


@both_scenarios
def test_targets_move_as_they_are_said_to(scenario: Scenario) -> None:
    draw = simulate(scenario, 4000, np.random.default_rng(3), steps=5)
    moved = draw.truth[1:] - draw.truth[:-1] @ scenario.phi.T
    np.testing.assert_allclose(np.cov(moved.reshape(-1, 4).T), scenario.Q, atol=3e-4)
    first, second = draw.measured(printed_models(scenario))
    noise = np.concatenate([first - draw.truth[..., :2], second - draw.truth], axis=-1).reshape(-1, 6)
    np.testing.assert_allclose(np.cov(noise.T), 0.25 * np.eye(6), atol=0.008)
    shared = draw.measured_once(printed_models(scenario))
    np.testing.assert_array_equal(shared[0], second[..., :2])


def test_matrices_are_those_of_the_print() -> None:
    Q = np.array([[1 / 64, 0, 1 / 16, 0], [0, 1 / 64, 0, 1 / 16], [1 / 16, 0, 1 / 4, 0], [0, 1 / 16, 0, 1 / 4]])
    np.testing.assert_allclose(MANOEUVRING.Q, 0.04 * Q, atol=1e-15)
    np.testing.assert_allclose(STATIC.Q, 0.04 * np.diag([0.25, 0.25, 0.0, 0.0]), atol=1e-15)
    moving = np.array([[1, 0, 0.5, 0], [0, 1, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1]])
    for scenario, phi in ((MANOEUVRING, moving), (STATIC, np.eye(4))):
        first, second = printed_models(scenario)
        np.testing.assert_array_equal(scenario.phi, phi)
        np.testing.assert_array_equal(first.phi, phi)
        np.testing.assert_array_equal(second.phi, moving)
        np.testing.assert_array_equal(second.Q, MANOEUVRING.Q)
        np.testing.assert_array_equal(second.R, 0.25 * np.eye(4))
        assert first.phi_P is second.phi_P is None
        np.testing.assert_array_equal(np.diag(fitted_models(scenario)[1].R), np.square([0.5, 0.5, 0.3, 0.3]))


def test_runs_are_the_same_however_many() -> None:
    few, many = (simulate(STATIC, n, np.random.default_rng(1), steps=4) for n in (2, 5))
    np.testing.assert_array_equal(many.truth[:, :2], few.truth)
    np.testing.assert_array_equal(many.noise[1][:, :2], few.noise[1])


def test_batches_are_joined_by_their_runs() -> None:
    draw = simulate(STATIC, 5, np.random.default_rng(1), steps=30)
    model = printed_models(STATIC)[0]
    z = draw.measured(printed_models(STATIC))[0]
    parts = [scored(draw.truth[:, s], kalman(model, z[:, s], STATIC.start)) for s in (slice(0, 1), slice(1, 5))]
    whole = scored(draw.truth, kalman(model, z, STATIC.start))
    both = joined(parts)
    np.testing.assert_array_equal(both.example, whole.example)
    for ours, expected in zip((both.per_run, both.over_time, both.nees), whole[:2] + whole[3:], strict=True):
        np.testing.assert_allclose(np.asarray(ours), np.asarray(expected), rtol=1e-12)


def test_scatter_is_that_of_fifty_runs() -> None:
    rng = np.random.default_rng(5)
    repeated = rng.normal(0.3, 0.03, (2000, 50))
    scatter = Score(repeated.ravel(), np.zeros(1), np.zeros(1), 2.0).scatter
    assert scatter["mean"] == pytest.approx(repeated.mean(axis=1).std(), rel=0.05)
    assert scatter["std"] == pytest.approx(repeated.std(axis=1).std(), rel=0.05)


def test_rows_are_labelled_and_json(shown: StudyResult, tmp_path: Path) -> None:
    shown.write_json(tmp_path / "rows.json")
    read = json.loads((tmp_path / "rows.json").read_text())
    labels = [(r["table"], r["row"], r["column"]) for r in read]
    assert labels == [(t, r, c) for t in ("1", "2") for r in ("mean", "std") for c in FILTERS]
    assert [r["paper"] for r in read[:8]] == [0.392, 0.279, 0.248, 0.337, 0.029, 0.029, 0.022, 0.044]
    assert [r["paper"] for r in read[8:]] == [0.282, 0.738, 0.258, 0.302, 0.028, 0.095, 0.025, 0.036]
    assert all(r["runs"] == 20 and 0.0 < r["ours_std"] < r["ours"] for r in read)


def test_tables_and_notes_say_what_is_whose(shown: StudyResult) -> None:
    assert all(len(row) == len(table.header) for table in shown.tables for row in table.rows)
    fitted = next(t for t in shown.tables if t.title.startswith("Fitted"))
    assert "not the paper's setting" in fitted.title
    claims = next(t for t in shown.tables if t.title.startswith("What the text"))
    holds = {text: verdict for text, _, verdict in claims.rows}
    assert holds["table 1: TV-IMM has the least error"] == holds["table 2: TV-IMM has the least error"] == "yes"
    assert holds["fig. 5: model 2 diverges on the static target"] == "no"
    assert holds["(11): the models are independent (one position for both)"] == "no"
    unmatched = [note for note in shown.notes if note.startswith("Cannot be matched")]
    assert [v for v in ("0.279", "0.738", "0.302") if any(v in note for note in unmatched)] == [
        "0.279",
        "0.738",
        "0.302",
    ]


def test_pictures_show_something(shown: StudyResult) -> None:
    assert {p.name for p in shown.pictures} == {f"tvimm_{n}.png" for n in ("single_run", "mean_error", "tables")}
    for picture in shown.pictures:
        pixels = imread(picture)
        assert min(pixels.shape[:2]) > 600
        assert len(np.unique(pixels[::3, ::3, :3].reshape(-1, 3), axis=0)) > 100


def test_pictures_that_cannot_be_written_are_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TrackmeshError, match="Cannot write"):
        study_of_tvimm.run(tmp_path / "file", runs=1)


def test_parts_follow_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    def part(name: str) -> study_of_tvimm.Part:
        def found(plots: Path | None, runs: int, progress: Callable[[float], None]) -> StudyResult:
            progress(0.5)
            progress(1.0)
            row = study_row(name, "rmse", "imm", paper=None, ours=1.0, runs=runs)
            return StudyResult([row], [name], [Table(name, [], [])], [Path(name)])

        return found

    shares: list[float] = []
    monkeypatch.setattr(study_of_tvimm, "PARTS", (part("1"), part("A")))
    both = study_of_tvimm.run(runs=3, progress=shares.append)
    assert [(r["table"], r["runs"]) for r in both.rows] == [("1", 3), ("A", 3)]
    assert both.notes == [t.title for t in both.tables] == [str(p) for p in both.pictures] == ["1", "A"]
    assert shares == [0.25, 0.5, 0.75, 1.0]


def test_progress_reaches_the_end() -> None:
    shares: list[float] = []
    study_of_tvimm.run(runs=1, progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def start_bank(scenario: Scenario, n: int) -> Bank:
    """As the filters start: both models at the true state."""
    x, P = np.tile(scenario.start, (n, 2, 1)), np.tile(P_START, (n, 2, 1, 1))
    return Bank(x, P, np.log(np.full((n, 2), 0.5)), np.tile(np.log(TRANSITIONS), (n, 1, 1)))


def textbook_filter(model: Model, scenario: Scenario) -> KalmanFilter:
    oracle = KalmanFilter(dim_x=4, dim_z=len(model.H))
    oracle.x, oracle.P = scenario.start.copy(), np.eye(4)
    oracle.F, oracle.Q, oracle.H, oracle.R = model.phi, model.Q, model.H, model.R
    return oracle


def moments(weight: FloatArray, x: FloatArray, P: FloatArray) -> FloatArray:
    """Mean and second moment of mixtures, stacked (n, 5, 4)."""
    second = np.einsum("nj,njab->nab", weight, P + x[..., :, None] * x[..., None, :])
    return np.concatenate([np.einsum("nj,nja->na", weight, x)[:, None], second], axis=1)


def printed_equations(
    models: tuple[Model, Model], z: list[FloatArray], scenario: Scenario
) -> list[tuple[FloatArray, FloatArray]]:
    """One run of TV-IMM as printed and corrected, in plain loops with inverses and densities."""
    r = range(2)
    x, P, mu, pi = [scenario.start] * 2, [np.eye(4)] * 2, np.array([0.5, 0.5]), TRANSITIONS
    fused = []
    for k in range(len(z[0])):
        weight = mu[:, None] * pi / (mu @ pi)
        mixed = [sum(weight[i, j] * x[i] for i in r) for j in r]
        spread = [sum(weight[i, j] * (P[i] + np.outer(x[i] - mixed[j], x[i] - mixed[j])) for i in r) for j in r]
        x, P = [], []
        for j, m in enumerate(models):
            prior = m.phi @ spread[j] @ m.phi.T + m.Q
            S = m.H @ prior @ m.H.T + m.R
            K = prior @ m.H.T @ np.linalg.inv(S)
            x.append(m.phi @ mixed[j] + K @ (z[j][k] - m.H @ m.phi @ mixed[j]))
            P.append(prior - K @ S @ K.T)
        fused_P = np.linalg.inv(sum(np.linalg.inv(P[j]) for j in r))
        fused_x = fused_P @ sum(np.linalg.inv(P[j]) @ x[j] for j in r)
        fused.append((fused_x, fused_P))
        mu = np.array([multivariate_normal.pdf(x[j], fused_x, fused_P) for j in r])
        mu = mu / mu.sum()
        pi = np.array([[multivariate_normal.pdf(x[i], x[j], P[j]) for j in r] for i in r])
        pi = pi / pi.sum(axis=1, keepdims=True)
    return fused
