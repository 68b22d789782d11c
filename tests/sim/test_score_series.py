"""Scores over time: the figures of each frame, the table and the picture of them."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import TrackFrame, TruthFrame
from trackmesh.sim.recording import START_NS
from trackmesh.sim.score_chart import MOST_POINTS, Row, draw_scores, steps, timeline, worst
from trackmesh.sim.scoring import FrameScore, Scorer, TruthTimeline, picture, score_run, write_series

MakeFrame = Callable[..., TrackFrame]


def truth(until_s: int, targets: int = 2) -> list[TruthFrame]:
    """Targets 10 km apart that fly east; the last one is gone after half of the time."""
    frames = []
    for t_s in range(until_s + 1):
        ids = np.arange(targets if t_s <= until_s // 2 else targets - 1)
        states = np.stack([100.0 * t_s + 0.0 * ids, 1e4 * ids, 100.0 + 0.0 * ids, 0.0 * ids], axis=1)
        frames.append(TruthFrame(scenario_id="s", t_ns=START_NS + t_s * 10**9, id=ids, state=states))
    return frames


def on(t_s: float, target: int, east_m: float = 0.0) -> list[float]:
    """A track's state at a target, or beside it."""
    return [100.0 * t_s + east_m, 1e4 * target, 100.0, 0.0]


@pytest.fixture
def run(frame: MakeFrame) -> Scorer:
    """Target 0 has track 5, from 6 s on 6; target 1 has 7, and 9 beside it at 3 s; 8 is nobody's at 4 s."""
    frames = []
    for t_s in range(1, 10):
        shown = {5 if t_s < 6 else 6: on(t_s, 0, 30.0)}
        shown |= {7: on(t_s, 1, 40.0)} if t_s <= 5 else {}
        shown |= {9: on(t_s, 1, 60.0)} if t_s == 3 else {}
        shown |= {8: [0.0, -5e4, 0.0, 0.0]} if t_s == 4 else {}
        frames.append(frame(t_s, list(shown), list(shown.values())))
    return score_run(frames, truth(10), 1000.0, 2.0, switch_m=400.0, gate_m=500.0)


def test_the_figures_of_each_frame(run: Scorer) -> None:
    by_s = {(score.t_ns - START_NS) // 10**9: score for score in run.scores}
    assert list(by_s) == list(range(1, 10))
    assert [score.scored for score in run.scores] == [False] + [True] * 8
    both = by_s[2]
    assert (both.targets, both.tracks, both.matched, both.missed, both.false) == (2, 2, 2, 0, 0)
    assert (both.gospa_m, both.gospa_switching_m) == pytest.approx((50.0, 50.0))
    assert both.rmse_m == pytest.approx(np.sqrt((900 + 1600) / 2))
    assert both.nees == pytest.approx((900 + 1600) / 2 / 2500)
    assert both.nees_low < 2 < both.nees_high
    doubled = by_s[3]
    assert (doubled.false, doubled.siap_ambiguity, doubled.siap_spuriousness) == (1, 1.5, 0.0)
    assert doubled.siap_position_m == pytest.approx((30 + 40 + 60) / 3)
    stray = by_s[4]
    assert (stray.false, stray.siap_completeness) == (1, 1.0)
    assert stray.siap_spuriousness == pytest.approx(1 / 3)
    swapped = by_s[6]
    assert (swapped.targets, swapped.switching, swapped.id_switches) == (1, 1.0, 1)
    assert swapped.gospa_switching_m == pytest.approx(np.hypot(30.0, 400.0))


def test_the_summary_is_of_the_frames(run: Scorer) -> None:
    scored, got = [score for score in run.scores if score.scored], run.summary()
    for name in ("gospa_m", "gospa_switching_m", "ospa_m", "localisation_m2", "missed", "false", "switching"):
        assert getattr(got, name) == pytest.approx(np.mean([getattr(score, name) for score in scored])), name
    assert got.frames == 8 and got.id_switches == sum(score.id_switches for score in scored) == 1
    assert (got.c_m, got.switch_m, got.gate_m) == (1000.0, 400.0, 500.0)
    assert got.siap_number_changes == 1
    assert got.siap_completeness == 1.0 and got.mostly_tracked == 1.0
    assert got.siap_longest_segment == pytest.approx((3.0 + 3.0) / (7.0 + 3.0))
    assert got.purity == 1.0 and got.continuity == pytest.approx(1 - 4 / 12)


@pytest.mark.parametrize(("sigma_m", "share"), [(50.0, 0.95), (40.0, 0.0), (70.0, 0.0)])
def test_a_consistent_run_stays_within_its_bands(frame: MakeFrame, sigma_m: float, share: float) -> None:
    rng, targets = np.random.default_rng(3), 60
    frames = []
    for t_s in range(100):
        error = np.concatenate([rng.normal(0.0, 50.0, (targets, 2)), np.zeros((targets, 2))], axis=1)
        states = np.array([on(t_s, target) for target in range(targets)]) + error
        frames.append(frame(t_s, np.arange(targets), states, sigma_m=sigma_m))
    got = score_run(frames, truth(220, targets), 1000.0, 0.0).summary()
    assert got.nees_in_band == pytest.approx(share, abs=0.06)
    assert (got.nees_low < got.nees < got.nees_high) == (share > 0.5)


def test_costs_have_natural_defaults() -> None:
    rules = Scorer(TruthTimeline(truth(1)), 600.0).rules
    assert rules == (600.0, 300.0, 600.0)


def test_the_covariance_of_position_and_velocity(frame: MakeFrame) -> None:
    one = frame(0.0, [1], [[0.0] * 4])
    root = np.random.default_rng(1).normal(size=(6, 6))
    full = root @ root.T
    shown = picture(one.model_copy(update={"covariance": full[np.triu_indices(6)][None].astype(np.float32)}))
    np.testing.assert_allclose(shown.state_covariance[0], full[:4, :4], rtol=1e-6)
    np.testing.assert_allclose(shown.covariance_m2[0], full[:2, :2], rtol=1e-6)


def test_the_table(run: Scorer, tmp_path: Path) -> None:
    write_series(run.scores, tmp_path / "scores.csv")
    with (tmp_path / "scores.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(FrameScore._fields)
    assert [int(row["t_ns"]) for row in rows] == [score.t_ns for score in run.scores]
    for row, score in zip(rows, run.scores, strict=True):
        for name, text in row.items():
            assert float(text) == pytest.approx(float(getattr(score, name)), rel=1e-6), name
    empty = run.scores[0]._replace(nees=float("nan"))
    write_series([empty], tmp_path / "scores.csv")
    assert ",," in (tmp_path / "scores.csv").read_text()
    with pytest.raises(TrackmeshError, match="Cannot write"):
        write_series(run.scores, tmp_path)


# --- the picture


def test_the_timeline(run: Scorer) -> None:
    t_s = np.array([(score.t_ns - START_NS) * 1e-9 - 1.0 for score in run.scores])
    first, second = timeline(run, t_s)
    assert (first.target_id, first.changes, first.unfollowed_s) == (0, 1, 0.0)
    assert first.there.tolist() == [[0.0, 9.0]]
    assert first.followed.tolist() == [[0.0, 5.0], [5.0, 9.0]] and first.track_id.tolist() == [5, 6]
    assert (second.target_id, second.changes) == (1, 0)
    assert second.there.tolist() == second.followed.tolist() == [[0.0, 5.0]]


def test_the_worst_targets_are_shown() -> None:
    def row(target: int, changes: int, followed_s: float) -> Row:
        spans = np.array([[0.0, followed_s]] * (changes + 1)) / (changes + 1)
        return Row(target, np.array([[0.0, 10.0]]), spans, np.arange(changes + 1))

    rows = [row(1, 0, 10.0), row(2, 3, 10.0), row(3, 0, 4.0), row(4, 1, 10.0), row(5, 0, 9.0)]
    assert [r.target_id for r in worst(rows, 3)] == [2, 3, 4]
    assert [r.target_id for r in worst(rows, 9)] == [1, 2, 3, 4, 5]


def test_curves_are_means_of_what_is_known() -> None:
    t_s = np.arange(3.0 * MOST_POINTS)
    values = np.where(t_s % 3 == 0, np.nan, t_s)
    values[:3] = np.nan
    t, line = steps(t_s, values)
    assert len(t) == len(line) == MOST_POINTS + 1
    assert np.isnan(line[0]) and line[1] == 4.5 and line[-1] == line[-2]
    assert t[1] == 3.0 and t[-1] == t_s[-1] + 1.0


@pytest.mark.parametrize("warmup_s", [0.0, 5.0, 99.0])
def test_the_picture_is_drawn(frame: MakeFrame, tmp_path: Path, warmup_s: float) -> None:
    frames = [frame(t, [5], [on(t, 0, 30.0)]) for t in range(1, 10)] + [frame(9.5, [], np.zeros((0, 4)))]
    scorer = score_run(frames, truth(10), 1000.0, warmup_s)
    draw_scores(scorer, tmp_path / "scores.png")
    drawn = imread(tmp_path / "scores.png")
    assert drawn.shape[0] > 500 and drawn.shape[1] > 500 and drawn.std() > 0.05


def test_nothing_to_draw_is_told(tmp_path: Path, run: Scorer) -> None:
    with pytest.raises(TrackmeshError, match="nothing to draw"):
        draw_scores(Scorer(TruthTimeline(truth(1))), tmp_path / "scores.png")
    with pytest.raises(TrackmeshError, match="Cannot"):
        draw_scores(run, tmp_path / "scores.xyz")
