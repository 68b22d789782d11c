"""The order of tests: what shares compiled kernels with another process comes last.

``make test`` runs the fusion engine's tests beside the others. Both need the kernels of the estimation package; those
that come later find them compiled.
"""

from __future__ import annotations

import pytest

LAST = ("tests/services/fusion/partition/", "tests/services/estimation/", "tests/sim/studies/")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.nodeid.startswith(LAST))
