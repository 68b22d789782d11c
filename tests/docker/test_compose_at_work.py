"""What the compose files start, started as processes of this host: their commands, certificates and routers' rules.

Run by ``make docker-check``: it takes a minute a file, and two where the numerics have to be compiled.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.docker.files import COMPOSE, read_yaml, who_runs
from tests.network.processes import Processes, free_port, processes
from tests.network.realm import READY_S, confirmed, next_where
from tests.network.secured import Deployment

from trackmesh.protocol.client import Client
from trackmesh.services.deployment.plan import Plan, load_plan
from trackmesh.sim.emi import scenario_scans
from trackmesh.sim.scenario import load_scenario

__all__ = ["processes"]

pytestmark = pytest.mark.skipif("TRACKMESH_DOCKER_CHECK" not in os.environ, reason="`make docker-check` runs it")

STATE = "/var/lib/trackmesh"
TRACKS = 25


def on_this_host(plan: Plan) -> Plan:
    """The plan with its routers at ports of this host."""
    ports = {name: free_port() for name in plan.routers}
    reached = {host: ports[name] for name, router in plan.routers.items() for host in router.hosts}
    routers = {
        name: router.model_copy(
            update={
                "listen": [f"tls/127.0.0.1:{ports[name]}"],
                "hosts": [*router.hosts, "127.0.0.1"],
                "connect": [f"tls/127.0.0.1:{reached[one.split('/')[1].split(':')[0]]}" for one in router.connect],
            }
        )
        for name, router in plan.routers.items()
    }
    return plan.model_copy(update={"routers": routers})


def services(compose: dict[str, Any]) -> Iterator[tuple[list[str], str]]:
    """Commands that `up` starts, and the host of the router that each connects to."""
    for service in compose["services"].values():
        if service["image"].startswith("trackmesh:") and "profiles" not in service:
            endpoint = service["environment"]["TRACKMESH_CONNECT"]
            yield service["command"], endpoint.removeprefix("tls/").partition(":")[0]


@pytest.mark.parametrize("path", COMPOSE.values(), ids=COMPOSE)
def test_it_does_what_it_should(path: Path, processes: Processes, tmp_path: Path) -> None:
    (compose,) = read_yaml(path)
    made = Deployment(on_this_host(load_plan(path.parent / "deployment.toml")), tmp_path / "certs")
    at = {host: router.listen[0] for router in made.plan.routers.values() for host in router.hosts}
    for name in made.plan.routers:
        made.router(processes, name)
    with made.bus("viewer.ops", next(iter(at.values()))) as bus:
        client, units = Client(bus), []
        with client.watch_statuses() as watch:
            for command, host in services(compose):
                who = who_runs(command)
                config = made.settings(who.common_name, at[host])
                arguments = [part.replace(STATE, str(tmp_path)) for part in command]
                processes.start("-m", "trackmesh.services.cli.main", *arguments, "--config", str(config))
                units += [who.name] * (who.role == "fusion")
            waiting = {(who.role, who.name) for who in made.plan.everybody() if who.role in {"fusion", "tags", "emi"}}
            while waiting:
                ready = next_where(watch, lambda status: status.state == "ready", f"{waiting} are ready", READY_S)
                waiting.discard((ready.kind, ready.unit_id))
        for unit in units:
            with client.watch_tracks(unit) as frames:
                next_where(frames, lambda frame: len(confirmed(frame)) >= TRACKS, f"{unit} has tracks", 90.0)
        assert not any(any(status.refused.values()) for status in client.statuses())
        if made.plan.participants.get("tags"):
            with client.watch_tags() as tags:
                next_where(tags, lambda frame: len(frame.tag_id) >= 8, "tags are there", 60.0)
        if made.plan.participants.get("emi"):
            world = load_scenario("two-radars")
            assert world.emi is not None
            scans = scenario_scans(world.emi, 1).batch
            assert len(list(client.invert(scans))) == len(scans.field)
