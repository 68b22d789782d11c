"""How much a sensor may send: what it declares, several times over, and all of an outage at once."""

from __future__ import annotations

from dataclasses import dataclass

USUAL_FACTOR = 4.0
LEAST_PER_S = 50.0
LEAST_BURST = 256.0
OUTAGE_S = 60.0
"""After an outage all that sensors kept of it comes at once; what is older than this is refused for its age."""
MOST_DECLARED_PER_S = 250.0
MOST_SENDERS = 4096
_OTHERS = ""
"""The name under which all share that came after so many others; no sensor has it."""


@dataclass
class _Bucket:
    """Holds up to ``burst`` tokens and gains ``per_s``."""

    per_s: float
    burst: float
    tokens: float
    filled_s: float

    def take(self, n: float, now_s: float) -> bool:
        self.tokens = min(self.burst, self.tokens + max(0.0, now_s - self.filled_s) * self.per_s)
        self.filled_s = now_s
        if self.tokens < n:
            return False
        self.tokens -= n
        return True


class Rates:
    """Two limits for each sensor: messages, whatever they hold, and plots.

    Args:
        most_batches_per_s: of a sensor, at most; 0: four times what it declares, at least 50.
        most_plots_per_s: of a sensor, at most.
    """

    def __init__(self, most_batches_per_s: float, most_plots_per_s: float) -> None:
        self._most_batches = most_batches_per_s
        self._most_plots = most_plots_per_s
        self._batches: dict[str, _Bucket] = {}
        self._plots: dict[str, _Bucket] = {}

    def expect(self, sensor_id: str, batches_per_s: float) -> None:
        """What a sensor declares to send. It can only raise its limit up to that of the settings."""
        per_s, burst = self._limit(batches_per_s)
        bucket = self._batches.get(sensor_id)
        if bucket is None or bucket.per_s != per_s:
            tokens = burst if bucket is None else max(0.0, burst - (bucket.burst - bucket.tokens))
            filled_s = -1e18 if bucket is None else bucket.filled_s
            self._batches[sensor_id] = _Bucket(per_s, burst, tokens, filled_s)

    def message(self, sensor_id: str, now_s: float) -> bool:
        """Whether one more message, not yet looked into, may be taken at a time of a steady clock."""
        if sensor_id not in self._batches:
            if len(self._batches) >= MOST_SENDERS:
                sensor_id = _OTHERS
            self.expect(sensor_id, 0.0)
        return self._batches[sensor_id].take(1.0, now_s)

    def plots(self, sensor_id: str, n: int, now_s: float) -> bool:
        """Whether a batch of ``n`` plots may be taken."""
        if sensor_id not in self._plots:
            burst = self._most_plots * OUTAGE_S
            self._plots[sensor_id] = _Bucket(self._most_plots, burst, burst, now_s)
        return self._plots[sensor_id].take(n, now_s)

    def _limit(self, batches_per_s: float) -> tuple[float, float]:
        declared = min(batches_per_s, MOST_DECLARED_PER_S)
        per_s = self._most_batches or max(LEAST_PER_S, USUAL_FACTOR * declared)
        return per_s, max(LEAST_BURST, OUTAGE_S * (self._most_batches or declared))
