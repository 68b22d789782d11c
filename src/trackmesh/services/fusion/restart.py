"""A picture made from local tracks alone, when the biases of the sensors have only now become known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.plots import Plots
from trackmesh.services.fusion.cycle import Declared
from trackmesh.services.fusion.layer import Layer


class Found(NamedTuple):
    """Targets: the plots that the local tracks of each remember, raw, in order of time; its best score; its members.

    A member is (sensor, row of its local layer).
    """

    plots: list[Plots]
    score: npt.NDArray[np.float64]
    members: list[list[tuple[int, int]]]


def picture_of(layers: list[Layer], declared: list[Declared]) -> Found:
    """One target for each group of confirmed local tracks that were declared one, and for each one that was not."""
    groups: list[list[tuple[int, int]]] = []
    of: dict[tuple[int, int], int] = {}
    for pairs in declared:
        for row_a, row_b in zip(pairs.row_a.tolist(), pairs.row_b.tolist(), strict=True):
            one, other = (pairs.a, row_a), (pairs.b, row_b)
            k = of.get(one, of.get(other, len(groups)))
            if k == len(groups):
                groups.append([])
            for member in (one, other):
                if of.setdefault(member, k) == k and member not in groups[k]:
                    groups[k].append(member)
    for sensor, layer in enumerate(layers):
        for row in layer.rows[layer.life.confirmed[layer.rows]].tolist():
            if (sensor, row) not in of:
                groups.append([(sensor, row)])
    plots, score = [], []
    kept = []
    for group in groups:
        remembered = [layers[sensor].filters.remembered(row) for sensor, row in group]
        together = np.concatenate(remembered)
        if len(together):
            plots.append(together[np.argsort(together["t_s"], kind="stable")])
            score.append(max(float(layers[sensor].life.score[row]) for sensor, row in group))
            kept.append(group)
    return Found(plots, np.array(score), kept)
