"""What is kept survives every fault of a link, in order, and no publisher is ever cut off for good."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from tests.hosts.link_faults import CASES, Outcome, Scene
from tests.hosts.namespaces import Network
from tests.network.processes import Processes

NAMES = [*(name for name in CASES if name != "pourcut4"), "router"]


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Outcome]]:
    """All cases at once, each on a link of its own; then the router's."""
    with Network() as network:
        processes = Processes(tmp_path_factory.mktemp("links"))
        try:
            with Scene(network, processes) as scene:
                yield scene.run(NAMES)
        finally:
            processes.close()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_lost_and_nobody_is_wedged(outcomes: dict[str, Outcome], name: str) -> None:
    one = outcomes[name]
    print(one)
    assert not one.wedged, one
    assert (one.lost, one.disordered) == (0, 0), one
    # The other side of it: there was an outage.
    assert one.withheld > 50 or name == "loss", one
    # Attempts come every half second, and may each take two; what it takes is far less, see docs/faults.md. A large
    # stream is held up by its socket, too.
    assert one.joined_s < 5.0 or "pour" in name, one
