from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from tests.services.fusion.makers import RULES, FloatArray, confirm, layer, look, plots

from trackmesh.services.fusion.layer import Layer, Step


def step(bank: Layer, t_s: float, *place: tuple[float, float]) -> Step:
    """One whole look at these places."""
    return bank.step(plots(t_s, np.array(place)), look(t_s), t_s)


def test_unused_plots_start_tracks_that_become_confirmed() -> None:
    bank = layer()
    first = step(bank, 0.0, (0, 0), (5e3, 0))
    assert bank.life.uid[first.row].tolist() == [0, 1]
    assert not first.by_confirmed.any()
    second = step(bank, 4.0, (5e3, 0), (0, 0))
    assert second.row.tolist() == first.row.tolist()[::-1]
    third = step(bank, 8.0, (0, 0), (5e3, 0))
    assert sorted(third.confirmed.tolist()) == sorted(first.row.tolist())
    assert not third.by_confirmed.any()
    assert step(bank, 12.0, (0, 0), (5e3, 0)).by_confirmed.all()


def test_a_plot_belongs_to_one_track_and_a_track_takes_one_plot() -> None:
    bank = layer()
    row = confirm(bank, (0, 0))[0]
    done = step(bank, 16.0, (10, 0), (-20, 0))
    assert (done.row == row).sum() == 1
    assert done.row[0] == row, "the nearer plot"
    assert bank.life.uid[done.row[1]] == 1, "the other starts a track"


def test_confirmed_tracks_choose_first() -> None:
    bank = layer()
    row = confirm(bank, (0, 0))[0]
    # A tentative track fits the only plot better, but that is in the confirmed one's gate as well.
    for t in (16.0, 20.0):
        assert step(bank, t, (0, 0), (350, 0)).row[0] == row
    done = step(bank, 24.0, (350, 0))
    assert done.row.tolist() == [row]


def test_the_score_is_the_likelihood_ratio() -> None:
    bank, density = layer(), 1e-9
    first = step(bank, 0.0, (0, 0)).row[0]
    x, P, mu = (bank.filters.filters.head[first][name].copy() for name in ("x", "P", "mu"))
    place: FloatArray = np.array([120.0, -80.0])
    ahead, covariance, weight = bank.predict(np.array([first]), 4.0)
    assert x[:, 0].tolist() == [0.0, 0.0]
    likelihood = 0.0
    for q, w in zip(bank.filters.models.numbers[:, 0], weight[0], strict=True):
        # Both models start alike; only their process noise differs.
        S = P[0][:2, :2] + 16.0 * P[0][2:, 2:] + (q * 64.0 / 3.0 + 2500.0) * np.eye(2)
        likelihood += w * scipy.stats.multivariate_normal(np.zeros(2), S).pdf(place)
    step(bank, 4.0, (120.0, -80.0))
    assert mu.sum() == pytest.approx(1.0)
    assert ahead.shape == (1, 4)
    assert covariance.shape == (1, 4, 4)
    assert bank.life.score[first] == pytest.approx(np.log(0.9 / density) + np.log(likelihood), abs=1e-9)


def test_scores_go_to_the_rows_they_belong_to() -> None:
    """Plots in any order: each track's score is that of its own plot."""
    places = [(0.0, 0.0), (8e3, 0.0), (0.0, 8e3), (8e3, 8e3)]
    off = [(10.0, 0.0), (200.0, 0.0), (0.0, 300.0), (400.0, 0.0)]
    want = {}
    for k, ((e, n), (de, dn)) in enumerate(zip(places, off, strict=True)):
        alone = layer()
        row = step(alone, 0.0, (e, n)).row
        step(alone, 4.0, (e + de, n + dn))
        want[k] = alone.life.score[row[0]]
    bank = layer()
    rows = step(bank, 0.0, *places).row
    for k in (2, 0, 3, 1):
        places[k] = (places[k][0] + off[k][0], places[k][1] + off[k][1])
    step(bank, 4.0, *(places[k] for k in (2, 0, 3, 1)))
    for k in range(4):
        assert bank.life.score[rows[k]] == pytest.approx(want[k], abs=1e-9)


def test_misses_end_a_tentative_track_and_time_a_confirmed_one() -> None:
    bank = layer()
    row = confirm(bank, (0, 0))[0]
    lone = step(bank, 16.0, (0, 0), (2e4, 0)).row[1]
    uid, link = int(bank.life.uid[row]), int(bank.life.link[row])
    lone_uid = bank.life.uid[lone]
    ended = [(t, step(bank, t, (5e4, t * 5e3)).ended) for t in (20.0, 24.0, 28.0, 32.0)]
    assert not np.isin([uid, lone_uid], bank.life.uid[bank.rows]).any()
    assert ended == [(20.0, []), (24.0, []), (28.0, []), (32.0, [(row, uid, link)])], "tentative ones are not told"


def test_a_look_without_plots_still_counts_as_one() -> None:
    bank = layer()
    row = step(bank, 0.0, (0, 0)).row[0]
    assert bank.life.alive[row]
    step(bank, 4.0)
    assert not bank.life.alive[row], "ln(1 - 0.9) is below the limit at once"


def test_rows_are_used_again_and_numbers_are_not() -> None:
    bank = layer(rows=4)
    born: set[int] = set()
    for k in range(30):
        # One step ends the tracks of the last look and starts those of this one.
        done = step(bank, 20.0 * k, (1e5 * k, 0), (0, 1e5 * (k + 1)))
        uids = set(bank.life.uid[done.row].tolist())
        assert not uids & born
        born |= uids
        assert len(bank.rows) == 2
    assert len(bank.life.uid) == 4
    assert len(born) == 60


def test_the_bank_grows_and_tracks_stay_in_their_rows() -> None:
    bank = layer(rows=2)
    places = [(3e3 * (k % 10), 3e3 * (k // 10)) for k in range(100)]
    first = step(bank, 0.0, *places)
    uid = bank.life.uid[first.row].tolist()
    assert uid == list(range(100))
    second = step(bank, 4.0, *places)
    assert second.row.tolist() == first.row.tolist()
    assert bank.life.hits[first.row].tolist() == [2] * 100
    assert len(bank.life.uid) == len(bank.filters.t_s) == 128


def test_sensors_can_be_added_while_tracks_live() -> None:
    bank = layer(sensors=1)
    row = confirm(bank, (0, 0))[0]
    bank.life.member[row, 0] = 5
    before = bank.life.seen_s[row, 0]
    bank.add_sensors(3)
    bank.add_sensors(2)
    assert bank.life.member[row].tolist() == [5, -1, -1]
    assert bank.life.seen_s[row, 0] == before
    done = bank.step(plots(14.0, np.zeros((1, 2))), look(14.0, sensor=2), 14.0)
    assert done.row.tolist() == [row]
    assert bank.life.seen_s[row, 2] == 14.0


def test_a_dropped_track_is_gone_and_its_row_free() -> None:
    bank = layer()
    row = step(bank, 0.0, (0, 0)).row[0]
    bank.drop(int(row))
    assert not len(bank.rows)
    done = step(bank, 1.0, (0, 0))
    assert done.row.tolist() == [row]
    assert bank.life.uid[row] == 1


def test_late_plots_reach_their_track_and_too_late_ones_do_not_move_it() -> None:
    late, in_order = layer(ring=3), layer(ring=3)
    times = [0.0, 4.0, 8.0, 12.0, 16.0]
    for t in [0.0, 4.0, 12.0, 8.0, 16.0]:
        late.step(plots(t, np.array([(100 * t, 0.0)])), look(t), max(t, 12.0 if t == 8.0 else t))
    for t in times:
        in_order.step(plots(t, np.array([(100 * t, 0.0)])), look(t), t)
    assert late.rows.tolist() == in_order.rows.tolist()
    assert late.filters.filters.head.tobytes() == in_order.filters.filters.head.tobytes()
    before = late.filters.filters.head[late.rows[0]].copy()
    done = late.step(plots(0.5, np.array([(50.0, 0.0)])), look(0.5), 16.0)
    assert done.row[0] != late.rows[0]
    assert late.filters.filters.head[late.rows[0]].tobytes() == before.tobytes()


def test_plots_of_one_batch_may_have_their_own_times() -> None:
    bank, speed = layer(), 250.0
    for turn in range(5):
        t = 4.0 * turn + np.array([0.5, 3.5])
        both = plots(t, np.array([(speed * t[0], 0.0), (0.0, 3e4 - speed * t[1])]))
        done = bank.step(both, look(4.0 * turn + 3.5), 4.0 * turn + 3.5)
    assert bank.life.confirmed[done.row].all()
    assert bank.filters.t_s[done.row].tolist() == [16.5, 19.5]
    mean, _, _ = bank.predict(done.row, 20.0)
    np.testing.assert_allclose(mean[:, :2], [[5000, 0], [0, 25000]], atol=60)


def test_no_rows_is_no_trouble() -> None:
    bank = layer()
    done = step(bank, 0.0)
    assert (done.row.tolist(), done.confirmed.tolist(), done.ended, done.late) == ([], [], [], 0)
    assert bank.judge(1.0)[1] == []
    mean, covariance, mu = bank.predict(np.empty(0, np.int64), 3.0)
    assert (mean.shape, covariance.shape, mu.shape) == ((0, 4), (0, 4, 4), (0, 2))
    assert RULES.confirm_hits == 3
