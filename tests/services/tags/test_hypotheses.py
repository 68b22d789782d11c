"""Several places at once: a circle about one reader, a place and its mirror image, and how one of them is left."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from tests.services.tags.lives import SIGMA, Table
from tests.services.tags.makers import LINE, SQUARE, One, covariance, ranges

from trackmesh.services.tags import mirror
from trackmesh.services.tags.hypotheses import COUNT, begin_circle, grown, make_blocks, prune
from trackmesh.services.tags.life import Manners
from trackmesh.services.tags.table import LOCATED, SEVERAL

EVERYWHERE = Manners().area


@pytest.mark.parametrize(("metres", "height"), [(20.0, 0.0), (5.0, 3.0), (0.5, 0.0), (0.0, 2.0)])
def test_the_circle_of_one_range_is_covered_evenly(metres: float, height: float) -> None:
    one, place = One(), np.array([3.0, -2.0, height])
    blocks = make_blocks(one.rules, 1)
    begin_circle(one.rules[0], blocks, 0, place, ranges((0.0, 0, metres), sigma=0.5)[0])
    x, P = blocks.filters["x"][0, :, 0, :2], blocks.filters["P"][0, :, 0, :2, :2]
    radius = math.sqrt(max(metres**2 - height**2, 0.0))
    density = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 200):
        e = place[:2] + radius * np.array([np.sin(angle), np.cos(angle)]) - x
        d2 = np.einsum("ka,kab,kb->k", e, np.linalg.inv(P), e)
        density.append(np.sum(np.exp(-0.5 * d2) / np.sqrt(np.linalg.det(P))) / COUNT)
    assert max(density) < 1.5 * min(density)
    # All of it together: somewhere within the circle.
    spread = np.cov(x.T, bias=True) + P.mean(0)
    assert np.trace(spread) == pytest.approx(radius**2 + 2 * 0.25, rel=0.3)


def test_one_reader_says_somewhere_on_its_circle_and_no_more() -> None:
    tags = Table(SQUARE)
    for k in range(40):
        tags.hear(0.1 * k, (12.0, 16.0), 0)
    assert tags.state == SEVERAL
    told = tags.told(4.0)
    np.testing.assert_allclose(told.x[0, :2], [0.0, 0.0], atol=1.0)
    assert math.sqrt(told.P[0, 0, 0]) == pytest.approx(20.0 / math.sqrt(2.0), rel=0.1)
    assert told.certainty[0] == pytest.approx(1.0 / COUNT)


def test_two_readers_leave_a_place_and_its_mirror_image() -> None:
    tags = Table(SQUARE)
    for k in range(60):
        tags.hear(0.1 * k, (25.0, 12.0), k % 2)
    told = tags.told(6.0)
    assert tags.state == SEVERAL
    places = sorted([told.x[0, :2].tolist(), told.other[0].tolist()], key=lambda place: place[1])
    np.testing.assert_allclose(places, [[25.0, -12.0], [25.0, 12.0]], atol=1.0)
    assert 0.3 < told.certainty[0] < 0.9
    assert sorted(told.used[0][told.used[0] >= 0]) == [0, 1]


def test_what_is_told_of_two_equal_places_does_not_waver() -> None:
    tags = Table(SQUARE)
    sides = []
    for k in range(150):
        tags.hear(0.1 * k, (25.0, 12.0), k % 2)
        if k > 40:
            sides.append(bool(tags.told(0.1 * k).x[0, 1] > 0))
    assert tags.state == SEVERAL
    assert sum(a != b for a, b in pairwise(sides)) <= 2


def test_a_third_reader_decides() -> None:
    tags = Table(SQUARE)
    for k in range(60):
        tags.hear(0.1 * k, (25.0, 12.0), k % 2)
    before = tags.free_blocks
    for k in range(60, 70):
        tags.hear(0.1 * k, (25.0, 12.0), 2)
    assert tags.state == LOCATED and tags.free_blocks == before + 1
    told = tags.told(7.0)
    assert math.dist(told.x[0, :2], (25.0, 12.0)) < 1.0
    assert told.certainty[0] == 1.0 and told.other[0].tolist() == told.x[0, :2].tolist()


def test_readers_on_a_line_are_told_as_ambiguous_at_once() -> None:
    tags = Table(LINE)
    tags.hear(0.0, (15.0, 12.0), 0, 1, 2)
    assert tags.state == SEVERAL
    told = tags.told(0.0)
    np.testing.assert_allclose(sorted([told.x[0, 1], told.other[0, 1]]), [-12.0, 12.0], atol=1.5)
    assert told.certainty[0] == pytest.approx(0.5, abs=0.05)


def test_the_area_where_tags_can_be_decides_too() -> None:
    manners = Manners(area=np.array([0.0, 0.0, 45.0, 30.0]))
    tags = Table(LINE, manners)
    tags.hear(0.0, (15.0, 12.0), 0, 1, 2)
    assert tags.state == LOCATED
    assert tags.told(0.0).x[0, 1] == pytest.approx(12.0, abs=1.5)
    # And for a tag that only one reader hears, from the wall: the half of the circle within.
    alone = Table(LINE, manners)
    for k in range(20):
        alone.hear(0.1 * k, (20.0, 15.0), 1)
    assert alone.told(2.0).x[0, 1] > 5.0


def test_if_all_are_outside_the_area_none_is_dropped() -> None:
    one = One()
    blocks = make_blocks(one.rules, 1)
    begin_circle(one.rules[0], blocks, 0, np.zeros(3), ranges((0.0, 0, 10.0), sigma=0.1)[0])
    assert prune(blocks, 0, np.array([100.0, 100.0, 200.0, 200.0])) == COUNT
    assert prune(blocks, 0, EVERYWHERE) == COUNT


def test_overlapping_places_are_merged_with_their_moments() -> None:
    one = One()
    blocks = make_blocks(one.rules, 1)
    begin_circle(one.rules[0], blocks, 0, np.zeros(3), ranges((0.0, 0, 1.0), sigma=2.0)[0])
    x, P = blocks.filters["x"][0, :, 0].copy(), blocks.filters["P"][0, :, 0].copy()
    assert prune(blocks, 0, EVERYWHERE) == 1
    kept = int(np.argmax(blocks.weight[0]))
    mean = x.mean(0)
    spread = P.mean(0) + np.einsum("ka,kb->ab", x - mean, x - mean) / COUNT
    np.testing.assert_allclose(blocks.filters["x"][0, kept, 0], mean, atol=1e-9)
    np.testing.assert_allclose(blocks.filters["P"][0, kept, 0], spread, atol=1e-9)


def test_room_grows_and_keeps_what_is_in_it() -> None:
    one = One()
    blocks = make_blocks(one.rules, 2)
    blocks.top[0], blocks.weight[1, 3], blocks.reader[1] = 1, 0.25, 9
    more = grown(blocks, one.rules)
    assert more.weight[1, 3] == 0.25 and more.reader[1] == 9
    free = sorted(more.free[: more.top[0]].tolist())
    assert free == [0, *range(2, len(more.reader))]


def test_a_start_from_ranges_that_contradict_each_other_recovers() -> None:
    tags = Table(SQUARE)
    tags.hear(0.0, (10.0, 30.0), 0, 1, 3, noise=np.array([20.0, 20.0, 0.0]))
    for k in range(1, 60):
        tags.hear(0.1 * k, (10.0, 30.0), 0, 1, 2, 3)
    assert tags.state == LOCATED
    assert math.dist(tags.told(6.0).x[0, :2], (10.0, 30.0)) < 3.0 * SIGMA


def strolled(across: float, **description: Any) -> Table:
    """A tag located north of a wall of readers, which a reader south of it hears at first.

    It then goes along the wall, dwells at the wall itself, and leaves it to the north, where only the wall hears it.
    """
    readers = np.vstack([LINE, [[20.0, -25.0, 0.0]]])
    tags = Table(readers, speed_mps=1.5, acceleration_mps2=0.7, **description)
    for k in range(140):
        t = 0.1 * k
        north = np.interp(t, [0.0, 2.0, 6.0, 9.0, 14.0], [8.0, 8.0, across, across, 10.0])
        tags.hear(t, (20.0 + 0.5 * t, north), *([0, 1, 2, 3] if k < 20 else [0, 1, 2]))
        if k == 20:
            assert tags.state == LOCATED
    return tags


@pytest.mark.parametrize("update", ["ut", "ekf"])
@pytest.mark.parametrize("motion", ["singer", "tvimm"])
def test_who_dwells_on_the_line_of_readers_may_leave_it_on_either_side(update: str, motion: str) -> None:
    tags = strolled(0.0, update=update, motion=motion)
    assert tags.state == SEVERAL
    told = tags.told(13.9)
    np.testing.assert_allclose(sorted([told.x[0, 1], told.other[0, 1]]), [-9.8, 9.8], atol=1.0)
    np.testing.assert_allclose([told.x[0, 0], told.other[0, 0]], [26.9, 26.9], atol=1.0)
    # The reader on the other side of the wall decides.
    for k in range(140, 150):
        tags.hear(0.1 * k, (27.0, 10.0), 0, 1, 2, 3)
    assert tags.state == LOCATED and tags.told(15.0).x[0, 1] == pytest.approx(10.0, abs=1.0)


def test_who_stays_away_from_it_keeps_his_side() -> None:
    tags = strolled(6.0)
    assert tags.state == LOCATED
    assert tags.told(13.9).x[0, 1] == pytest.approx(9.8, abs=1.0)


def test_who_crosses_it_straight_on_keeps_his_way() -> None:
    tags = Table(np.vstack([LINE, [[20.0, -25.0, 0.0]]]), speed_mps=1.5, acceleration_mps2=0.3)
    for k in range(160):
        readers = [0, 1, 2, 3] if k < 60 else [0, 1, 2]
        tags.hear(0.1 * k, (20.0, 10.0 - 0.125 * k), *readers)
    assert tags.state == LOCATED
    assert tags.told(15.9).x[0, 1] == pytest.approx(-9.9, abs=1.0)


@pytest.mark.parametrize("more", [{}, {"motion": "tvimm", "bias_sd_m": 1.0}])
def test_a_mirrored_filter_is_the_mirrored_one(more: dict[str, Any]) -> None:
    rng, one = np.random.default_rng(3), One(**more).begin()
    r, d = one.f.x.shape
    one.f.x[:], one.f.P[:] = rng.normal(size=(r, d)), np.array([covariance(rng, d) for _ in range(r)])
    x, P = one.f.x.copy(), one.f.P.copy()
    normal = np.array([0.6, 0.8])
    line = np.array([2.0, -1.0, *normal])
    flip = np.eye(d)
    for a in (0, 2, 4):
        flip[a : a + 2, a : a + 2] -= 2.0 * np.outer(normal, normal)
    shift = np.zeros(d)
    shift[:2] = 2.0 * (normal @ line[:2]) * normal
    mirror._reflect(one.f, line)
    np.testing.assert_allclose(one.f.x, x @ flip.T + shift, atol=1e-12)
    np.testing.assert_allclose(one.f.P, flip @ P @ flip.T, atol=1e-12)
    mirror._reflect(one.f, line)
    np.testing.assert_allclose(one.f.x, x, atol=1e-12)


def test_where_another_reader_hears_no_side_is_in_doubt() -> None:
    readers = np.array([[0.0, 0.0, 0.0], [20.0, -10.0, 0.0], [40.0, 0.0, 0.0]])
    tags = Table(readers, speed_mps=1.5, acceleration_mps2=0.7)
    for k in range(140):
        # It dwells on the line of two readers, and leaves it again.
        north = np.interp(0.1 * k, [0.0, 2.0, 4.0, 9.0, 14.0], [8.0, 8.0, 0.0, 0.0, 10.0])
        tags.hear(0.1 * k, (25.0, north), 0, 1, 2)
        assert tags.state == LOCATED
