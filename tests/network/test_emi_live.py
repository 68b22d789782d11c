"""Two EMI services with worker processes of their own: sharing, one of them killed, work given up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.network.processes import Process, Processes, RouterProcess, wait_until
from tests.network.realm import READY_S, Realm, next_where

from trackmesh.protocol.client import Client
from trackmesh.protocol.messages import EmiScanBatch
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.sim.emi import random_targets, simulate, survey_geometry


def service(realm: Realm, client: Client, unit: str) -> Process:
    """Start a service, and wait until it is ready."""
    with client.watch_statuses("emi", unit) as watch:
        process = realm.trackmesh("emi", "--unit-id", unit, "--processes", "1")
        next_where(watch, lambda s: s.state == "ready", f"the service {unit} is ready", READY_S)
    return process


def batch(n: int) -> EmiScanBatch:
    geometry = survey_geometry((4.0, 4.0), 0.2)
    one = simulate(geometry, random_targets(8, 1), 25.0, 1, batch_id="area").batch
    return one.model_copy(update={"field": np.tile(one.field, (n // 8, 1, 1, 1))})


def workers() -> set[int]:
    """Worker processes on this machine."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if b"trackmesh.services.emi.service.worker" in path.read_bytes():
                found.add(int(path.parent.name))
        except OSError:
            continue
    return found


def test_two_services_share_a_batch_and_one_does_what_the_other_leaves(
    processes: Processes, router: RouterProcess, tmp_path: Path
) -> None:
    realm, before = Realm(processes, router, tmp_path), workers()
    with ZenohBus.open([router.endpoint], timeout_s=10.0) as bus:
        client = Client(bus)
        service(realm, client, "a")
        b = service(realm, client, "b")
        wait_until(lambda: len(client.alive("emi")) == 2, "both are alive")
        shared = client.invert(batch(64))
        assert sorted(r.index for r in shared) == list(range(64))
        assert set(shared.by_unit) == {"a", "b"}
        broken = client.invert(batch(400))
        got = [next(broken).index]
        b.kill()
        got += [r.index for r in broken]
        assert sorted(got) == list(range(400))
        # The workers of a service that was killed end by themselves.
        wait_until(lambda: len(workers() - before) == 1, "the orphans have ended", 20.0)


def test_work_that_nobody_waits_for_is_given_up_and_a_stop_leaves_no_process(
    processes: Processes, router: RouterProcess, tmp_path: Path
) -> None:
    realm, before = Realm(processes, router, tmp_path), workers()
    with ZenohBus.open([router.endpoint], timeout_s=10.0) as bus:
        client = Client(bus)
        process = service(realm, client, "a")
        with client.watch_statuses("emi", "a") as watch:
            with client.invert(batch(800)) as inversion:
                next(inversion)
            status = next_where(watch, lambda s: bool(s.refused.get("cancelled")), "it is given up", 20.0)
        assert status.counters["scans"] < 800
        assert len(list(client.invert(batch(8)))) == 8
    assert process.stop() == 0, process.output
    assert workers() <= before
