"""The life of tags: how they begin, what is left out, when they begin anew, when they are lost."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.services.tags.lives import SIGMA, Table
from tests.services.tags.makers import SQUARE, ranges

from trackmesh.services.tags import table
from trackmesh.services.tags.life import Manners
from trackmesh.services.tags.table import (
    DUPLICATES,
    FREE,
    HEARD,
    LATE,
    LOCATED,
    REPAIRS,
    RESTARTS,
    RING,
    SEVERAL,
    STARTS,
)

PLACE = (13.0, 27.0)


def located(readers: np.ndarray = SQUARE, until_s: float = 3.0, **more: object) -> Table:
    """A tag that stands at PLACE and has been heard by all readers ten times a second."""
    tags = Table(readers, **more)  # type: ignore[arg-type]
    for k in range(round(10 * until_s)):
        tags.hear(0.1 * k, PLACE, 0, 1, 2, 3)
    assert tags.state == LOCATED
    return tags


def test_three_readers_locate_at_once() -> None:
    tags = Table(SQUARE)
    tags.hear(0.0, PLACE, 0, 1, 2)
    assert (tags.state, tags.count(STARTS)) == (LOCATED, 1)
    assert math.dist(tags.told(0.0).x[0, :2], PLACE) < 5.0 * SIGMA


def test_three_readers_within_the_window_do_too() -> None:
    tags = Table(SQUARE, Manners(window_s=2.0, wait_s=5.0))
    for t_s, reader in ((0.0, 0), (0.7, 1)):
        tags.hear(t_s, PLACE, reader)
        assert tags.state == HEARD
    tags.hear(1.5, PLACE, 2)
    assert tags.state == LOCATED


def test_readers_heard_too_far_apart_do_not() -> None:
    tags = Table(SQUARE, Manners(window_s=2.0, wait_s=50.0))
    for t_s, reader in ((0.0, 0), (1.5, 1), (3.0, 2)):
        tags.hear(t_s, PLACE, reader)
    assert tags.state == HEARD


def test_after_the_wait_fewer_readers_must_do() -> None:
    tags = Table(SQUARE, Manners(wait_s=1.0))
    tags.hear(0.0, PLACE, 0)
    tags.wait(0.9)
    assert tags.state == HEARD
    tags.wait(1.0)
    assert tags.state == SEVERAL
    heard = Table(SQUARE, Manners(wait_s=1.0))
    for t_s in (0.0, 0.5, 1.1):
        heard.hear(t_s, PLACE, 0)
    assert heard.state == SEVERAL


def test_late_ranges_are_left_out() -> None:
    tags = located()
    before = tags.tags.filters.copy()
    tags.hear(1.0, PLACE, 0, 1)
    assert tags.count(LATE) == 2
    assert (tags.tags.filters == before).all()


@pytest.mark.parametrize("together", [True, False])
def test_a_reading_that_is_repeated_counts_once(together: bool) -> None:
    tags, other = located(), located()
    rows = [(3.0, 0, 30.0), (3.0, 1, 38.0)]
    other.take(ranges(*rows, sigma=SIGMA))
    if together:
        tags.take(ranges(rows[0], rows[0], rows[1], sigma=SIGMA))
    else:
        tags.take(ranges(*rows, sigma=SIGMA))
        tags.take(ranges(*rows[:1], sigma=SIGMA))
    assert tags.count(DUPLICATES) == 1
    assert (tags.tags.filters == other.tags.filters).all()


def test_more_of_one_instant_may_come_later() -> None:
    tags, whole = located(), located()
    z = ranges((3.0, 0, 30.1), (3.0, 1, 38.2), (3.0, 2, 30.0), sigma=SIGMA)
    whole.take(z)
    for k in range(3):
        tags.take(z[k : k + 1])
    np.testing.assert_allclose(tags.tags.filters["x"], whole.tags.filters["x"])


def test_a_tag_that_was_carried_off_is_found_again() -> None:
    tags = located()
    far = (35.0, 3.0)
    for k in range(30, 60):
        tags.hear(0.1 * k, far, 0, 1, 2, 3)
    assert tags.count(RESTARTS) == 1
    assert tags.state == LOCATED
    assert math.dist(tags.told(6.0).x[0, :2], far) < 5.0 * SIGMA


def test_one_reader_round_a_corner_never_starts_anew() -> None:
    tags = located()
    for k in range(30, 130):
        tags.hear(0.1 * k, PLACE, 0, 1, 2, 3, noise=np.array([6.0, 0.1, -0.1, 0.0]))
    assert tags.count(RESTARTS) == 0
    assert math.dist(tags.told(13.0).x[0, :2], PLACE) < 1.0


def test_doubts_of_few_readers_must_last_longer() -> None:
    tags = located(acceleration_mps2=0.05, speed_mps=0.05)
    for k in range(20):
        tags.hear(6.0 + 0.1 * k, PLACE, 0, noise=20.0 + k)
    assert tags.state == LOCATED and tags.count(RESTARTS) == 0
    assert tags.tags.filters[0].doubts > tags.manners.doubts
    for k in range(20, 45):
        tags.hear(6.0 + 0.1 * k, PLACE, 0, noise=20.0 + k)
    assert tags.count(RESTARTS) >= 1


def test_what_is_heard_after_a_long_silence_begins_anew() -> None:
    tags = located(manners=Manners(lost_s=30.0))
    tags.hear(3.0 + 29.0, PLACE, 0)
    assert tags.state == LOCATED
    tags.hear(3.0 + 29.0 + 31.0, PLACE, 0)
    assert tags.state == HEARD


def test_a_minute_of_silence_lets_the_covariance_grow() -> None:
    tags = located()
    spread = [float(np.trace(tags.told(t_s).P[0, :2, :2])) for t_s in (3.0, 4.0, 10.0, 30.0, 63.0)]
    assert spread == sorted(spread)
    assert math.sqrt(spread[-1]) > 20.0
    assert spread[0] < 0.1


def test_a_filter_that_broke_begins_anew() -> None:
    tags = located()
    tags.tags.filters[0].x[0, 0] = np.nan
    tags.hear(3.1, PLACE, 0, 1, 2, 3)
    assert tags.count(REPAIRS) == 1
    tags.hear(3.2, PLACE, 0, 1, 2, 3)
    assert tags.state == LOCATED and np.isfinite(tags.told(3.2).x).all()


def test_a_row_may_be_nobodys_again() -> None:
    tags = Table(SQUARE)
    for k in range(30):
        tags.hear(0.1 * k, PLACE, 0)
    assert (tags.state, tags.free_blocks) == (SEVERAL, 1)
    table.forget(tags.tags, 0)
    assert (tags.state, tags.free_blocks) == (FREE, 2)
    tags.hear(0.0, (30.0, 30.0), 0, 1, 2)
    assert tags.state == LOCATED


def test_without_a_free_block_the_rest_waits() -> None:
    tags = Table(SQUARE, rows=3)
    tags.tags.blocks.top[0] = 0
    assert tags.take(ranges((0.0, 0, 5.0))) == 0
    tags.tags.blocks.top[0] = 1
    assert tags.take(ranges((0.0, 0, 5.0))) == 1


def test_bias_and_scale_survive_a_new_start() -> None:
    tags = Table(SQUARE, Manners(lost_s=5.0), bias_sd_m=1.0, scale_sd=0.1)
    rng = np.random.default_rng(3)
    for k in range(600):
        place = np.array([20.0 + 15.0 * math.cos(0.02 * k), 20.0 + 15.0 * math.sin(0.02 * k)])
        d = np.hypot(*(place - SQUARE[:, :2]).T)
        tags.take(ranges(*[(0.1 * k, r, 1.06 * d[r] + 0.2 * rng.normal()) for r in range(4)], sigma=SIGMA))
    learnt = tags.told(60.0).x[0, 6:]
    assert learnt[1] == pytest.approx(0.06, abs=0.02)
    d = np.hypot(*(np.array([30.0, 10.0]) - SQUARE[:, :2]).T)
    tags.take(ranges(*[(80.0, r, 1.06 * d[r]) for r in range(4)], sigma=SIGMA))
    assert tags.state == LOCATED and tags.count(STARTS) == 2
    np.testing.assert_allclose(tags.told(80.0).x[0, 6:], learnt, atol=1e-9)
    assert math.dist(tags.told(80.0).x[0, :2], (30.0, 10.0)) < 0.5


def test_only_the_last_ranges_are_remembered() -> None:
    tags = located()
    late = table.latest(tags.tags, 0, RING)
    assert late["t_s"].tolist() == sorted(late["t_s"]) and late["t_s"][-1] == pytest.approx(2.9)
    assert table.readers_in(late) == 4
    assert len(table.window(tags.tags, 0, 2.75)) == 8
