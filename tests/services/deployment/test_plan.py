"""The deployment file: what it means, and what a user reads when it is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from trackmesh.services.deployment.plan import Participant, Plan, PlanError, RouterPlan, load_plan


def load(tmp_path: Path, text: str) -> Plan:
    path = tmp_path / "deployment.toml"
    path.write_text(text)
    return load_plan(path)


def test_an_empty_file_is_one_router_that_nobody_may_use(tmp_path: Path) -> None:
    plan = load(tmp_path, "")
    assert list(plan.everybody()) == []
    assert plan.router() == ("main", RouterPlan())


def test_participants_by_role(tmp_path: Path) -> None:
    plan = load(tmp_path, 'participants.sensor = ["north"]\nparticipants.viewer = ["north", "ops"]')
    assert [who.common_name for who in plan.everybody()] == ["sensor.north", "viewer.north", "viewer.ops"]
    assert plan.ids("north") == ["north"]


def test_a_sensor_may_speak_for_several(tmp_path: Path) -> None:
    plan = load(tmp_path, 'participants.sensor = ["hall"]\n[speaks_for]\nhall = ["hall", "reader-1", "reader-2"]')
    assert plan.ids("hall") == ["hall", "reader-1", "reader-2"]


def test_the_common_name_can_be_taken_apart() -> None:
    assert Participant("sensor", "a-b_c").common_name.split(".") == ["sensor", "a-b_c"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x = [", "is no TOML"),
        ("port = 1", "is wrong at port: Extra inputs are not permitted"),
        ('participants.pilot = ["a"]', "is wrong at participants.pilot"),
        ('participants.sensor = ["North"]', "String should match pattern"),
        ('participants.sensor = ["a", "b", "a"]', "the sensor a stands there twice"),
        ('speaks_for.x = ["a"]', "speaks_for has x, which is no sensor"),
        ('participants.sensor = ["a", "b"]\nspeaks_for.a = ["b"]', "a and b both speak for b"),
        ('routers.main.listen = ["tcp/0.0.0.0:7447"]', "with certificates it must be tls/"),
        ('routers.main.connect = ["tcp/other:7447"]', "with certificates it must be tls/"),
        ('routers.main.hosts = ["not a host"]', "String should match pattern"),
        ("routers = {}", "at least 1 item"),
        ("limits.plots_per_s = 0", "greater than 0"),
        ("limits.message_bytes = 99999999999", "less than or equal to"),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(PlanError) as error:
        load(tmp_path, text)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="No such file"):
        load_plan(tmp_path / "none.toml")


def test_which_router_must_be_clear() -> None:
    plan = Plan(routers={"a": RouterPlan(), "b": RouterPlan()})
    with pytest.raises(PlanError, match=r"Which router\? There are a, b\."):
        plan.router()
    with pytest.raises(PlanError, match="There is no router c, only a, b"):
        plan.router("c")
    assert plan.router("b")[0] == "b"
