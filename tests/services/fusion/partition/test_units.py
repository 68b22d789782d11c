"""Units in one process against one engine over everything, in the peers' scenario; longer: benchmarks.scale_out."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import peer_scenario, scale_out, units
from benchmarks.scale_out import CASES, Figures, death_of, run_case

from trackmesh.protocol.codec import encode
from trackmesh.services.fusion import snapshot
from trackmesh.services.fusion.partition.engine import PartitionedEngine
from trackmesh.services.fusion.settings import EngineSettings

pytestmark = pytest.mark.skipif(
    not peer_scenario.available(), reason="the peers' scenario is not beside the repository"
)

SHORT_S, DEATH_S = 150.0, 70.0


def short(name: str, seed: int = 2, targets: int = 100) -> Figures:
    case = CASES[name]
    return run_case(death_of(case, DEATH_S) if case.death else case, seed, SHORT_S, targets)


@pytest.mark.parametrize("seed", [2, 3])
def test_two_units_are_as_good_as_one(seed: int) -> None:
    found = run_case(CASES["nominal"], seed)
    assert found["single_kept_pct"] == 100.0
    assert found["kept_pct"] >= 97.0
    assert found["switches"] <= found["single_switches"] + 4
    assert found["gospa_m"] <= 1.01 * found["single_gospa_m"]
    assert found["duplicates"] <= found["single_duplicates"] + 0.02
    assert found["wrong"] == 0.0


def test_without_adoption_identities_end_at_the_border() -> None:
    found = run_case(CASES["hard border"], 2, 200.0, 150)
    assert found["crossers"] > 10
    assert found["kept_pct"] < 15.0
    assert found["switches"] > found["single_switches"] + 20


@pytest.mark.parametrize("name", ["4 s late", "50 % lost", "corner", "polygons"])
def test_identities_survive_what_networks_do(name: str) -> None:
    found = short(name)
    assert found["kept_pct"] >= found["single_kept_pct"]
    assert found["switches"] <= found["single_switches"] + 4
    assert found["gospa_ratio"] < 1.01
    assert found["wrong"] == 0.0


def test_batches_delivered_twice_give_the_same_frames() -> None:
    def told(times: int) -> list[bytes]:
        case = CASES["nominal"]._replace(times=times)
        run = scale_out.several_units(case, case.make(2, 60.0, 50), 2)
        return [encode(frame) for _, frame in run.shown]

    assert told(1) == told(2)


@pytest.mark.parametrize(
    ("name", "least"), [("death", 96.0), ("death, standby", 96.0), ("death, return", 96.0), ("corner, death", 96.0)]
)
def test_the_tracks_of_a_dead_unit_go_on(name: str, least: float) -> None:
    found = short(name)
    assert found["ids_60_pct"] >= least
    assert found["shown_4_pct"] >= least
    assert found["switches"] <= found["single_switches"] + 6
    assert found["wrong"] == 0.0


def test_a_neighbour_that_heard_nothing_keeps_no_identity() -> None:
    found = short("death, cold")
    assert found["ids_60_pct"] == 0.0
    assert found["shown_4_pct"] < 50.0
    assert found["shown_30_pct"] > 95.0


def test_a_unit_that_returns_owns_its_area_again_under_the_same_ids() -> None:
    case = death_of(CASES["death, return"], DEATH_S)
    assert case.death is not None
    case = case._replace(death=case.death._replace(back_s=100.0))
    run = scale_out.several_units(case, case.make(3, SHORT_S, 60), 3)
    back = run.realm.units["unit-1"].engine
    assert back.neighbours.state == "active"
    assert back.counters["adopted"] > 10
    assert back.counters["taken_over"] > 10
    last = run.realm.units["unit-1"].last
    assert last is not None
    assert (last.epoch >= 2).sum() > 10


def test_units_that_could_not_hear_each_other_agree_again_on_every_id() -> None:
    case = CASES["cut 20 s"]._replace(cut=units.Cut(60.0, 80.0))
    found = run_case(case, 2, SHORT_S, 100)
    assert found["kept_pct"] >= found["single_kept_pct"]
    assert found["switches"] <= found["single_switches"] + 4
    assert found["wrong"] == 0.0


def test_a_units_tracks_are_kept_over_its_own_restart_with_their_epochs() -> None:
    case = CASES["nominal"]
    trial = case.make(2, 60.0, 50)
    realm = units.make_realm(trial, scale_out.HALVES, EngineSettings(), seed=2)
    units.drive(realm, trial)
    before = realm.units["unit-1"].engine
    kept = before.snapshot()
    assert kept is not None
    after = PartitionedEngine(before.settings, before.unit, before.share)
    after.restore(snapshot.from_bytes(snapshot.to_bytes(kept)))
    claims = before.ownership.claims
    assert (claims.epoch > 0).sum() > 10
    np.testing.assert_array_equal(after.ownership.epochs(claims.ident), claims.epoch)
    # Others may own them by now: that they have to hear first.
    assert not after.ownership.claims.owner.any()


def test_ids_of_a_restarted_unit_are_new() -> None:
    case = CASES["nominal"]
    trial = case.make(2, 30.0, 20)
    realm = units.make_realm(trial, scale_out.HALVES, EngineSettings())
    first, second = (realm.make("unit-1", boot) for boot in (0, 1))
    assert set(first._picture.numbers(50).tolist()).isdisjoint(second._picture.numbers(50).tolist())


def test_registration_is_taken_from_a_neighbour_where_nothing_is_known() -> None:
    # One radar reaches into the second unit's area alone: it has no pairs of its own to learn from.
    case = CASES["bias"]
    trial = case.make(2, 60.0, 50)
    realm = units.make_realm(trial, scale_out.HALVES, EngineSettings(), seed=2)
    units.drive(realm, trial)
    told = realm.units["unit-1"].engine
    late = realm.make("unit-2", 1)
    late.alive(frozenset(["unit-1"]))
    message = told.corrections.message("unit-1", "one", 0, 0)
    late.band(realm.told[-1] if realm.told[-1].unit_id == "unit-1" else realm.told[-2])
    late.neighbour_registration(message)
    for feed in trial.feeds[:3]:
        late.plots(feed.batch)
    assert late.counters["biases_of_neighbours"] == 2
    biases = {one.sensor_id: one for one in late.corrections.biases.messages()} if late.corrections.biases else {}
    for one in message.sensors:
        np.testing.assert_allclose(biases[one.sensor_id].bias, one.bias, rtol=1e-3)
        np.testing.assert_allclose(biases[one.sensor_id].covariance, 4.0 * one.covariance, rtol=0.2)
        assert biases[one.sensor_id].locked
