"""The router's settings are read by Zenoh, by the Python router and by ``zenohd`` alike."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from trackmesh.protocol.zenoh_config import router_config
from trackmesh.services.deployment.plan import Limits, Plan, PlanError, RouterPlan
from trackmesh.services.deployment.router_file import router_file
from trackmesh.services.deployment.users import read_users, updated_users, write_users

PLAN = Plan(participants={"sensor": ["north"], "fusion": ["main"], "viewer": ["ops"]})


def read(tmp_path: Path, plan: Plan, name: str | None = None, **more: str) -> Any:
    """As the Python router reads it; Zenoh refuses settings that it does not know."""
    path = tmp_path / "router.json5"
    path.write_text(router_file(plan, name, **more))
    config = router_config([], path)
    return lambda key: json.loads(config.get_json(key))


def test_links_are_sealed_and_both_sides_show_who_they_are(tmp_path: Path) -> None:
    setting = read(tmp_path, PLAN.model_copy(update={"folder": "/etc/trackmesh"}))
    tls = setting("transport/link/tls")
    assert tls["enable_mtls"]
    assert tls["verify_name_on_connect"]
    assert tls["close_link_on_expiration"]
    assert tls["root_ca_certificate"] == "/etc/trackmesh/ca.pem"
    assert tls["listen_private_key"] == "/etc/trackmesh/router.main.key"
    assert setting("transport/link/protocols") == ["tls", "quic"]
    assert setting("listen/endpoints") == ["tls/0.0.0.0:7447"]
    assert setting("access_control/enabled")


def test_the_python_router_changes_nothing_of_it(tmp_path: Path) -> None:
    """So zenohd, which reads the file alone, does the same."""
    path = tmp_path / "router.json5"
    path.write_text(router_file(PLAN))
    ours, alone = router_config([], path), zenoh.Config.from_file(path)
    assert json.loads(str(ours)) == json.loads(str(alone))


def test_passwords(tmp_path: Path) -> None:
    plan = PLAN.model_copy(
        update={"security": "passwords", "routers": {"main": RouterPlan(listen=["tcp/127.0.0.1:7447"])}}
    )
    setting = read(tmp_path, plan, password="secret")
    auth = setting("transport/auth/usrpwd")
    assert (auth["user"], auth["password"]) == ("router.main", "secret")
    assert auth["dictionary_file"] == "certs/users.txt"
    assert setting("access_control/subjects")[0]["usernames"] == ["sensor.north"]
    assert setting("transport/link/tls/root_ca_certificate") is None


def test_an_open_deployment_asks_for_nothing(tmp_path: Path) -> None:
    setting = read(tmp_path, Plan(security="open", routers={"main": RouterPlan(listen=["tcp/0.0.0.0:7447"])}))
    assert not setting("access_control/enabled")
    assert setting("transport/auth/usrpwd/dictionary_file") is None


def test_limits(tmp_path: Path) -> None:
    limits = Limits(message_bytes=2**20, plots_bytes=2**16, plots_per_s=50.0, links=7)
    setting = read(tmp_path, PLAN.model_copy(update={"limits": limits}))
    assert [one["size_limit"] for one in setting("low_pass_filter")] == [2**20, 2**16]
    assert {rule["freq"] for rule in setting("downsampling")[0]["rules"]} == {50.0}
    assert setting("transport/unicast/max_sessions") == 7


def test_two_sites(tmp_path: Path) -> None:
    plan = Plan(routers={"a": RouterPlan(hosts=["a"], connect=["tls/b:7447"]), "b": RouterPlan(hosts=["b"])})
    a, b = read(tmp_path, plan, "a"), read(tmp_path, plan, "b")
    assert a("connect/endpoints") == ["tls/b:7447"]
    assert a("transport/link/tls/connect_certificate") == "certs/router.a.pem"
    assert b("connect/endpoints") == []
    assert {one["id"] for one in b("access_control/subjects")} == {"router.a", "router.b"}
    with pytest.raises(PlanError, match="Which router"):
        router_file(plan)


def test_known_passwords_stay_and_leavers_go(tmp_path: Path) -> None:
    path = tmp_path / "users.txt"
    assert read_users(path) == {}
    path.write_text("sensor.north:old\nsensor.gone:x\n")
    users = updated_users(PLAN, read_users(path))
    assert list(users) == ["sensor.north", "fusion.main", "viewer.ops", "router.main"]
    assert users["sensor.north"] == "old"
    assert len({len(users[name]) for name in list(users)[1:]}) == 1
    assert len(users["viewer.ops"]) >= 32
    write_users(path, users)
    assert read_users(path) == users
    assert path.stat().st_mode & 0o777 == 0o600
    path.write_text("nonsense\n")
    with pytest.raises(PlanError, match=r"Line 1 of .* is no name:password"):
        read_users(path)
