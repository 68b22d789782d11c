"""What a service says of its sensors: who is silent since when, of whom nothing is taken, whose clock is off."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from trackmesh.protocol.links import clock_time
from trackmesh.services.sensor_clock import BLOCK_S, ClockEstimate, SensorClock

SILENT_PERIODS = 3.0
SILENT_S = 3.0
TOLD_S = 3600.0
"""For so long a silent sensor is missed; then it is taken to be gone for good."""
BLOCK_PERIODS = 2.5
DRIFT_SIGMAS = 5.0
_NEVER = ClockEstimate(None, None, 0.0, 0)


@dataclass
class _Watched:
    """One sensor: when its last batch came, and the last one that was taken."""

    clock: SensorClock
    period_s: float
    look_s: float
    heard_ns: int
    taken_ns: int
    told: bool = False
    reason: str = ""


class Limits(NamedTuple):
    """From where on a clock is worth a word: how far off it is, how fast it drifts."""

    offset_s: float
    drift_ppm: float


@dataclass
class SensorWatch:
    """Follows each sensor's batches as they come; times are UTC ns of our clock.

    Attributes:
        limits: of the clocks.
        clocks: whether times are those of now; recordings bring times of their own.
        named: sensors that there must be, though they were never heard.
        began_ns: from when on they are missed.
        word: what a sensor is called.
    """

    limits: Limits
    clocks: bool
    named: tuple[str, ...] = ()
    began_ns: int = 0
    word: str = "sensor"
    _watched: dict[str, _Watched] = field(default_factory=dict)
    _followed: frozenset[str] | None = None

    def expect(self, sensor_id: str, period_s: float, now_ns: int) -> None:
        """A sensor has said that it looks around every ``period_s``."""
        one = self._watched.get(sensor_id)
        if one is None:
            clock = SensorClock(max(BLOCK_S, BLOCK_PERIODS * period_s), period_s)
            self._watched[sensor_id] = _Watched(clock, period_s, period_s, now_ns, now_ns)
        else:
            one.period_s = period_s

    def follow(self, sensors: frozenset[str], now_ns: int) -> None:
        """Only of these anything is to come from now on; without this, of all."""
        for name in sensors - (self._followed if self._followed is not None else frozenset()):
            if (one := self._watched.get(name)) is not None:
                one.heard_ns = one.taken_ns = max(now_ns, one.heard_ns)
        self._followed = sensors

    def heard(self, sensor_id: str, newest_ns: int | None, sectors: int, now_ns: int) -> None:
        """A batch came, whether or not it is taken; ``newest_ns`` is the time of its last plot."""
        one = self._watched.get(sensor_id)
        if one is None:
            return
        one.heard_ns, one.told, one.look_s = now_ns, True, one.period_s / max(1, sectors)
        if newest_ns is not None and self.clocks:
            one.clock.heard(now_ns / 1e9, (now_ns - newest_ns) / 1e9)

    def took(self, sensor_id: str, now_ns: int) -> None:
        """That batch was taken."""
        if (one := self._watched.get(sensor_id)) is not None:
            one.taken_ns = now_ns

    def refused(self, sensor_id: str, reason: str) -> None:
        """That batch was refused."""
        if (one := self._watched.get(sensor_id)) is not None:
            one.reason = reason

    def clock(self, sensor_id: str) -> ClockEstimate:
        """What is known of a sensor's clock."""
        one = self._watched.get(sensor_id)
        return _NEVER if one is None else one.clock.estimate()

    def silent_since_ns(self, sensor_id: str, now_ns: int) -> int | None:
        """When the last batch came of a sensor that should have sent more since; None: it is on time."""
        one = self._watched.get(sensor_id)
        if one is None or not self._follows(sensor_id) or not _overdue(one, one.heard_ns, now_ns):
            return None
        return one.heard_ns

    def notices(self, alive: Iterable[str] | None, now_ns: int) -> dict[str, str]:
        """What is wrong now: a sentence each, by a name that stays while it lasts.

        Args:
            alive: sensors whose tokens are there; None: they have none.
            now_ns: the time.
        """
        return self._silences(None if alive is None else set(alive), now_ns) | self._refusals(now_ns) | self._clocks()

    def _follows(self, sensor_id: str) -> bool:
        return self._followed is None or sensor_id in self._followed

    def _silences(self, alive: set[str] | None, now_ns: int) -> dict[str, str]:
        silent = {
            name: one.heard_ns
            for name, one in self._watched.items()
            if self._follows(name) and _overdue(one, one.heard_ns, now_ns) and now_ns - one.heard_ns < TOLD_S * 1e9
        }
        if now_ns - self.began_ns > SILENT_S * 1e9:
            silent |= {name: self.began_ns for name in self.named if name not in self._watched}
        return {
            f"silent {name}": f"{self.word.capitalize()} {name} is silent since {clock_time(since_ns)}: "
            + _why_silent(name, alive)
            for name, since_ns in sorted(silent.items())
        }

    def _refusals(self, now_ns: int) -> dict[str, str]:
        found = {}
        for name, one in sorted(self._watched.items()):
            if one.told and _overdue(one, one.taken_ns, now_ns) and not _overdue(one, one.heard_ns, now_ns):
                since = clock_time(one.taken_ns)
                found[f"refused {name}"] = (
                    f"Nothing of {self.word} {name} is taken since {since}: refused ({one.reason})."
                )
        return found

    def _clocks(self) -> dict[str, str]:
        found = {}
        for name, one in sorted(self._watched.items()):
            known = one.clock.estimate()
            if (sentence := self._offset(name, known, one.look_s)) is not None:
                found[f"clock {name}"] = sentence
            if (sentence := self._drift(name, known)) is not None:
                found[f"drift {name}"] = sentence
        return found

    def _drift(self, name: str, known: ClockEstimate) -> str | None:
        if known.drift_ppm is None:
            return None
        if abs(known.drift_ppm) <= max(self.limits.drift_ppm, DRIFT_SIGMAS * known.drift_sigma_ppm):
            return None
        way, ppm = "gains" if known.drift_ppm > 0 else "loses", abs(known.drift_ppm)
        told = f"{ppm:.0f} ± {known.drift_sigma_ppm:.0f} ppm ({ppm * 3.6e-3:.2f} s an hour)"
        return f"The clock of {self.word} {name} {way} {told}."

    def _offset(self, name: str, known: ClockEstimate, look_s: float) -> str | None:
        if known.offset_s is None:
            return None
        if known.offset_s > self.limits.offset_s:
            return f"The clock of {self.word} {name} is {known.offset_s:.2f} s ahead."
        if -known.offset_s > self.limits.offset_s + look_s:
            late = f"What {self.word} {name} sends comes {-known.offset_s:.2f} s after its time"
            return f"{late}: its clock is behind, or they are late."
        return None


def _why_silent(name: str, alive: set[str] | None) -> str:
    if alive is None:
        return "no batch comes."
    return "alive, but no batch comes." if name in alive else "not alive: process, host or link is down."


def _overdue(one: _Watched, last_ns: int, now_ns: int) -> bool:
    return now_ns - last_ns > max(SILENT_PERIODS * one.period_s, SILENT_S) * 1e9
