"""Every test here starts real processes."""

from __future__ import annotations

import pytest
from tests.network.processes import processes, router

__all__ = ["processes", "router"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "tests/network" in item.path.as_posix():
            item.add_marker(pytest.mark.process)
