"""The router as a process: its settings, its ready line, its end."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from tests.network.processes import ROOT, Processes, free_port, wait_until

from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.protocol.zenoh_config import endpoints_of, router_config

SHIPPED = ROOT / "docker" / "open.json5"


def test_the_shipped_settings_are_those_of_the_code() -> None:
    shipped, ours = router_config([], SHIPPED), router_config(["tcp/0.0.0.0:7447"])
    assert endpoints_of(shipped, "listen") == ["tcp/0.0.0.0:7447"]
    for key in (
        "mode",
        "scouting/delay",
        "scouting/multicast/enabled",
        "scouting/gossip/enabled",
        "timestamping/enabled",
        "adminspace/enabled",
        "transport/link/tx/lease",
        "transport/link/tx/queue",
        "transport/link/rx/max_message_size",
        "transport/shared_memory/enabled",
        "transport/unicast/open_timeout",
    ):
        assert json.loads(shipped.get_json(key)) == json.loads(ours.get_json(key)), key


def test_the_shipped_settings_start_a_router(processes: Processes) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arguments = ["-m", "trackmesh.services.router", "--config", str(SHIPPED), "--listen", endpoint]
    process = processes.start(*arguments, "--log-format", "json")
    process.wait_for("ready after")
    assert json.loads(process.output.splitlines()[0])["locators"] == [endpoint]
    ZenohBus.open([endpoint], timeout_s=5.0).close()
    assert process.stop(signal.SIGTERM) == 0


def test_a_port_that_is_left_open_is_told(processes: Processes) -> None:
    process = processes.start("-m", "trackmesh.services.router", "--listen", "tcp/127.0.0.1:0")
    process.wait_for("ready after")
    endpoint = process.output.split("reached at ")[1].split()[0]
    ZenohBus.open([endpoint], timeout_s=5.0).close()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--listen", "nowhere"], "listen/endpoints"),
        (["--config", "none.json5"], "no such file"),
        (["--config", __file__], "are wrong"),
    ],
)
def test_a_wrong_setting_is_one_sentence(processes: Processes, arguments: list[str], sentence: str) -> None:
    process = processes.start("-m", "trackmesh.services.router", *arguments)
    wait_until(lambda: not process.running, "the router ends")
    assert process.stop() == 1
    assert sentence in process.output and len(process.output.splitlines()) == 1


def test_a_message_that_is_too_large_is_dropped_and_the_link_stays(processes: Processes, tmp_path: Path) -> None:
    path = tmp_path / "router.json5"
    path.write_text(json.dumps({"transport": {"link": {"rx": {"max_message_size": 300_000}}}}))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arguments = ["-m", "trackmesh.services.router", "--config", str(path), "--listen", endpoint]
    processes.start(*arguments).wait_for("ready after")
    with ZenohBus.open([endpoint], timeout_s=5.0) as sender, ZenohBus.open([endpoint], timeout_s=5.0) as receiver:
        subscription = receiver.subscribe("large/@v1/x")
        publisher = sender.publisher("large/@v1/x")

        def heard() -> bool:
            publisher.put(bytes(1_000_000), "")
            publisher.put(bytes(100_000), "")
            sample = subscription.receive(0.1)
            return sample is not None and len(sample.payload) == 100_000

        wait_until(heard, "the smaller message arrives")
        sizes = {len(sample.payload) for sample in iter(lambda: subscription.receive(0.2), None)}
    assert sizes <= {100_000}
