"""Links that are slow, half-open, silent or severed, by a proxy in between: no host but this one, no root."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from tests.hosts.link_faults import Link, Outcome
from tests.hosts.proxy import Proxy
from tests.network.processes import Processes, RouterProcess, wait_until

from trackmesh.protocol.zenoh_bus import ZenohBus

CASES: dict[str, tuple[Callable[[Proxy], None], float]] = {
    "slow": (lambda proxy: proxy.slow(0.1, 0.2), 3.0),
    "silent": (Proxy.drop, 4.0),
    "half-open": (lambda proxy: setattr(proxy.down, "open", False), 4.0),
    "severed": (Proxy.sever, 2.0),
}


@pytest.fixture(scope="module")
def outcomes(router: RouterProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Outcome]]:
    """All cases at once, each on a link of its own."""
    host, port = router.endpoint.removeprefix("tcp/").split(":")
    processes = Processes(tmp_path_factory.mktemp("links"))
    proxies = {name: Proxy((host, int(port))) for name in CASES}
    with ZenohBus.open([router.endpoint], timeout_s=10.0) as bus:
        links = {name: Link(processes, bus, name, proxies[name].endpoint) for name in CASES}

        def run(name: str) -> Outcome:
            fault, lasts_s = CASES[name]
            links[name].wait()
            return links[name].run(name, lambda: fault(proxies[name]), proxies[name].heal, lasts_s)

        try:
            with ThreadPoolExecutor() as pool:
                yield dict(zip(CASES, pool.map(run, CASES), strict=True))
        finally:
            for name in CASES:
                links[name].close()
                proxies[name].close()
            processes.close()


@pytest.mark.parametrize("name", CASES)
def test_nothing_is_lost_and_nobody_is_wedged(outcomes: dict[str, Outcome], name: str) -> None:
    one = outcomes[name]
    assert not one.wedged, one
    assert (one.lost, one.disordered) == (0, 0), one
    # The other side of it: something was held up.
    assert one.withheld > (3 if name == "slow" else 50), one


def test_the_proxy_delays_keeps_order_and_holds_back() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, Proxy(("127.0.0.1", server.getsockname()[1])) as proxy:
        near = socket.create_connection(("127.0.0.1", proxy.port))
        far, _ = server.accept()
        proxy.slow(0.2, 0.1)
        began_s = time.monotonic()
        for k in range(50):
            near.sendall(bytes([k]))
        got = b""
        while len(got) < 50:
            got += far.recv(64)
        assert got == bytes(range(50)) and time.monotonic() - began_s >= 0.2
        proxy.slow(0.0)
        proxy.down.open = False
        far.sendall(b"held")
        near.sendall(b"passes")
        assert far.recv(64) == b"passes"
        far.settimeout(0.0)
        near.settimeout(0.1)
        with pytest.raises(TimeoutError):
            near.recv(64)
        proxy.heal()
        near.settimeout(5.0)
        assert near.recv(64) == b"held"
        proxy.sever()
        with pytest.raises(ConnectionResetError):
            near.recv(64)
        wait_until(lambda: not proxy._writers, "all connections are gone")
        near.close()
        far.close()
