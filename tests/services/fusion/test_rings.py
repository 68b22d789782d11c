"""Units that take each other's tracks: the dead stay dead, and nobody grows surer by what he said himself."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    FloatArray,
    engine,
    in_time_order,
    live,
    nearest,
    ns,
    scans,
)
from tests.services.fusion.units import Realm, unit

from trackmesh.protocol.messages import PlotBatch, TrackFrame
from trackmesh.services.fusion import composition
from trackmesh.services.fusion.engine import FusionEngine

DIE_S = 60.0
OWN = {"north": "first", "east": "second"}


def ring() -> Realm:
    """Two units, a radar each."""
    return Realm(unit("first", 1, NORTH, inputs=("second",)), unit("second", 2, EAST, inputs=("first",)))


def plots(until_s: float, seed: int = 1) -> list[PlotBatch]:
    east = scans(EAST, FAR_APART, until_s, offset_s=0.7, seed=seed + 100)
    return in_time_order(scans(NORTH, FAR_APART, until_s, seed=seed), east)


def feed(realm: Realm, until_s: float, *, silent: str = "", seed: int = 1) -> None:
    """The plots of both radars, but none of the ``silent`` one, with a tick every second."""
    due_s = 1.0
    for batch in plots(until_s, seed):
        while ns(due_s) < batch.t_ns.max():
            realm.tick(due_s)
            due_s += 1.0
        if batch.sensor_id != silent:
            realm.plots(OWN[batch.sensor_id], batch)


def shown(realm: Realm) -> dict[str, float]:
    """When each unit showed a track for the last time, seconds."""
    return {name: max((f.t_ns - ns(0.0)) / 1e9 for f in frames if live(f)) for name, frames in realm.frames.items()}


@pytest.mark.parametrize("silent", ["", "east"])
def test_targets_that_nobody_sees_any_more_end_everywhere(silent: str) -> None:
    realm = ring()
    feed(realm, DIE_S, silent=silent)
    assert all(len(live(frames[-1])) == 4 for frames in realm.frames.values())
    for t in np.arange(DIE_S, DIE_S + 60.0).tolist():
        realm.tick(t)
    assert all(t_s <= DIE_S + 15.0 for t_s in shown(realm).values())
    assert all(len(one.inputs.banks[other].rows.ident) == 0 for one, other in banks(realm))


def banks(realm: Realm) -> list[tuple[Any, str]]:
    return [(realm.engines["first"], "second"), (realm.engines["second"], "first")]


def ring_of_three() -> Realm:
    """Of which only the first has a radar."""
    return Realm(
        unit("first", 1, NORTH, inputs=("third",)), unit("second", 2, inputs=("first",)),
        unit("third", 3, inputs=("second",)),
    )  # fmt: skip


def test_three_in_a_ring_of_which_one_sees() -> None:
    realm = ring_of_three()
    feed(realm, DIE_S, silent="east")
    assert all(len(live(frames[-1])) == 4 for frames in realm.frames.values())
    for t in np.arange(DIE_S, DIE_S + 60.0).tolist():
        realm.tick(t)
    assert all(t_s <= DIE_S + 15.0 for t_s in shown(realm).values())


def test_the_test_would_see_a_ghost(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = composition.Composition.complete

    def boast(self: Any, frame: TrackFrame, numbers: npt.NDArray[np.int64], t_s: float) -> TrackFrame:
        done = honest(self, frame, numbers, t_s)
        return done.model_copy(update={"updated_t_ns": np.full(len(numbers), done.t_ns)})

    monkeypatch.setattr(composition.Composition, "complete", boast)
    realm = ring_of_three()
    feed(realm, DIE_S, silent="east")
    for t in np.arange(DIE_S, DIE_S + 60.0).tolist():
        realm.tick(t)
    assert all(t_s > DIE_S + 50.0 for t_s in shown(realm).values())


# --- how sure they are ---


def consistency(realm: Realm) -> tuple[float, float]:
    """Mean NEES of position and velocity (4 if the covariance is right), and the least ratio of the volume of a
    position ellipse to that of a unit which has the plots of both radars."""
    nees, ratio = [], []
    central = engine(NORTH, EAST)
    for batch in plots(DIE_S):
        mine = OWN[batch.sensor_id]
        both = central.plots(batch)
        realm.plots(mine, batch)
        told = realm.frames[mine][-1]
        t_s = (told.t_ns - ns(0.0)) / 1e9
        if t_s < 25.0 or both is None:
            continue
        for place, velocity in zip(FAR_APART.at(t_s), FAR_APART.velocity, strict=True):
            k, _ = nearest(told, place)
            P = told.covariance_matrices()[k, :4, :4]
            error = told.state[k, :4] - np.concatenate([place, velocity])
            nees.append(error @ np.linalg.solve(P, error))
            ratio.append(area(P) / area(both.covariance_matrices()[nearest(both, place)[0], :4, :4]))
    return float(np.mean(nees)), float(np.min(ratio))


def area(P: FloatArray) -> float:
    return float(np.sqrt(np.linalg.det(P[:2, :2])))


def test_covariances_do_not_fall_below_what_the_plots_justify() -> None:
    nees, ratio = consistency(ring())
    assert nees < 4.0
    assert ratio > 0.9


def test_adding_up_information_would(monkeypatch: pytest.MonkeyPatch) -> None:
    def add_up(xa: FloatArray, Pa: FloatArray, xb: FloatArray, Pb: FloatArray) -> tuple[FloatArray, ...]:
        A, B = np.linalg.inv(Pa), np.linalg.inv(Pb)
        P = np.linalg.inv(A + B)
        return (P @ (A @ xa[:, :, None] + B @ xb[:, :, None]))[:, :, 0], P, np.ones(len(xa))

    monkeypatch.setattr(composition, "intersect", add_up)
    _, ratio = consistency(ring())
    assert ratio < 0.8


# --- biases ---


def biased_unit(**settings: Any) -> tuple[FusionEngine, int]:
    """A unit whose only radar is wrong by 400 m and .5 deg, with the tracks of a right one: and how many it shows."""
    realm = Realm(unit("first", 1, NORTH, inputs=()), unit("second", 2, EAST, inputs=("first",), **settings))
    for batch in plots(DIE_S):
        if batch.sensor_id == "east":
            wrong = batch.values + np.array([400.0, np.deg2rad(0.5)])
            batch = batch.model_copy(update={"values": wrong})
        realm.plots(OWN[batch.sensor_id], batch)
    return realm.engines["second"], len(live(realm.frames["second"][-1]))


def test_a_unit_learns_the_bias_of_its_radar_from_one_that_is_declared_right() -> None:
    tracker, tracks = biased_unit(input_reference=True, input_error_m=20.0)
    assert tracks == 4
    told = tracker.registration()
    assert told is not None
    of = {one.sensor_id: one for one in told.sensors}
    assert of["east"].locked
    assert abs(of["east"].bias[0] - 400.0) < 60.0 and abs(np.rad2deg(of["east"].bias[1]) - 0.5) < 0.06


def test_undeclared_it_does_not() -> None:
    tracker, tracks = biased_unit()
    assert tracks > 4
    told = tracker.registration()
    assert told is not None and not any(one.locked for one in told.sensors)


def test_of_two_that_take_each_other_s_tracks_only_the_one_with_the_higher_number_learns() -> None:
    how = {"input_reference": True, "input_error_m": 20.0}
    realm = Realm(unit("first", 1, NORTH, inputs=("second",), **how), unit("second", 2, EAST, inputs=("first",), **how))
    for batch in plots(40.0):
        realm.plots(OWN[batch.sensor_id], batch)
    pairs = {}
    for name, one in realm.engines.items():
        told = one.registration()
        assert told is not None
        pairs[name] = sum(sensor.pairs for sensor in told.sensors)
    assert pairs["first"] == 0 and pairs["second"] > 0
