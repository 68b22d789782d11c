"""Methods of association on the tracks of two simulated radars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from matplotlib.image import imread
from tests.services.estimation.makers import LAW, covariances, seeds

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.services.estimation.track_distances import cross_covariance
from trackmesh.sim.studies.association import study
from trackmesh.sim.studies.association.stress import evidence, table
from trackmesh.sim.studies.association.stress.carried import Carried, left_of, moved, positive_root
from trackmesh.sim.studies.association.stress.cases import (
    BIAS_AZIMUTH_DEG,
    BIAS_RANGE_M,
    CASES,
    P_DETECT,
    WARM_UP_S,
    Case,
)
from trackmesh.sim.studies.association.stress.local_tracks import Moment, Recording, Seen, record
from trackmesh.sim.studies.association.stress.methods import (
    ALPHA,
    COLUMNS,
    METHODS,
    Decided,
    decide,
    raw_tracks,
    registration,
    run,
)
from trackmesh.sim.studies.association.stress.modified import ModifiedTest
from trackmesh.sim.studies.association.stress.radars import simulate
from trackmesh.sim.studies.association.stress.scores import Score, score

FRESH = 5000
"""Seeds that the study itself does not use."""

NOMINAL = Case("nominal", 40, duration_s=60.0)
BIAS = Case("bias", 60, duration_s=100.0, bias=True)
FORMATIONS = Case("formations", 60, duration_s=100.0, scale=2.0, formation_m=500.0)
TINY = (
    Case("tiny", 8, duration_s=10.0, seeds=1),
    Case("tiny bias", 8, duration_s=10.0, seeds=1, bias=True),
    Case("tiny formations", 8, duration_s=10.0, seeds=1, formation_m=800.0),
)


def scores(case: Case, *columns: str, seed: int = FRESH) -> dict[str, Score]:
    recording = record(case, seed)
    return {column: score(recording, run(recording, column)) for column in columns}


# --- what is claimed ---


def test_nothing_is_missed_where_nothing_is_wrong() -> None:
    for name, found in scores(NOMINAL, *COLUMNS).items():
        # The looser level rejects some true pairs: their looks are not independent.
        assert found.correct > (98.0 if ".05" in name else 99.0), name
        assert found.wrong < 0.1, name


def test_the_sum_of_equation_28_fails_under_bias_and_registration_saves_every_method() -> None:
    found = scores(BIAS, *COLUMNS)
    assert found["sequential"].correct < 20.0
    assert found["sequential .05"].correct < found["sequential"].correct
    # A memory is worse than none here: what is wrong adds up.
    assert found["sequential"].correct < found["seqllr"].correct < found["gnn"].correct < 95.0
    for name in METHODS:
        assert found[f"{name}+reg"].correct > 98.5, name
    assert found["seqllr+reg"].correct >= 99.5
    assert found["seqllr+reg"].wrong <= 0.2


def test_the_bias_is_learnt_from_what_is_declared() -> None:
    recording = record(BIAS, FRESH)
    known = registration(recording)
    decide(recording, METHODS["seqllr"](), known)
    first, second = known.messages()
    assert first.locked
    assert second.locked
    for found, true in ((first.bias, (0.0, 0.0)), (second.bias, (BIAS_RANGE_M, np.deg2rad(BIAS_AZIMUTH_DEG)))):
        assert abs(found[0] - true[0]) < 40.0
        assert abs(found[1] - true[1]) < np.deg2rad(0.06)


def test_untold_interference_is_added_up_too() -> None:
    case = NOMINAL._replace(told=False, scale=2.0, duration_s=100.0)
    found = scores(case, "gnn", "sequential", "seqllr")
    assert found["sequential"].correct < 95.0
    assert min(found["gnn"].correct, found["seqllr"].correct) > 98.5


def test_a_memory_keeps_formations_apart() -> None:
    found = scores(FORMATIONS, "gnn", "weighted", "modified", "sequential", "seqllr")
    assert found["gnn"].switches > 5.0
    assert max(found["sequential"].switches, found["seqllr"].switches) < 3.0
    assert found["seqllr"].wrong <= 2.0
    assert found["modified"].wrong < found["weighted"].wrong


# --- the radars ---


def test_both_radars_look_at_the_cycle_s_times_unless_told_otherwise() -> None:
    for sensor in simulate(NOMINAL, 1):
        assert np.all(sensor.plots["t_s"] % 2.0 == 0.0)
        assert sensor.seen.mean() == pytest.approx(P_DETECT, abs=0.02)
    first, second = simulate(NOMINAL._replace(asynchronous=True), 1)
    assert (first.period_s, second.period_s) == (2.0, 2.7)
    for sensor in (first, second):
        turn_s = sensor.period_s * np.arange(len(sensor.plots))[:, None]
        assert np.all(sensor.plots["t_s"] >= turn_s)
        assert np.all(sensor.plots["t_s"] <= turn_s + sensor.period_s)
        assert len(np.unique(sensor.plots["t_s"][0])) == NOMINAL.targets


def test_a_bias_moves_the_plots_of_the_second_radar_only() -> None:
    plain, biased = simulate(BIAS._replace(bias=False), 2), simulate(BIAS, 2)
    np.testing.assert_array_equal(plain[0].plots["z"], biased[0].plots["z"])
    before, after = (s[1].plots["z"] - s[1].site_m for s in (plain, biased))
    np.testing.assert_allclose(np.hypot(*after.T) - np.hypot(*before.T), 150.0, atol=1e-6)
    turn = np.arctan2(after[..., 0], after[..., 1]) - np.arctan2(before[..., 0], before[..., 1])
    np.testing.assert_allclose(np.rad2deg((turn + np.pi) % (2 * np.pi) - np.pi), 0.4, atol=1e-9)


def test_errors_have_the_covariance_that_is_told() -> None:
    sharp, blunt = (simulate(NOMINAL._replace(scale=scale, targets=200), 3) for scale in (1e-9, 1.0))
    for truth, sensor in zip(sharp, blunt, strict=True):
        apart, R = sensor.plots["z"] - truth.plots["z"], sensor.plots["R"]
        full = np.stack([R[..., 0], R[..., 1], R[..., 1], R[..., 2]], axis=-1).reshape(*R.shape[:-1], 2, 2)
        D = np.einsum("tni,tni->tn", apart, np.linalg.solve(full, apart[..., None])[..., 0])
        assert D.mean() == pytest.approx(2.0, rel=0.05)
        untold = simulate(NOMINAL._replace(told=False), 3)[0].plots["R"]
        told = simulate(NOMINAL, 3)[0].plots["R"]
    # Exactly half of it is interference; the covariances are taken at the measured places.
    np.testing.assert_allclose(told, 2.0 * untold)


def test_formations_gaps_and_coverage() -> None:
    sharp = Case("sharp", 40, duration_s=60.0, scale=1e-9)
    z = simulate(sharp._replace(formation_m=700.0), 4)[0].plots["z"]
    np.testing.assert_allclose(np.linalg.norm(z[:, :20] - z[:, 20:], axis=2), 700.0, rtol=1e-6)
    seen = simulate(sharp._replace(gaps=True, targets=400), 4)[0].seen
    missing = (~seen).astype(int)
    longest = [max(len(run) for run in "".join(map(str, column)).split("0")) for column in missing.T]
    assert 0.2 < np.mean(np.array(longest) >= 7) < 0.4
    covered = simulate(sharp._replace(coverage=0.7, targets=400), 4)
    share = [sensor.seen.any(axis=0).mean() for sensor in covered]
    np.testing.assert_allclose(share, 0.7, atol=0.06)
    both = (covered[0].seen.any(axis=0) & covered[1].seen.any(axis=0)).mean()
    assert both == pytest.approx(0.49, abs=0.07)


# --- the local tracks ---


def test_local_tracks_know_their_errors() -> None:
    pairs = evidence.true_pairs(evidence.NOMINAL, 1)
    assert 0.3 < np.nanmean(pairs.distance) / 4.0 < 1.1


def test_a_track_is_told_after_three_plots_and_is_another_after_a_gap() -> None:
    recording = record(Case("gaps", 300, duration_s=60.0, gaps=True), 6)
    first = [len(moment.a.number) for moment in recording.moments[:4]]
    # Plots at 0, 2 and 4 s.
    assert first[0] == 0
    assert first[1] > 200
    lives: dict[int, set[int]] = {}
    for moment in recording.moments:
        assert len(np.unique(moment.a.number)) == len(moment.a.number)
        for number, target in zip(moment.a.number.tolist(), moment.a.target.tolist(), strict=True):
            lives.setdefault(target, set()).add(number)
    again = np.mean([len(numbers) > 1 for numbers in lives.values()])
    assert 0.2 < again < 0.4


def test_the_same_seed_is_the_same_run() -> None:
    one, other = (record(FORMATIONS._replace(duration_s=10.0), 7).moments[-1] for _ in range(2))
    for a, b in zip(one.a, other.a, strict=True):
        np.testing.assert_array_equal(a, b)


# --- cross-covariances ---


@LAW
@given(seeds)
def test_what_an_update_leaves_is_that_of_a_kalman_filter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, R, H = covariances(rng, (3,), 4), covariances(rng, (3,), 2), np.eye(2, 4)
    gain = np.swapaxes(np.linalg.solve(H @ P @ H.T + R, H @ P), 1, 2)
    kept = np.eye(4) - gain @ H
    np.testing.assert_allclose(left_of(P, kept @ P), kept, atol=1e-6)
    # An update that makes an error larger is taken as none.
    np.testing.assert_allclose(left_of(P, 2.0 * P), np.tile(np.eye(4), (3, 1, 1)), atol=1e-8)


@LAW
@given(seeds)
def test_the_root_is_symmetric_and_of_the_positive_part(seed: int) -> None:
    Q = covariances(np.random.default_rng(seed), (3,), 4)
    root = positive_root(Q)
    np.testing.assert_allclose(root, np.swapaxes(root, 1, 2), atol=1e-10)
    np.testing.assert_allclose(root @ root, Q, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(positive_root(-Q), 0.0, atol=1e-6)


def test_what_is_carried_is_the_recursion_where_filters_have_one_model() -> None:
    """Two Kalman filters of different R over ten cycles, one update each, at the same times."""
    q, dt_s, H = 30.0, 2.0, np.eye(2, 4)
    F = moved(np.array([dt_s]))[0]
    Q = q * np.kron(np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]]), np.eye(2))
    noise = [np.diag([1e4, 4e4]), np.array([[9e4, 1e4], [1e4, 2e4]])]
    carried, P = [Carried(1), Carried(1)], [np.diag([1e4, 1e4, 4e4, 4e4])] * 2
    row, expected, got = np.array([0]), np.zeros((4, 4)), np.zeros((4, 4))
    for one, start in zip(carried, P, strict=True):
        one.begin(row, np.zeros(1), start[None])
    for k in range(1, 11):
        kept = []
        for s, one in enumerate(carried):
            one.renew()
            predicted = F @ P[s] @ F.T + Q
            gain = np.linalg.solve(H @ predicted @ H.T + noise[s], H @ predicted).T
            kept.append(np.eye(4) - gain @ H)
            P[s] = kept[s] @ predicted
            one.predict(row, np.array([dt_s * k]), predicted[None])
            one.update(row, P[s][None])
            one.predict(row, np.array([dt_s * k]), P[s][None])
        expected = cross_covariance(expected, F, Q, kept[0], kept[1])
        got = carried[0].A[0] @ got @ carried[1].A[0].T + carried[0].B[0] @ carried[1].B[0].T
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@LAW
@given(seeds)
def test_the_joint_covariance_of_what_is_carried_is_one(seed: int) -> None:
    """Whatever a filter of several models does with its covariances, C of the modified method is a covariance."""
    rng = np.random.default_rng(seed)
    scale = np.diag([100.0, 100.0, 10.0, 10.0])
    carried, Pab = [Carried(1), Carried(1)], np.zeros((4, 4))
    row, P = np.array([0]), [scale @ one @ scale for one in covariances(rng, (2,), 4)]
    for s, one in enumerate(carried):
        one.begin(row, np.zeros(1), P[s][None])
    for k in range(1, 5):
        for s, one in enumerate(carried):
            one.renew()
            at_s = 2.0 * k - rng.uniform(0.0, 2.0)
            for t_s, updated in ((at_s, True), (2.0 * k, False)):
                F = moved(np.array([t_s - one.t_s[0]]))[0]
                P[s] = F @ P[s] @ F.T + rng.uniform(0.0, 0.3) * scale @ covariances(rng, (), 4) @ scale
                one.predict(row, np.array([t_s]), P[s][None])
                if updated:
                    root = np.linalg.cholesky(P[s])
                    inner = np.linalg.qr(rng.normal(size=(4, 4)))[0]
                    P[s] = root @ inner @ np.diag(rng.uniform(0.05, 1.0, 4)) @ inner.T @ root.T
                    one.update(row, P[s][None])
        Pab = carried[0].A[0] @ Pab @ carried[1].A[0].T + carried[0].B[0] @ carried[1].B[0].T
        joint = np.block([[P[0], Pab], [Pab.T, P[1]]])
        size = np.sqrt(np.diag(joint))
        assert np.linalg.eigvalsh(joint / np.outer(size, size)).min() > -1e-9


def test_every_modified_covariance_of_a_run_is_one() -> None:
    recording = record(NOMINAL._replace(asynchronous=True, gaps=True), FRESH)
    test = ModifiedTest(ALPHA)
    for moment in recording.moments:
        test.cycle(moment, raw_tracks(moment.a, None, ""), raw_tracks(moment.b, None, ""), None)
    assert test.repaired == 0


# --- scores ---


def seen(targets: list[int]) -> Seen:
    n, empty = len(targets), np.zeros((0,))
    return Seen(np.arange(n), np.array(targets, np.int64), np.zeros((n, 4)), np.zeros((n, 4, 4)), empty, empty)


def test_scores_by_hand() -> None:
    late = WARM_UP_S + 2.0
    moments = [
        Moment(2.0, seen([0, 1, 2]), seen([0, 1, 2])),
        Moment(late, seen([0, 1, 2]), seen([0, 2])),
        Moment(late + 2.0, seen([0, 1]), seen([0, 1, 2])),
    ]
    recording = Recording(Case("by hand", 3), (np.zeros(2), np.zeros(2)), moments)
    decided = [
        Decided(2.0, np.array([0]), np.array([1])),
        Decided(late, np.array([0, 1]), np.array([0, 2])),
        Decided(late + 2.0, np.array([0, 1]), np.array([2, 1])),
    ]
    # Possible: 0 and 2, then 0 and 1. Right: 0, then 1. Target 0 goes from 0 to 2, target 1 from 2 to 1.
    assert score(recording, decided) == Score(50.0, 50.0, 500.0)
    nothing = [Decided(m.t_s, np.array([], np.int64), np.array([], np.int64)) for m in moments]
    assert score(recording, nothing) == Score(0.0, 0.0, 0.0)


# --- the sum over time ---


def test_sums_of_true_pairs_scatter_more_than_chi_square() -> None:
    pairs = evidence.true_pairs(evidence.UNTOLD, 1)
    rho = pairs.autocorrelation(20)
    assert rho[0] == 1.0
    assert rho[1] > 0.5
    assert np.all(np.diff(rho[:8]) < 0.0)
    assert evidence.repeats(rho) > 2.0
    assert 0.8 < np.nanmean(pairs.distance) / 4.0 < 1.4
    assert pairs.rejected(0.001)[-1] > 0.05
    assert pairs.rejected(0.001, 1e9)[-1] == 0.0


def test_evidence_skips_what_is_not_there() -> None:
    whitened: FloatArray = np.ones((4, 2, 4))
    whitened[1, 0] = np.nan
    pairs = evidence.Pairs(whitened)
    np.testing.assert_array_equal(pairs.looks[:, 0], [1, 1, 2, 3])
    np.testing.assert_array_equal(pairs.statistic[:, 0], [4, 4, 8, 12])
    np.testing.assert_array_equal(pairs.per_freedom(), np.ones((4, 2)))
    assert evidence.times_s(pairs).tolist() == [2.0, 4.0, 6.0, 8.0]


# --- the whole study ---


def test_the_study_is_whole(tmp_path: Path) -> None:
    shares: list[float] = []
    found = study.run_cases(TINY, tmp_path / "new", 2, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    stress = [row for row in found.rows if row["table"] == "stress"]
    assert {row["column"] for row in stress} == set(COLUMNS)
    assert {row["row"] for row in stress} == {case.name for case in TINY}
    assert all(row["paper"] is None and row["runs"] == 1 for row in stress)
    assert len(found.rows) == 18 + 3 * len(TINY) * len(COLUMNS)
    assert len({(r["table"], r["row"], r["column"]) for r in found.rows}) == len(found.rows)
    assert all(len(line) == len(shown.header) for shown in found.tables for line in shown.rows)
    assert len(found.pictures) == 3
    for picture in found.pictures:
        pixels = imread(picture)
        assert min(pixels.shape[:2]) > 300
        assert len(np.unique(pixels[::3, ::3, :3].reshape(-1, 3), axis=0)) > 100


def test_a_picture_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TrackmeshError, match="Cannot write"):
        study.run_cases(TINY[:1], tmp_path / "file", 1, lambda _: None)


def test_the_notes_are_made_of_the_numbers() -> None:
    cases = {case.name: case for case in CASES}
    assert len(cases) == len(CASES)
    good, bad = Score(100.0, 0.0, 0.0), Score(40.0, 1.0, 9.0)
    found = {
        name: {column: [bad if column == "seqllr+reg" and case.targets == 2000 else good] for column in COLUMNS}
        for name, case in cases.items()
    }
    notes = "\n".join(table.present(found).notes)
    assert "gaps, asynchronous, 2000 (61.00 against 0.00 of gnn)" in notes
    assert "nominal, 80 (" not in notes
