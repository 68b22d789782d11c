"""Commands that prepare a secured deployment: certificates, and the settings of routers."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.table import Table

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages.base import ID_PATTERN, ID_RE
from trackmesh.services.cli.options import AsJson, out, say, told
from trackmesh.services.process import EXIT_FAILED

if TYPE_CHECKING:
    from trackmesh.services.deployment.authority import Certificate
    from trackmesh.services.deployment.plan import Participant, Plan

certs = typer.Typer(help="A small certificate authority for one deployment.", no_args_is_help=True)

Folder = Annotated[Path, typer.Option("--folder", metavar="FOLDER", help="Of the authority and what it issues.")]
Plan_ = Annotated[Path, typer.Argument(metavar="DEPLOYMENT.toml", help="Who takes part, see docs/security.md.")]
AnyRole = Literal["router", "sensor", "fusion", "emi", "tags", "archive", "gateway", "viewer"]

_CERTS = Path("certs")


@certs.command("init")
@told
def certs_init(
    folder: Folder = _CERTS,
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Of the deployment.")] = "trackmesh",
    days: Annotated[float, typer.Option("--days", min=0.001, metavar="N", help="How long it holds.")] = 3650,
) -> None:
    """Make an authority: ca.pem for everybody, ca.key for nobody."""
    from trackmesh.services.deployment.authority import create_authority

    made = create_authority(folder, name, days)
    say(f"{made.path} until {made.ends:%Y-%m-%d}; keep {folder / 'ca.key'} where no participant reads it")


@certs.command("issue")
@told
def certs_issue(
    role: Annotated[AnyRole | None, typer.Argument(metavar="ROLE", help="router, sensor, fusion, ...")] = None,
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Of the router or participant.")] = None,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="HOST", help="Name or address under which a router is reached; repeat it."),
    ] = None,
    deployment: Annotated[
        Path | None,
        typer.Option("--deployment", metavar="DEPLOYMENT.toml", help="Issue what is missing for all of a deployment."),
    ] = None,
    days: Annotated[float, typer.Option("--days", min=0.001, metavar="N", help="How long it holds.")] = 365,
    renew: Annotated[bool, typer.Option("--renew", help="Replace key and certificate.")] = False,
    folder: Folder = _CERTS,
) -> None:
    """Issue a key and a certificate, for one or for a whole deployment."""
    from trackmesh.services.deployment.authority import issue, read_certificate

    for who, hosts in _wanted(role, name, host or [], deployment):
        there = folder / f"{who.common_name}.pem"
        if deployment is not None and not renew and there.exists():
            if set(read_certificate(there).hosts) != set(hosts):
                say(f"{there} is for other hosts than {deployment} says; issue it again, with --renew")
            continue
        made = issue(folder, who, hosts, days, renew=renew)
        say(f"{made.path} until {made.ends:%Y-%m-%d}")


@certs.command("show")
@told
def certs_show(
    path: Annotated[Path, typer.Argument(metavar="FOLDER|FILE", help="What to look at.")] = _CERTS,
    within: Annotated[
        float, typer.Option("--within", metavar="DAYS", help="Exit code 1 if any ends within so many days.")
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Show whose certificates there are, and how long they hold."""
    from trackmesh.services.deployment.authority import read_certificate, read_folder

    found = [read_certificate(path)] if path.is_file() else read_folder(path)
    if as_json:
        json.dump([_row(one) for one in found], sys.stdout, indent=2)
        print()
    else:
        out.print(_table(found))
    if any(one.days_left() < within or not one.vouched for one in found):
        raise typer.Exit(EXIT_FAILED)


@told
def router_config(
    deployment: Plan_,
    router: Annotated[
        str | None, typer.Option("--router", metavar="NAME", help="Which router; may be left out if there is one.")
    ] = None,
    out_path: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.json5", help="File to write; default: standard output.")
    ] = None,
    folder: Annotated[
        str | None,
        typer.Option("--folder", metavar="FOLDER", help="Where the router finds its files, if not as the plan says."),
    ] = None,
    users: Annotated[
        Path | None,
        typer.Option("--users", metavar="FILE", help="With passwords: file to write them to; new ones are drawn."),
    ] = None,
) -> None:
    """Write the settings of a router: who may do what.

    For `trackmesh router --config` and `zenohd -c` alike.
    """
    from trackmesh.services.deployment.plan import ROUTER, Participant, load_plan
    from trackmesh.services.deployment.router_file import router_file

    plan = load_plan(deployment)
    if folder is not None:
        plan = plan.model_copy(update={"folder": folder})
    password = None
    if plan.security == "passwords":
        password = _passwords(plan, users)[Participant(ROUTER, plan.router(router)[0]).common_name]
    text = router_file(plan, router, password=password)
    if out_path is None:
        sys.stdout.write(text)
        return
    out_path.write_text(text, encoding="utf-8")
    if password is not None:
        out_path.chmod(0o600)
    say(f"{out_path}: {sum(1 for _ in plan.everybody())} participants, security by {plan.security}")


def _passwords(plan: Plan, path: Path | None) -> dict[str, str]:
    from trackmesh.services.deployment.users import read_users, updated_users, write_users

    if path is None:
        raise TrackmeshError("A deployment with passwords needs --users, the file that keeps them.")
    users = updated_users(plan, read_users(path))
    write_users(path, users)
    return users


def _wanted(
    role: AnyRole | None, name: str | None, hosts: list[str], deployment: Path | None
) -> list[tuple[Participant, list[str]]]:
    from trackmesh.services.deployment.plan import ROUTER, Participant, load_plan

    if deployment is not None:
        if role is not None or hosts:
            raise typer.BadParameter("--deployment says for whom; leave out role, name and --host.")
        plan = load_plan(deployment)
        routers = [(Participant(ROUTER, router), table.hosts) for router, table in plan.routers.items()]
        return [*routers, *((who, []) for who in plan.everybody())]
    if role is None or name is None:
        raise typer.BadParameter("Give a role and a name, or --deployment.")
    if not ID_RE.fullmatch(name):
        raise typer.BadParameter(f"The name {name!r} must match {ID_PATTERN}.")
    if hosts and role != ROUTER:
        raise typer.BadParameter("Only a router has hosts.")
    return [(Participant(role, name), hosts)]


def _row(one: Certificate) -> dict[str, object]:
    return {
        "file": str(one.path),
        "common_name": one.common_name,
        "hosts": one.hosts,
        "begins": one.begins.isoformat(),
        "ends": one.ends.isoformat(),
        "days_left": round(one.days_left(), 3),
        "vouched": one.vouched,
    }


def _table(found: list[Certificate]) -> Table:
    table = Table("name", "hosts", "until", "days left", "vouched for")
    for one in found:
        left = one.days_left()
        days = f"{left:.0f}" if left > 0 else "ended"
        until = f"{one.ends:%Y-%m-%d %H:%M}"
        table.add_row(one.common_name, " ".join(one.hosts), until, days, "yes" if one.vouched else "NO")
    return table
