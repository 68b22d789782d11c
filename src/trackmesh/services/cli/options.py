"""What the commands share: their common options, the way into the network, and how a mistake is told."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, NoReturn, ParamSpec, TypeVar

import typer
from rich.console import Console

from trackmesh.protocol.client import Client
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.services.process import EXIT_FAILED
from trackmesh.services.runtime import ServiceSettings

P = ParamSpec("P")
R = TypeVar("R")

Config = Annotated[Path | None, typer.Option("--config", help="TOML file of settings.")]
Connect = Annotated[str | None, typer.Option("--connect", help="Routers, separated by commas: tcp/host:7447.")]
Realm = Annotated[str | None, typer.Option("--realm", help="Key space of the deployment.")]
UnitId = Annotated[str | None, typer.Option("--unit-id", help="Name of this service.")]
LogFormat = Annotated[str | None, typer.Option("--log-format", help="human or json.")]
LogLevel = Annotated[str | None, typer.Option("--log-level", help="debug, info, warning or error.")]
AsJson = Annotated[bool, typer.Option("--json", help="Write JSON, for programs.")]

out = Console()
err = Console(stderr=True)


def told(command: Callable[P, R]) -> Callable[P, R]:
    """Turn an error of ours into one sentence on stderr and exit code 1."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except TrackmeshError as error:
            fail(str(error))
        except BrokenPipeError:
            # Who read our output has gone; nothing is wrong with us.
            sys.stderr.close()
            raise typer.Exit(EXIT_FAILED) from None

    return run


def fail(sentence: str) -> NoReturn:
    """End with one sentence and exit code 1."""
    err.print(f"trackmesh: {sentence}", style="red", highlight=False, markup=False)
    raise typer.Exit(EXIT_FAILED)


@contextmanager
def client(connect: str | None, realm: str | None, config: Path | None = None) -> Iterator[Client]:
    """A client of the realm; left in order at the end of the block."""
    from trackmesh.protocol.zenoh_bus import ZenohBus

    settings = ServiceSettings.load(config, {"connect": connect, "realm": realm, "connect_timeout_s": 5.0})
    with ZenohBus.open(
        settings.connect, timeout_s=settings.connect_timeout_s, config_path=settings.zenoh_config
    ) as bus:
        yield Client(bus, settings.realm)
