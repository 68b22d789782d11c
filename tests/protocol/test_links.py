"""What is told of links that come and go."""

from __future__ import annotations

from trackmesh.protocol.links import Links

S = 1_000_000_000
AT = 12 * 3600 * S
A, B = "tcp/a:7447", "tcp/b:7447"


class Scene:
    def __init__(self) -> None:
        self.now_ns, self.said = AT, list[str]()
        self.links = Links(self.said.append, lambda: self.now_ns)

    def pass_s(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)


def test_nothing_is_told_of_a_link_that_holds_nor_where_there_are_none() -> None:
    scene = Scene()
    assert scene.links.figures() == {} and scene.links.notice() == "" and scene.links.steady
    scene.links.came(A)
    scene.pass_s(5)
    assert (scene.links.up, scene.links.notice(), scene.said) == ([A], "", [])
    assert scene.links.figures() == {"links_lost": 0.0, "cut_off_s": 0.0}


def test_a_lost_link_is_told_while_it_lasts_and_a_minute_after() -> None:
    scene = Scene()
    scene.links.came(A)
    scene.links.went(A)
    scene.pass_s(8)
    assert scene.links.notice() == f"There is no link to a router since 12:00:00 UTC: {A} was lost."
    assert scene.links.figures() == {"links_lost": 1.0, "cut_off_s": 8.0}
    assert not scene.links.steady
    scene.links.came(A)
    assert not scene.links.steady
    assert scene.links.notice() == f"There was no link to the router {A} for 8.0 s from 12:00:00 UTC."
    scene.pass_s(61)
    assert scene.links.steady
    assert scene.links.notice() == ""
    assert scene.links.figures() == {"links_lost": 1.0, "cut_off_s": 8.0}
    assert scene.said == [f"the link to the router {A} is lost", f"joined through {A} again after 8.0 s"]


def test_another_router_in_its_place_is_told_until_the_first_is_back() -> None:
    scene = Scene()
    scene.links.came(A)
    scene.links.went(A)
    scene.links.came(B)
    scene.pass_s(600)
    assert scene.links.notice() == f"The router {A} was lost at 12:00:00 UTC; joined through {B} instead."
    assert scene.links.up == [B]


def test_the_end_of_a_link_that_never_was_is_nothing() -> None:
    scene = Scene()
    scene.links.went(A)
    assert (scene.links.notice(), scene.said) == ("", [])
