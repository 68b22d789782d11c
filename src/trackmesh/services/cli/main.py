"""The command ``trackmesh``."""

from __future__ import annotations

import typer

from trackmesh.services.cli import files, network, services
from trackmesh.services.cli.demo import demo

app = typer.Typer(
    help="trackmesh: many sensors, one picture, over Zenoh.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

for command in (
    demo,
    *(services.router, services.fusion, services.emi),
    *(network.watch, network.tracks, network.sensors, network.status, network.play, network.invert),
    *(files.track, files.score, files.plot, files.schema),
):
    app.command()(command)
app.add_typer(services.sim, name="sim")
app.add_typer(files.convert, name="convert")


def main() -> None:
    """Entry point."""
    app()


if __name__ == "__main__":
    main()
