"""Settings of services: flags over environment over file over defaults."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)
from pydantic_settings import SettingsError as _SourceError

from trackmesh.protocol.bus import DEFAULT_ENDPOINT
from trackmesh.protocol.credentials import Credentials
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import DEFAULT_REALM
from trackmesh.protocol.messages.base import Id, Positive
from trackmesh.services.logs import LogFormat, LogLevel

ENV_PREFIX = "TRACKMESH_"


class SettingsError(TrackmeshError):
    """A setting is wrong; ``str()`` says which, where it was given, and why."""


def _split(value: object) -> object:
    if not isinstance(value, str):
        return value
    return [part.strip() for part in value.split(",") if part.strip()]


Texts = Annotated[list[str], NoDecode, BeforeValidator(_split)]
"""A list of strings; in the environment and in flags separated by commas."""


class TlsSettings(BaseModel):
    """Files for ``tls/`` endpoints, all PEM."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ca: Path | None = Field(None, description="certificates of who may vouch for a router")
    certificate: Path | None = Field(None, description="our own certificate, where routers ask for one")
    key: Path | None = Field(None, description="its private key")


class ServiceSettings(BaseSettings):
    """What every service can be told; a service adds its own by subclassing.

    ``load`` reads all sources. The constructor takes its arguments alone, and neither file nor environment, so that
    tests do not depend on where they run.
    """

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, env_nested_delimiter="__", env_ignore_empty=True, extra="forbid", frozen=True
    )

    realm: Id = Field(DEFAULT_REALM, description="key space of the deployment")
    unit_id: Id = Field("main", description="name of this service within its realm and kind")
    connect: Annotated[Texts, Field(min_length=1, description="endpoints of the routers, tried in turn")] = [
        DEFAULT_ENDPOINT
    ]
    tls: TlsSettings = TlsSettings(ca=None, certificate=None, key=None)
    user: str | None = Field(None, description="our name, where routers ask for a password")
    password_file: Path | None = Field(None, description="its first line is the password")
    zenoh_config: Path | None = Field(None, description="JSON5 file of Zenoh settings, for what is not settings here")
    heartbeat_file: Path | None = Field(None, description="rewritten every second, for probes of health")
    connect_timeout_s: Positive = Field(30.0, description="how long to wait for a router at start")
    log_level: LogLevel = "info"
    log_format: LogFormat = "human"
    stop_deadline_s: Positive = Field(5.0, description="an orderly stop that takes longer is cut short")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """The constructor's arguments only; ``load`` reads the rest."""
        return (init_settings,)

    @classmethod
    def load(cls, config: Path | None = None, overrides: Mapping[str, Any] | None = None) -> Self:
        """Settings from all sources.

        Args:
            config: a TOML file, nested tables for nested settings.
            overrides: values of flags; None means not given.

        Raises:
            SettingsError: the file cannot be read, or a setting is unknown or wrong.
        """
        layers = {
            "": {name: value for name, value in (overrides or {}).items() if value is not None},
            " in the environment": _environment(cls),
            f" in {config}": _read_toml(config) if config else {},
        }
        merged: dict[str, Any] = {}
        for layer in reversed(layers.values()):
            merged = _merge(merged, layer)
        try:
            return cls(**merged)
        except ValidationError as error:
            raise SettingsError(_sentence(error, layers)) from None

    def endpoints(self) -> list[str]:
        """Where to connect; empty if that is left to the Zenoh file."""
        return self.connect if "connect" in self.model_fields_set or self.zenoh_config is None else []

    def credentials(self) -> Credentials:
        """What proves who we are to a router.

        Raises:
            SettingsError: the password cannot be read.
            BusError: a file of TLS cannot be read, or one of a pair is missing.
        """
        password = _first_line(self.password_file) if self.password_file else None
        return Credentials(self.tls.ca, self.tls.certificate, self.tls.key, self.user, password)


def _first_line(path: Path) -> str:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise SettingsError(f"Cannot read the password file {path}: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise SettingsError(f"The password file {path} is no text.") from None
    if not lines or not lines[0].strip():
        raise SettingsError(f"The password file {path} is empty.")
    return lines[0].strip()


def _environment(cls: type[BaseSettings]) -> dict[str, Any]:
    try:
        return EnvSettingsSource(cls)()
    except _SourceError as error:
        raise SettingsError(f"A {ENV_PREFIX}* variable cannot be read: {error}.") from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise SettingsError(f"Cannot read {path}: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path} is no TOML: {error}.") from None


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for name, value in over.items():
        old = merged.get(name)
        merged[name] = _merge(old, value) if isinstance(old, dict) and isinstance(value, Mapping) else value
    return merged


def _sentence(error: ValidationError, layers: Mapping[str, Mapping[str, Any]]) -> str:
    first = error.errors(include_url=False, include_context=False)[0]
    path = [str(part) for part in first["loc"]]
    where = next((label for label, layer in layers.items() if _holds(layer, path)), "")
    if first["type"] == "extra_forbidden":
        return f"Unknown setting {'.'.join(path)}{where}."
    return f"The setting {'.'.join(path)}{where} is wrong: {first['msg']} (given: {first['input']!r:.80})."


def _holds(layer: Mapping[str, Any], path: list[str]) -> bool:
    value: Any = layer
    for name in path:
        if not isinstance(value, Mapping):
            return True
        if name not in value:
            return False
        value = value[name]
    return True
