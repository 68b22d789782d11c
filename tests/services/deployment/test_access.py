"""Who may do what, by a model of Zenoh's access control; real routers are asked in ``network`` and ``hosts``."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

from trackmesh.protocol.keys import Keys, matches
from trackmesh.services.deployment.access import access_control
from trackmesh.services.deployment.plan import Plan
from trackmesh.services.deployment.rights import RIGHTS

PLAN = Plan(
    participants={
        "sensor": ["north", "east", "hall"],
        "fusion": ["one", "two"],
        "emi": ["field"],
        "tags": ["indoor"],
        "archive": ["disk"],
        "gateway": ["web"],
        "viewer": ["ops"],
    },
    speaks_for={"hall": ["hall", "reader-1"]},
)
KEYS = Keys()
EVERYBODY = [who.common_name for who in PLAN.everybody()]


def allowed(who: str, message: str, key: str, flow: str = "ingress") -> bool:
    """Whether a rule for somebody includes a key, or a simple key expression."""
    control: Any = access_control(PLAN)
    ids = {ident for policy in control["policies"] if who in policy["subjects"] for ident in policy["rules"]}
    rules = [rule for rule in control["rules"] if rule["id"] in ids]
    return any(
        matches(expression, key)
        for rule in rules
        if message in rule["messages"] and flow in rule["flows"]
        for expression in rule["key_exprs"]
    )


def who_may(message: str, key: str) -> set[str]:
    return {who for who in EVERYBODY if allowed(who, message, key)}


@pytest.mark.parametrize(
    ("key", "who"),
    [
        (KEYS.plots("north"), "sensor.north"),
        (KEYS.sensor("north"), "sensor.north"),
        (KEYS.ranges("hall"), "sensor.hall"),
        (KEYS.sensor("reader-1"), "sensor.hall"),
        (KEYS.status("sim-radar", "east"), "sensor.east"),
        (KEYS.tracks("one"), "fusion.one"),
        (KEYS.refined("two"), "fusion.two"),
        (KEYS.registration("one"), "fusion.one"),
        (KEYS.band("one"), "fusion.one"),
        (KEYS.status("fusion", "one"), "fusion.one"),
        (KEYS.tags("indoor"), "tags.indoor"),
        (KEYS.status("emi", "field"), "emi.field"),
        (KEYS.status("archive", "disk"), "archive.disk"),
        (KEYS.status("gateway", "web"), "gateway.web"),
    ],
)
def test_each_key_has_one_publisher(key: str, who: str) -> None:
    assert who_may("put", key) == {who}
    assert who_may("delete", key) == {who}
    assert allowed(who, "liveliness_token", f"{key}/@adv/pub/a1/7/_")
    assert allowed(who, "declare_queryable", f"{key}/@adv/pub/a1/7/_")
    assert allowed(who, "reply", key)


@pytest.mark.parametrize(
    ("key", "who"),
    [
        (KEYS.live("sensor", "north"), "sensor.north"),
        (KEYS.live("sensor", "reader-1"), "sensor.hall"),
        (KEYS.live("fusion", "two"), "fusion.two"),
        (KEYS.live("tags", "indoor"), "tags.indoor"),
    ],
)
def test_nobody_is_alive_in_the_name_of_another(key: str, who: str) -> None:
    assert who_may("liveliness_token", key) == {who}


@pytest.mark.parametrize(
    ("key", "who"),
    [
        (KEYS.service("tracks", "one"), "fusion.one"),
        (KEYS.service("emi", "field"), "emi.field"),
        (KEYS.service("history", "disk"), "archive.disk"),
        (KEYS.sensor("north"), "sensor.north"),
    ],
)
def test_nobody_answers_in_the_name_of_another(key: str, who: str) -> None:
    assert who_may("declare_queryable", key) == {who}
    assert who_may("reply", key) == {who}


@pytest.mark.parametrize(
    ("expression", "who"),
    [
        (KEYS.plots("*"), {"fusion.one", "fusion.two", "archive.disk"}),
        (KEYS.ranges("*"), {"tags.indoor", "archive.disk"}),
        (KEYS.tracks("*"), {"fusion.one", "fusion.two", "archive.disk", "gateway.web", "viewer.ops"}),
        (KEYS.status("*", "*"), {"archive.disk", "gateway.web", "viewer.ops"}),
        (KEYS.everything(), {"archive.disk"}),
    ],
)
def test_who_may_hear(expression: str, who: set[str]) -> None:
    assert who_may("declare_subscriber", expression) == who
    assert {one for one in EVERYBODY if allowed(one, "put", expression, "egress")} == who


@pytest.mark.parametrize(
    ("expression", "who"),
    [
        (KEYS.service("tracks", "*"), {"fusion.one", "fusion.two", "archive.disk", "gateway.web", "viewer.ops"}),
        (KEYS.service("emi", "*"), {"gateway.web", "viewer.ops"}),
        (KEYS.service("history", "disk"), {"gateway.web", "viewer.ops"}),
        (f"{KEYS.plots('north')}/@adv/pub/a1/7/_", {"fusion.one", "fusion.two", "archive.disk"}),
    ],
)
def test_who_may_ask(expression: str, who: set[str]) -> None:
    assert who_may("query", expression) == who


def test_sensors_hear_and_ask_nothing() -> None:
    for message in ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"):
        for key in (KEYS.plots("north"), KEYS.sensor("north"), KEYS.live("sensor", "north"), KEYS.everything()):
            assert not allowed("sensor.north", message, key)


def test_everybody_is_told_who_listens() -> None:
    for who in EVERYBODY:
        assert allowed(who, "declare_subscriber", KEYS.everything(), "egress")
        assert allowed(who, "query", KEYS.service("tracks", "*"), "egress")


def test_strangers_and_other_realms_may_nothing() -> None:
    control: Any = access_control(PLAN)
    assert control["enabled"]
    assert control["default_permission"] == "deny"
    assert all(e.startswith("trackmesh/@v1/") for rule in control["rules"] for e in rule["key_exprs"])


def test_another_router_speaks_for_all() -> None:
    assert allowed("router.main", "put", KEYS.plots("north"))
    assert allowed("router.main", "put", KEYS.plots("north"), "egress")


def test_every_role_has_rights_and_what_it_hears_does_not_depend_on_its_name() -> None:
    assert set(RIGHTS) == {*PLAN.participants, "router"}
    for rights in RIGHTS.values():
        one, other = rights(KEYS, ["a"]), rights(KEYS, ["b"])
        assert (one.hears, one.asks, one.watches) == (other.hears, other.asks, other.watches)


def test_with_passwords_users_are_named() -> None:
    control: Any = access_control(PLAN.model_copy(update={"security": "passwords"}))
    assert {"id": "sensor.north", "usernames": ["sensor.north"]} in control["subjects"]


def test_every_family_of_keys_is_somebodys() -> None:
    """Whoever adds a family says in ``rights.py`` whose it is; else secured deployments would be silent there."""
    methods = [name for name in vars(Keys) if not name.startswith("_") and name not in {"realm", "everything"}]
    arity = {name: len(inspect.signature(getattr(KEYS, name)).parameters) for name in methods}
    families = {getattr(KEYS, name)(*["x"] * count).split("/")[2] for name, count in arity.items()}
    every = [rights(KEYS, ["x"]) for role, rights in RIGHTS.items() if role != "router"]
    owned = {key.split("/")[2] for one in every for key in (*one.says, *one.lives, *one.answers)}
    # The truth is for scoring simulations; there is none where it would have to be secured.
    assert families - owned == {"truth"}
