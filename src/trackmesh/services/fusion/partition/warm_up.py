"""Compiles what units with areas need beside the engine, before a neighbour dies and it is needed at once."""

from __future__ import annotations

import numpy as np

from trackmesh.services.fusion.engine import Unit
from trackmesh.services.fusion.partition.areas import Place
from trackmesh.services.fusion.partition.band import Share
from trackmesh.services.fusion.partition.engine import PartitionedEngine
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.warm_up import SECOND_NS, scene_batch, scene_sensor


def warm_up(settings: EngineSettings) -> None:
    """Two units track three targets, tell each other, and one goes on for the other."""
    settings = settings.model_copy(update={"cycle_s": 1.0})
    places = {"a": np.array([-30e3, 0.0]), "b": np.array([30e3, 0.0])}
    units = {
        name: PartitionedEngine(settings, Unit(name, k + 1), Share(Place(place), 200e3, 1000.0, 1.0))
        for k, (name, place) in enumerate(places.items())
    }
    for name, engine in units.items():
        engine.alive(frozenset(units) - {name})
        for sensor in "ab":
            engine.sensor(scene_sensor(sensor))
    for k in range(10):
        for offset, sensor in enumerate("ab"):
            for name, engine in units.items():
                frame, told = engine.plots(scene_batch(sensor, k, (2 * k + offset) * SECOND_NS)), engine.band_message()
                other = units["b" if name == "a" else "a"]
                if told is not None:
                    other.band(told)
                if frame is not None:
                    other.neighbour_tracks(frame)
    # As if it had never heard of them: it starts them from the picture of the other.
    heir = units["a"]
    for row in heir._system.rows.tolist():
        heir._system.drop(row)
    heir.alive(frozenset())
    heir.tick(200 * SECOND_NS)
