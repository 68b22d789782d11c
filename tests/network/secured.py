"""A secured deployment for tests: an authority, certificates, the router's settings, and ways in for everybody."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from tests.network.processes import Process, Processes, wait_until

from trackmesh.protocol.bus import Bus, Subscription
from trackmesh.protocol.credentials import Credentials
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.deployment.authority import create_authority, issue
from trackmesh.services.deployment.plan import ROUTER, Participant, Plan
from trackmesh.services.deployment.router_file import router_file

KEYS = Keys()


class Deployment:
    """The files of a plan in a folder.

    Attributes:
        plan: with its folder set.
        folder: of the files.
    """

    def __init__(self, plan: Plan, folder: Path) -> None:
        self.folder = folder
        self.plan = plan.model_copy(update={"folder": str(folder)})
        create_authority(folder)
        for name, router in plan.routers.items():
            issue(folder, Participant(ROUTER, name), router.hosts)
        for who in plan.everybody():
            issue(folder, who)

    def credentials(self, common_name: str) -> Credentials:
        return Credentials(
            self.folder / "ca.pem", self.folder / f"{common_name}.pem", self.folder / f"{common_name}.key"
        )

    def router(self, processes: Processes, name: str | None = None, within: Sequence[str] = ()) -> Process:
        """Start a router, and wait until it listens."""
        name, _ = self.plan.router(name)
        path = self.folder / f"{name}.json5"
        path.write_text(router_file(self.plan, name))
        process = processes.start("-m", "trackmesh.services.router", "--config", str(path), within=within)
        process.wait_for("ready after")
        return process

    def endpoint(self, router: str | None = None) -> str:
        return self.plan.router(router)[1].listen[0]

    def bus(self, common_name: str, endpoint: str | None = None) -> ZenohBus:
        """A way in for a participant, from the test's own process."""
        return ZenohBus.open([endpoint or self.endpoint()], credentials=self.credentials(common_name), timeout_s=10.0)

    def settings(self, common_name: str, endpoint: str | None = None) -> Path:
        """The same for a process, as its ``--config``."""
        path = self.folder / f"{common_name}.toml"
        who = self.credentials(common_name)
        files = {"ca": who.ca, "certificate": who.certificate, "key": who.key}
        lines = [f"connect = {json.dumps([endpoint or self.endpoint()])}", "[tls]"]
        path.write_text("\n".join([*lines, *(f"{name} = {json.dumps(str(file))}" for name, file in files.items())]))
        return path


def arrives(mouth: Bus, ear: Bus, key: str, allowed: str, payload: bytes = b"x", enough: int = 5) -> int:
    """How many of the messages to ``key`` are heard until ``enough`` to an ``allowed`` key of the same sender were.

    The link keeps their order, so what was not heard by then was not passed on.
    """
    heard, fence = ear.subscribe(key), ear.subscribe(allowed)
    speak, wave = mouth.publisher(key), mouth.publisher(allowed)
    waves = 0

    def waved() -> bool:
        nonlocal waves
        speak.put(payload, "")
        wave.put(b"", "")
        waves += fence.receive(0.05) is not None
        return waves >= enough

    wait_until(waved, f"{allowed} arrives")
    count = waiting(heard)
    for declared in (heard, fence, speak, wave):
        declared.close()
    return count


def waiting(subscription: Subscription) -> int:
    """How many messages are waiting now."""
    count = 0
    while subscription.receive(0) is not None:
        count += 1
    return count
