"""What neighbours know of sensors: where a unit knows nothing yet, it begins with that."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from trackmesh.protocol.messages import Registration, SensorBias
from trackmesh.services.estimation import bias
from trackmesh.services.fusion.biases import Change
from trackmesh.services.fusion.corrections import Corrections
from trackmesh.services.fusion.partition.neighbours import Neighbours
from trackmesh.services.fusion.sensors import Sensor

_FEWEST_PAIRS = 4
_TIMES = 4.0
_SIGMAS, _APART_M, _RANGE_M, _MOST_M = 5.0, 50.0, 50_000.0, 50_000.0


class Priors:
    """Estimates of biases are not averaged between units: the pairs of the band are the same plots in both of them.

    A unit takes over a neighbour's, with its covariance times four, of a sensor that it knows from fewer than four
    pairs itself; and counts as ``registration_disagrees`` where two units are sure of different things.
    """

    def __init__(self, corrections: Corrections, counters: Counter[str]) -> None:
        self._known = corrections.biases
        self._counters = counters

    def take(self, sensors: Mapping[str, Sensor], neighbours: Neighbours) -> list[Change]:
        """Begin with what neighbours know, where nothing is known; what changes in the corrections."""
        known = self._known
        if known is None:
            return []
        unknown = {name for name in sensors if not known.locked(name) and known.pairs(name) < _FEWEST_PAIRS}
        best: dict[str, SensorBias] = {}
        for told in neighbours.registrations() if unknown else ():
            for one in told.sensors:
                if one.sensor_id in unknown and one.locked:
                    known_best = best.get(one.sensor_id)
                    if known_best is None or one.pairs > known_best.pairs:
                        best[one.sensor_id] = one
        return [self._suppose(one) for one in best.values() if self._fits(one, sensors[one.sensor_id])]

    def _fits(self, one: SensorBias, sensor: Sensor) -> bool:
        polar = one.columns[0] == "range_m"
        proper = np.isfinite(one.covariance).all() and bias.positive_definite(one.covariance[None]).all()
        likely = bias.length(one.bias, polar, _RANGE_M) < _MOST_M
        return bool(polar == (sensor.info.kind == "radar") and proper and likely)

    def _suppose(self, one: SensorBias) -> Change:
        assert self._known is not None
        P = np.zeros((3, 3))
        P[:2, :2] = _TIMES * one.covariance
        P[2, 2] = _TIMES * one.time_offset_sigma_s**2
        self._counters["biases_of_neighbours"] += 1
        return self._known.suppose(one.sensor_id, np.array([*one.bias, one.time_offset_s]), P)

    def compare(self, told: Registration, neighbours: Neighbours) -> None:
        """Count sensors of which we and a neighbour are sure of different things."""
        if self._known is None:
            return
        ours = {one.sensor_id: one for one in self._known.messages() if one.locked}
        for one in told.sensors:
            mine = ours.get(one.sensor_id)
            if mine is None or not one.locked or mine.columns != one.columns:
                continue
            polar = one.columns[0] == "range_m"
            apart = np.array([*(one.bias - mine.bias), 0.0])
            both = np.zeros((3, 3))
            both[:2, :2] = one.covariance + mine.covariance
            allowed = _SIGMAS * bias.spread(both, polar, _RANGE_M) + _APART_M
            if bias.length(apart, polar, _RANGE_M) > allowed:
                self._counters["registration_disagrees"] += 1
