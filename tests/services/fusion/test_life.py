from __future__ import annotations

import numpy as np
import pytest
from tests.services.fusion.makers import RULES, IntArray

from trackmesh.services.estimation.plots import make_plots
from trackmesh.services.fusion import life as lives
from trackmesh.services.fusion.life import NEVER, Life, Rules, make_life

ROW = np.array([0])
LOG_MISS = float(np.log(0.1))


def begun(t_s: float = 0.0, n: int = 1, sensors: int = 2) -> Life:
    life = make_life(n + 1, sensors)
    lives.born(life, np.arange(n), 10, np.full(n, t_s), 0)
    return life


def hit(life: Life, t_s: float, gain: float = 5.0, sensor: int = 0) -> None:
    plot = make_plots([[0.0, 0.0]], [1.0, 0.0, 1.0], t_s)
    lives.hit(life, RULES, ROW, np.array([True]), plot, np.array([gain]), sensor)


def miss(life: Life, t_s: float, *, whole: bool = True, lately_s: float = np.inf, east_m: float = 1e4) -> bool:
    """Judge a look of sensor 0 with a period of 4 s at row 0; whether it was a miss."""
    before, mean = life.misses[0], np.array([[east_m, 0.0, 100.0, 0.0]] * len(life.uid))
    lives.miss(life, ROW, mean, np.zeros(len(life.uid)), t_s, 0, np.zeros(2), 12e3, lately_s, 4.0, 0.5, whole, LOG_MISS)
    return bool(life.misses[0] > before)


def judged(life: Life, t_s: float, rules: Rules = RULES) -> tuple[list[int], list[int]]:
    """Rows confirmed and rows ended."""
    rows: IntArray = np.flatnonzero(life.alive)
    confirmed, ended = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
    n, m = lives.judge(life, rules, rows, t_s, confirmed, ended)
    return confirmed[:n].tolist(), ended[:m].tolist()


# --- birth and hits ---


def test_a_new_track_knows_one_plot() -> None:
    life = begun(5.0, n=2)
    assert life.uid.tolist() == [10, 11, -1]
    assert life.alive.tolist() == [True, True, False]
    assert life.hits[:2].tolist() == [1, 1]
    assert life.seen_s[0].tolist() == [5.0, NEVER]
    assert life.looked_s[0].tolist() == [5.0, 5.0]


def test_a_row_used_again_is_as_new() -> None:
    life = begun(0.0)
    hit(life, 4.0)
    miss(life, 12.0)
    judged(life, 100.0)
    life.link[0], life.link_n[0], life.member[0] = 3, 4, 7
    lives.born(life, ROW, 20, np.array([200.0]), 1)
    fresh = make_life(2, 2)
    lives.born(fresh, ROW, 20, np.array([200.0]), 1)
    for name, a, b in zip(Life._fields, life, fresh, strict=True):
        assert np.array_equal(a[0], b[0]), name


def test_hits_add_up_to_the_cap_and_late_ones_turn_no_clock_back() -> None:
    life = begun(10.0)
    for t in (14.0, 18.0, 9.0):
        hit(life, t, gain=12.0)
    assert life.hits[0] == 4
    assert life.score[0] == life.best[0] == RULES.score_cap
    assert (life.first_s[0], life.last_s[0]) == (9.0, 18.0)
    assert (life.seen_s[0, 0], life.looked_s[0, 0]) == (18.0, 18.0)
    assert life.seen_s[0, 1] == NEVER


def test_a_hit_forgives_misses() -> None:
    life = begun(0.0)
    assert miss(life, 4.0)
    assert miss(life, 8.0)
    hit(life, 12.0)
    assert life.misses[0] == 0


# --- misses ---


def test_a_whole_look_is_judged_once() -> None:
    life = begun(0.0)
    assert not miss(life, 1.9)
    assert miss(life, 4.0)
    assert not miss(life, 4.0)
    assert life.score[0] == pytest.approx(LOG_MISS)


def test_a_look_that_is_older_than_the_last_is_no_miss() -> None:
    life = begun(0.0)
    hit(life, 8.0)
    assert not miss(life, 4.0)


def test_a_sector_is_judged_after_a_period_and_its_margin() -> None:
    life = begun(0.0)
    for t in np.arange(0.0, 4.5, 0.125).tolist():
        assert not miss(life, t, whole=False)
    assert miss(life, 4.625, whole=False)
    # The next is due a period after the last was, not after it was judged.
    assert life.looked_s[0, 0] == 4.0
    assert not miss(life, 8.5, whole=False)
    assert miss(life, 8.625, whole=False)


def test_after_a_long_silence_one_miss_is_counted_not_many() -> None:
    life = begun(0.0)
    assert miss(life, 100.0, whole=False, east_m=0.0)
    assert life.looked_s[0, 0] == 100.0
    assert not miss(life, 100.125, whole=False, east_m=0.0)


def test_beyond_its_range_a_radar_misses_nothing() -> None:
    life = begun(0.0)
    assert not miss(life, 4.0, east_m=11.7e3)  # 12.1 km by then
    assert miss(life, 8.0, east_m=11.1e3)  # 11.9 km by then


def test_a_sensor_without_coverage_misses_only_what_it_saw_lately() -> None:
    life = begun(0.0)
    assert miss(life, 4.0, lately_s=20.0)
    assert miss(life, 19.0, lately_s=20.0)
    assert not miss(life, 24.0, lately_s=20.0)
    life.seen_s[0, 0] = NEVER
    assert not miss(life, 30.0, lately_s=20.0)


# --- the table of states ---


def test_confirmed_by_score_and_hits_together() -> None:
    life = begun(0.0)
    hit(life, 4.0, gain=13.0)
    assert judged(life, 4.0) == ([], [])
    hit(life, 8.0, gain=0.0)
    assert judged(life, 8.0) == ([0], [])
    assert judged(life, 8.0) == ([], [])
    weak = begun(0.0)
    for t in (4.0, 8.0, 12.0):
        hit(weak, t, gain=4.0)
    assert judged(weak, 12.0) == ([], [])


@pytest.mark.parametrize(
    ("field", "value", "t_s"),
    [("score", -2.1, 0.0), ("misses", 3, 0.0), ("best", 6.1, 0.0), ("last_s", 0.0, 9.1)],
    ids=["score", "misses", "fall", "age"],
)
def test_each_reason_alone_drops_a_tentative_track(field: str, value: float, t_s: float) -> None:
    life = begun(0.0)
    assert judged(life, 0.0) == ([], [])
    getattr(life, field)[0] = value
    assert judged(life, t_s) == ([], [0])
    assert not life.alive[0]


@pytest.mark.parametrize(
    ("field", "value", "t_s"),
    [("score", -2.0, 0.0), ("misses", 2, 0.0), ("best", 6.0, 0.0), ("last_s", 0.0, 9.0)],
    ids=["score", "misses", "fall", "age"],
)
def test_at_the_limit_a_tentative_track_lives_on(field: str, value: float, t_s: float) -> None:
    life = begun(0.0)
    getattr(life, field)[0] = value
    assert judged(life, t_s) == ([], [])


def test_a_confirmed_track_ends_by_time_alone() -> None:
    life = begun(0.0)
    for t in (4.0, 8.0):
        hit(life, t, gain=8.0)
    assert judged(life, 8.0) == ([0], [])
    life.score[0], life.misses[0] = -50.0, 9
    assert judged(life, 23.0) == ([], [])
    assert judged(life, 23.1) == ([], [0])
    assert life.confirmed[0], "the status of an ended row can still be told"
    assert judged(life, 30.0) == ([], [])


# --- shared plots ---


def share(life: Life, system_uid: int) -> tuple[int, int]:
    lives.share(life, ROW, np.array([system_uid]))
    return int(life.link[0]), int(life.link_n[0])


def test_plots_shared_in_a_row_are_counted() -> None:
    life = begun()
    assert [share(life, 7) for _ in range(6)] == [(7, n) for n in (1, 2, 3, 4, 5, 5)]
    assert share(life, -1) == (7, 4)
    assert share(life, 8) == (8, 1)
    assert [share(life, -1), share(life, -1)] == [(8, 0), (8, 0)]


def test_a_confirmed_track_that_lives_on_clutter_ends_by_its_score() -> None:
    rules = RULES._replace(end_fall=9.0)
    life = begun()
    for t in (4.0, 8.0, 12.0, 16.0):
        hit(life, t, gain=8.0)
    assert judged(life, 16.0, rules) == ([0], [])
    hit(life, 20.0, gain=-8.9)
    assert judged(life, 20.0, rules) == ([], [])
    hit(life, 24.0, gain=-0.2)
    assert judged(life, 24.0, rules) == ([], [0])
