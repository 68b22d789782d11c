"""A scenario: what a simulated world holds, read from a TOML file and checked.

The world is flat: one plane of east and north metres about the origin, which is also where the
radars' slant range is measured. Angles in a file may be given in degrees (``..._deg``) or radians
(``..._rad``); inside they are radians. The scenarios that come with the package are listed by
``scenario_names``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import resources
from math import radians
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import Geodetic
from trackmesh.protocol.messages.base import Finite, Id, NonNegative, Positive
from trackmesh.sim.plane import place_enu_m

Range = tuple[Positive, Positive]


class ScenarioError(TrackmeshError):
    """A scenario cannot be used; the text is one sentence for the person who wrote it."""


class _Section(BaseModel):
    """A part of a scenario file: immutable, and nothing in it is ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _degrees_to_radians(cls, data: object) -> object:
        """Accept ``x_deg`` for every field that is called ``x_rad``."""
        if not isinstance(data, Mapping):
            return data
        given = dict(data)
        for name in cls.model_fields:
            if not name.endswith("_rad"):
                continue
            in_degrees = name.removesuffix("_rad") + "_deg"
            if in_degrees not in given:
                continue
            if name in given:
                raise ValueError(f"give {name} or {in_degrees}, not both")
            value = given.pop(in_degrees)
            if not isinstance(value, int | float):
                raise ValueError(f"{in_degrees} must be a number")
            given[name] = radians(value)
        return given


class Targets(_Section):
    """How many targets there are and how they move.

    Of ``count`` targets ``quiet_count`` never manoeuvre: they cross the area in a straight line, and where
    one leaves it another one, with a new id, comes in. The others spend ``manoeuvre_share`` of their time
    in coordinated turns and stay inside the area.
    """

    count: Annotated[int, Field(ge=1, le=100_000)]
    quiet_count: Annotated[int, Field(ge=0)] = 0
    area_enu_m: tuple[Finite, Finite, Finite, Finite]
    speed_mps: Range
    turn_rate_deg_s: Range = (1.0, 3.0)
    turn_duration_s: Range = (10.0, 25.0)
    manoeuvre_share: Annotated[float, Field(gt=0.0, le=0.9)] = 0.2
    appear_s: NonNegative = 0.0
    lifetime_s: Range | None = None

    @field_validator("speed_mps", "turn_rate_deg_s", "turn_duration_s", "lifetime_s")
    @classmethod
    def _is_ascending(cls, value: Range | None) -> Range | None:
        if value is not None and value[0] > value[1]:
            raise ValueError(f"the range {list(value)} is not ascending")
        return value

    @model_validator(mode="after")
    def _fits_its_area(self) -> Self:
        east_0, north_0, east_1, north_1 = self.area_enu_m
        if self.quiet_count > self.count:
            raise ValueError(f"quiet_count ({self.quiet_count}) is above count ({self.count})")
        needed = 4.0 * self.speed_mps[1] / radians(self.turn_rate_deg_s[1])
        side = min(east_1 - east_0, north_1 - north_0)
        if side <= needed:
            raise ValueError(
                f"area_enu_m, with a shortest side of {side:.0f} m, gives a target at {self.speed_mps[1]:g} m/s "
                f"and {self.turn_rate_deg_s[1]:g} degrees/s no room to turn: it needs more than {needed:.0f} m"
            )
        return self


class Radar(_Section):
    """One rotating radar, its errors and its clutter.

    The beam is at north at ``offset_s`` and turns clockwise once in ``period_s``. A bias is added to what
    the radar measures, and is not told to anyone.
    """

    id: Id
    site_enu_m: tuple[Finite, Finite, Finite] | None = None
    site: Geodetic | None = None
    period_s: Positive
    offset_s: NonNegative = 0.0
    sigma_range_m: Positive
    sigma_azimuth_rad: Annotated[float, Field(gt=0.0, le=0.2)]
    p_detect: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    clutter_per_scan: Annotated[float, Field(ge=0.0, le=1.0e5)] = 0.0
    max_range_m: Positive
    sectors: Annotated[int, Field(ge=1, le=4096)] = 32
    bias_range_m: Finite = 0.0
    bias_azimuth_rad: Finite = 0.0

    @model_validator(mode="after")
    def _has_one_site(self) -> Self:
        if (self.site is None) == (self.site_enu_m is None):
            raise ValueError("give either site_enu_m or site (latitude_deg, longitude_deg, height_m)")
        return self

    def position_m(self, origin: Geodetic) -> tuple[float, float, float]:
        """East, north, up (m) of the site in the plane of ``origin``."""
        if self.site is not None:
            return place_enu_m(self.site, origin)
        assert self.site_enu_m is not None
        return self.site_enu_m


class EmiTarget(_Section):
    """A buried object: where it lies, and its polarizabilities (m^3) along its own axes."""

    position_m: tuple[Finite, Finite, Finite]
    polarizability_m3: tuple[Finite, Finite, Finite]
    attitude_deg: tuple[Finite, Finite] = (0.0, 0.0)


class Emi(_Section):
    """A survey grid centred on the origin, ``height_m`` above ground, and what is buried under it."""

    grid_m: Range
    spacing_m: Positive
    height_m: NonNegative = 0.0
    snr_db: Annotated[float, Field(ge=-40.0, le=120.0)]
    targets: Annotated[tuple[EmiTarget, ...], Field(min_length=1)]


class Rssi(_Section):
    """Readers that tell signal strengths: power at a metre, exponent of its loss, noise of a reading."""

    power_1m_dbm: Finite = -45.0
    exponent: Positive = 2.5
    noise_db: NonNegative = 3.0


class TagReader(_Section):
    """A reader of tags: its name and its place, east and north."""

    id: Id
    site_enu_m: tuple[Finite, Finite]


class Tags(_Section):
    """Tags that are carried along a path, and the readers that hear them now and then.

    Each tag follows the same way through ``path_enu_m`` (a smooth curve, back and forth), turned or mirrored in its
    square and at another time. ``stop_and_go`` is the share by which the speed swings, once in ``stop_and_go_s``; at
    the ends of the way a tag slows down over ``turn_m``. At every tick each reader within ``max_range_m`` hears a tag
    with probability ``p_detect``; a share ``nlos_share`` of the ranges goes round a corner and is longer by an
    exponential of mean ``nlos_m``.
    """

    network_id: Id = "hall"
    count: Annotated[int, Field(ge=1, le=100_000)] = 1
    path_enu_m: Annotated[tuple[tuple[Finite, Finite], ...], Field(min_length=2)]
    speed_mps: Positive
    stop_and_go: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    stop_and_go_s: Positive = 13.0
    turn_m: NonNegative = 8.0
    tick_s: Positive = 0.1
    max_range_m: Positive
    p_detect: Annotated[float, Field(gt=0.0, le=1.0)]
    sigma_range_m: Positive
    nlos_share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    nlos_m: Positive = 8.0
    rssi: Rssi | None = None
    readers: Annotated[tuple[TagReader, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _names_each_reader_once(self) -> Self:
        ids = [reader.id for reader in self.readers]
        if twice := sorted({name for name in ids if ids.count(name) > 1}):
            raise ValueError(f"the reader id {twice[0]!r} is used more than once")
        return self


class Scenario(_Section):
    """A whole simulated world; with a seed it says everything that happens in it.

    It holds targets and the radars that see them, tags with their readers, buried objects, or all of these.
    """

    name: Id
    description: str = ""
    origin: Geodetic
    duration_s: Positive
    targets: Targets | None = None
    radars: tuple[Radar, ...] = ()
    emi: Emi | None = None
    tags: Tags | None = None

    @model_validator(mode="after")
    def _names_each_radar_once(self) -> Self:
        ids = [radar.id for radar in self.radars]
        if twice := sorted({name for name in ids if ids.count(name) > 1}):
            raise ValueError(f"the radar id {twice[0]!r} is used more than once")
        return self

    @model_validator(mode="after")
    def _holds_something(self) -> Self:
        if (self.targets is None) != (not self.radars):
            raise ValueError("targets need radars that see them, and radars need targets")
        if self.targets is None and self.emi is None and self.tags is None:
            raise ValueError("there must be targets with radars, tags or emi")
        return self

    def seen_targets(self) -> Targets:
        """The targets of the radars.

        Raises ScenarioError where the scenario has none.
        """
        if self.targets is None:
            raise ScenarioError(f"the scenario {self.name!r} has no targets and no radars.")
        return self.targets

    def heard_tags(self) -> Tags:
        """The tags.

        Raises ScenarioError where the scenario has none.
        """
        if self.tags is None:
            raise ScenarioError(f"The scenario {self.name!r} has no [tags] section.")
        return self.tags

    def radar(self, radar_id: str) -> Radar:
        """The radar of that id.

        Raises ScenarioError where the scenario has none of that name.
        """
        for radar in self.radars:
            if radar.id == radar_id:
                return radar
        known = ", ".join(radar.id for radar in self.radars) or "none"
        raise ScenarioError(f"the scenario {self.name!r} has no radar {radar_id!r}; it has {known}.")


def scenario_names() -> list[str]:
    """The scenarios that come with trackmesh."""
    folder = resources.files("trackmesh.sim") / "scenarios"
    return sorted(Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """The scenario of that name, or in that file.

    Raises ScenarioError, with one sentence that names the field at fault, where there is no such
    scenario or it is not valid.
    """
    stem, text = _read(name_or_path)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"The scenario {stem!r} is not valid TOML: {error}.") from None
    try:
        return Scenario.model_validate({"name": stem} | content)
    except ValidationError as error:
        raise ScenarioError(f"The scenario {stem!r} is not valid: {_first_reason(error)}.") from None


def _read(name_or_path: str | Path) -> tuple[str, str]:
    known = scenario_names()
    if str(name_or_path) in known:
        packaged = resources.files("trackmesh.sim") / "scenarios" / f"{name_or_path}.toml"
        return str(name_or_path), packaged.read_text(encoding="utf-8")
    path = Path(name_or_path)
    try:
        return path.stem, path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ScenarioError(
            f"There is no scenario {str(name_or_path)!r} ({why}); give a TOML file or one of {', '.join(known)}."
        ) from None


def _first_reason(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(step) for step in first["loc"])
    what = first["msg"].removeprefix("Value error, ")
    more = error.error_count() - 1
    return (f"{where}: " if where else "") + what + (f" (and {more} more)" if more else "")
