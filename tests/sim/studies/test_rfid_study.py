"""The RFID study: what the tags' filters must show, in small; its rows, pictures and the slides' misprints."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread

from trackmesh.services.tags import singer
from trackmesh.services.tags.records import Describe
from trackmesh.sim.studies.result import StudyResult
from trackmesh.sim.studies.rfid import cases, study
from trackmesh.sim.studies.rfid.bound import bound_given, posterior_bound
from trackmesh.sim.studies.rfid.cases import SERVICE, TVIMM, describe, one_sided
from trackmesh.sim.studies.rfid.printed_forms import (
    driving_variance,
    printed_driving_variance,
    printed_moments,
    printed_noise,
)
from trackmesh.sim.studies.rfid.runs import follow
from trackmesh.sim.studies.rfid.worlds import Data, hall, matched, reference, simulate, weighed

RUNS, SEED = 100, 2


@pytest.fixture(scope="module")
def clean() -> Data:
    return cases.clean_data(RUNS, SEED)


@pytest.fixture(scope="module")
def corners() -> Data:
    return cases.corner_data(RUNS, SEED)


# --- what must be shown


@pytest.mark.parametrize("update", ["ekf", "ut"])
def test_in_the_clean_world_errors_are_small_and_honest(clean: Data, update: str) -> None:
    for change in ({}, TVIMM):
        outcome = follow(describe(update=update, **change), clean)
        assert outcome.rms_m <= 1.73
        assert 0.8 <= outcome.nees <= 1.1
        assert outcome.diverged == outcome.lost == 0.0
    assert follow(SERVICE, clean).rms_m <= 1.73


ONE_SIDED = {"ekf": one_sided(1.5, update="ekf"), "ut": one_sided(1.5), "own": SERVICE}


@pytest.mark.parametrize("description", ONE_SIDED.values(), ids=ONE_SIDED)
def test_ranges_round_corners_lose_no_tag(corners: Data, description: Describe) -> None:
    outcome = follow(description, corners)
    assert outcome.rms_m <= 2.05
    assert outcome.lost == 0.0
    assert outcome.nees < 1.3


def test_without_doubt_they_double_the_error(corners: Data) -> None:
    assert follow(describe(), corners).rms_m > 3.5


def test_where_readers_seldom_hear_the_ukf_is_the_better_one() -> None:
    data = cases.sparse_data(800, SEED, 0.05)
    ekf, ut, ukf = (follow(describe(update=update), data) for update in ("ekf", "ut", "ukf-printed"))
    assert ukf.variance.sum() <= ekf.variance.sum() and ut.variance.sum() <= ekf.variance.sum()
    # The EKF is sure of what it does not know.
    assert ekf.nees > 3.0 and ut.nees < 1.3
    own = follow(SERVICE, data)
    assert own.variance.sum() < 0.7 * ut.variance.sum() and 0.8 < own.nees < 1.3


def test_giving_steps_up_is_what_breaks_the_printed_ukf() -> None:
    data = cases.sparse_data(60, SEED, 0.05)
    printed = follow(describe(update="ukf-printed", **cases.SLIDES), data)
    ours = follow(describe(update="ut", **cases.SLIDES), data)
    assert printed.discarded > 50 and printed.all_rms_m > 4.0 * ours.all_rms_m


def test_on_paths_of_its_own_model_a_filter_is_near_the_bound() -> None:
    world = cases.matched_world(300, SEED)
    assert world.bound_m == pytest.approx(1.355, rel=0.05)
    for row in world.rows:
        # The published posterior bound of such a world is 1.355 m.
        assert row.outcome.all_rms_m <= 1.10 * 1.355
        assert row.outcome.all_rms_m <= 1.03 * world.given_m
        assert 0.9 < row.outcome.nees < 1.1


def test_the_bound_given_the_readings_is_the_larger_one() -> None:
    tags = hall()
    truth = matched(tags, 40, 1)
    first = np.array([10.0, 10.0, 1.0, 1.0, 0.5, 0.5])
    averaged = posterior_bound(tags, truth, 0.5, 0.5, first)
    given_ = bound_given(simulate(tags, truth, 1), 0.5, 0.5, first)
    assert averaged < given_ < 1.3 * averaged
    # Where every reader hears at every tick nothing is left to chance but the path.
    always = hall(p_detect=1.0)
    a, b = posterior_bound(always, truth, 0.5, 0.5, first), bound_given(simulate(always, truth, 1), 0.5, 0.5, first)
    assert b == pytest.approx(a, rel=0.08)


def test_the_covariance_in_the_square_is_what_cures_the_adaptation(clean: Data) -> None:
    outcomes = {
        name: follow(describe(update="ekf", adapt=flags, **begun), clean) for name, flags, begun in cases.ABLATION
    }
    slides = outcomes["as in the slides"]
    assert slides.rms_m > 8.0 and slides.acceleration < 0.1 and slides.nees > 100.0
    assert outcomes["and P_aa"].rms_m < 2.2
    assert outcomes["and forgetting"].rms_m > 8.0 and outcomes["and the mean interval"].rms_m > 8.0
    own = outcomes["variance alone, alpha 0.5"]
    assert own.rms_m <= 1.73 and 0.8 <= own.nees <= 1.1


def test_signal_strengths_want_the_noise_that_they_have(clean: Data) -> None:
    rows = {row.name: row.outcome for row in cases.strength_world(60, SEED).rows}
    best = rows["ut, 1.3 times that"]
    assert 0.7 < best.nees < 1.4 and best.nees == min(outcome.nees for outcome in rows.values())
    assert best.rms_m < 0.8 * rows["ekf, share of the distance"].rms_m
    assert rows["ekf, share of the distance"].nees > 3.0
    told = weighed(clean, 0.5, 0.1).ranges[0]
    assert (told["variance"] == 0.25).all() and (told["relative"] == 0.1).all()


# --- the slides' misprints


def right_noise(alpha: float, dt_s: float) -> np.ndarray:
    out, Q = np.empty(6), np.zeros((3, 3))
    singer.noise(alpha, 1.0, dt_s, out)
    Q[np.triu_indices(3)] = out
    return np.asarray(Q + np.triu(Q, 1).T)


@pytest.mark.parametrize(("alpha", "dt_s"), [(0.05, 0.1), (0.5, 0.3), (2.0, 1.0)])
def test_the_printed_q23_is_wrong_and_the_others_are_right(alpha: float, dt_s: float) -> None:
    printed, right = printed_noise(alpha, 1.0, dt_s), right_noise(alpha, dt_s)
    wrong = np.abs(printed - right) > 1e-3 * np.abs(right)
    if alpha * dt_s > 0.1:
        # For smaller intervals the closed forms lose their digits as well.
        assert wrong.tolist() == [[False, False, False], [False, False, True], [False, True, False]]
    scale = 1.0 / np.sqrt(np.diag(printed))
    assert np.linalg.eigvalsh(printed * np.outer(scale, scale)).min() < -0.1
    assert np.linalg.eigvalsh(right * np.outer(1 / np.sqrt(np.diag(right)), 1 / np.sqrt(np.diag(right)))).min() > -1e-12


@given(st.lists(st.floats(-50, 50), min_size=2, max_size=40))
def test_the_printed_moments_are_one_and_the_same(a: list[float]) -> None:
    r0, r1 = printed_moments(np.array(a))
    assert r0 == r1


def test_the_printed_driving_variance_goes_below_nought() -> None:
    variance, alpha, dt_s = 4.0, 2.0, 0.2
    beta = math.exp(-alpha * dt_s)
    assert driving_variance(variance, beta * variance) == pytest.approx(variance * (1 - beta**2))
    assert printed_driving_variance(variance, beta * variance, alpha) < 0.0


# --- the study itself


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    return study.run(tmp_path_factory.mktemp("pictures"), 8)


def test_the_rows_of_table_8_5_have_their_labels(result: StudyResult, tmp_path: Path) -> None:
    rows = [row for row in result.rows if row["table"] == "8.5"]
    assert [(row["row"], row["column"], row["paper"]) for row in rows] == [
        ("x variance", "ukf", 43.7320), ("x variance", "ekf", 49.2714),
        ("y variance", "ukf", 30.1378), ("y variance", "ekf", 38.524),
    ]  # fmt: skip
    assert all(row["runs"] == 8 for row in rows)
    result.write_json(tmp_path / "rfid.json")
    assert len(json.loads((tmp_path / "rfid.json").read_text())) == len(result.rows)


def test_every_world_is_in_it(result: StudyResult) -> None:
    tables = [row["table"] for row in result.rows]
    assert set(tables) == {"8.5", "A", "B 0.1", "B 0.05", "B 0.03", "C", "D", "E", "ablation"}
    assert len(result.tables) == 9 and len(result.notes) == 8


def test_the_pictures_show_something(result: StudyResult) -> None:
    assert [picture.name for picture in result.pictures] == ["rfid_paths.png", "rfid_detection.png"]
    for picture in result.pictures:
        image = imread(picture)
        assert image.shape[0] > 500 and image.std() > 0.03


def test_a_run_follows_from_its_seed() -> None:
    tags = hall()
    one, other = (simulate(tags, reference(tags, 3), 5) for _ in range(2))
    assert all((a == b).all() for a, b in zip(one.ranges, other.ranges, strict=True))
    a, b = follow(SERVICE, one), follow(SERVICE, other)
    assert (a.path == b.path).all() and a.rms_m == b.rms_m
