"""Settings: which source wins, and what a user reads when one is wrong."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import pytest
from pydantic import BaseModel, Field

from trackmesh.services.runtime import ServiceSettings, SettingsError, Texts


class Radio(BaseModel):
    channel: int = 1
    power_w: float = 2.0


class Settings(ServiceSettings):
    period_s: Annotated[float, Field(gt=0)] = 1.0
    sensors: Texts = ["*"]
    radio: Radio = Radio()


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith("TRACKMESH_"):
            monkeypatch.delenv(name)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "service.toml"
    path.write_text("period_s = 3\nunit_id = 'file'\n[radio]\nchannel = 3\npower_w = 3\n")
    return path


def test_defaults() -> None:
    settings = Settings.load()
    assert (settings.realm, settings.period_s, settings.connect) == ("trackmesh", 1.0, ["tcp/127.0.0.1:7447"])


def test_flags_over_environment_over_file_over_defaults(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings.load(file).period_s == 3.0
    monkeypatch.setenv("TRACKMESH_PERIOD_S", "4")
    assert Settings.load(file).period_s == 4.0
    assert Settings.load(file, {"period_s": 5.0}).period_s == 5.0
    assert Settings.load(file, {"period_s": None}).period_s == 4.0
    assert Settings.load(file).unit_id == "file"


def test_nested_settings_are_merged_field_by_field(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKMESH_RADIO__CHANNEL", "7")
    assert Settings.load(file).radio == Radio(channel=7, power_w=3.0)


def test_lists_are_separated_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKMESH_CONNECT", "tcp/a:1, tcp/b:2")
    settings = Settings.load(overrides={"sensors": "north,south"})
    assert (settings.connect, settings.sensors) == (["tcp/a:1", "tcp/b:2"], ["north", "south"])


def test_an_empty_variable_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKMESH_PERIOD_S", "")
    assert Settings.load().period_s == 1.0


def test_the_constructor_reads_no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKMESH_PERIOD_S", "4")
    assert Settings().period_s == 1.0


def test_the_endpoints_may_be_left_to_the_zenoh_file(tmp_path: Path) -> None:
    assert Settings().endpoints() == ["tcp/127.0.0.1:7447"]
    assert Settings(zenoh_config=tmp_path).endpoints() == []
    assert Settings(zenoh_config=tmp_path, connect=["tcp/a:1"]).endpoints() == ["tcp/a:1"]


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ({"period_s": 0}, r"The setting period_s is wrong: Input should be greater than 0 \(given: 0\)\.$"),
        ({"unit_id": "North 1"}, r"The setting unit_id is wrong: .*given: 'North 1'"),
        ({"radio": {"channel": "x"}}, r"The setting radio\.channel is wrong"),
        ({"connect": ""}, "The setting connect is wrong"),
        ({"perod_s": 1}, r"Unknown setting perod_s\.$"),
    ],
)
def test_a_wrong_flag_is_one_sentence(overrides: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SettingsError, match=sentence):
        Settings.load(overrides=overrides)


def test_a_wrong_variable_says_that_it_is_one(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKMESH_PERIOD_S", "soon")
    with pytest.raises(SettingsError, match=r"The setting period_s in the environment is wrong: .*'soon'"):
        Settings.load(file)
    monkeypatch.setenv("TRACKMESH_RADIO", "{")
    with pytest.raises(SettingsError, match=r"A TRACKMESH_\* variable cannot be read"):
        Settings.load(file)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("period_s = -1", r"The setting period_s in .*service\.toml is wrong"),
        ("perod_s = 1", r"Unknown setting perod_s in .*service\.toml"),
        ("period_s =", r"service\.toml is no TOML"),
        ("\udcff", r"service\.toml is no TOML"),
    ],
)
def test_a_wrong_file_is_named(file: Path, text: str, sentence: str) -> None:
    file.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(SettingsError, match=sentence):
        Settings.load(file)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"Cannot read .*none\.toml: No such file"):
        Settings.load(tmp_path / "none.toml")


def test_credentials_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ca", "certificate", "key"):
        (tmp_path / name).touch()
        monkeypatch.setenv(f"TRACKMESH_TLS__{name.upper()}", str(tmp_path / name))
    (tmp_path / "password").write_text("secret\nanything else\n")
    monkeypatch.setenv("TRACKMESH_USER", "sensor.north")
    monkeypatch.setenv("TRACKMESH_PASSWORD_FILE", str(tmp_path / "password"))
    found = Settings.load().credentials()
    assert (found.ca, found.certificate, found.key) == tuple(tmp_path / name for name in ("ca", "certificate", "key"))
    assert (found.user, found.password) == ("sensor.north", "secret")


def test_a_password_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    for name, sentence in (("empty", "is empty"), ("none", "No such file")):
        with pytest.raises(SettingsError, match=sentence):
            Settings(user="a", password_file=tmp_path / name).credentials()


def test_no_credentials_by_default() -> None:
    assert Settings.load().credentials().settings() == {}
