"""Tags over a real network: readers as a process, the service as another, killed and started again."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.network.processes import Process, Processes, RouterProcess, wait_until
from tests.network.realm import READY_S, next_where
from typer.testing import CliRunner, Result

from trackmesh.protocol.client import Client
from trackmesh.protocol.files import read_records, to_line
from trackmesh.protocol.messages import LOCATED, LOST, ServiceStatus, TagFrame
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.cli.main import app
from trackmesh.sim.recording import START_NS
from trackmesh.sim.scenario import load_scenario
from trackmesh.sim.tags import TagWorld

CONFIG = "[engine]\nlost_s = 2.0\nframe_period_s = 0.1\nidle_frame_s = 0.2\n"
TAGS = 8


class Hall:
    """One key space at one router, with the scenario's readers and a tag service."""

    def __init__(self, processes: Processes, router: RouterProcess, realm: str, folder: Path) -> None:
        self._processes = processes
        self._realm = realm
        self.config = folder / "tags.toml"
        self.config.write_text(CONFIG)
        self.endpoint = router.endpoint
        self.start_ns = time.time_ns()

    def trackmesh(self, *arguments: str) -> Process:
        network = ("--connect", self.endpoint, "--realm", self._realm)
        return self._processes.start("-m", "trackmesh.services.cli.main", *arguments, *network)

    def readers(self, *more: str) -> Process:
        start = ("--seed", "3", "--start-ns", str(self.start_ns))
        return self.trackmesh("sim", "tags", "--scenario", "two-radars", *start, *more)

    def service(self, client: Client, *more: str) -> tuple[Process, ServiceStatus]:
        """Start the service; it, and its status once it is ready."""
        with client.watch_statuses("tags") as watch:
            process = self.trackmesh("tags", "--config", str(self.config), *more)
            ready = next_where(watch, lambda s: s.state == "ready", "the service is ready", READY_S)
        return process, ready

    def command(self, *arguments: str) -> Result:
        return CliRunner().invoke(app, [*arguments, "--connect", self.endpoint, "--realm", self._realm])


@pytest.fixture
def client(router: RouterProcess, request: pytest.FixtureRequest) -> Iterator[Client]:
    with ZenohBus.open([router.endpoint], timeout_s=10.0) as bus:
        yield Client(bus, request.node.name.replace("_", "-")[:60])


@pytest.fixture
def hall(processes: Processes, router: RouterProcess, client: Client, tmp_path: Path) -> Hall:
    return Hall(processes, router, client.keys.realm, tmp_path)


def located(frame: TagFrame) -> bool:
    return len(frame.tag_id) == TAGS and bool((frame.status == LOCATED).all())


@pytest.mark.timeout(READY_S + 120)
def test_tags_are_located_lost_with_their_readers_and_found_again(hall: Hall, client: Client, tmp_path: Path) -> None:
    box = tmp_path / "box.jsonl"
    with client.watch_tags(history=False) as frames, client.watch_statuses("tags") as statuses:
        service, _ = hall.service(client, "--black-box", str(box))
        readers = hall.readers()
        captured = [next_where(frames, located, "all tags are located", 30.0)]
        world = TagWorld(load_scenario("two-radars"), 3)
        frame = next_where(frames, lambda f: f.t_ns > captured[0].t_ns + 3_000_000_000, "a later frame", 20.0)
        truth = world.paths.positions((frame.t_ns - hall.start_ns) / 1e9)
        error = frame.state[:, :2] - truth[[int(name[4:]) - 1 for name in frame.tag_id]]
        assert np.sqrt((error**2).sum(1).mean()) < 6.0
        next_where(statuses, lambda s: s.figures.get("readers_alive") == 19, "all readers are alive", 10.0)
        assert len(client.sensors()) == 19
        # The whole network dies at once.
        readers.kill()
        next_where(frames, lambda f: len(f.status) > 0 and bool((f.status == LOST).all()), "all are lost", 15.0)
        next_where(statuses, lambda s: s.figures["readers_alive"] == 0, "no reader is alive", 15.0)
        hall.readers()
        next_where(frames, located, "all are located again", 30.0)
        last = next_where(frames, lambda _: True, "a frame", 5.0)
        assert service.stop() == 0
    assert "Traceback" not in service.output and "ERROR" not in service.output
    # The box gives what was published, to the byte.
    out = tmp_path / "tags.jsonl"
    result = CliRunner().invoke(app, ["locate", str(box), "--out", str(out)])
    assert result.exit_code == 0, result.output
    lines = out.read_text().splitlines()
    for frame in (captured[0], last):
        assert to_line(frame) in lines


@pytest.mark.timeout(READY_S + 120)
def test_a_killed_service_is_replaced_and_readers_from_a_file_do(hall: Hall, client: Client, tmp_path: Path) -> None:
    table = load_scenario("two-radars").heard_tags()
    path = tmp_path / "readers.toml"
    path.write_text(
        "[defaults]\nmax_range_m = 30.0\nsigma_m = 2.0\n"
        + "".join(f'[[readers]]\nid = "{r.id}"\nsite_enu_m = {list(r.site_enu_m)}\n' for r in table.readers)
    )
    hall.readers("--silent")
    first, _ = hall.service(client, "--readers", str(path))
    with client.watch_tags(history=False) as frames:
        before = next_where(frames, located, "all tags are located", 30.0)
        assert client.sensors() == []
        first.kill()
        hall.trackmesh("tags", "--readers", str(path))
        after = next_where(frames, lambda f: f.boot_id != before.boot_id and located(f), "found again", READY_S)
    assert after.seq >= 0
    # And people can watch it.
    watched = hall.command("watch", "--tags", "--seconds", "1.5")
    assert watched.exit_code == 0
    assert json.loads(watched.stdout.splitlines()[0])["type"] == "tags"
    shown = hall.command("status")
    assert "located" not in shown.output and "hall" in shown.output and "ranges" in shown.output
    file = tmp_path / "seen.jsonl"
    assert hall.command("watch", "--tags", "--seconds", "1", "--out", str(file)).exit_code == 0
    assert list(read_records(file, TagFrame))


def test_a_file_that_is_missing_is_one_sentence(hall: Hall) -> None:
    process = hall.trackmesh("tags", "--readers", "missing.toml")
    wait_until(lambda: not process.running, "the service gives up", 30.0)
    assert process.stop() == 1
    assert "Cannot read missing.toml" in process.output and "Traceback" not in process.output


@pytest.mark.timeout(READY_S + 120)
def test_a_recording_of_ranges_is_played(hall: Hall, client: Client, tmp_path: Path) -> None:
    ranges, tags = tmp_path / "ranges.jsonl", tmp_path / "tags.jsonl"
    made = CliRunner().invoke(app, ["sim", "ranges", str(ranges), "--seconds", "10"])
    assert made.exit_code == 0, made.output
    hall.service(client, "--clock", "data")
    with client.watch_tags(history=False, capacity=100_000) as frames:
        player = hall.trackmesh("play", str(ranges), "--speed", "0", "--keep-time")
        end_ns = START_NS + 9_500_000_000
        last = next_where(frames, lambda f: f.tag_id == ["tag-1"] and f.t_ns > end_ns, "the end", 40.0)
        wait_until(lambda: not player.running, "the player has ended", 20.0)
    assert player.stop() == 0 and "101 batches published" in player.output
    located = CliRunner().invoke(app, ["locate", str(ranges), "--out", str(tags), "--config", str(hall.config)])
    assert located.exit_code == 0, located.output
    here = {frame.t_ns: frame for frame in read_records(tags, TagFrame) if isinstance(frame, TagFrame)}
    # The first ranges may have come before the readers were known.
    np.testing.assert_allclose(last.state[:, :2], here[last.t_ns].state[:, :2], atol=0.1)
