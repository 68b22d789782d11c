"""Several hosts on one machine: network namespaces joined by a bridge, their links cut, made lossy, or slow.

Needs root, and Debian's ``iproute2`` and ``iptables``. Each ``Network`` has names and addresses of its own, so that
several test runs on one machine do not meet. The test itself takes part as another host, at ``Network.address``.
"""

from __future__ import annotations

import functools
import itertools
import os
import random
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

HOSTS_MOST = 200
_DEVICE = "eth0"
_HERE = 254
_serial = itertools.count()


class NamespaceError(Exception):
    """A command of the system failed; ``str()`` is the command and what it said."""


@functools.cache
def missing() -> str:
    """Why there can be no namespaces here; empty if there can be."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    absent = [tool for tool in ("ip", "tc", "iptables") if shutil.which(tool) is None]
    if absent:
        return f"network namespaces need {', '.join(absent)} (Debian: iproute2, iptables)"
    try:
        with Network() as network:
            host = network.host()
            host.drop()
            host.lose(0.5)
            host.limit(1000)
    except NamespaceError as error:
        return f"this kernel has no network namespaces for tests: {error}"
    return ""


class Host:
    """One namespace with one link to the bridge; made by ``Network.host``."""

    def __init__(self, name: str, port: str, address: str) -> None:
        self.name = name
        self.address = address
        self._port = port

    @property
    def within(self) -> tuple[str, ...]:
        """What to put before a command so that it runs on this host. The process is the command's own, no parent."""
        return ("ip", "netns", "exec", self.name)

    def run(self, *command: str, timeout_s: float = 10.0) -> str:
        """Run a command to its end; what it printed.

        Raises:
            NamespaceError: it failed.
        """
        return _run(*self.within, *command, timeout_s=timeout_s)

    def cut(self) -> None:
        """Pull the cable at the switch: nothing passes, and nobody is told."""
        _run("ip", "link", "set", self._port, "down")

    def drop(self, *, incoming: bool = True, outgoing: bool = True) -> None:
        """Discard packets without a word; one direction alone makes a half-open link."""
        self._filter("-j", "DROP", incoming=incoming, outgoing=outgoing)

    def lose(self, share: float, *, incoming: bool = True, outgoing: bool = True) -> None:
        """Discard a random share of the packets of each direction, 0 to 1."""
        chance = ("-m", "statistic", "--mode", "random", "--probability", f"{share:g}")
        self._filter(*chance, "-j", "DROP", incoming=incoming, outgoing=outgoing)

    def limit(self, kbit_per_s: float, *, burst_bytes: int = 32_768, queue_ms: float = 400.0) -> None:
        """Send no faster than this."""
        shape = ("rate", f"{kbit_per_s:g}kbit", "burst", str(burst_bytes), "latency", f"{queue_ms:g}ms")
        self.run("tc", "qdisc", "replace", "dev", _DEVICE, "root", "tbf", *shape)

    def heal(self) -> None:
        """Undo whatever was done to the link."""
        self.run("iptables", "-w", "-F")
        if "tbf" in self.run("tc", "qdisc", "show", "dev", _DEVICE):
            self.run("tc", "qdisc", "delete", "dev", _DEVICE, "root")
        _run("ip", "link", "set", self._port, "up")

    @contextmanager
    def while_cut(self) -> Iterator[None]:
        """Cut for the length of a block."""
        self.cut()
        try:
            yield
        finally:
            self.heal()

    def _filter(self, *rule: str, incoming: bool, outgoing: bool) -> None:
        for chain, flag, wanted in (("INPUT", "-i", incoming), ("OUTPUT", "-o", outgoing)):
            if wanted:
                self.run("iptables", "-w", "-A", chain, flag, _DEVICE, *rule)


class Network:
    """A bridge, and the hosts joined to it; all are gone after ``close``. Processes in them are not: kill them before.

    Raises:
        NamespaceError: the system refuses.
    """

    def __init__(self) -> None:
        # An interface's name has at most 15 characters.
        self._tag = f"{os.getpid() % 10**7:x}{next(_serial)}"
        self._bridge = f"tm{self._tag}"
        self._subnet = f"10.{random.randrange(64, 128)}.{random.randrange(256)}"
        self._hosts: list[Host] = []
        self.address = f"{self._subnet}.{_HERE}"
        _run("ip", "link", "add", self._bridge, "type", "bridge")
        try:
            _run("ip", "address", "add", f"{self.address}/24", "dev", self._bridge)
            _run("ip", "link", "set", self._bridge, "up")
        except NamespaceError:
            self.close()
            raise

    def host(self) -> Host:
        """Join another host."""
        number = len(self._hosts) + 1
        if number > HOSTS_MOST:
            raise NamespaceError(f"A network of tests has at most {HOSTS_MOST} hosts.")
        host = Host(f"tm{self._tag}h{number}", f"tm{self._tag}p{number}", f"{self._subnet}.{number}")
        _run("ip", "netns", "add", host.name)
        self._hosts.append(host)
        _run("ip", "link", "add", host._port, "type", "veth", "peer", "name", _DEVICE, "netns", host.name)
        _run("ip", "link", "set", host._port, "master", self._bridge, "up")
        _run("ip", "-n", host.name, "address", "add", f"{host.address}/24", "dev", _DEVICE)
        for device in (_DEVICE, "lo"):
            _run("ip", "-n", host.name, "link", "set", device, "up")
        return host

    def hosts(self, count: int) -> list[Host]:
        """Join several."""
        return [self.host() for _ in range(count)]

    def close(self) -> None:
        """Take down all of it, whatever of it there is."""
        for host in self._hosts:
            # The port goes with it at once; with the namespace it goes only when its last process has ended.
            for command in (("link", "delete", host._port), ("netns", "delete", host.name)):
                subprocess.run(["ip", *command], capture_output=True, check=False)
        self._hosts.clear()
        subprocess.run(["ip", "link", "delete", self._bridge], capture_output=True, check=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _run(*command: str, timeout_s: float = 10.0) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NamespaceError(f"{' '.join(command)}: {error}") from None
    if done.returncode:
        raise NamespaceError(f"{' '.join(command)}: {' '.join((done.stderr or done.stdout).split())}")
    return done.stdout
