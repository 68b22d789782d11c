from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trackmesh.sim.scenario import Scenario, Targets, load_scenario
from trackmesh.sim.truth import Truth, World, make_truth, truth_frame


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    slow = draw(st.floats(5.0, 300.0))
    fast = slow * draw(st.floats(1.0, 3.0))
    low = draw(st.floats(0.3, 5.0))
    high = low * draw(st.floats(1.0, 4.0))
    room = 4.0 * fast / np.deg2rad(high)
    east, north = (room * draw(st.floats(1.01, 6.0)) for _ in range(2))
    count = draw(st.integers(1, 12))
    targets = Targets(
        count=count,
        quiet_count=draw(st.integers(0, count)),
        area_enu_m=(-0.3 * east, -0.6 * north, 0.7 * east, 0.4 * north),
        speed_mps=(slow, fast),
        turn_rate_deg_s=(low, high),
        turn_duration_s=(5.0, draw(st.floats(5.0, 60.0))),
        manoeuvre_share=draw(st.floats(0.01, 0.9)),
        appear_s=draw(st.sampled_from([0.0, 50.0])),
        lifetime_s=draw(st.sampled_from([None, (20.0, 80.0)])),
    )
    return load_scenario("two-radars").model_copy(update={"targets": targets, "duration_s": 400.0})


@settings(max_examples=60, deadline=None)
@given(scenarios(), st.integers(0, 2**32))
def test_targets_stay_inside_the_area(scenario: Scenario, seed: int) -> None:
    truth = make_truth(scenario, seed)
    area = np.array(scenario.seen_targets().area_enu_m)
    slack = 1e-5 + 1e-9 * np.abs(area).max()
    for t_s in np.linspace(0.0, truth.horizon_s, 150):
        ids, states = truth.state_at(t_s)
        assert (states[:, :2] >= area[:2] - slack).all()
        assert (states[:, :2] <= area[2:] + slack).all()
        assert len(ids) <= scenario.seen_targets().count
        assert len(set(ids.tolist())) == len(ids)


@settings(max_examples=30, deadline=None)
@given(scenarios(), st.integers(0, 2**32), st.floats(1.0, 5.0))
def test_a_longer_horizon_changes_nothing_before(scenario: Scenario, seed: int, factor: float) -> None:
    short = make_truth(scenario, seed)
    long = make_truth(scenario, seed, short.horizon_s * factor)
    for t_s in np.linspace(0.0, short.horizon_s, 23):
        for a, b in zip(short.state_at(t_s), long.state_at(t_s), strict=True):
            np.testing.assert_array_equal(a, b)


def test_velocity_is_the_derivative_of_position(two_radars: Scenario) -> None:
    truth = make_truth(two_radars, 3)
    rows = np.flatnonzero(truth.alive(0.0) & truth.alive(290.0))
    for t_s in np.linspace(1.0, 289.0, 60):
        now = np.full(len(rows), t_s)
        step = (truth.states(rows, now + 1e-3)[:, :2] - truth.states(rows, now - 1e-3)[:, :2]) / 2e-3
        # Where a leg changes within the step, the rate jumps by at most 3 degrees/s.
        np.testing.assert_allclose(step, truth.states(rows, now)[:, 2:], atol=0.02)


def test_the_paths_solve_their_equation_of_motion(two_radars: Scenario) -> None:
    truth = make_truth(two_radars, 5)
    row = np.array([4])
    edges = truth.legs.t_s[truth.legs.first[4] : truth.legs.first[5]]

    def flow(t_s: float, state: np.ndarray) -> np.ndarray:
        rate = truth.legs.turn_rate_rad_s[truth.legs.at(row, np.array([t_s]))][0]
        return np.array([state[2], state[3], rate * state[3], -rate * state[2]])

    state = truth.states(row, np.zeros(1))[0]
    for begin, end in zip(edges[:-1], np.minimum(edges[1:], 300.0), strict=True):
        if end > begin:
            # Stop just short of the border: there the next leg begins.
            solved = solve_ivp(flow, (begin, end - 1e-9), state, rtol=1e-11, atol=1e-9)
            state = solved.y[:, -1]
    np.testing.assert_allclose(truth.states(row, np.array([300.0]))[0], state, atol=1e-4)


def test_quiet_targets_never_turn_and_are_replaced(two_radars: Scenario) -> None:
    truth = make_truth(two_radars, 1, 3000.0)
    quiet = np.flatnonzero(truth.quiet)
    assert len(quiet) > two_radars.seen_targets().quiet_count
    assert not truth.legs.turn_rate_rad_s[truth.legs.at(quiet, truth.born_s[quiet])].any()
    for t_s in np.linspace(0.0, 3000.0, 40):
        there = truth.alive(t_s)
        assert there[quiet].sum() == two_radars.seen_targets().quiet_count
        assert there.sum() == two_radars.seen_targets().count


def test_the_share_of_turning_is_what_was_asked() -> None:
    scenario = load_scenario("many")
    truth = make_truth(scenario, 1, 1000.0)
    rows = np.flatnonzero(~truth.quiet)

    def turning(t_s: float) -> float:
        rate = truth.legs.turn_rate_rad_s[truth.legs.at(rows, np.full(len(rows), t_s))]
        return float(np.mean(rate != 0))

    # Turning back at the border comes on top.
    assert 0.19 < np.mean([turning(t) for t in np.linspace(200.0, 1000.0, 40)]) < 0.26


def test_births_and_deaths(two_radars: Scenario) -> None:
    targets = two_radars.seen_targets().model_copy(
        update={"appear_s": 30.0, "lifetime_s": (40.0, 60.0), "quiet_count": 0}
    )
    truth = make_truth(two_radars.model_copy(update={"targets": targets}), 1)
    assert (truth.born_s <= 30.0).all()
    assert (truth.born_s > 0.0).all()
    lived = truth.dies_s - truth.born_s
    assert (lived >= 40.0).all()
    assert (lived <= 60.0).all()
    assert len(truth.state_at(35.0).ids) == 40
    assert len(truth.state_at(95.0).ids) == 0


def test_seeds_differ_and_repeat(two_radars: Scenario) -> None:
    def positions(seed: int) -> np.ndarray:
        return make_truth(two_radars, seed).state_at(100.0).states

    np.testing.assert_array_equal(positions(1), positions(1))
    assert not np.array_equal(positions(1), positions(2))


def test_a_world_looks_further_when_asked(two_radars: Scenario) -> None:
    world = World(two_radars, 1)
    before: Truth = world.truth(10.0)
    assert world.truth(300.0) is before
    assert world.truth(301.0).horizon_s >= 301.0
    frame = truth_frame(world, 500.5, 10**18)
    assert frame.t_ns == 10**18 + 500_500_000_000
    assert len(frame.id) == two_radars.seen_targets().count


@pytest.mark.parametrize("t_s", [-5.0, 0.0, 299.999])
def test_a_leg_is_found_at_any_time(two_radars: Scenario, t_s: float) -> None:
    legs = make_truth(two_radars, 2).legs
    rows = np.arange(len(legs.first) - 1)
    found = legs.at(rows, np.full(len(rows), t_s))
    expected = [
        legs.first[r] + max(0, np.searchsorted(legs.t_s[legs.first[r] : legs.first[r + 1]], t_s, side="right") - 1)
        for r in rows
    ]
    np.testing.assert_array_equal(found, expected)
