"""Keys: built from checked names, parsed back, and matched as Zenoh itself matches them."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st
from tests.protocol.strategies import ids

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import Keys, kind_and_id, last_chunk, matches, parse_parameters

KEYS = Keys("harbour")
ONE_ID: list[Callable[[str], str]] = [
    KEYS.plots, KEYS.ranges, KEYS.sensor, KEYS.tracks, KEYS.refined, KEYS.tags, KEYS.band, KEYS.registration,
    KEYS.truth,
]  # fmt: skip
TWO_IDS: list[Callable[[str, str], str]] = [KEYS.service, KEYS.live, KEYS.status]

chunks = st.sampled_from(["a", "b", "ab", "plots", "@v1", "@v2"])
keys = st.lists(chunks, min_size=1, max_size=5).map("/".join)
expressions = st.lists(chunks | st.sampled_from(["*", "**"]), min_size=1, max_size=5).map("/".join)


def test_the_keys_are_those_of_the_protocol() -> None:
    assert [key("x") for key in ONE_ID] == [
        f"harbour/@v1/{family}/x"
        for family in ("plots", "ranges", "sensors", "tracks", "refined", "tags", "band", "registration", "truth")
    ]
    assert [key("x", "y") for key in TWO_IDS] == [f"harbour/@v1/{family}/x/y" for family in ("svc", "live", "status")]
    assert Keys().plots("x") == "trackmesh/@v1/plots/x"


@given(ids, ids)
def test_a_key_is_taken_apart_again(one: str, other: str) -> None:
    assert last_chunk(KEYS.plots(one)) == one
    assert kind_and_id(KEYS.live(one, other)) == (one, other)
    assert kind_and_id(KEYS.status(one, other)) == (one, other)


@given(ids)
def test_every_key_is_one_for_zenoh_and_meets_its_wildcard(name: str) -> None:
    for one in ONE_ID:
        assert str(zenoh.KeyExpr(one(name))) == one(name)
        assert matches(one("*"), one(name))
    for two in TWO_IDS:
        assert matches(two("*", "*"), two(name, name))


@given(
    st.text(max_size=6) | st.sampled_from(["north\n", "a" * 65, "a/b", "A", "**", "@v1", "é", "a*", "$*", "_a", "#"])
)
def test_what_is_no_name_is_refused(text: str) -> None:
    good = text == "*" or (re.fullmatch("[a-z0-9][a-z0-9_-]{0,63}", text, re.ASCII) is not None)
    two: list[Callable[[str], object]] = [lambda name: KEYS.live("sensor", name), lambda name: KEYS.live(name, "a")]
    for key in (*ONE_ID, *two, Keys):
        if good:
            key(text)
        else:
            with pytest.raises(TrackmeshError, match="must match"):
                key(text)


@given(expressions, keys)
@example("**", "a/@v1/b")
@example("a/**", "a")
@example("**/@v1/**", "@v1")
@example("a/*/b", "a/@v1/b")
@example("**/**/a", "a")
def test_matching_is_that_of_zenoh(expression: str, key: str) -> None:
    ours = matches(expression, key)
    assert ours == zenoh.KeyExpr.autocanonize(expression).intersects(zenoh.KeyExpr(key))


def test_another_version_is_never_heard() -> None:
    assert not matches("harbour/**", KEYS.plots("a"))
    assert not matches("harbour/*/plots/a", KEYS.plots("a"))
    assert not matches(KEYS.plots("*"), "harbour/@v2/plots/a")


@pytest.mark.parametrize(
    ("text", "parameters"),
    [
        ("", {}),
        ("fmt=json", {"fmt": "json"}),
        ("fmt=json;x=1", {"fmt": "json", "x": "1"}),
        (";;fmt=json;", {"fmt": "json"}),
        ("flag", {"flag": ""}),
        ("a=b=c", {"a": "b=c"}),
    ],
)
def test_parameters_are_names_and_values(text: str, parameters: dict[str, str]) -> None:
    assert parse_parameters(text) == parameters
    assert {name: zenoh.Parameters(text).get(name) for name in parameters} == parameters


def test_a_realm_is_named() -> None:
    with pytest.raises(TrackmeshError, match="named"):
        Keys("*")
