"""The links between test hosts do what they are told."""

from __future__ import annotations

import re

import pytest
from tests.hosts.namespaces import Host, NamespaceError, Network

_PINGER = """
import socket, sys, time
count, address = int(sys.argv[1]), (sys.argv[2], 4000)
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for i in range(count):
    try:
        s.sendto(bytes([i % 256]) * int(sys.argv[3]), address)
    except PermissionError:
        pass
    time.sleep(0.001)
"""


def _received(host: Host) -> int:
    found = re.search(r"RX:.*\n\s+\d+\s+(\d+)", host.run("ip", "-s", "link", "show", "eth0"))
    assert found
    return int(found.group(1))


def _sent(source: Host, target: Host, count: int, size: int = 10) -> int:
    before = _received(target)
    source.run("python3", "-c", _PINGER, str(count), target.address, str(size))
    return _received(target) - before


def _reaches(source: Host, address: str) -> bool:
    script = f"import socket; socket.create_connection(('{address}', 4001), 0.3)"
    try:
        source.run("python3", "-c", script)
    except NamespaceError as error:
        return "refused" in str(error)
    return True


def test_hosts_reach_each_other_and_the_test(network: Network) -> None:
    first, second = network.hosts(2)
    assert first.address != second.address
    assert _reaches(first, second.address)
    assert _reaches(first, network.address)


def test_a_cut_link_carries_nothing_until_it_is_healed(network: Network) -> None:
    first, second = network.hosts(2)
    with first.while_cut():
        assert not _reaches(first, second.address)
        assert not _reaches(second, first.address)
    assert _reaches(first, second.address)


def test_packets_are_dropped_in_one_direction(network: Network) -> None:
    first, second = network.hosts(2)
    assert _reaches(first, second.address)
    first.drop(incoming=False)
    assert _sent(first, second, 100) < 10
    assert _sent(second, first, 100) >= 100
    first.heal()
    assert _sent(first, second, 100) >= 100


def test_a_share_of_the_packets_is_lost(network: Network) -> None:
    first, second = network.hosts(2)
    assert _reaches(first, second.address)
    first.lose(0.5, incoming=False)
    assert 60 < _sent(first, second, 200) < 140


def test_a_limited_link_drops_what_is_too_much(network: Network) -> None:
    first, second = network.hosts(2)
    assert _reaches(first, second.address)
    first.limit(400.0, burst_bytes=4000, queue_ms=10.0)
    assert _sent(first, second, 200, 1000) < 100
    first.heal()
    assert _sent(first, second, 200, 1000) >= 200


def test_two_networks_do_not_meet(network: Network) -> None:
    with Network() as other:
        assert other.host().name != network.host().name


def test_nothing_is_left(network: Network) -> None:
    host = network.host()
    network.close()
    with pytest.raises(NamespaceError, match=r"netns exec"):
        host.run("true")
