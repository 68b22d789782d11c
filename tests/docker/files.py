"""The files of ``docker/``, read as what they are."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import typer
import yaml

from trackmesh.services.cli.main import app
from trackmesh.services.deployment.plan import ROUTER, Participant, Plan
from trackmesh.services.settings import ENV_PREFIX, ServiceSettings

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
COMPOSE = {"one host": DOCKER / "compose.yaml", "two sites": DOCKER / "two-sites" / "compose.yaml"}
BASE, DEMO = DOCKER / "kubernetes" / "base", DOCKER / "kubernetes" / "demo"


def read_yaml(path: Path) -> list[Any]:
    """All documents of a file."""
    return [document for document in yaml.safe_load_all(path.read_text()) if document is not None]


def parsed(arguments: Sequence[str]) -> tuple[str, dict[str, Any]]:
    """A command line of ``trackmesh`` as the program understands it: the command, and its parameters.

    Raises:
        click.UsageError: it does not.
    """
    command = _program()
    context = click.Context(command, info_name="trackmesh")
    names: list[str] = []
    rest = list(arguments)
    while hasattr(command, "commands"):
        name, found, rest = command.resolve_command(context, rest)
        command, names = found, [*names, name]
        context = command.make_context(name, list(rest), parent=context) if not hasattr(found, "commands") else context
    return " ".join(names), context.params


@functools.cache
def _program() -> Any:
    return typer.main.get_command(app)


def who_runs(arguments: Sequence[str]) -> Participant:
    """Whose certificate a command needs."""
    command, given = parsed(arguments)
    if command == "sim radar":
        return Participant("sensor", given["radar"])
    if command == "sim tags":
        return Participant("sensor", "hall")
    if command in {"status", "tracks", "watch"}:
        return Participant("viewer", "ops")
    return Participant(command, given["unit_id"] or "main")


def unknown_settings(names: Sequence[str]) -> list[str]:
    """Environment variables that no service reads."""
    return [name for name in names if name.startswith(ENV_PREFIX) and not _known(name)]


def _known(name: str) -> bool:
    first, *rest = name.removeprefix(ENV_PREFIX).lower().split("__")
    field = ServiceSettings.model_fields.get(first)
    if field is None:
        return first == "cache"
    inner = getattr(field.annotation, "model_fields", {})
    return rest[0] in inner if rest else not inner


def certificate_files(plan: Plan) -> set[str]:
    """What ``trackmesh certs`` makes for a plan, without the authority's key."""
    everybody = [*plan.everybody(), *(Participant(ROUTER, name) for name in plan.routers)]
    return {"ca.pem"} | {f"{who.common_name}.{end}" for who in everybody for end in ("pem", "key")}


def workloads(paths: Sequence[Path]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and pod of every Kubernetes deployment."""
    for path in paths:
        for document in read_yaml(path):
            if document["kind"] == "Deployment":
                yield document["metadata"]["name"], document["spec"]["template"]["spec"]
