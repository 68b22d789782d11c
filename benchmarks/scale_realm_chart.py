"""What the units of a realm cost: a figure of ``scale_realm``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

_PARTS = (("engine_share", "engine", "tab:blue"), ("band_share", "band messages", "tab:orange"))


def draw(units: Sequence[Mapping[str, float]], places: Sequence[Sequence[float]], side_km: float, path: Path) -> None:
    """Share of a core of each unit, by part; tracks, radars and time of a batch of each."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.patches import Rectangle

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained", width_ratios=(1, 1.5))
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
    for (east_m, north_m), one in zip(places, units, strict=True):
        east, north = east_m / 1e3, north_m / 1e3
        corner = (east - 0.5 * side_km, north - 0.5 * side_km)
        right.add_patch(Rectangle(corner, side_km, side_km, facecolor="tab:blue", alpha=0.12, edgecolor="k"))
        text = f"{one['owned']:.0f} tracks\n{one['sensors']:.0f} radars\np99 {one['batch_p99_ms']:.0f} ms"
        right.annotate(text, (east, north), ha="center", va="center", fontsize=8)
    right.set(xlabel="east, km", ylabel="north, km", title="the areas: tracks owned, radars heard, time of a batch")
    right.set_aspect("equal")
    right.autoscale_view()
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
