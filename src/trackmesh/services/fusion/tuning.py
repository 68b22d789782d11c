"""Settings that fit a recording: which of them are sought, what one candidate costs, how candidates are compared.

Pure but for the time it takes: records and settings in, scores out. What is to be least is given by the caller, as a
function of the pictures and of the evidence that the engine collects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import Tick, UnitRecord
from trackmesh.protocol.messages import Message, PlotBatch, SensorInfo, TrackFrame
from trackmesh.services.fusion.offline import OfflineRun
from trackmesh.services.fusion.search import Axis, search
from trackmesh.services.fusion.settings import EngineSettings

FloatArray = npt.NDArray[np.float64]

NO_PICTURES_S = 1e9
"""A time between pictures for objectives that look at none; making them is half the cost of a pass."""

_PICTURES_A_PERIOD = 4.0
_LEAST_DENSITY, _MOST_DENSITY = 1e-18, 1e6


class Range(NamedTuple):
    """What a setting may become, how far exploration goes (a factor), and with which others it is moved together."""

    low: float
    high: float
    reach: float
    group: str


_WORDS = {
    "turn_rate_max_degps": Range(0.1, 60.0, 4.0, "turn"),
    "acceleration_max_mps2": Range(0.05, 200.0, 10.0, "noise"),
    "manoeuvre_s": Range(1.0, 300.0, 3.0, "time"),
    "quiet_s": Range(2.0, 3600.0, 3.0, "time"),
    "q_quiet": Range(5e-3, 10.0, 10.0, "noise"),
}
_MODELS = {
    "q_m2ps3": Range(1e-5, 1e5, 100.0, "noise"),
    "sojourn_s": Range(1.0, 3600.0, 3.0, "time"),
}
_GAINS = {"alpha_beta_acceleration_mps2": Range(0.05, 200.0, 10.0, "noise")}
_RANGES = {"tvimm": _WORDS, "alpha-beta": _GAINS}


def ranges_of(settings: EngineSettings) -> dict[str, Range]:
    """The settings that are sought, by name: those that the filter of the system tracks is made of."""
    return _RANGES.get(settings.filter, _MODELS)


class Recording(NamedTuple):
    """A recording in memory.

    Attributes:
        records: without the unit of a black box.
        settings: those of the black box; None if it is none.
        plots: how many there are.
        first_ns, last_ns: times of the first and last plot; 0 if there is none.
    """

    records: list[Message]
    settings: EngineSettings | None
    plots: int
    first_ns: int
    last_ns: int


class Candidate(NamedTuple):
    """The score of one more candidate, and the best so far; the first one is what the search begins with."""

    number: int
    score: float
    best: EngineSettings
    best_score: float


class Evidence:
    """What the engine made of the scored part of a recording; complete once all pictures are used up."""

    def __init__(self, run: OfflineRun) -> None:
        self._run = run
        self._before: tuple[float, int] | None = None

    @property
    def begun(self) -> bool:
        """Whether the scored part has begun."""
        return self._before is not None

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood ratio of the picture against clutter, summed over the looks of the part."""
        return self._total() - (self._before[0] if self._before else 0.0)

    @property
    def plots(self) -> int:
        """Plots taken in the part."""
        return self._run.plots - (self._before[1] if self._before else 0)

    def begin(self) -> None:
        """The scored part begins here."""
        self._before = (self._total(), self._run.plots)

    def _total(self) -> float:
        return self._run.engine.log_likelihood if self._run.engine else 0.0


Objective = Callable[[Iterator[TrackFrame], Evidence], float]
"""What is to be least: a function of the pictures of the scored part, which it must use up, and of the evidence."""


def unlikelihood(frames: Iterator[TrackFrame], evidence: Evidence) -> float:
    """Minus the predictive log-likelihood ratio a plot, in nats; NaN without plots."""
    for _ in frames:
        pass
    return -evidence.log_likelihood / evidence.plots if evidence.plots else math.nan


def recording_of(records: Iterable[Message]) -> Recording:
    """The records of a file, ready to be tracked again and again by other settings.

    Raises:
        TrackmeshError: it is a black box, and its settings are not of this version.
    """
    kept, settings = list[Message](), None
    for record in records:
        if isinstance(record, UnitRecord):
            settings = _settings_of(record)
        else:
            kept.append(record)
    batches = [record for record in kept if isinstance(record, PlotBatch) and len(record.t_ns)]
    first = min((int(batch.t_ns.min()) for batch in batches), default=0)
    last = max((int(batch.t_ns.max()) for batch in batches), default=0)
    return Recording(kept, settings, sum(len(batch.t_ns) for batch in batches), first, last)


def split_at(records: list[Message], t_ns: int) -> int:
    """The index of the first record of plots, or tick, after ``t_ns``; their number if there is none."""
    return next((k for k, record in enumerate(records) if _time_ns(record) > t_ns), len(records))


def evaluate(
    records: list[Message], settings: EngineSettings, objective: Objective, *, begin: int = 0, picture_s: float = 0.0
) -> float:
    """Track the records by ``settings`` and score what comes of record ``begin`` and later ones.

    ``picture_s`` is the least time between pictures; it changes what is scored, not what is tracked. Refined states
    are not made.

    Raises:
        TrackmeshError: a record is not one of an input.
    """
    period_s = max(settings.frame_period_s, picture_s)
    run = OfflineRun(settings.model_copy(update={"frame_period_s": period_s, "lag": 0}))
    evidence = Evidence(run)

    def fed() -> Iterator[Message]:
        for k, record in enumerate(records):
            if k == begin:
                evidence.begin()
            yield record

    return objective((frame for frame in run.frames(fed()) if evidence.begun), evidence)


def picture_period_s(records: list[Message]) -> float:
    """How often a picture is worth its cost: four times in the shortest period of a sensor."""
    return min((r.period_s for r in records if isinstance(r, SensorInfo)), default=0.0) / _PICTURES_A_PERIOD


def tune(
    start: EngineSettings, score: Callable[[EngineSettings], float], evaluations: int, seed: int = 1
) -> Iterator[Candidate]:
    """Try settings near ``start`` by their ``score``, lower being better; see ``search`` for how.

    Sought is what ``ranges_of`` names; noise levels stay in ascending order. Settings that ``EngineSettings`` refuses
    are the worst.
    """

    def scored(values: FloatArray) -> float:
        try:
            return score(settings_with(start, values))
        except ValidationError:
            return math.inf

    for trial in search(axes_of(start), scored, evaluations, seed, lambda values: ascending(start, values)):
        yield Candidate(trial.number, trial.score, settings_with(start, trial.best), trial.best_score)


def axes_of(settings: EngineSettings) -> list[Axis]:
    """The numbers that are sought, as the settings have them."""
    return [
        Axis(number, *known) for name, known in ranges_of(settings).items() for number in numbers_of(settings, name)
    ]


def numbers_of(settings: EngineSettings, name: str) -> list[float]:
    """The numbers of one setting: one, or one a model."""
    value = getattr(settings, name)
    return list(value) if isinstance(value, list) else [value]


def settings_with(settings: EngineSettings, values: FloatArray) -> EngineSettings:
    """The settings with these numbers in the place of those sought.

    Raises:
        ValidationError: they are no settings.
    """
    left = iter(values.tolist())
    changed: dict[str, object] = {}
    for name in ranges_of(settings):
        old = getattr(settings, name)
        changed[name] = list(islice(left, len(old))) if isinstance(old, list) else next(left)
    return EngineSettings.model_validate(settings.model_dump(exclude_unset=True) | changed)


def ascending(settings: EngineSettings, values: FloatArray) -> FloatArray:
    """The same models in the order of their noise; numbers that are not of models stay as they are."""
    if ranges_of(settings) is not _MODELS:
        return values
    models = values.reshape(len(_MODELS), -1)
    return np.ascontiguousarray(models[:, np.argsort(models[0], kind="stable")]).ravel()


def at_bounds(start: EngineSettings, found: EngineSettings) -> list[str]:
    """The names of the settings that went as far as they may."""
    return [
        name
        for name, known in ranges_of(found).items()
        if not {known.low, known.high}.isdisjoint(set(numbers_of(found, name)) - set(numbers_of(start, name)))
    ]


def measured_clutter(records: list[Message], settings: EngineSettings) -> dict[str, float]:
    """False plots a look and square metre of each sensor: the median over a pass of what the engine estimates.

    Raises:
        TrackmeshError: a record is not one of an input.
    """
    run = OfflineRun(settings.model_copy(update={"frame_period_s": 0.0}))
    seen: dict[str, list[float]] = {}
    for _ in run.frames(records):
        for name, sensor in (run.engine.sensors if run.engine else {}).items():
            seen.setdefault(name, []).append(sensor.system_clutter.whole())
    return {name: float(np.median(values)) for name, values in seen.items()}


def with_clutter(records: list[Message], density: Mapping[str, float]) -> list[Message]:
    """The records, with a clutter density for each sensor that declares none and has one in ``density``.

    Likelihoods against clutter can be compared only if that stays what it is, whatever the settings make of it.
    """
    return [_declared(record, density) if isinstance(record, SensorInfo) else record for record in records]


def _declared(info: SensorInfo, density: Mapping[str, float]) -> SensorInfo:
    if info.clutter_density is not None or info.sensor_id not in density:
        return info
    value = min(max(density[info.sensor_id], _LEAST_DENSITY), _MOST_DENSITY)
    return info.model_copy(update={"clutter_density": value})


def _settings_of(record: UnitRecord) -> EngineSettings:
    try:
        return EngineSettings.model_validate(record.settings)
    except ValidationError:
        raise TrackmeshError("The black box was recorded with settings of another version of trackmesh.") from None


def _time_ns(record: Message) -> int:
    if isinstance(record, Tick):
        return record.t_ns
    return int(record.t_ns.max()) if isinstance(record, PlotBatch) and len(record.t_ns) else 0
