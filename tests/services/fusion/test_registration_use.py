from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.services.fusion.biased import (
    EAST,
    LARGE,
    NORTH,
    PLACES,
    RING,
    SMALL,
    WEST,
    Sky,
    Station,
    announced,
    assert_registered,
    biased,
    errors,
    finish,
    run,
)

from trackmesh.services.estimation.bias import Geometry, Tracks
from trackmesh.services.estimation.bias_start import global_start
from trackmesh.services.fusion.biases import Change, RegistrationRules, moved
from trackmesh.services.fusion.registration import Registration

FloatArray = npt.NDArray[np.float64]

FREE = RegistrationRules(lock_m=0.0)


def test_nothing_is_corrected_before_it_is_locked_but_the_test_uses_what_is_known() -> None:
    sky = Sky(14, 2, [NORTH, EAST._replace(bias=SMALL)])
    registration = announced(sky)
    cycles = run(registration, sky, 200.0)
    _, first = next(cycles)
    assert not first
    assert not registration.locked("east")
    assert not registration.shift("east", RING).any()
    assert registration.shift("east", RING, applied=False).any()
    mean, _ = registration.difference("north", "east", RING, RING)
    known = [registration.shift(name, RING, applied=False) for name in ("north", "east")]
    assert mean == pytest.approx(known[0] - known[1])
    list(cycles)
    assert registration.shift("east", RING).any()


def test_what_is_not_known_widens_the_gate_and_then_shrinks() -> None:
    sky = Sky(15, 50, [NORTH, EAST._replace(bias=LARGE)])
    registration = announced(sky)
    mean, before = registration.difference("north", "east", RING, RING)
    assert not mean.any()
    prior = [registration.covariance(name, RING) for name in ("north", "east")]
    assert before == pytest.approx(prior[0] + prior[1])
    assert np.sqrt(np.linalg.eigvalsh(prior[0])) == pytest.approx(np.tile([300.0, 50e3 * np.deg2rad(0.6)], (8, 1)))
    finish(registration, sky, 60.0)
    mean, after = registration.difference("north", "east", RING, RING)
    assert (np.trace(after, axis1=1, axis2=2) < 0.02 * np.trace(before, axis1=1, axis2=2)).all()
    true = biased(sky.stations[1], RING)
    told = registration.difference("north", "east", RING, true)[0]
    assert RING - true == pytest.approx(told, abs=100.0)


def test_a_locked_shift_brings_plots_back() -> None:
    sky = Sky(16, 50, [NORTH, EAST._replace(bias=LARGE)])
    registration = announced(sky)
    finish(registration, sky, 120.0)
    measured = biased(sky.stations[1], RING)
    assert np.hypot(*(measured - RING).T).min() > 300.0
    left = measured - registration.shift("east", measured) - RING
    assert np.hypot(*left.T).max() < 60.0


def test_corrections_change_in_told_steps_and_what_was_corrected_can_follow() -> None:
    sky = Sky(17, 50, [NORTH, EAST._replace(bias=LARGE)])
    registration = announced(sky)
    raw = held = RING + np.array(EAST.site_m)
    told: list[Change] = []
    for _, changes in run(registration, sky, 160.0):
        for change in changes:
            if change.sensor_id == "east":
                held = moved(change, held)
                told.append(change)
        assert raw - held == pytest.approx(registration.shift("east", raw), abs=1e-6)
    assert [c.kind for c in told[:2]] == ["locked", "moved"]
    assert told[0].shift_m == pytest.approx(np.hypot(300.0, 50e3 * np.deg2rad(0.8)), rel=0.2)
    assert not told[0].before.any()
    for old, new in pairwise(told):
        assert np.array_equal(old.after, new.before)
        assert new.shift_m > 10.0
    assert len(told) < 15


def test_velocities_carry_time_offsets_along() -> None:
    geometry = Geometry(True, np.zeros(2))
    change = Change("a", "moved", geometry, np.array([10.0, 0.001, 0.2]), np.array([20.0, 0.002, 0.5]), 0.0)
    states = np.concatenate([RING, np.full((8, 2), 100.0)], axis=1)
    later = moved(change, states)
    assert later - moved(change, RING) == pytest.approx(np.full((8, 2), -30.0), abs=0.1)


def test_a_free_pair_is_used_every_cycle_and_a_locked_one_every_fourth() -> None:
    sky = Sky(18, 50, [NORTH, EAST])
    registration, free = announced(sky), announced(sky, FREE)
    used: dict[int, list[float]] = {0: [], 1: []}
    for t_s in np.arange(0.0, 40.0, 2.0).tolist():
        a, b = sky.look(t_s)
        for k, one in enumerate((registration, free)):
            if one.update("north", "east", *a, *b, t_s):
                used[k].append(t_s)
            one.settle(t_s)
    assert used[0] == [0.0, 8.0, 16.0, 24.0, 32.0]
    assert used[1] == np.arange(0.0, 40.0, 2.0).tolist()


def test_a_jump_is_noticed_and_followed_while_the_old_correction_stays() -> None:
    sky = Sky(19, 50, [NORTH, EAST._replace(bias=SMALL)])
    registration = announced(sky)
    finish(registration, sky, 120.0)
    assert [e.jumps for e in registration.messages()] == [0, 0]
    sky.stations[1] = EAST._replace(bias=(-150.0, 0.0, 0.0))
    kinds = []
    for t_s, changes in run(registration, sky, 180.0, begin_s=120.0):
        assert registration.locked("east"), t_s
        kinds += [(c.kind, c.sensor_id) for c in changes]
    assert kinds.count(("jumped", "east")) == 1
    assert [e.jumps for e in registration.messages()] == [0, 1]
    assert_registered(registration, sky)


def test_a_jump_that_local_tracks_follow_slowly_is_one() -> None:
    sky = Sky(38, 50, [NORTH, EAST])
    registration = announced(sky)
    finish(registration, sky, 60.0)
    for t_s in np.arange(60.0, 76.0, 2.0).tolist():
        part = (t_s - 58.0) / 16.0
        sky.stations[1] = EAST._replace(bias=(2 * part * LARGE[0], 2 * part * LARGE[1], 0.0))
        registration.update("north", "east", *sky.look(t_s)[0], *sky.look(t_s + 1.0)[1], t_s)
        registration.settle(t_s)
    finish(registration, sky, 180.0, begin_s=76.0)
    assert [e.jumps for e in registration.messages()] == [0, 1]
    assert_registered(registration, sky)


def test_without_a_jump_none_is_counted_and_with_few_pairs_none_is_believed() -> None:
    sky = Sky(20, 50, [NORTH, EAST._replace(bias=LARGE)])
    registration = announced(sky)
    finish(registration, sky, 600.0)
    assert [e.jumps for e in registration.messages()] == [0, 0]
    few = announced(Sky(21, 3, [NORTH, EAST]), RegistrationRules(lock_m=1e4))
    sky = Sky(21, 3, [NORTH, EAST])
    finish(few, sky, 60.0)
    sky.stations[1] = EAST._replace(bias=LARGE)
    finish(few, sky, 120.0, begin_s=60.0)
    assert [e.jumps for e in few.messages()] == [0, 0]


def test_of_three_sensors_the_one_that_jumped_is_blamed() -> None:
    sky = Sky(22, 50, [NORTH, EAST, WEST])
    registration = announced(sky)
    finish(registration, sky, 60.0)
    sky.stations[1] = EAST._replace(bias=LARGE)
    finish(registration, sky, 120.0, begin_s=60.0)
    assert [e.jumps for e in registration.messages()] == [0, 1, 0]
    assert_registered(registration, sky)


# --- what cannot be known ---


def test_a_lone_sensor_says_that_it_has_no_pairs() -> None:
    registration = Registration()
    registration.announce("north", "polar")
    for t_s in (0.0, 1e6):
        registration.settle(t_s)
    (north,) = registration.messages()
    assert north.observable == [False, False, True]
    assert north.notes == [
        "range_m: no pairs with another sensor yet", "azimuth_rad: no pairs with another sensor yet",
    ]  # fmt: skip
    assert np.sqrt(np.diag(north.covariance)) == pytest.approx([300.0, np.deg2rad(0.6)])


@pytest.mark.parametrize("station", [NORTH, PLACES])
def test_sensors_of_one_geometry_say_that_only_a_difference_is_known(station: Station) -> None:
    sky = Sky(23, 50, [station, station._replace(name="same", bias=(100.0, 0.005 if station is NORTH else 60.0, 0.0))])
    registration = announced(sky)
    finish(registration, sky, 120.0)
    first, same = registration.messages()
    assert first.observable == same.observable == [False, False, True]
    assert first.notes == [f"{column}: known only in relation to same" for column in first.columns]
    assert not registration.locked("same")
    error = errors(registration, sky)
    assert np.abs(error["same"] - error[station.name])[0] < 30.0


def test_many_sensors_on_one_mast_do_not_talk_each_other_into_certainty() -> None:
    sky = Sky(24, 30, [NORTH._replace(name=f"{k}") for k in range(6)])
    registration = announced(sky)
    finish(registration, sky, 40.0)
    assert not any(any(e.observable[:2]) for e in registration.messages())


def test_two_radars_apart_know_all() -> None:
    sky = Sky(25, 50, [NORTH, EAST])
    registration = announced(sky)
    finish(registration, sky, 60.0)
    assert [e.notes for e in registration.messages()] == [[], []]
    assert [e.observable for e in registration.messages()] == [[True] * 3] * 2


def test_a_reference_on_the_same_mast_makes_the_other_known() -> None:
    sky = Sky(26, 50, [NORTH, NORTH._replace(name="same", bias=SMALL)])
    registration = Registration()
    registration.announce("north", "polar", prior=[0.0, 0.0, 0.0])
    registration.announce("same", "polar")
    north, same = sky.look(0.0)
    registration.update("north", "same", north.x[:2], north.P[:2], same.x[:2], same.P[:2], 0.0)
    assert not registration.settle(0.0)
    assert not registration.locked("north"), "known, but not what it is compared with"
    finish(registration, sky, 60.0, begin_s=2.0)
    assert all(registration.messages()[1].observable)
    assert registration.locked("same")
    assert not registration.messages()[0].bias.any()
    assert_registered(registration, sky)


def test_where_a_difference_is_enough_sensors_on_one_mast_lock() -> None:
    sky = Sky(27, 50, [NORTH, NORTH._replace(name="same", bias=SMALL)])
    registration = announced(sky, RegistrationRules(lock_difference=True))
    finish(registration, sky, 60.0)
    assert registration.locked("same")
    measured = biased(sky.stations[1], RING)
    apart = measured - registration.shift("same", measured) - (RING - registration.shift("north", RING))
    assert np.hypot(*apart.T).max() < 60.0
    few = announced(Sky(28, 2, sky.stations), RegistrationRules(lock_difference=True))
    finish(few, Sky(28, 2, sky.stations), 3.0)
    assert not few.locked("same")


# --- sensors that come, move and change ---


def test_a_sensor_can_come_later_and_a_new_site_is_taken_over() -> None:
    sky = Sky(29, 50, [NORTH, EAST._replace(bias=SMALL), WEST._replace(bias=(80.0, -0.004, 0.0))])
    registration = announced(Sky(29, 50, sky.stations[:2]))
    two = Sky(29, 50, sky.stations[:2])
    finish(registration, two, 60.0)
    before = registration.messages()[1].bias
    sky.stations[1] = sky.stations[1]._replace(site_m=(41e3, 12e3))
    for station in sky.stations:
        registration.announce(station.name, station.kind, station.site_m)
    assert registration.messages()[1].bias == pytest.approx(before)
    finish(registration, sky, 180.0, begin_s=60.0)
    assert_registered(registration, sky)
    assert [e.jumps for e in registration.messages()] == [0, 0, 0]


def test_a_sensor_that_becomes_another_begins_anew() -> None:
    sky = Sky(30, 50, [NORTH, EAST._replace(bias=SMALL)])
    registration = announced(sky)
    finish(registration, sky, 60.0)
    applied = registration.shift("east", RING)
    registration.announce("east", "position")
    assert not registration.locked("east")
    assert not registration.shift("east", RING).any()
    _, east = registration.messages()
    assert east.columns == ["east_m", "north_m"]
    assert np.sqrt(np.diag(east.covariance)) == pytest.approx([100.0, 100.0])
    (change,) = registration.settle(60.0)
    assert (change.kind, change.sensor_id) == ("reset", "east")
    assert moved(change, RING - applied) == pytest.approx(RING, abs=5.0)
    assert not registration.settle(62.0)


def test_pairs_of_a_sensor_that_became_another_are_forgotten() -> None:
    sky = Sky(39, 50, [NORTH, EAST._replace(bias=SMALL)])
    registration = announced(sky)
    a, b = sky.look(0.0)
    registration.update("north", "east", *a, *b, 0.0)
    registration.announce("east", "position")
    assert not registration.settle(0.0)
    assert not registration.messages()[1].bias.any()
    assert registration.due("north", "east", 0.0)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("radar",), "kind must be"), (("polar", [0.0]), "shape"), (("polar", [0.0, np.nan]), "finite"),
        (("polar", [0.0, 0.0], [1.0, -1.0, 0.0]), "negative"), (("polar", [0.0, 0.0], "much"), "numbers"),
    ],
)  # fmt: skip
def test_what_is_no_sensor_is_refused(words: tuple[Any, ...], sentence: str) -> None:
    registration = Registration()
    with pytest.raises(ValueError, match=sentence):
        registration.announce("a", *words)
    assert not registration.messages()
    assert not registration.snapshot()["sensors"]


def test_a_sensor_is_no_pair_with_itself_and_strangers_are_unknown() -> None:
    sky = Sky(31, 3, [NORTH])
    registration = announced(sky)
    (look,) = sky.look(0.0)
    with pytest.raises(ValueError, match="two sensors"):
        registration.update("north", "north", *look, *look, 0.0)
    with pytest.raises(KeyError):
        registration.shift("nobody", RING)


def test_tracks_that_are_no_numbers_are_left_out() -> None:
    sky = Sky(32, 10, [NORTH, EAST])
    registration = announced(sky)
    a, b = sky.look(0.0)
    a.x[0], a.P[1], b.P[2] = np.nan, 0.0, np.inf
    assert registration.update("north", "east", *a, *b, 0.0)
    registration.settle(0.0)
    assert [e.pairs for e in registration.messages()] == [7, 7]
    assert np.isfinite(registration.messages()[0].bias).all()
    assert not registration.update("north", "east", a.x[:1], a.P[:1], b.x[:1], b.P[:1], 8.0)
    assert not registration.update("north", "east", a.x[:0], a.P[:0], b.x[:0], b.P[:0], 8.0)


def test_time_that_goes_back_is_no_time() -> None:
    sky = Sky(33, 50, [NORTH, EAST])
    registration = announced(sky)
    finish(registration, sky, 60.0)
    P = registration.snapshot()["covariance"]
    assert not registration.settle(10.0)
    assert np.array_equal(registration.snapshot()["covariance"], P)
    assert not registration.due("north", "east", 10.0)


# --- a large bias ---


def test_a_global_start_is_wanted_when_pairs_do_not_come() -> None:
    sky = Sky(34, 50, [NORTH, EAST])
    registration = announced(sky)
    asked = [t for t in np.arange(0.0, 200.0, 2.0).tolist() if registration.lost("north", "east", 50, 40, t)]
    assert asked == [20.0, 60.0, 140.0]
    assert not registration.lost("north", "east", 50, 3, 1000.0)
    assert not any(registration.lost("north", "east", 50, 40, t) for t in (1000.0, 1018.0))
    a, b = sky.look(1019.0)
    registration.update("north", "east", *a, *b, 1019.0)
    assert not any(registration.lost("east", "north", 50, 40, t) for t in (1020.0, 1038.0))
    assert registration.lost("east", "north", 50, 40, 1040.0)


def test_two_kilometres_and_two_degrees_are_found_started_and_locked() -> None:
    bias = (2000.0, float(np.deg2rad(2.0)), 0.0)
    sky = Sky(35, 50, [NORTH._replace(bias=(-400.0, 0.005, 0.0)), EAST._replace(bias=bias)])
    registration = announced(sky)
    a, b = sky.look(0.0)
    sites = [Geometry(True, np.array(station.site_m)) for station in sky.stations]
    found = global_start(Tracks(sites[0], *a), Tracks(sites[1], *b))
    assert found.found
    rows = a.x[found.a], a.P[found.a], b.x[found.b], b.P[found.b]
    assert registration.begin("north", "east", (found.bias_a, found.bias_b), *rows, 0.0)
    changes = registration.settle(0.0)
    assert [c.kind for c in changes] == ["locked", "locked"]
    assert changes[1].shift_m > 500.0
    finish(registration, sky, 120.0, begin_s=2.0)
    assert_registered(registration, sky)
    assert [e.jumps for e in registration.messages()] == [0, 0]


def test_a_large_bias_that_vanishes_is_started_anew() -> None:
    bias = (1500.0, float(np.deg2rad(1.5)), 0.0)
    sky = Sky(37, 50, [NORTH, EAST._replace(bias=bias)])
    registration = announced(sky)
    for t_s, now in ((0.0, sky.stations[1]), (100.0, EAST)):
        sky.stations[1] = now
        a, b = sky.look(t_s)
        assert registration.begin("north", "east", (np.zeros(2), np.array(now.bias[:2])), *a, *b, t_s)
        registration.settle(t_s)
        assert_registered(registration, sky, metres=150.0, degrees=0.2)
        finish(registration, sky, t_s + 90.0, begin_s=t_s + 2.0)
        assert_registered(registration, sky)
    assert registration.shift("east", RING) == pytest.approx(0.0, abs=60.0)
