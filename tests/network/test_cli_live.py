"""Commands that bring something into a running deployment: a recording that is played, scans to be inverted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.network.processes import Processes, RouterProcess, wait_until
from tests.network.realm import READY_S, TARGETS, Realm, next_where
from typer.testing import CliRunner, Result

from trackmesh.protocol.client import Client
from trackmesh.protocol.files import from_line, read_records
from trackmesh.protocol.messages import EmiResult, PlotBatch, TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.cli.main import app


def good(*arguments: object) -> Result:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result


def test_a_recording_played_as_fast_as_possible_gives_its_picture(
    processes: Processes, router: RouterProcess, tmp_path: Path
) -> None:
    realm, name = Realm(processes, router, tmp_path), "played"
    plots, tracks = tmp_path / "plots.jsonl", tmp_path / "tracks.jsonl"
    good("sim", "record", plots, "--scenario", realm.scenario, "--seconds", 20)
    good("track", plots, "--out", tracks)
    expected = [frame for frame in read_records(tracks, TrackFrame) if isinstance(frame, TrackFrame)]
    with ZenohBus.open([router.endpoint], timeout_s=10.0) as bus:
        client = Client(bus, name)
        realm.fusion(client, "main", 0, "--realm", name, "--clock", "data")
        with client.watch_tracks() as frames, client.watch_statuses("fusion") as statuses:
            player = realm.trackmesh("play", str(plots), "--speed", "0", "--realm", name)
            last = next_where(frames, lambda f: f.seq == len(expected) - 1, "the last frame", 30.0)
            wait_until(lambda: not player.running, "the player has ended", 30.0)
            status = next_where(statuses, lambda s: s.counters.get("frames") == len(expected), "the last status", 10.0)
    batches = sum(isinstance(record, PlotBatch) for record in read_records(plots))
    assert player.stop() == 0 and player.output == f"{batches} batches published\n"
    assert sum(s.batches for s in status.sensors) == batches
    assert [(s.gaps, s.refused) for s in status.sensors] == [(0, 0)] * 2
    assert len(last.track_id) == TARGETS == len(expected[-1].track_id)
    played, recorded = (np.sort(frame.state[:, 0]) for frame in (last, expected[-1]))
    assert np.abs(played - recorded).max() < 1.0


def test_scans_are_inverted_by_a_service_as_they_are_here(
    processes: Processes, router: RouterProcess, tmp_path: Path
) -> None:
    realm, scans = Realm(processes, router, tmp_path), tmp_path / "scans.jsonl"
    good("sim", "emi", scans)
    with ZenohBus.open([router.endpoint], timeout_s=10.0) as bus, Client(bus).watch_statuses("emi") as statuses:
        realm.trackmesh("emi")
        next_where(statuses, lambda s: s.state == "ready", "the EMI service is ready", READY_S)
    asked = good("invert", scans, "--json", "--connect", router.endpoint).stdout.splitlines()
    here = good("invert", scans, "--json", "--local").stdout.splitlines()
    assert len(asked) == len(here) == 3
    for line, other in zip(asked, here, strict=True):
        there, local = from_line(line), from_line(other)
        assert isinstance(there, EmiResult) and isinstance(local, EmiResult)
        assert there.status == local.status == "ok"
        assert there.targets[0].position_m == pytest.approx(local.targets[0].position_m)
