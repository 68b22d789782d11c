"""The compose files: by the schema of the specification, and by what they mean."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.docker.files import COMPOSE, certificate_files, parsed, read_yaml, unknown_settings, who_runs

from trackmesh.services.deployment.plan import ROUTER, Participant, Plan, load_plan
from trackmesh.services.deployment.router_file import router_file

pytestmark = pytest.mark.parametrize("path", COMPOSE.values(), ids=COMPOSE)


def load(path: Path) -> tuple[dict[str, Any], Plan]:
    (compose,) = read_yaml(path)
    return compose, load_plan(path.parent / "deployment.toml")


def ours(compose: dict[str, Any]) -> dict[str, Any]:
    return {name: one for name, one in compose["services"].items() if one["image"].startswith("trackmesh:")}


def routers(compose: dict[str, Any]) -> dict[str, Any]:
    return {name: one for name, one in compose["services"].items() if one["image"].startswith("eclipse/zenoh:")}


def files_of(service: dict[str, Any], compose: dict[str, Any]) -> dict[str, str]:
    """Where a service finds which file."""
    found = {}
    for one in service["secrets"]:
        source, target = (one, one) if isinstance(one, str) else (one["source"], one["target"])
        found[target if target.startswith("/") else f"/run/secrets/{target}"] = compose["secrets"][source]["file"]
    return found


def test_the_schema_of_the_specification(path: Path) -> None:
    tool = Path(sys.executable).with_name("check-jsonschema")
    if not tool.exists() and shutil.which(tool.name) is None:
        pytest.skip("check-jsonschema is not installed")
    command = [str(tool) if tool.exists() else tool.name, "--builtin-schema", "vendor.compose-spec", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout


def test_every_command_is_one_of_ours_and_shows_its_own_certificate(path: Path) -> None:
    compose, plan = load(path)
    for name, service in ours(compose).items():
        who = who_runs(service["command"])
        assert who in set(plan.everybody()), name
        settings, files = service["environment"], files_of(service, compose)
        assert files[settings["TRACKMESH_TLS__CA"]] == "certs/ca.pem"
        assert files[settings["TRACKMESH_TLS__CERTIFICATE"]] == f"certs/{who.common_name}.pem"
        assert files[settings["TRACKMESH_TLS__KEY"]] == f"certs/{who.common_name}.key"


def test_every_setting_exists(path: Path) -> None:
    compose, _ = load(path)
    for service in ours(compose).values():
        assert unknown_settings(list(service["environment"])) == []


def test_every_certificate_is_one_that_is_issued(path: Path) -> None:
    compose, plan = load(path)
    assert {Path(one["file"]).name for one in compose["secrets"].values()} == certificate_files(plan)


def test_services_reach_a_router_by_a_name_that_its_certificate_has(path: Path) -> None:
    compose, plan = load(path)
    for name, service in ours(compose).items():
        host, port = re.fullmatch(r"tls/([\w-]+):(\d+)", service["environment"]["TRACKMESH_CONNECT"]).groups()  # type: ignore[union-attr]
        router = compose["services"][host]
        assert host in service["depends_on"]
        assert set(service["networks"]) & set(router["networks"]), name
        (planned,) = (one for one in plan.routers.values() if host in one.hosts)
        assert planned.listen == [f"tls/0.0.0.0:{port}"]
        assert router["healthcheck"]["test"][-1] == port


def test_a_router_has_the_settings_of_the_plan_and_the_files_they_name(path: Path) -> None:
    compose, plan = load(path)
    assert len(routers(compose)) == len(plan.routers)
    for name, service in routers(compose).items():
        (planned,) = (known for known, one in plan.routers.items() if name in one.hosts)
        (config,) = service["configs"]
        assert service["command"][:2] == ["-c", config["target"]]
        assert "--rest-http-port=none" in service["command"]
        text = (path.parent / compose["configs"][config["source"]]["file"]).read_text()
        assert text == router_file(plan, planned)
        named = {target: Path(file).name for target, file in files_of(service, compose).items()}
        own = Participant(ROUTER, planned).common_name
        wanted = ("ca.pem", f"{own}.pem", f"{own}.key")
        assert named == {f"{plan.folder}/{file}": file for file in wanted}


def test_containers_may_little(path: Path) -> None:
    compose, _ = load(path)
    for name, service in compose["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert name == "viewer" or service["deploy"]["resources"]["limits"], name


def test_units_of_one_realm_have_their_own_numbers(path: Path) -> None:
    compose, _ = load(path)
    units = [
        given
        for service in ours(compose).values()
        for command, given in [parsed(service["command"])]
        if command == "fusion"
    ]
    numbers = [given["unit_number"] for given in units]
    assert len(set(numbers)) == len(units)
    for given in units:
        assert set((given["inputs"] or "").split(",")) - {""} <= {one["unit_id"] for one in units} - {given["unit_id"]}
