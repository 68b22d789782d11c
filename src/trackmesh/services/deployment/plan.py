"""The file that describes a deployment: its routers, and who takes part in which role."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from trackmesh.protocol.codec import MAX_BYTES
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import DEFAULT_REALM
from trackmesh.protocol.messages.base import Id

Role = Literal["sensor", "fusion", "emi", "tags", "archive", "gateway", "viewer"]
ROUTER = "router"

_SEALED = ("tls/", "quic/")

Host = Annotated[str, Field(pattern=r"^[A-Za-z0-9:][A-Za-z0-9.:_-]{0,252}$")]


class PlanError(TrackmeshError):
    """A deployment file is wrong; ``str()`` says what."""


class Participant(NamedTuple):
    """Somebody who may take part."""

    role: str
    name: str

    @property
    def common_name(self) -> str:
        """As it stands in the certificate, or as the name of a user. No name has a dot, so it can be taken apart."""
        return f"{self.role}.{self.name}"


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RouterPlan(_Table):
    """One router.

    Attributes:
        listen: endpoints.
        hosts: names and addresses under which it is reached; its certificate is for these.
        connect: endpoints of routers that it joins, such as that of another site.
    """

    listen: Annotated[list[str], Field(min_length=1)] = ["tls/0.0.0.0:7447"]
    hosts: list[Host] = []
    connect: list[str] = []


class Limits(_Table):
    """What a router lets pass; None is no limit.

    Attributes:
        message_bytes: of any message.
        plots_bytes: of a batch of plots or ranges.
        plots_per_s: batches of plots or ranges over one link. What comes too soon after the one before is not passed
            on; with a margin of ten or more only floods meet it, and what a burst loses is fetched again.
        links: at a time.
    """

    message_bytes: Annotated[int, Field(ge=1024, le=MAX_BYTES)] = MAX_BYTES
    plots_bytes: Annotated[int, Field(ge=1024, le=MAX_BYTES)] = 4 * 2**20
    plots_per_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    links: Annotated[int, Field(ge=1)] = 1000


class Plan(_Table):
    """A deployment.

    Attributes:
        realm: its key space.
        security: ``certificates`` (mutual TLS), ``passwords``, or ``open`` to whoever reaches it.
        folder: where a router finds its certificate, its key, ``ca.pem`` and ``users.txt``.
        routers: by name.
        participants: their names, by role.
        speaks_for: ids of sensors and networks of readers for which a sensor speaks, if other than its own name.
        limits: what routers let pass.
    """

    realm: Id = DEFAULT_REALM
    security: Literal["certificates", "passwords", "open"] = "certificates"
    folder: str = "certs"
    routers: Annotated[dict[Id, RouterPlan], Field(min_length=1)] = {"main": RouterPlan()}
    participants: dict[Role, list[Id]] = {}
    speaks_for: dict[Id, Annotated[list[Id], Field(min_length=1)]] = {}
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for role, names in self.participants.items():
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"the {role} {twice[0]} stands there twice")
        if strangers := sorted(set(self.speaks_for) - set(self.participants.get("sensor", []))):
            raise ValueError(f"speaks_for has {strangers[0]}, which is no sensor")
        owners: dict[str, str] = {}
        for sensor in self.participants.get("sensor", []):
            for ident in self.ids(sensor):
                if owners.setdefault(ident, sensor) != sensor:
                    raise ValueError(f"{owners[ident]} and {sensor} both speak for {ident}")
        if self.security == "certificates":
            self._only_sealed()
        return self

    def _only_sealed(self) -> None:
        for name, router in self.routers.items():
            for endpoint in [*router.listen, *router.connect]:
                if not endpoint.startswith(_SEALED):
                    raise ValueError(
                        f"the router {name} has the endpoint {endpoint}; with certificates it must be tls/"
                    )

    def ids(self, sensor: str) -> list[str]:
        """For whom a sensor speaks."""
        return self.speaks_for.get(sensor, [sensor])

    def everybody(self) -> Iterator[Participant]:
        """All but the routers."""
        for role, names in self.participants.items():
            for name in names:
                yield Participant(role, name)

    def router(self, name: str | None = None) -> tuple[str, RouterPlan]:
        """A router by its name, or the only one.

        Raises:
            PlanError: there is no such router, or which one is meant is not clear.
        """
        if name is None and len(self.routers) > 1:
            raise PlanError(f"Which router? There are {', '.join(self.routers)}.")
        name = name or next(iter(self.routers))
        if name not in self.routers:
            raise PlanError(f"There is no router {name}, only {', '.join(self.routers)}.")
        return name, self.routers[name]


def load_plan(path: Path) -> Plan:
    """The deployment of a TOML file.

    Raises:
        PlanError: it cannot be read, or is wrong.
    """
    try:
        with path.open("rb") as file:
            return Plan.model_validate(tomllib.load(file))
    except OSError as error:
        raise PlanError(f"Cannot read {path}: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise PlanError(f"{path} is no TOML: {error}.") from None
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise PlanError(f"{path} is wrong{f' at {where}' if where else ''}: {message}.") from None
