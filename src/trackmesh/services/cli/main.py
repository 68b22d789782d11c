"""The command ``trackmesh``."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from trackmesh.services.cli import deployment, files, induction, network, services, studies, tags
from trackmesh.services.cli.compiling import compile_
from trackmesh.services.cli.demo import demo
from trackmesh.services.cli.scoring import score
from trackmesh.services.cli.tuning import tune

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"trackmesh {version('trackmesh')}")
        raise typer.Exit


@app.callback()
def _top(
    _: Annotated[
        bool, typer.Option("--version", help="Say which version this is, and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Many sensors, one picture of tracks, over Zenoh.

    Settings come from flags, else from TRACKMESH_* in the environment, else from the file given by --config.
    """


for command in (
    demo,
    *(services.router, services.fusion, services.emi, tags.tags),
    *(network.watch, network.tracks, network.sensors, network.status, network.play, induction.invert),
    *(files.track, tags.locate, score, tune, files.plot, files.schema, studies.study),
    deployment.router_config,
):
    app.command()(command)
app.command("compile")(compile_)
app.add_typer(services.sim, name="sim")
files.convert.command("emi-csv")(induction.convert_emi_csv)
app.add_typer(files.convert, name="convert")
app.add_typer(deployment.certs, name="certs")


def main() -> None:
    """Entry point."""
    app()


if __name__ == "__main__":
    main()
