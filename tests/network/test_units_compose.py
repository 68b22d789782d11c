"""Two units over Zenoh: the second has a radar of short reach, and the rest of the targets from the first."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.network.processes import Processes
from tests.network.realm import TARGETS, Realm, confirmed, next_where, wait_for_tracks

from trackmesh.protocol.client import Client
from trackmesh.protocol.messages import ServiceStatus, TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus

NORTH_REACHES_ALL, EAST_REACHES = "max_range_m = 120e3", "max_range_m = 45e3"


@pytest.fixture
def realm(processes: Processes, tmp_path: Path) -> Realm:
    made = Realm(processes, processes.router(), tmp_path)
    before, _, after = made.scenario.read_text().rpartition(NORTH_REACHES_ALL)
    made.scenario.write_text(before + EAST_REACHES + after)
    return made


@pytest.fixture
def client(realm: Realm) -> Iterator[Client]:
    with ZenohBus.open([realm.endpoint], timeout_s=10.0) as bus:
        yield Client(bus)


def column(frame: TrackFrame, name: str) -> set[int]:
    """Ids of the tracks with a member in this column."""
    return set(frame.track_id[frame.members[:, frame.sensors.index(name)] >= 0].tolist())


def input_of(status: ServiceStatus) -> dict[str, bool]:
    return {sensor.sensor_id: sensor.alive for sensor in status.sensors}


def test_a_unit_has_the_targets_of_another_and_keeps_their_numbers(realm: Realm, client: Client) -> None:
    first, _ = realm.fusion(client, "first", 1, "--sensors", "north")
    second, _ = realm.fusion(client, "second", 2, "--sensors", "east", "--inputs", "first")
    realm.radars()
    wait_for_tracks(client, "first")
    with client.watch_tracks("second") as frames, client.watch_statuses("fusion", "second") as statuses:
        both = next_where(
            frames,
            lambda f: len(confirmed(f)) == TARGETS == len(column(f, "first")) and 0 < len(column(f, "east")) < TARGETS,
            "the second has all targets, a part of them from its own radar",
            40.0,
        )
        assert both.sensors == ["first", "east"]
        assert {int(k) >> 41 for k in both.track_id} == {2}
        told = next_where(statuses, lambda s: "first" in input_of(s), "the input is told of", 5.0)
        assert input_of(told) == {"east": True, "first": True}
        # Nobody's track twice: two that are one would stand within metres of each other.
        apart = np.linalg.norm(both.state[:, None, :2] - both.state[None, :, :2], axis=2)
        assert apart[~np.eye(TARGETS, dtype=bool)].min() > 300.0

        own = column(both, "east")
        first.kill()
        next_where(statuses, lambda s: not input_of(s)["first"], "the first unit is gone", 5.0)
        left = next_where(frames, lambda f: not column(f, "first"), "its tracks are gone too", 30.0)
    assert own & set(left.track_id.tolist())
    assert len(left.track_id) < TARGETS
    assert second.stop() == 0
    assert "Traceback" not in second.output and "ERROR" not in second.output
