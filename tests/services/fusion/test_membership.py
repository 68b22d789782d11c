from __future__ import annotations

import numpy as np
from tests.services.fusion.makers import layer

from trackmesh.services.fusion import life as lives
from trackmesh.services.fusion import membership
from trackmesh.services.fusion.layer import Layer


def bank(uids: list[int], sensors: int = 1) -> Layer:
    out = layer(sensors=sensors)
    for row, uid in enumerate(uids):
        lives.born(out.life, np.array([row]), uid, np.zeros(1), 0)
    return out


def linked(uids: list[int], links: list[int], counts: list[int]) -> Layer:
    """Local tracks that shared their last plots, so many in a row, with system tracks."""
    out = bank(uids)
    out.life.link[: len(uids)], out.life.link_n[: len(uids)] = links, counts
    return out


def members(system: Layer, sensor: int = 0) -> list[int]:
    return [int(uid) for uid in system.life.member[system.rows, sensor]]


def test_two_shared_plots_make_a_member() -> None:
    system = bank([100, 101, 102], sensors=2)
    membership.renew(system, linked([7, 8, 9], [102, 100, 101], [2, 1, 5]), 1)
    assert members(system, 1) == [-1, 9, 7]
    assert members(system, 0) == [-1, -1, -1]


def test_a_member_that_ended_leaves() -> None:
    system, local = bank([100]), linked([7], [100], [2])
    membership.renew(system, local, 0)
    local.life.alive[0] = False
    membership.renew(system, local, 0)
    assert members(system) == [-1]


def test_a_member_stays_until_it_goes_to_another() -> None:
    system, local = bank([100, 101]), linked([7], [100], [3])
    membership.renew(system, local, 0)
    local.life.link_n[0] = 0
    membership.renew(system, local, 0)
    assert members(system) == [7, -1]
    local.life.link[0], local.life.link_n[0] = 101, 1
    membership.renew(system, local, 0)
    assert members(system) == [7, -1], "one plot is an accident"
    local.life.link_n[0] = 2
    membership.renew(system, local, 0)
    assert members(system) == [-1, 7]


def test_a_live_member_is_not_displaced() -> None:
    system = bank([100])
    membership.renew(system, linked([7, 8], [100, 100], [2, 0]), 0)
    membership.renew(system, linked([7, 8], [100, 100], [0, 5]), 0)
    assert members(system) == [7]


def test_two_members_change_places_at_once() -> None:
    system = bank([100, 101])
    membership.renew(system, linked([7, 8], [100, 101], [2, 2]), 0)
    membership.renew(system, linked([7, 8], [101, 100], [2, 2]), 0)
    assert members(system) == [8, 7]


def test_a_link_to_a_track_that_ended_does_nothing() -> None:
    system = bank([100])
    membership.renew(system, linked([7], [99], [5]), 0)
    assert members(system) == [-1]


def test_no_local_tracks_and_no_system_tracks() -> None:
    system = bank([100])
    system.life.member[0, 0] = 7
    membership.renew(system, bank([]), 0)
    assert members(system) == [-1]
    membership.renew(bank([]), linked([7], [100], [2]), 0)
