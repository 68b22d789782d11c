"""Units as services on a bus in memory: what they tell each other, what they refuse, who goes on for whom."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from tests.network.processes import ROOT, wait_until
from tests.services.fusion.makers import radar
from tests.services.fusion.running import KEYS, Running

from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.memory_bus import MemoryHub
from trackmesh.protocol.messages import BandFrame, Geodetic, PlotBatch
from trackmesh.services.fusion.partition.engine import PartitionedEngine
from trackmesh.services.fusion.settings import FusionSettings
from trackmesh.services.runtime import SettingsError

WEST, EAST = {"centre_enu_m": [-20e3, 0.0]}, {"centre_enu_m": [20e3, 0.0]}
BAND = encoding(BandFrame)


def unit(hub: MemoryHub, name: str, number: int, partition: dict[str, Any], **more: Any) -> Running:
    engine = {"cycle_s": 0.4, "confirm_hits": 3} | more.pop("engine", {})
    return Running("wall", hub=hub, unit_id=name, unit_number=number, partition=partition, engine=engine, **more)


def engine_of(running: Running) -> PartitionedEngine:
    engine = running.service.engine
    assert isinstance(engine, PartitionedEngine)
    return engine


class Targets:
    """Three targets, one of them in the east, seen by one radar twice a second."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._seq = 0
        self._began_s = time.time()
        self.info = radar("north", period_s=0.5, max_range_m=60e3, sigma={"range_m": 20.0, "azimuth_rad": 1e-4})
        running.put(KEYS.sensor("north"), encode(self.info), encoding(self.info))

    def look(self) -> None:
        flown = np.array([50.0 * (time.time() - self._began_s), 0.0])
        place = np.array([[-21e3, 5e3], [21e3, 5e3], [-22e3, -9e3]]) + flown
        values = np.stack([np.hypot(*place.T), np.arctan2(*place.T) % (2 * np.pi)], axis=1)
        batch = PlotBatch(
            sensor_id="north", boot_id="one", seq=self._seq, t_ns=np.full(len(place), time.time_ns()),
            columns=["range_m", "azimuth_rad"], values=values,
        )  # fmt: skip
        self._seq += 1
        self._running.put(KEYS.plots("north"), encode(batch), encoding(batch))

    def until(self, condition: Any, what: str, timeout_s: float = 20.0) -> None:
        due = [time.monotonic()]

        def looked() -> bool:
            if time.monotonic() >= due[0]:
                due[0] += 0.5
                self.look()
            return bool(condition())

        wait_until(looked, what, timeout_s)


def shown(running: Running) -> set[int]:
    """Ids that the unit answers with."""
    frames = running.client.query_tracks(unit=running.runtime.settings.unit_id)
    return {int(ident) for one in frames for ident in one.track_id}


def test_two_units_share_the_targets_and_one_goes_on_for_the_other() -> None:
    hub = MemoryHub()
    settings: dict[str, Any] = {"confirm_s": 1.0}
    with unit(hub, "west", 1, WEST | settings) as west:
        east = unit(hub, "east", 2, EAST | settings)
        east.__enter__()
        targets = Targets(west)
        both = lambda: engine_of(west).neighbours.owning() and engine_of(east).neighbours.owning()  # noqa: E731
        targets.until(both, "both own their areas")
        targets.until(lambda: len(shown(west)) == 2 and len(shown(east)) == 1, "each shows its targets")
        ours, theirs = shown(west), shown(east)
        assert {ident >> 41 for ident in ours} == {1} and {ident >> 41 for ident in theirs} == {2}
        assert west.service._plots.sensors == {"north"}  # type: ignore[union-attr]
        east.__exit__()
        targets.until(lambda: shown(west) == ours | theirs, "west goes on with the tracks of east")
        assert engine_of(west).counters["inherited"] + engine_of(west).counters["taken_over"] >= 1


def test_of_two_units_with_one_number_the_younger_stops() -> None:
    hub = MemoryHub()
    with unit(hub, "west", 1, WEST) as west:
        Targets(west).until(engine_of(west).neighbours.owning, "west owns its area")
        young = unit(hub, "young", 1, EAST)
        young.runtime.start()
        young.service.start()
        wait_until(young.runtime.stopping.is_set, "the younger stops")
        young.runtime.close()
        assert young.runtime.exit_code == 1
        assert "both have the unit_number 1" in str(engine_of(young).neighbours.conflict)
        assert not west.runtime.stopping.is_set()
        assert west.refused.get("same_number", 0) >= 0


def test_wrong_band_messages_are_refused_by_reason() -> None:
    hub = MemoryHub()
    with unit(hub, "west", 1, WEST, origin={"latitude_deg": 48.0, "longitude_deg": 11.0}) as west:
        bands = west.bus.subscribe(KEYS.band("west"), history=True)
        wait_until(lambda: engine_of(west).now_ns is not None, "time passes")
        sample = bands.receive(timeout_s=10.0)
        assert sample is not None
        good = decode(sample.payload, BandFrame, sample.encoding).model_copy(update={"unit_id": "other"})
        number = {"area": good.area.model_copy(update={"unit_number": 2})}
        elsewhere = good.area.model_copy(
            update={"unit_number": 2, "origin": Geodetic(latitude_deg=10.0, longitude_deg=0.0, height_m=0.0)}
        )
        corners = np.array([[0.0, 0.0], [9e3, 0.0], [1e3, 1e3], [0.0, 9e3]])
        bent = number["area"].model_copy(update={"polygon_enu_m": corners})
        for payload, kind in [
            (encode(good.model_copy(update=number)), BAND),
            (encode(good.model_copy(update=number)), BAND),
            (encode(good.model_copy(update={"area": elsewhere})), BAND),
            (encode(good.model_copy(update=number | {"unit_id": "someone"})), BAND),
            (encode(good.model_copy(update={"area": bent, "seq": good.seq + 1})), BAND),
            (b"rubbish", BAND),
        ]:
            west.put(KEYS.band("other"), payload, kind)
        expected = {"old_frame": 1, "other_origin": 1, "wrong_unit": 1, "malformed": 1, "wrong_area": 1}
        wait_until(lambda: expected.items() <= west.refused.items(), "all are refused")
        assert engine_of(west).counters["band_messages"] == 1


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"partition": WEST | {"width_m": 1000.0}}, "a band 1000 m wide is too narrow for handovers 1000 m deep"),
        ({"partition": {}}, "a unit has one of centre_enu_m, centre_deg, polygon_enu_m and polygon_deg"),
        ({"partition": {"centre_deg": [48.0, 11.0]}}, "needs the setting origin"),
        ({"partition": {"polygon_enu_m": [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]}}, "a polygon must be convex"),
        ({"partition": WEST, "inputs": ["other"]}, "takes no tracks of other units"),
        ({"partition": WEST, "engine": {"filter": "alpha-beta"}}, "remembers no plots"),
        ({"partition": WEST, "engine": {"ring_system": 8}}, "ring_system must be 16"),
        ({"partition": WEST, "black_box": "box.jsonl"}, "keeps no black box"),
    ],
)
def test_settings_that_cannot_work_are_refused_in_one_sentence(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SettingsError) as error:
        FusionSettings.load(None, change)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["west", "east"])
def test_the_examples_can_be_used(name: str) -> None:
    known = FusionSettings.load(ROOT / "examples" / f"{name}.toml")
    assert known.unit_id == name and known.partition is not None
    assert known.band_width_m() == pytest.approx(7563.0, abs=1.0)


def test_the_band_is_as_wide_as_the_settings_need() -> None:
    known = FusionSettings(partition=WEST)
    assert known.band_width_m() == pytest.approx(1000 + 250 * 19 + 4.5 * 150 + 300 + np.deg2rad(0.6) * 80e3)
    slow = {"speed_max_mps": 20.0, "handover_m": 100.0, "sigma_m": 20.0, "reach_m": 20e3}
    marine = FusionSettings(partition=WEST | slow, engine={"bias_range_m": 50.0, "bias_azimuth_deg": 0.3})
    assert 500.0 < marine.band_width_m() < 1500.0


def test_areas_in_degrees_lie_in_the_plane_of_the_origin() -> None:
    origin = {"latitude_deg": 48.0, "longitude_deg": 11.0}
    known = FusionSettings(partition={"centre_deg": [48.1, 11.0]}, origin=origin)
    assert known.partition is not None
    place = known.partition.place(known.origin)
    np.testing.assert_allclose(place.centre_m, [0.0, 11_120.0], atol=10.0)
