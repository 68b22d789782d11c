"""Many runs of the hall at once: each run is a tag, all hear the same hall, each with noise of its own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.tags import singer
from trackmesh.services.tags.records import RANGE, Records
from trackmesh.sim.scenario import Tags, load_scenario
from trackmesh.sim.tag_paths import TagPaths
from trackmesh.sim.tags import hear

FloatArray = npt.NDArray[np.float64]

TICKS = 600
MATCHED_TICKS = 300
MATCHED_ALPHA, MATCHED_VARIANCE = 0.5, 0.5
WALL_M = 10.0
_ACROSS = 100.0
_MOST_TRIES = 400


class Data(NamedTuple):
    """What the readers measured.

    Attributes:
        tick_s: time between ticks. truth: (ticks + 1, runs, 2). ranges: the ranges of each tick from the first on.
        readers: (R, 3) their places.
    """

    tick_s: float
    truth: FloatArray
    ranges: list[Records]
    readers: FloatArray


def hall(**change: object) -> Tags:
    """The tags section of the scenario ``rfid19``, changed."""
    return load_scenario("rfid19").heard_tags().model_copy(update=change)


def reference(tags: Tags, runs: int) -> FloatArray:
    """The reference path, the same for all runs: (TICKS + 1, runs, 2)."""
    t_s = np.asarray(np.arange(TICKS + 1) * tags.tick_s, np.float64)
    path = TagPaths(tags).place(np.zeros(len(t_s), np.int64), t_s)
    return np.broadcast_to(path[:, None], (len(path), runs, 2)).copy()


def matched(tags: Tags, runs: int, seed: int) -> FloatArray:
    """Paths of Singer's model itself that stay in the hall: (MATCHED_TICKS + 1, runs, 2).

    They begin within the middle of the hall, at a metre a second per axis; those that come nearer than ``WALL_M`` to a
    wall, behind which there are no readers, are drawn anew.
    """
    rng = np.random.default_rng([seed, 5])
    step, block = np.empty(3), np.empty(6)
    singer.transition(MATCHED_ALPHA, tags.tick_s, step)
    singer.noise(MATCHED_ALPHA, MATCHED_VARIANCE, tags.tick_s, block)
    A = np.array([[1.0, tags.tick_s, step[0]], [0.0, 1.0, step[1]], [0.0, 0.0, step[2]]])
    Q = np.zeros((3, 3))
    Q[np.triu_indices(3)] = block
    root = np.linalg.cholesky(Q + np.triu(Q, 1).T)
    out = np.empty((MATCHED_TICKS + 1, runs, 2))
    open_runs = np.arange(runs)
    for _ in range(_MOST_TRIES):
        x = np.zeros((len(open_runs), 2, 3))
        x[:, :, 0] = rng.uniform(0.2 * _ACROSS, 0.8 * _ACROSS, (len(open_runs), 2))
        x[:, :, 1] = rng.standard_normal((len(open_runs), 2))
        x[:, :, 2] = np.sqrt(MATCHED_VARIANCE) * rng.standard_normal((len(open_runs), 2))
        path = [x[:, :, 0]]
        for _ in range(MATCHED_TICKS):
            x = x @ A.T + rng.standard_normal(x.shape) @ root.T
            path.append(x[:, :, 0])
        places = np.array(path)
        out[:, open_runs] = places
        outside = ((places < WALL_M) | (places > _ACROSS - WALL_M)).any(axis=(0, 2))
        open_runs = open_runs[outside]
        if not len(open_runs):
            break
    return out


def simulate(tags: Tags, truth: FloatArray, seed: int) -> Data:
    """Ranges of all ticks; their variance is that of the scenario, and of signal strengths nought (see ``weighed``)."""
    places = np.array([reader.site_enu_m for reader in tags.readers], float)
    readers = np.column_stack([places, np.zeros(len(places))])
    rng = np.random.default_rng([seed, 8])
    return Data(tags.tick_s, truth, list(_ticks(tags, places, truth, rng)), readers)


def _ticks(tags: Tags, places: FloatArray, truth: FloatArray, rng: np.random.Generator) -> Iterator[Records]:
    for tick in range(1, len(truth)):
        heard = hear(tags, places, truth[tick], rng)
        z = np.zeros(len(heard.tag), RANGE)
        z["row"], z["reader"], z["range_m"] = heard.tag, heard.reader, heard.range_m
        z["t_s"], z["variance"] = tick * tags.tick_s, tags.sigma_range_m**2
        yield z


def weighed(data: Data, sigma_m: float, relative: float) -> Data:
    """The same ranges with another noise told of them: constant, and as a share of the distance."""
    ranges = [z.copy() for z in data.ranges]
    for z in ranges:
        z["variance"], z["relative"] = sigma_m**2, relative
    return data._replace(ranges=ranges)
