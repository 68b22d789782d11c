"""Credentials: what is missing or unreadable is said before anybody tries to connect."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from trackmesh.protocol.credentials import Credentials
from trackmesh.protocol.errors import BusError
from trackmesh.protocol.zenoh_config import client_config, credentials_of


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "file.pem"
    path.touch()
    return path


def test_a_client_that_shows_a_certificate(file: Path) -> None:
    credentials = Credentials(file, file, file)
    config = client_config(["tls/router:7447"], None, credentials)
    tls = json.loads(config.get_json("transport/link/tls"))
    assert tls["enable_mtls"] is True
    assert {tls[f"{what}"] for what in ("root_ca_certificate", "connect_certificate", "connect_private_key")} == {
        str(file)
    }
    assert credentials_of(config) == credentials


def test_a_client_that_only_looks_at_the_routers(file: Path) -> None:
    config = client_config([], None, Credentials(ca=file))
    assert json.loads(config.get_json("transport/link/tls/enable_mtls")) is None


def test_credentials_win_over_the_file_of_settings(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text('{transport: {auth: {usrpwd: {user: "a", password: "x"}}}}')
    config = client_config([], path, Credentials(user="b", password="y"))
    assert json.loads(config.get_json("transport/auth/usrpwd/user")) == "b"


def test_nothing_is_changed_without() -> None:
    assert str(client_config([])) == str(client_config([], None, Credentials()))


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"certificate": "x"}, "A certificate needs a key as well."),
        ({"key": "x"}, "A key needs a certificate as well."),
        ({"user": "x"}, "A user needs a password as well."),
        ({"password": "x"}, "A password needs a user as well."),
        ({"certificate": "x", "key": "x"}, "A certificate needs a ca as well, for that of the router."),
    ],
)
def test_half_of_something(file: Path, given: dict[str, str], sentence: str) -> None:
    made = {name: file if name in {"certificate", "key"} else value for name, value in given.items()}
    with pytest.raises(BusError) as error:
        Credentials(**made)  # type: ignore[arg-type]
    assert str(error.value) == sentence


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(BusError, match=r"Cannot read the ca .*none\.pem: No such file"):
        Credentials(ca=tmp_path / "none.pem")
