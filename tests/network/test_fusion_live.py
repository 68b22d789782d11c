"""Fusion units at work: what they publish, what a late joiner gets, what the death of a part does to the others."""

from __future__ import annotations

import contextlib
import itertools
import json
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.network.processes import Processes, wait_until
from tests.network.realm import RADARS, TARGETS, Realm, confirmed, next_where, wait_for_tracks
from typer.testing import CliRunner, Result

from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode
from trackmesh.protocol.errors import Unavailable
from trackmesh.protocol.files import from_line, read_records, to_line
from trackmesh.protocol.messages import COASTING, PlotBatch, SensorInfo, ServiceStatus, TrackFrame, TrackQuery
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.cli.main import app

LEASE_S = 2.0
MARGIN_S = 3.0


def trackmesh(*arguments: str) -> Result:
    """A command in this process."""
    return CliRunner().invoke(app, arguments)


def alive(status: ServiceStatus) -> dict[str, bool]:
    """Which sensors a unit holds for alive."""
    return {sensor.sensor_id: sensor.alive for sensor in status.sensors}


# --- one run from start to end: the sensors die, then the unit is stopped


@dataclass
class Run:
    """What was captured of it, and what its black box gives.

    Attributes:
        coasted: the ids that were confirmed when the sensors died.
        after: the status that told their death.
    """

    captured: list[TrackFrame]
    offline: list[str]
    coasted: set[int]
    after: ServiceStatus
    exit_code: int
    log: str


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("run")
    processes = Processes(folder)
    try:
        yield _whole_run(processes, folder)
    finally:
        processes.close()


def _whole_run(processes: Processes, folder: Path) -> Run:
    realm = Realm(processes, processes.router(), folder)
    box, tracks = folder / "black-box.jsonl", folder / "tracks.jsonl"
    with ZenohBus.open([realm.endpoint], timeout_s=10.0) as bus:
        client = Client(bus)
        with client.watch_tracks(history=False) as frames, client.watch_statuses("fusion") as statuses:
            fusion, _ = realm.fusion(client, "main", 0, "--black-box", str(box))
            radars = realm.radars()
            captured: list[TrackFrame] = []
            while not captured or len(confirmed(captured[-1])) < TARGETS:
                captured.append(next_where(frames, lambda _: True, "a frame", 60.0))
            ids = confirmed(captured[-1])
            next_where(statuses, lambda s: alive(s) == dict.fromkeys(RADARS, True), "both sensors alive", 10.0)
            # One dies at once, the other falls silent with its connections open.
            radars["east"].kill()
            radars["north"].send(signal.SIGSTOP)
            after = next_where(
                statuses, lambda s: alive(s) == dict.fromkeys(RADARS, False), "both sensors gone", LEASE_S + MARGIN_S
            )
            while not (captured[-1].status == COASTING).all():
                captured.append(next_where(frames, lambda _: True, "a frame", 10.0))
            exit_code = fusion.stop()
            captured += iter(lambda: frames.receive(0.3), None)
    result = trackmesh("track", str(box), "--out", str(tracks))
    assert result.exit_code == 0, result.output
    return Run(captured, tracks.read_text().splitlines(), ids, after, exit_code, fusion.output)


def test_the_black_box_gives_exactly_the_frames_that_were_published(run: Run) -> None:
    numbers = [frame.seq for frame in run.captured]
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert len(numbers) > 20
    first = next(i for i, line in enumerate(run.offline) if json.loads(line)["seq"] == numbers[0])
    assert [to_line(frame) for frame in run.captured] == run.offline[first : first + len(numbers)]


def test_dead_sensors_are_told_and_their_tracks_coast(run: Run) -> None:
    assert alive(run.after) == dict.fromkeys(RADARS, False)
    last = run.captured[-1]
    assert run.coasted <= set(last.track_id.tolist())
    assert set(last.status.tolist()) == {COASTING}
    assert (last.updated_t_ns < last.t_ns).all()


def test_a_unit_ends_well(run: Run) -> None:
    assert run.exit_code == 0
    assert "Traceback" not in run.log and "ERROR" not in run.log


# --- a realm that lives as long as this file


@pytest.fixture(scope="module")
def realm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Realm]:
    folder = tmp_path_factory.mktemp("realm")
    processes = Processes(folder)
    try:
        realm = Realm(processes, processes.router(), folder)
        with ZenohBus.open([realm.endpoint], timeout_s=10.0) as bus:
            realm.main, _ = realm.fusion(Client(bus))
            realm.sensors = realm.radars()
            wait_for_tracks(Client(bus))
        yield realm
    finally:
        processes.close()


@pytest.fixture
def client(realm: Realm) -> Iterator[Client]:
    with ZenohBus.open([realm.endpoint], timeout_s=10.0) as bus:
        yield Client(bus)


def test_a_late_joiner_gets_the_picture_and_the_sensors_at_once(realm: Realm, client: Client) -> None:
    now = client.watch_tracks("main", history=False).receive(10.0)
    assert now is not None
    with ZenohBus.open([realm.endpoint], timeout_s=10.0) as bus, Client(bus).watch_tracks("main") as frames:
        first = frames.receive(10.0)
        next_where(frames, lambda f: f.seq == now.seq, "the picture of before", 10.0)
        infos = bus.subscribe(client.keys.sensor("*"), history=True)
        samples = [infos.receive(10.0) for _ in RADARS]
    # It was published before the joiner came.
    assert first is not None and first.seq < now.seq
    assert {decode(s.payload, SensorInfo, s.encoding).sensor_id for s in samples if s} == set(RADARS)


def test_a_question_to_nobody_says_who_is_not_alive(realm: Realm, client: Client) -> None:
    with pytest.raises(Unavailable, match=r"^The fusion service west is not alive; alive: main\.$"):
        client.query_tracks(unit="west")
    with pytest.raises(Unavailable, match=r"^No fusion service is alive\.$"):
        Client(client.bus, "elsewhere").query_tracks()
    result = trackmesh("tracks", "--unit", "west", "--connect", realm.endpoint)
    assert result.exit_code == 1
    assert result.stderr == "trackmesh: The fusion service west is not alive; alive: main.\n"


def test_two_units_in_one_realm(realm: Realm, client: Client) -> None:
    west, _ = realm.fusion(client, "west", 1)
    try:
        wait_for_tracks(client, "main")
        wait_for_tracks(client, "west")
        main, second = client.query_tracks()
    finally:
        assert west.stop() == 0
    assert (main.unit_id, second.unit_id) == ("main", "west")
    assert len(main.track_id) >= TARGETS and len(second.track_id) >= TARGETS
    assert not set(main.track_id.tolist()) & set(second.track_id.tolist())
    assert set((main.track_id >> 41).tolist()) == {0} and set((second.track_id >> 41).tolist()) == {1}


def test_a_killed_unit_comes_back_with_its_tracks_under_new_ids(realm: Realm, client: Client, tmp_path: Path) -> None:
    before = wait_for_tracks(client)
    sent = {sensor.sensor_id: sensor.boot_id for sensor in _batches_of(client)}
    realm.main.kill()
    died_ns = time.time_ns()
    box = tmp_path / "black-box.jsonl"
    realm.main, ready = realm.fusion(client, "main", 0, "--black-box", str(box))
    after = wait_for_tracks(client)
    with client.watch_statuses("fusion") as statuses:
        heard = next_where(statuses, lambda s: alive(s) == dict.fromkeys(RADARS, True), "both sensors heard", 20.0)
    assert ready.boot_id == after.boot_id != before.boot_id
    assert min(confirmed(after)) > max(before.track_id.tolist())
    # The sensors went on, and the new unit got what they had kept.
    assert all(sensor.running for sensor in realm.sensors.values())
    assert [sensor.gaps for sensor in heard.sensors] == [0, 0]
    taken = [record for record in read_records(box) if isinstance(record, PlotBatch)]
    assert {batch.sensor_id: batch.boot_id for batch in taken} == sent
    for name in RADARS:
        of_one = [batch for batch in taken if batch.sensor_id == name]
        assert min(int(batch.t_ns.min()) for batch in of_one if batch.t_ns.size) < died_ns
        assert all(b.seq == a.seq + 1 for a, b in itertools.pairwise(of_one))


def _batches_of(client: Client) -> list[PlotBatch]:
    """A batch of each sensor."""
    found: dict[str, PlotBatch] = {}
    with contextlib.closing(client.bus.subscribe(client.keys.plots("*"))) as plots:
        while found.keys() != set(RADARS):
            sample = plots.receive(10.0)
            assert sample is not None, f"no plots but of {sorted(found)}"
            batch = decode(sample.payload, PlotBatch, sample.encoding)
            found[batch.sensor_id] = batch
    return list(found.values())


# --- the commands that ask a running realm


def asked(realm: Realm, *arguments: str) -> Result:
    result = trackmesh(*arguments, "--connect", realm.endpoint)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    return result


def frames_in(result: Result) -> list[TrackFrame]:
    frames = [from_line(line) for line in result.stdout.splitlines()]
    return [frame for frame in frames if isinstance(frame, TrackFrame)]


def test_status_shows_services_and_what_they_hear(realm: Realm) -> None:
    def told() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = json.loads(asked(realm, "status", "--json").stdout)
        return found

    wait_until(lambda: told()[0]["figures"].get("tracks", 0.0) >= TARGETS, "the status counts all tracks", 30.0)
    services = told()
    kinds = [(service["kind"], service["unit_id"]) for service in services]
    assert kinds == [("fusion", "main"), ("sim-radar", "east"), ("sim-radar", "north")]
    assert services[0]["state"] == "ready" and services[0]["counters"]["frames"] > 0
    assert [sensor["sensor_id"] for sensor in services[0]["sensors"]] == ["east", "north"]
    table = asked(realm, "status").stdout
    assert "fusion" in table and "sim-radar" in table and "north" in table


def test_sensors_lists_who_is_there(realm: Realm) -> None:
    sensors = json.loads(asked(realm, "sensors", "--json").stdout)
    assert [(s["sensor_id"], s["alive"], s["period_s"]) for s in sensors] == [
        ("east", True, 1.25),
        ("north", True, 1.0),
    ]
    assert "10.0 km E, 5.0 km N" in asked(realm, "sensors").stdout


def test_tracks_shows_the_picture_or_a_part_of_it(realm: Realm, client: Client) -> None:
    wait_for_tracks(client)
    (whole,) = frames_in(asked(realm, "tracks", "--json"))
    assert len(whole.track_id) >= TARGETS
    (right,) = frames_in(asked(realm, "tracks", "--json", "--bbox", "0,-1e6,1e6,1e6"))
    (left,) = frames_in(asked(realm, "tracks", "--json", "--bbox=-1e6,-1e6,0,1e6"))
    assert (right.state[:, 0] >= 0).all() and (left.state[:, 0] <= 0).all()
    one = int(whole.track_id[0])
    (alone,) = frames_in(asked(realm, "tracks", "--json", "--id", str(one)))
    assert alone.track_id.tolist() == [one]
    assert str(one) in asked(realm, "tracks").stdout


@pytest.mark.parametrize("relative", [True, False])
def test_tracks_at_a_time_to_come(realm: Realm, client: Client, relative: bool) -> None:
    wait_for_tracks(client)
    at = "+100" if relative else str(time.time() + 100.0)
    (then,) = frames_in(asked(realm, "tracks", "--json", "--at", at))
    (now,) = client.query_tracks(TrackQuery(track_ids=then.track_id.tolist()))
    dt_s = (then.t_ns - now.t_ns) / 1e9
    assert 90.0 < dt_s < 110.0
    rows = [then.track_id.tolist().index(ident) for ident in now.track_id.tolist()]
    moved_m = np.linalg.norm(then.state[rows, :2] - now.state[:, :2], axis=1)
    assert (moved_m > 5000.0).all() and (moved_m < 25_000.0).all()


def test_watch_writes_frames_to_a_file_or_a_pipe(realm: Realm, client: Client, tmp_path: Path) -> None:
    wait_for_tracks(client)
    path = tmp_path / "tracks.jsonl"
    assert asked(realm, "watch", "--out", str(path), "--seconds", "1").stdout == ""
    written = [record.seq for record in read_records(path, TrackFrame) if isinstance(record, TrackFrame)]
    assert written == list(range(written[0], written[0] + len(written)))
    # Not a terminal: lines that programs can read.
    assert frames_in(asked(realm, "watch", "--seconds", "1"))
