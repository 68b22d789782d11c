"""Publishers of messages that are kept, each behind a link: what a fault of the link, or of the router, costs.

The router and each publisher are hosts of their own, the subscribers are on the test's. All cases at once, or those
named, and a JSON row for each: ``python -m tests.hosts.link_faults [REPEATS] [CASE ...]``.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, Self

from tests.hosts.namespaces import Host, Network
from tests.network.processes import Process, Processes, wait_until

from trackmesh.protocol.bus import AliveSubscription, Subscription
from trackmesh.protocol.zenoh_bus import ZenohBus

KEPT = 750
PATIENCE_S = 20.0
PORT = 7447


class Outcome(NamedTuple):
    """What a case cost.

    Attributes:
        published: numbers, of which ``lost`` never came and ``disordered`` came after a later one.
        withheld: published, but not come, when the link was healed.
        joined_s: from healing to the moment at which the publisher was alive for the subscriber; 0 if it always was.
        again_s: from healing to the first message that was published after it, which waits for all withheld ones.
        wedged: that, or those published later, did not come within 20 s.
    """

    case: str
    published: int
    withheld: int
    lost: int
    disordered: int
    joined_s: float
    again_s: float
    wedged: bool


class Listener:
    """Takes numbers from a subscription, with the time at which each came, and when their publisher joined."""

    def __init__(self, subscription: Subscription, tokens: AliveSubscription) -> None:
        self.came: list[tuple[int, float]] = []
        self.alive_s: list[float] = []
        self._subscription, self._tokens = subscription, tokens
        self._threads = [threading.Thread(target=work) for work in (self._run, self._watch)]
        for thread in self._threads:
            thread.start()

    @property
    def last(self) -> int:
        return self.came[-1][0] if self.came else -1

    def numbers(self) -> list[int]:
        return [number for number, _ in self.came]

    def close(self) -> None:
        self._subscription.close()
        self._tokens.close()
        for thread in self._threads:
            thread.join()

    def _watch(self) -> None:
        for event in self._tokens:
            if event.alive:
                self.alive_s.append(time.monotonic())

    def _run(self) -> None:
        for sample in self._subscription:
            self.came.append((int(sample.payload), time.monotonic()))


class Link:
    """A publisher behind a link, and a subscriber that is not: what a fault in between costs.

    Args:
        processes: where the publisher is started, and ended.
        bus: of the subscriber.
        name: of this link among others.
        endpoint: at which the publisher finds the router.
        within: as a ``Host`` has it.
        role: of the publisher: ``tick``, or ``pour``, which fills the socket while nothing passes.
    """

    def __init__(
        self,
        processes: Processes,
        bus: ZenohBus,
        name: str,
        endpoint: str,
        within: Sequence[str] = (),
        role: str = "tick",
    ) -> None:
        key = f"links/@v1/plots/{name}"
        subscription = bus.subscribe(key, history=True, capacity=100_000)
        self.listener = Listener(subscription, bus.watch_alive(f"{key}/alive"))
        self.publisher = processes.start("-m", "tests.network.peers", role, endpoint, key, str(KEPT), within=within)

    def wait(self) -> None:
        """Wait until messages come."""
        wait_until(lambda: self.listener.last >= 20, "messages come")

    def published(self) -> int:
        """The last number that was published."""
        lines = [line for line in self.publisher.output.split("\n")[:-1] if line.startswith("at ")]
        return int(lines[-1].removeprefix("at ")) if lines else -1

    def run(self, case: str, fault: Callable[[], None], heal: Callable[[], None], lasts_s: float) -> Outcome:
        """Have something go wrong for a while."""
        fault()
        time.sleep(lasts_s)
        before = self.listener.last
        heal()
        healed_s, at = time.monotonic(), self.published()
        wedged = not self._comes(at + 1, PATIENCE_S)
        first_s = next((came_s for number, came_s in self.listener.came if number > at), healed_s + PATIENCE_S)
        goal = self.published() + 20
        wedged = wedged or not self._comes(goal, PATIENCE_S)
        numbers = self.listener.numbers()
        lost = set(range(goal)) - set(numbers)
        disordered = sum(b <= a for a, b in itertools.pairwise(numbers))
        joined_s = next((at_s - healed_s for at_s in self.listener.alive_s if at_s > healed_s), 0.0)
        took = round(joined_s, 3), round(first_s - healed_s, 3)
        return Outcome(case, goal, at - before, len(lost), disordered, *took, wedged)

    def _comes(self, number: int, timeout_s: float) -> bool:
        deadline_s = time.monotonic() + timeout_s
        while self.listener.last < number and time.monotonic() < deadline_s:
            time.sleep(0.005)
        return self.listener.last >= number

    def close(self) -> None:
        self.listener.close()
        self.publisher.kill()


class Scene:
    """A router on a host of its own, the subscribers on the test's, and links to as many more hosts as are named."""

    def __init__(self, network: Network, processes: Processes) -> None:
        self._network, self._processes = network, processes
        self._router_host = network.host()
        self.endpoint = f"tcp/{self._router_host.address}:{PORT}"
        self.router = self._start_router()
        self._bus = ZenohBus.open([self.endpoint], timeout_s=10.0)
        self._links: list[Link] = []

    def link(self, name: str) -> tuple[Host, Link]:
        """Another host, and the link to it."""
        host, role = self._network.host(), "pour" if "pour" in name else "tick"
        self._links.append(Link(self._processes, self._bus, name, self.endpoint, host.within, role))
        return host, self._links[-1]

    def run(self, names: Sequence[str]) -> dict[str, Outcome]:
        """Cases of ``CASES``, all at once, each on a link of its own; then the router's, if it is among them."""
        given = {name: self.link(f"{k}-{name}") for k, name in enumerate(names)}
        for _, link in given.values():
            link.wait()
        with ThreadPoolExecutor() as pool:
            found = {n: pool.submit(_run, n, *given[n]) for n in names if n != "router"}
        outcomes = {name: one.result() for name, one in found.items()}
        if "router" in given:
            _, link = given["router"]
            outcomes["router"] = link.run("router killed", self.router.kill, self.restart_router, 2.0)
        return outcomes

    def restart_router(self) -> None:
        """Start it again, having killed it if it runs."""
        self.router.kill()
        self.router = self._start_router()

    def _start_router(self) -> Process:
        command = ("-m", "trackmesh.services.router", "--listen", f"tcp/0.0.0.0:{PORT}")
        process = self._processes.start(*command, within=self._router_host.within)
        process.wait_for("ready after")
        return process

    def close(self) -> None:
        for link in self._links:
            link.close()
        self._bus.close()
        self.router.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class Case(NamedTuple):
    """What is done to a host's link, and for how long."""

    text: str
    fault: Callable[[Host], None]
    lasts_s: float


CASES = {
    "cut4": Case("link cut", Host.cut, 4.0),
    "cut8": Case("link cut", Host.cut, 8.0),
    "drop4": Case("all packets dropped in silence", Host.drop, 4.0),
    "half4": Case("packets to the sensor dropped", lambda host: host.drop(outgoing=False), 4.0),
    "pour4": Case("all packets of a large stream dropped", Host.drop, 4.0),
    "pourcut4": Case("link of a large stream cut", Host.cut, 4.0),
    "loss": Case("5 % of packets lost", lambda host: host.lose(0.05), 8.0),
}


def _run(name: str, host: Host, link: Link) -> Outcome:
    case = CASES[name.partition("-")[0]]
    return link.run(f"{case.text}, {case.lasts_s:g} s", lambda: case.fault(host), host.heal, case.lasts_s)


def main() -> None:
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    names = sys.argv[2:] or [*CASES, "router"]
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder, Network() as network:
            processes = Processes(Path(folder))
            with Scene(network, processes) as scene:
                # A case may be named several times.
                for outcome in scene.run([f"{n}-{k}" if n in names[:k] else n for k, n in enumerate(names)]).values():
                    print(json.dumps(outcome._asdict()), flush=True)
            processes.close()


if __name__ == "__main__":
    main()
