"""Local tracks of sensors with biases: what filters give of targets in straight flight, errors correlated in time.

Written with sines and arctangents, independently of what is tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.fusion.biases import Change, Kind, RegistrationRules
from trackmesh.services.fusion.registration import Registration

FloatArray = npt.NDArray[np.float64]

RING = 50e3 * np.stack([np.sin(np.arange(8.0)), np.cos(np.arange(8.0))], axis=1)
"""Places (8, 2) at which shifts are compared."""


class Station(NamedTuple):
    """A sensor: bias is [range_m, azimuth_rad, time_offset_s], or [east_m, north_m, time_offset_s]."""

    name: str
    kind: Kind
    site_m: tuple[float, float]
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)


NORTH = Station("north", "polar", (0.0, 0.0))
EAST = Station("east", "polar", (40e3, 10e3))
WEST = Station("west", "polar", (-30e3, 30e3))
PLACES = Station("places", "position", (0.0, 0.0))
SMALL = (150.0, float(np.deg2rad(0.4)), 0.0)
LARGE = (300.0, float(np.deg2rad(0.8)), 0.0)


def biased(station: Station, position_m: FloatArray) -> FloatArray:
    """True positions (n, 2) as the station measures them, its time offset apart."""
    if station.kind == "position":
        return position_m + station.bias[:2]
    east, north = (position_m - station.site_m).T
    r, azimuth = np.hypot(east, north) + station.bias[0], np.arctan2(east, north) + station.bias[1]
    return np.stack([r * np.sin(azimuth), r * np.cos(azimuth)], axis=1) + station.site_m


class Tracked(NamedTuple):
    """Local tracks of a station: x (n, 4), P (n, 4, 4); row by row the same targets at every station."""

    x: FloatArray
    P: FloatArray


class Sky:
    """Targets in straight flight, and what each station's filter makes of them at one time after another."""

    def __init__(
        self, seed: int, n: int, stations: Sequence[Station], *, span_m: float = 100e3, correlation_s: float = 8.0,
        noise: float = 1.0,
    ) -> None:  # fmt: skip
        self.rng = np.random.default_rng(seed)
        self.stations = list(stations)
        self.correlation_s, self.noise = correlation_s, noise
        speed, course = self.rng.uniform(80, 250, n), self.rng.uniform(0, 2 * np.pi, n)
        self.velocity = speed[:, None] * np.stack([np.sin(course), np.cos(course)], axis=1)
        self.start = self.rng.uniform(-span_m / 2, span_m / 2, (n, 2)) + np.array([20e3, 5e3])
        self.t_s = -np.inf
        self.errors = [np.zeros((n, 4)) for _ in stations]

    def covariance(self, station: Station, position_m: FloatArray) -> FloatArray:
        """Of a filter: 70 m along and .1 deg across the view of a radar, 80 m of other sensors, 15 m/s."""
        n = len(position_m)
        P = np.zeros((n, 4, 4))
        if station.kind == "position":
            P[:, :2, :2] = 80.0**2 * np.eye(2)
        else:
            east, north = (position_m - station.site_m).T
            r = np.hypot(east, north)
            along, across = np.stack([east, north], 1) / r[:, None], np.stack([north, -east], 1) / r[:, None]
            P[:, :2, :2] = 70.0**2 * along[:, :, None] * along[:, None]
            P[:, :2, :2] += (70.0**2 + (r * np.deg2rad(0.1)) ** 2)[:, None, None] * across[:, :, None] * across[:, None]
        P[:, 2:, 2:] = 15.0**2 * np.eye(2)
        lag = 0.5 * 15.0 * np.linalg.cholesky(P[:, :2, :2])
        P[:, :2, 2:], P[:, 2:, :2] = lag, np.swapaxes(lag, 1, 2)
        return self.noise**2 * P

    def truth(self, t_s: float) -> FloatArray:
        """Positions (n, 2)."""
        return np.asarray(self.start + t_s * self.velocity)

    def look(self, t_s: float) -> list[Tracked]:
        """The local tracks of all stations at a time, later each time."""
        rho = np.exp(-(t_s - self.t_s) / self.correlation_s) if self.correlation_s else 0.0
        self.t_s = t_s
        return [self._tracked(k, t_s, rho) for k in range(len(self.stations))]

    def _tracked(self, k: int, t_s: float, rho: float) -> Tracked:
        station = self.stations[k]
        position = self.truth(t_s + station.bias[2])
        P = self.covariance(station, position)
        fresh = self.rng.standard_normal(self.errors[k].shape)
        self.errors[k] = rho * self.errors[k] + np.sqrt(1.0 - rho * rho) * fresh
        error = (np.linalg.cholesky(P) @ self.errors[k][:, :, None])[..., 0]
        measured = biased(station, position)
        velocity = biased(station, position + 0.5 * self.velocity) - biased(station, position - 0.5 * self.velocity)
        return Tracked(np.concatenate([measured, velocity], axis=1) + error, P)


def announced(sky: Sky, rules: RegistrationRules | None = None) -> Registration:
    """A registration that knows the stations."""
    registration = Registration(rules)
    for station in sky.stations:
        registration.announce(station.name, station.kind, station.site_m)
    return registration


def run(
    registration: Registration, sky: Sky, until_s: float, *, begin_s: float = 0.0, step_s: float = 2.0
) -> Iterator[tuple[float, list[Change]]]:
    """Cycles in which all pairs of all stations are declared: the time of each and what changed."""
    for t_s in np.arange(begin_s, until_s, step_s).tolist():
        looks = sky.look(t_s)
        for j, other in enumerate(sky.stations):
            for i, one in enumerate(sky.stations[:j]):
                registration.update(one.name, other.name, *looks[i], *looks[j], t_s)
        yield t_s, registration.settle(t_s)


def finish(registration: Registration, sky: Sky, until_s: float, *, begin_s: float = 0.0) -> list[Change]:
    """All changes of a run."""
    return [change for _, changes in run(registration, sky, until_s, begin_s=begin_s) for change in changes]


def errors(registration: Registration, sky: Sky) -> dict[str, FloatArray]:
    """Estimated less true bias (2,) of each station."""
    return {e.sensor_id: e.bias - s.bias[:2] for e, s in zip(registration.messages(), sky.stations, strict=True)}


def assert_registered(registration: Registration, sky: Sky, metres: float = 30.0, degrees: float = 0.06) -> None:
    """All biases are estimated within these errors."""
    for name, error in errors(registration, sky).items():
        polar = registration.messages()[[s.name for s in sky.stations].index(name)].columns[0] == "range_m"
        assert abs(error[0]) < metres, name
        assert abs(error[1]) < (np.deg2rad(degrees) if polar else metres), name
