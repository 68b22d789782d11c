"""What several units keep of identities, beside one engine and beside a hard border: a figure of ``scale_out``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Rows = Sequence[Mapping[str, Any]]

_DEATHS = {
    "death": "last picture",
    "death, standby": "unit stands by",
    "death, band": "band only",
    "death, cold": "cold",
}
_LATER_S = (4, 8, 12, 16, 30, 60)


def draw(rows: Rows, path: Path) -> None:
    """Crossers kept of every case; what is shown, and under which ids, after a unit's death."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 5.2), layout="constrained")
    names = list(dict.fromkeys(str(row["case"]) for row in rows if "death" not in str(row["case"])))
    place = np.arange(len(names))[::-1]
    left.barh(
        place + 0.2, [_mean(rows, name, "single_kept_pct") for name in names], 0.36, color="0.8", label="one engine"
    )
    left.barh(
        place - 0.2, [_mean(rows, name, "kept_pct") for name in names], 0.36, color="tab:blue", label="several units"
    )
    left.set_yticks(place, names)
    left.set(xlabel="targets that cross the border and keep their id, %", xlim=(0, 104))
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    for colour, (name, label) in zip(("tab:blue", "tab:green", "tab:orange", "tab:red"), _DEATHS.items(), strict=True):
        if any(row["case"] == name for row in rows):
            style = "o-" if name != "death, standby" else "s--"
            ids = [_mean(rows, name, f"ids_{s}_pct") for s in _LATER_S]
            right.plot(_LATER_S, ids, style, color=colour, label=f"same id: {label}")
    shown = [_mean(rows, "death, cold", f"shown_{s}_pct") for s in _LATER_S]
    right.plot(_LATER_S, shown, ":", color="0.4", label="shown under any id: cold, or band only")
    right.set(xlabel="seconds after a unit was killed (noticed after 2 s)", ylabel="of the targets that it showed, %")
    right.set(ylim=(-3, 104), xlim=(0, 62))
    right.legend(loc="center right", frameon=False, fontsize=8)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _mean(rows: Rows, case: str, figure: str) -> float:
    found = [row[figure] for row in rows if row["case"] == case and row.get(figure) is not None]
    return float(np.mean(found)) if found else float("nan")
