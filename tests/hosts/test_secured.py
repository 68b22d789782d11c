"""A router, two sensors and a fusion unit on three hosts, a client on a fourth, over mutual TLS: who may do what.

Whatever is refused here has a counterpart that is allowed, in the same test or the first one, so that nothing passes
merely because nothing arrives.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.hosts.namespaces import Host, Network
from tests.network.processes import Processes, wait_until
from tests.network.realm import READY_S, TARGETS, confirmed, next_where, write_scenario
from tests.network.secured import KEYS, Deployment, arrives, waiting

from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.credentials import Credentials
from trackmesh.protocol.errors import BusError, Unavailable
from trackmesh.protocol.messages import TrackQuery
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.deployment.authority import create_authority, issue
from trackmesh.services.deployment.plan import Participant, Plan, RouterPlan

PORT = 7447
EVERYBODY = {
    "sensor": ["north", "east", "spare"],
    "fusion": ["main", "spare"],
    "archive": ["disk"],
    "viewer": ["ops"],
}


class Site:
    """The deployment at work; the test's own process is the client's host."""

    def __init__(self, made: Deployment, router: Host) -> None:
        self.made = made
        self.router = router
        self.address = f"{router.address}:{PORT}"

    def bus(self, name: str) -> ZenohBus:
        return self.made.bus(name, f"tls/{self.address}")

    def refused(self, credentials: Credentials, endpoint: str = "") -> str:
        """Why a client is not let in; that of the right certificate must be at the same time."""
        self.bus("viewer.ops").close()
        with pytest.raises(BusError) as error:
            ZenohBus.open([endpoint or f"tls/{self.address}"], credentials=credentials, timeout_s=0.5)
        return str(error.value)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("secured")
    processes = Processes(folder)
    with Network() as network:
        host, field, centre = network.hosts(3)
        plan = Plan(
            routers={"main": RouterPlan(listen=[f"tls/0.0.0.0:{PORT}"], hosts=[host.address])}, participants=EVERYBODY
        )
        site = Site(Deployment(plan, folder / "certs"), host)
        try:
            _start(site, processes, folder, field, centre)
            yield site
        finally:
            processes.close()


def _start(site: Site, processes: Processes, folder: Path, field: Host, centre: Host) -> None:
    def start(host: Host, who: str, *command: str) -> None:
        config = ["--config", str(site.made.settings(who, f"tls/{site.address}"))]
        processes.start("-m", "trackmesh.services.cli.main", *command, *config, within=host.within)

    site.made.router(processes, within=site.router.within)
    with site.bus("viewer.ops") as bus, Client(bus).watch_statuses("fusion") as watch:
        start(centre, "fusion.main", "fusion")
        next_where(watch, lambda status: status.state == "ready", "the unit is ready", READY_S)
    scenario = ["--scenario", str(write_scenario(folder)), "--start-ns", str(time.time_ns())]
    for radar in ("north", "east"):
        start(field, f"sensor.{radar}", "sim", "radar", "--radar", radar, *scenario)


def test_with_the_right_certificates_all_goes_on_as_without(site: Site) -> None:
    with site.bus("viewer.ops") as bus:
        client = Client(bus)
        with client.watch_tracks("main") as watch:
            next_where(watch, lambda f: len(confirmed(f)) == TARGETS, "all tracks are there", 40.0)
        (frame,) = client.query_tracks()
        assert set(frame.sensors) == {"north", "east"}
        assert [info.sensor_id for info in client.sensors()] == ["east", "north"]
        assert ("fusion", "main") in client.alive()
        (unit,) = [status for status in client.statuses() if status.kind == "fusion"]
        assert not any(unit.refused.values())


def test_a_certificate_of_another_authority_is_refused(site: Site, tmp_path: Path) -> None:
    create_authority(tmp_path)
    strange = issue(tmp_path, Participant("viewer", "ops")).path
    credentials = Credentials(site.made.folder / "ca.pem", strange, strange.with_suffix(".key"))
    assert "of an authority that it does not know" in site.refused(credentials)


def test_a_router_of_another_authority_is_refused(site: Site, tmp_path: Path) -> None:
    create_authority(tmp_path)
    ours = site.made.credentials("viewer.ops")
    refused = site.refused(Credentials(tmp_path / "ca.pem", ours.certificate, ours.key))
    assert "its certificate does not convince us" in refused


def test_a_router_under_a_name_that_is_not_its_own_is_refused(site: Site) -> None:
    other = f"{site.router.address.rpartition('.')[0]}.250"
    site.router.run("ip", "address", "replace", f"{other}/24", "dev", "eth0")
    assert "IP address mismatch" in site.refused(site.made.credentials("viewer.ops"), f"tls/{other}:{PORT}")


def test_no_certificate_is_refused(site: Site) -> None:
    assert "it asks for a certificate" in site.refused(Credentials(ca=site.made.folder / "ca.pem"))


def test_plain_tcp_is_refused(site: Site) -> None:
    for credentials in (Credentials(), site.made.credentials("viewer.ops")):
        assert "it may want tls/" in site.refused(credentials, f"tcp/{site.address}")


@pytest.mark.parametrize(
    ("who", "own"), [("sensor.spare", KEYS.sensor("spare")), ("fusion.spare", KEYS.status("fusion", "spare"))]
)
@pytest.mark.parametrize(
    "key",
    [KEYS.tracks("main"), KEYS.plots("north"), KEYS.sensor("north"), KEYS.registration("main"), KEYS.tags("main")],
)
def test_nobody_publishes_for_another(site: Site, who: str, own: str, key: str) -> None:
    with site.bus(who) as mouth, site.bus("viewer.ops") as viewer, site.bus("archive.disk") as ear:
        # Real messages come there as well; a forged one would be this one.
        forged = b"forged"
        heard = ear.subscribe(key)
        assert arrives(mouth, viewer, own, own, forged) > 0
        arrives(mouth, ear, key, own, forged)
        while (sample := heard.receive(0)) is not None:
            assert sample.payload != forged


def test_a_fusion_unit_publishes_its_own_tracks_and_a_sensor_its_own_plots(site: Site) -> None:
    with site.bus("archive.disk") as ear, site.bus("fusion.spare") as unit, site.bus("sensor.spare") as sensor:
        assert arrives(unit, ear, KEYS.tracks("spare"), KEYS.status("fusion", "spare"), b"forged") > 0
        assert arrives(sensor, ear, KEYS.plots("spare"), KEYS.sensor("spare"), b"forged") > 0


def test_nobody_is_alive_in_the_name_of_another(site: Site) -> None:
    with site.bus("sensor.spare") as bus, site.bus("viewer.ops") as viewer:
        bus.declare_alive(KEYS.live("fusion", "ghost"))
        bus.declare_alive(KEYS.live("sensor", "spare"))
        wait_until(lambda: KEYS.live("sensor", "spare") in viewer.alive(KEYS.live("*", "*")), "the sensor is alive")
        assert KEYS.live("fusion", "ghost") not in viewer.alive(KEYS.live("*", "*"))


def test_nobody_answers_in_the_name_of_another(site: Site) -> None:
    with site.bus("sensor.spare") as bus, site.bus("fusion.spare") as unit, site.bus("viewer.ops") as viewer:
        bus.serve(KEYS.service("tracks", "ghost"), lambda _: [(b"forged", "")])
        unit.serve(KEYS.service("tracks", "spare"), lambda _: [(b"own", "")])
        wait_until(lambda: list(viewer.query(KEYS.service("tracks", "spare"))), "the unit answers")
        assert list(viewer.query(KEYS.service("tracks", "ghost"))) == []


@pytest.mark.parametrize("expression", [KEYS.plots("*"), KEYS.tracks("*"), KEYS.everything()])
def test_a_sensor_overhears_nothing(site: Site, expression: str) -> None:
    with site.bus("sensor.spare") as bus, site.bus("archive.disk") as ear:
        overheard, heard = bus.subscribe(expression), ear.subscribe(expression)
        for _ in range(10):
            assert heard.receive(20.0) is not None
        assert waiting(overheard) == 0


def test_a_viewer_hears_tracks_but_no_plots(site: Site) -> None:
    with site.bus("viewer.ops") as bus, site.bus("archive.disk") as ear:
        plots, tracks, heard = (
            bus.subscribe(KEYS.plots("*")),
            bus.subscribe(KEYS.tracks("*")),
            ear.subscribe(KEYS.plots("*")),
        )
        for _ in range(10):
            assert heard.receive(20.0) is not None
            assert tracks.receive(20.0) is not None
        assert waiting(plots) == 0


def test_an_eavesdropping_question_gets_no_answer(site: Site) -> None:
    query = TrackQuery()
    with site.bus("viewer.ops") as viewer, site.bus("sensor.north") as sensor:
        question = (KEYS.service("tracks", "*"), encode(query), encoding(query))
        assert list(viewer.query(*question))
        assert list(sensor.query(*question)) == []
        assert list(sensor.query(KEYS.sensor("*"))) == []
        assert viewer.alive(KEYS.live("*", "*"))
        assert sensor.alive(KEYS.live("*", "*")) == []
        with pytest.raises(Unavailable):
            Client(sensor).query_tracks()


def test_what_a_sensor_sent_before_cannot_be_asked_for(site: Site) -> None:
    with site.bus("sensor.spare") as bus, site.bus("archive.disk") as ear:
        overheard, heard = bus.subscribe(KEYS.plots("*"), history=True), ear.subscribe(KEYS.plots("*"), history=True)
        for _ in range(10):
            assert heard.receive(20.0) is not None
        assert waiting(overheard) == 0


def test_who_is_not_in_the_plan_may_nothing(site: Site) -> None:
    issue(site.made.folder, Participant("viewer", "gone"), renew=True)
    with site.bus("viewer.gone") as gone, site.bus("viewer.ops") as ops:
        overheard, heard = gone.subscribe(KEYS.tracks("*")), ops.subscribe(KEYS.tracks("*"))
        for _ in range(5):
            assert heard.receive(20.0) is not None
        assert waiting(overheard) == 0
        assert list(gone.query(KEYS.sensor("*"))) == []
