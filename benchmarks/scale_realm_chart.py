"""What the units of a realm cost: a figure of ``scale_realm``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

_PARTS = (("engine_share", "engine", "tab:blue"), ("band_share", "band messages", "tab:orange"))


def draw(units: Sequence[Mapping[str, float]], places: Sequence[Sequence[float]], path: Path) -> None:
    """Share of a core of each unit, by part; tracks of each unit where it stands."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    index = np.arange(1, len(units) + 1)
    below = np.zeros(len(units))
    for name, label, colour in _PARTS:
        share = 100.0 * np.array([one[name] for one in units])
        left.bar(index, share, 0.7, below, label=label, color=colour)
        below += share
    rest = 100.0 * np.array([one["core_share"] for one in units]) - below
    left.bar(index, rest, 0.7, below, label="encoding pictures", color="tab:green")
    left.set(xlabel="unit", ylabel="of one core, %", xticks=index)
    left.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    km = np.array(places) / 1e3
    owned = np.array([one["owned"] for one in units])
    right.scatter(km[:, 0], km[:, 1], s=owned / owned.max() * 900.0, color="tab:blue", alpha=0.35)
    for (east, north), one in zip(km.tolist(), units, strict=True):
        text = f"{one['owned']:.0f} tracks\n{one['sensors']:.0f} radars\np99 {one['batch_p99_ms']:.0f} ms"
        right.annotate(text, (east, north), ha="center", va="center", fontsize=9)
    right.set(xlabel="east km", ylabel="north km", title="owned tracks, radars heard, time of a batch")
    right.margins(0.2, 0.45)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
