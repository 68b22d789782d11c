"""The passwords of a deployment without certificates: one line each, ``sensor.north:...``, as Zenoh reads them."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from trackmesh.services.deployment.plan import ROUTER, Participant, Plan, PlanError

_BYTES = 24


def read_users(path: Path) -> dict[str, str]:
    """Passwords by name; none if there is no file.

    Raises:
        PlanError: a line is no name and password.
        OSError: the file cannot be read.
    """
    if not path.exists():
        return {}
    found: dict[str, str] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        name, colon, password = line.strip().partition(":")
        if not (name and colon and password):
            raise PlanError(f"Line {number} of {path} is no name:password.")
        found[name] = password
    return found


def updated_users(plan: Plan, known: dict[str, str]) -> dict[str, str]:
    """Who takes part and the routers, each with its known password or a new one; others are left out."""
    everybody = [*plan.everybody(), *(Participant(ROUTER, name) for name in plan.routers)]
    return {who.common_name: known.get(who.common_name) or secrets.token_urlsafe(_BYTES) for who in everybody}


def write_users(path: Path, users: dict[str, str]) -> None:
    """Write the file for nobody but its owner to read, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as file:
        file.writelines(f"{name}:{password}\n" for name, password in users.items())
    fresh.replace(path)
