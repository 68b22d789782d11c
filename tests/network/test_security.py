"""Secured links and rights, with real routers on this host; ``tests/hosts`` has a whole deployment."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from tests.network.processes import Processes, RouterProcess, free_port, wait_until
from tests.network.secured import KEYS, Deployment, arrives, waiting

from trackmesh.protocol.bus import Subscription
from trackmesh.protocol.credentials import Credentials
from trackmesh.protocol.errors import BusError
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.deployment.authority import create_authority, issue
from trackmesh.services.deployment.plan import Limits, Participant, Plan, RouterPlan
from trackmesh.services.deployment.router_file import router_file
from trackmesh.services.deployment.users import updated_users, write_users

EVERYBODY = {"sensor": ["north", "east"], "archive": ["disk"], "viewer": ["ops"]}
HOSTS = ["localhost", "127.0.0.1"]


def plan(*, limits: Limits | None = None) -> Plan:
    router = RouterPlan(listen=[f"tls/127.0.0.1:{free_port()}"], hosts=HOSTS)
    return Plan(routers={"main": router}, participants=EVERYBODY, limits=limits or Limits())


def test_settings_in_a_file_of_zenoh_do_as_well(processes: Processes, tmp_path: Path) -> None:
    made = Deployment(plan(), tmp_path)
    made.router(processes)
    who = made.credentials("viewer.ops")
    path = tmp_path / "client.json5"
    tls = {"root_ca_certificate": who.ca, "connect_certificate": who.certificate, "connect_private_key": who.key}
    texts = {name: str(file) for name, file in tls.items()}
    path.write_text(json.dumps({"transport": {"link": {"tls": texts | {"enable_mtls": True}}}}))
    with ZenohBus.open([made.endpoint()], config_path=path, timeout_s=5.0) as bus:
        assert bus.alive(KEYS.live("*", "*")) == []


def test_the_endpoint_may_stand_in_the_file(processes: Processes, tmp_path: Path) -> None:
    router = processes.router()
    path = tmp_path / "client.json5"
    path.write_text(json.dumps({"connect": {"endpoints": [router.endpoint]}}))
    with ZenohBus.open([], config_path=path, timeout_s=5.0) as bus:
        assert bus.alive("none/@v1/**") == []


def test_who_is_not_let_in_reads_why(processes: Processes, tmp_path: Path) -> None:
    made = Deployment(plan(), tmp_path / "ours")
    made.router(processes)
    create_authority(tmp_path / "other")
    stranger = Participant("viewer", "ops")
    issue(tmp_path / "other", stranger)
    issue(made.folder, Participant("viewer", "late"), days=0)
    ours, port = made.folder / "ca.pem", made.endpoint().rpartition(":")[2]
    files = (tmp_path / "other" / "viewer.ops.pem", tmp_path / "other" / "viewer.ops.key")
    cases = {
        "for tls/ a ca must be set": (Credentials(), made.endpoint()),
        "it asks for a certificate": (Credentials(ca=ours), made.endpoint()),
        "our certificate is of an authority that it does not know": (Credentials(ours, *files), made.endpoint()),
        "our certificate has ended": (made.credentials("viewer.late"), made.endpoint()),
        "unable to get local issuer": (Credentials(tmp_path / "other" / "ca.pem", *files), made.endpoint()),
        "it may want tls/": (made.credentials("viewer.ops"), f"tcp/127.0.0.1:{port}"),
        "start one with": (made.credentials("viewer.ops"), f"tls/127.0.0.1:{free_port()}"),
    }

    def told(credentials: Credentials, endpoint: str) -> str:
        with pytest.raises(BusError) as error:
            ZenohBus.open([endpoint], credentials=credentials, timeout_s=0.3)
        return str(error.value)

    # On a busy machine a router may not answer in time; then the sentence is that nobody answers.
    for reason, (credentials, endpoint) in cases.items():
        wait_until(lambda c=credentials, e=endpoint, r=reason: r in told(c, e), reason, 30.0)  # type: ignore[misc]


def test_a_link_ends_with_the_certificate_and_comes_again_with_the_next(processes: Processes, tmp_path: Path) -> None:
    made = Deployment(plan(), tmp_path)
    made.router(processes)
    issue(tmp_path, Participant("sensor", "north"), days=5.0 / 86_400, renew=True)
    with made.bus("viewer.ops") as viewer, made.bus("sensor.north") as sensor:
        sensor.declare_alive(KEYS.live("sensor", "north"))
        wait_until(lambda: viewer.alive(KEYS.live("*", "*")), "the sensor is there")
        wait_until(lambda: not viewer.alive(KEYS.live("*", "*")), "the sensor is put out")
        issue(tmp_path, Participant("sensor", "north"), renew=True)
        wait_until(lambda: viewer.alive(KEYS.live("*", "*")), "the sensor is there again, without a new start")


def test_while_authorities_change_both_are_trusted(processes: Processes, tmp_path: Path) -> None:
    made = Deployment(plan(), tmp_path / "old")
    create_authority(tmp_path / "next")
    fresh = Participant("viewer", "ops")
    issue(tmp_path / "next", fresh)
    both = (tmp_path / "next" / "ca.pem").read_text() + (made.folder / "ca.pem").read_text()
    (made.folder / "ca.pem").write_text(both)
    made.router(processes)
    certificate, key = (tmp_path / "next" / f"viewer.ops.{end}" for end in ("pem", "key"))
    renewed = Credentials(made.folder / "ca.pem", certificate, key)
    with made.bus("viewer.ops"):
        pass
    with ZenohBus.open([made.endpoint()], credentials=renewed, timeout_s=5.0):
        pass


def test_what_was_sent_before_or_during_an_outage_comes_afterwards(processes: Processes, tmp_path: Path) -> None:
    """The library's caches need rights of their own; without them all works but this."""
    made = Deployment(plan(), tmp_path)
    router = made.router(processes)
    with made.bus("sensor.north") as north, made.bus("archive.disk") as disk:
        plots = north.publisher(KEYS.plots("north"), history=16)
        for number in range(5):
            plots.put(bytes([number]), "")
        ear = disk.subscribe(KEYS.plots("*"), history=True)
        assert received(ear, 5) == [0, 1, 2, 3, 4]
        plots.put(bytes([5]), "")
        assert received(ear, 1) == [5]
        router.kill()
        for number in range(6, 10):
            plots.put(bytes([number]), "")
        made.router(processes)
        assert received(ear, 4) == [6, 7, 8, 9]


def received(subscription: Subscription, count: int) -> list[int]:
    """The first bytes of the next messages."""
    found: list[int] = []
    for _ in range(count):
        sample = subscription.receive(15.0)
        assert sample is not None, f"only {found}"
        found.append(sample.payload[0])
    return found


def test_a_router_drops_what_is_too_large(processes: Processes, tmp_path: Path) -> None:
    made = Deployment(plan(limits=Limits(plots_bytes=2000)), tmp_path)
    made.router(processes)
    with made.bus("archive.disk") as ear, made.bus("sensor.north") as north:
        plots, fence = KEYS.plots("north"), KEYS.sensor("north")
        assert arrives(north, ear, plots, fence, b"x" * 2001) == 0
        assert arrives(north, ear, plots, fence, b"x" * 2000) > 0


def test_a_router_passes_on_no_more_than_its_rate(processes: Processes, tmp_path: Path) -> None:
    made = Deployment(plan(limits=Limits(plots_per_s=10.0)), tmp_path)
    made.router(processes)
    with made.bus("archive.disk") as ear, made.bus("sensor.north") as north:
        heard, flood = ear.subscribe(KEYS.plots("north")), north.publisher(KEYS.plots("north"))

        def begun() -> bool:
            flood.put(b"x", "")
            return heard.receive(0.05) is not None

        wait_until(begun, "the flood begins")
        began_s = time.monotonic()
        for _ in range(2000):
            flood.put(b"x", "")
        assert arrives(north, ear, KEYS.status("sim-radar", "north"), KEYS.sensor("north")) > 0
        assert waiting(heard) <= 10.0 * (time.monotonic() - began_s) + 1


def test_a_router_has_no_more_links_than_its_limit(processes: Processes, tmp_path: Path) -> None:
    made = Deployment(plan(limits=Limits(links=2)), tmp_path)
    made.router(processes)
    with made.bus("archive.disk"):
        with made.bus("sensor.north"), pytest.raises(BusError):
            ZenohBus.open([made.endpoint()], credentials=made.credentials("viewer.ops"), timeout_s=0.5)
        made.bus("viewer.ops").close()


def test_how_a_router_is_run_is_nobodys_business(processes: Processes, router: RouterProcess, tmp_path: Path) -> None:
    made = Deployment(plan(), tmp_path)
    made.router(processes)
    with ZenohBus.open([router.endpoint]) as bus:
        assert list(bus.query("@/*/router"))
    with made.bus("archive.disk") as bus:
        assert list(bus.query("@/*/router")) == []


def test_names_and_passwords(processes: Processes, tmp_path: Path) -> None:
    router = RouterPlan(listen=[f"tcp/127.0.0.1:{free_port()}"])
    secured = Plan(security="passwords", folder=str(tmp_path), routers={"main": router}, participants=EVERYBODY)
    users = updated_users(secured, {})
    write_users(tmp_path / "users.txt", users)
    path = tmp_path / "router.json5"
    path.write_text(router_file(secured, password=users["router.main"]))
    processes.start("-m", "trackmesh.services.router", "--config", str(path)).wait_for("ready after")

    def enter(name: str, password: str) -> ZenohBus:
        return ZenohBus.open(router.listen, credentials=Credentials(user=name, password=password), timeout_s=0.5)

    with enter("archive.disk", users["archive.disk"]) as ear, enter("sensor.north", users["sensor.north"]) as north:
        assert arrives(north, ear, KEYS.plots("north"), KEYS.sensor("north")) > 0
        assert arrives(north, ear, KEYS.plots("east"), KEYS.sensor("north")) == 0
    for name, password in (("sensor.north", "guess"), ("sensor.none", users["sensor.north"])):
        with pytest.raises(BusError, match="it may want tls/, or a user and password"):
            enter(name, password)
    with pytest.raises(BusError):
        ZenohBus.open(router.listen, timeout_s=0.5)


def test_two_sites_are_one_realm(processes: Processes, tmp_path: Path) -> None:
    ports = [free_port(), free_port()]
    listen = [f"tls/127.0.0.1:{port}" for port in ports]
    sites = {
        "a": RouterPlan(listen=[listen[0]], hosts=HOSTS),
        "b": RouterPlan(listen=[listen[1]], hosts=HOSTS, connect=[listen[0]]),
    }
    made = Deployment(Plan(routers=sites, participants=EVERYBODY), tmp_path)
    # The one that is to be joined may come later.
    made.router(processes, "b")
    other = made.router(processes, "a")
    with made.bus("sensor.north", listen[0]) as north, made.bus("archive.disk", listen[1]) as ear:
        assert arrives(north, ear, KEYS.plots("north"), KEYS.sensor("north")) > 0
        assert arrives(north, ear, KEYS.plots("east"), KEYS.sensor("north")) == 0
        plots = north.publisher(KEYS.plots("north"), history=16)
        for number in range(5):
            plots.put(bytes([number]), "")
        assert received(ear.subscribe(KEYS.plots("*"), history=True), 5) == [0, 1, 2, 3, 4]
        north.serve(KEYS.sensor("north"), lambda _: [(b"it is me", "")])
        north.declare_alive(KEYS.live("sensor", "north"))
        wait_until(lambda: ear.alive(KEYS.live("*", "*")), "the sensor is alive at the other site")
        wait_until(lambda: list(ear.query(KEYS.sensor("*"))), "the sensor answers the other site")
    other.kill()
    with made.bus("sensor.east", listen[1]) as east, made.bus("archive.disk", listen[1]) as ear:
        assert arrives(east, ear, KEYS.plots("east"), KEYS.sensor("east")) > 0
