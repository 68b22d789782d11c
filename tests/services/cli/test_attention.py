"""What a watching person is told beside the picture."""

from __future__ import annotations

from typing import Any

from trackmesh.protocol.errors import BusError
from trackmesh.protocol.links import Links
from trackmesh.protocol.messages import ServiceStatus
from trackmesh.services.cli.attention import Attention, routers_down


def status(unit: str = "main", **more: Any) -> ServiceStatus:
    fields = {"kind": "fusion", "boot_id": "x", "seq": 0, "t_ns": 0, "state": "ready", "uptime_s": 1.0}
    return ServiceStatus(unit_id=unit, **(fields | more))


class Scene:
    def __init__(self) -> None:
        self.now_s, self.links = 0.0, Links()
        self.attention = Attention(self.links, lambda: self.now_s)


def test_what_services_say_is_passed_on_until_it_is_over() -> None:
    scene = Scene()
    scene.attention.take(status(degraded=["Sensor a is silent."]))
    scene.attention.take(status("other"))
    assert scene.attention.lines() == ["fusion main: Sensor a is silent."]
    scene.attention.take(status())
    assert scene.attention.lines() == []


def test_a_service_that_goes_quiet_is_told_but_not_one_that_stopped() -> None:
    scene = Scene()
    scene.attention.take(status())
    scene.attention.take(status("other"))
    scene.attention.take(status("other", state="stopping"))
    scene.now_s = 12.0
    assert scene.attention.lines() == ["fusion main: says nothing since 12 s; it has died, or its link is down."]
    scene.now_s = 4000.0
    assert scene.attention.lines() == []


def test_without_a_link_only_that_is_told() -> None:
    scene = Scene()
    scene.attention.take(status())
    scene.links.came("tcp/a:1")
    scene.links.went("tcp/a:1")
    scene.now_s = 12.0
    (line,) = scene.attention.lines()
    assert line.startswith("here: There is no link to a router since") and "tcp/a:1 was lost" in line


def test_of_several_routers_those_that_do_not_answer_are_named() -> None:
    def reach(endpoint: str) -> None:
        if endpoint == "tcp/b:1":
            raise BusError("no")

    assert routers_down(["tcp/a:1", "tcp/b:1"], reach) == ["router: tcp/b:1 does not answer."]
    assert routers_down(["tcp/b:1"], reach) == []
