"""Tests on several hosts, which are network namespaces of this machine; skipped where there can be none."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from tests.hosts.namespaces import Network, missing
from tests.network.processes import processes

__all__ = ["network", "processes"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ours = [item for item in items if "tests/hosts" in item.path.as_posix()]
    for item in ours:
        item.add_marker(pytest.mark.process)
    with_hosts = [item for item in ours if {"network", "outcomes"} & set(getattr(item, "fixturenames", ()))]
    if with_hosts and (reason := missing()):
        for item in with_hosts:
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture
def network() -> Iterator[Network]:
    """A bridge without hosts; fixtures that use it are taken down in the right order: first processes, then links."""
    with Network() as made:
        yield made
