"""What the commands share: their common options, the way into the network, and how people are told."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Literal, NoReturn, ParamSpec, TypeVar

import typer
from rich.console import Console

from trackmesh.protocol.client import Client
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.services.process import EXIT_FAILED
from trackmesh.services.runtime import ServiceSettings

P = ParamSpec("P")
R = TypeVar("R")

Config = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="TOML file of settings.")]
Connect = Annotated[
    str | None,
    typer.Option("--connect", metavar="ENDPOINTS", help="Routers, separated by commas; default: tcp/127.0.0.1:7447."),
]
Realm = Annotated[
    str | None, typer.Option("--realm", metavar="NAME", help="Key space of the deployment; default: trackmesh.")
]
Inputs = Annotated[
    str | None,
    typer.Option("--inputs", metavar="UNITS", help="Take the tracks of these units as well, separated by commas."),
]
UnitId = Annotated[str | None, typer.Option("--unit-id", metavar="NAME", help="Name of this service; default: main.")]
Unit = Annotated[
    str, typer.Option("--unit", metavar="NAME", help="Ask this unit only; default: all.", show_default=False)
]
LogFormat = Annotated[Literal["human", "json"] | None, typer.Option("--log-format", help="How the log is written.")]
LogLevel = Annotated[
    Literal["debug", "info", "warning", "error"] | None, typer.Option("--log-level", help="The least that is logged.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Write JSON, for programs.")]
Scenario = Annotated[str, typer.Option("--scenario", metavar="NAME|FILE", help="A scenario's name, or a TOML file.")]
Seed = Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Everything random follows from it.")]

PATIENCE_S = 2.0
"""How long a command that only asks tries to find a router, unless a setting says otherwise."""

PROBE_S = 0.3
"""And how long one of several routers may take to answer."""

_WIDE = 160
_ROOM_TO_WRAP = None if sys.stdout.isatty() or "COLUMNS" in os.environ else _WIDE

out = Console(width=_ROOM_TO_WRAP)
err = Console(stderr=True)


def say(sentence: str, style: str = "") -> None:
    """Tell people something, on stderr: one line, however long."""
    one_line = " ".join(sentence.split())
    err.print(one_line, style=style, highlight=False, markup=False, soft_wrap=True)


def fail(sentence: str) -> NoReturn:
    """End with one sentence and exit code 1."""
    say(f"trackmesh: {sentence}", style="red")
    raise typer.Exit(EXIT_FAILED)


def told(command: Callable[P, R]) -> Callable[P, R]:
    """Turn an error of ours, or of the disk, into one sentence on stderr and exit code 1."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            result = command(*args, **kwargs)
            sys.stdout.flush()
        except TrackmeshError as error:
            fail(str(error))
        except BrokenPipeError:
            # Who read our output has gone; nothing is wrong with us, and the interpreter must not flush once more.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(EXIT_FAILED) from None
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            fail(f"{where}{error.strerror or error}.")
        return result

    return run


@contextmanager
def client(connect: str | None, realm: str | None, config: Path | None = None) -> Iterator[Client]:
    """A client of the realm; left in order at the end of the block."""
    from trackmesh.protocol.zenoh_bus import ZenohBus

    settings = ServiceSettings.load(config, {"connect": connect, "realm": realm})
    patience_s = settings.connect_timeout_s if "connect_timeout_s" in settings.model_fields_set else PATIENCE_S
    with ZenohBus.open(
        settings.endpoints(),
        timeout_s=patience_s,
        config_path=settings.zenoh_config,
        credentials=settings.credentials(),
    ) as bus:
        yield Client(bus, settings.realm)


def endpoints(connect: str | None, config: Path | None = None) -> list[str]:
    """Where the routers are, as far as flags, environment and file say."""
    return ServiceSettings.load(config, {"connect": connect}).endpoints()


def reach(endpoint: str, config: Path | None = None) -> None:
    """Join through one router, and leave.

    Raises:
        TrackmeshError: it does not answer.
    """
    from trackmesh.protocol.zenoh_bus import ZenohBus

    settings = ServiceSettings.load(config)
    ZenohBus.open(
        [endpoint], timeout_s=PROBE_S, config_path=settings.zenoh_config, credentials=settings.credentials()
    ).close()


def corners(text: str | None, option: str) -> list[float] | None:
    """Four numbers separated by commas; a usage error otherwise."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
        raise typer.BadParameter(f"{text!r} must be 4 numbers separated by commas.", param_hint=option)
    return numbers


def instant_ns(text: str | None, option: str) -> int | None:
    """Unix time in seconds, or ``+5`` for five seconds from now, as nanoseconds; a usage error otherwise."""
    if text is None:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    at_s = seconds + time.time() if text.startswith("+") else seconds
    # Beyond 2262 nanoseconds no longer fit.
    if not 0.0 <= at_s < 2**63 / 1e9:
        raise typer.BadParameter(f"{text!r} must be a Unix time in seconds, or +5 for 5 s from now.", param_hint=option)
    return round(at_s * 1e9)
