"""``trackmesh certs`` and ``trackmesh router-config``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import zenoh
from tests.services.cli.conftest import Run

_PLAN = """
[routers.main]
hosts = ["localhost", "127.0.0.1"]
[participants]
sensor = ["north", "east"]
viewer = ["ops"]
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deployment.toml").write_text(_PLAN)
    return tmp_path


def test_from_one_file_to_a_secured_deployment(here: Path, run: Run) -> None:
    for command in (
        ("certs", "init"),
        ("certs", "issue", "--deployment", "deployment.toml"),
        ("router-config", "deployment.toml", "--out", "router.json5"),
    ):
        done = run(*command)
        assert done.exit_code == 0, done.output
    made = {path.name for path in (here / "certs").glob("*.pem")}
    assert made == {"ca.pem", "router.main.pem", "sensor.north.pem", "sensor.east.pem", "viewer.ops.pem"}
    assert json.loads(zenoh.Config.from_file(here / "router.json5").get_json("access_control/enabled"))
    shown = json.loads(run("certs", "show", "--json").stdout)
    assert [one["common_name"] for one in shown][:2] == ["trackmesh authority", "router.main"]
    assert all(one["vouched"] for one in shown)


def test_a_participant_that_comes_later(here: Path, run: Run) -> None:
    run("certs", "init")
    run("certs", "issue", "--deployment", "deployment.toml")
    before = (here / "certs/sensor.north.pem").read_bytes()
    (here / "deployment.toml").write_text(_PLAN.replace('"east"', '"east", "west"'))
    done = run("certs", "issue", "--deployment", "deployment.toml")
    assert done.stderr.count("\n") == 1
    assert "sensor.west.pem until" in done.stderr
    assert (here / "certs/sensor.north.pem").read_bytes() == before


def test_a_router_that_is_reached_elsewhere_now(here: Path, run: Run) -> None:
    run("certs", "init")
    run("certs", "issue", "--deployment", "deployment.toml")
    assert run("certs", "issue", "--deployment", "deployment.toml").stderr == ""
    (here / "deployment.toml").write_text(_PLAN.replace('"localhost"', '"elsewhere"'))
    told = run("certs", "issue", "--deployment", "deployment.toml").stderr
    assert "router.main.pem is for other hosts than deployment.toml says" in told


def test_what_ends_soon_is_an_exit_code(here: Path, run: Run) -> None:
    run("certs", "init")
    run("certs", "issue", "sensor", "north", "--days", 20)
    assert run("certs", "show").exit_code == 0
    assert run("certs", "show", "--within", 30).exit_code == 1
    assert run("certs", "show", "certs/sensor.north.pem", "--within", 10).exit_code == 0


def test_passwords(here: Path, run: Run) -> None:
    (here / "deployment.toml").write_text(
        'security = "passwords"\nparticipants.viewer = ["ops"]\nrouters.main.listen = ["tcp/0.0.0.0:7447"]\n'
    )
    refused = run("router-config", "deployment.toml")
    assert refused.exit_code == 1
    assert "needs --users" in refused.stderr
    done = run("router-config", "deployment.toml", "--users", "users.txt", "--out", "router.json5")
    assert done.exit_code == 0, done.output
    assert (here / "users.txt").read_text().startswith("viewer.ops:")
    assert (here / "router.json5").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("command", "sentence", "code"),
    [
        (("certs", "issue", "sensor", "north"), "There is no ca.pem in certs", 1),
        (("certs", "issue", "sensor"), "Give a role and a name", 2),
        (("certs", "issue", "sensor", "North"), "must match", 2),
        (("certs", "issue", "sensor", "north", "--host", "x"), "Only a router has hosts", 2),
        (("certs", "issue", "pilot", "north"), "pilot", 2),
        (("certs", "issue", "sensor", "a", "--deployment", "deployment.toml"), "leave out role", 2),
        (("certs", "show"), "There are no certificates in certs", 1),
        (("router-config", "none.toml"), "Cannot read none.toml", 1),
        (("router-config", "deployment.toml", "--router", "b"), "There is no router b, only main", 1),
        (("router-config", "deployment.toml", "--out", "none/x.json5"), "No such file", 1),
    ],
)
def test_a_mistake_is_one_sentence(here: Path, run: Run, command: tuple[str, ...], sentence: str, code: int) -> None:
    done = run(*command)
    assert done.exit_code == code
    assert sentence in done.stderr
    assert "Traceback" not in done.output
