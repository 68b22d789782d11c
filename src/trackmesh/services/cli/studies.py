"""The command ``study``: the tables and figures of the papers, ours beside theirs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.services.cli.options import err, out, told
from trackmesh.services.cli.progress import progress_bar
from trackmesh.sim.studies.result import StudyResult

Study = Callable[[Path | None, int, Callable[[float], None] | None], StudyResult]


def _studies() -> dict[str, Study]:
    from trackmesh.sim.studies import alpha_beta, tvimm
    from trackmesh.sim.studies.association import study as association
    from trackmesh.sim.studies.emi import study as emi
    from trackmesh.sim.studies.manoeuvre import study as manoeuvre
    from trackmesh.sim.studies.rfid import study as rfid

    return {
        "tvimm": tvimm.run,
        "manoeuvre": manoeuvre.run,
        "association": association.run,
        "alpha-beta": alpha_beta.run,
        "rfid": rfid.run,
        "emi": emi.run,
    }


@told
def study(
    name: Annotated[str, typer.Argument(help="tvimm, manoeuvre, association, alpha-beta, rfid or emi")],
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the rows here.")] = None,
    plots: Annotated[Path | None, typer.Option("--plots", help="Write the figures to this folder.")] = None,
    runs: Annotated[int, typer.Option("--runs", min=0, help="Monte-Carlo runs; 0: as many as the study needs.")] = 0,
) -> None:
    """Compute a paper's tables anew, beside the printed."""
    known = _studies()
    if name not in known:
        raise TrackmeshError(f"There is no study {name!r}; there are {', '.join(known)}.")
    with progress_bar(name, 1.0) as advance:
        result = known[name](plots, runs, advance)
    for title, header, rows in result.tables:
        table = Table(*header, title=title, title_justify="left")
        for row in rows:
            table.add_row(*row)
        out.print(table)
    for note in result.notes:
        out.print(f"- {note}", highlight=False)
    if json_path:
        result.write_json(json_path)
    for picture in result.pictures:
        err.print(f"figure in {picture}", highlight=False)
