"""How far a sensor's clock is off, and how fast it drifts, from when its measurements arrive.

A measurement arrives after it was made, by a delay that has a floor (the way of an undisturbed message) and no ceiling:
queues, bursts after an outage and busy machines only add to it. So the least delay of a while says what the clocks
differ by, up to that floor, and the line through the least delays of many whiles how fast it grows.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray

BLOCK_S = 10.0
BLOCKS = 60
LOWEST = 3
ONE_OF = 8
"""Of so many batches in a block one may have a wild time stamp."""
OFFSET_BLOCKS = 3
OFFSET_BATCHES = 5
DRIFT_BLOCKS = 12
LEAST_SCATTER_S = 0.002
STEP_BLOCKS = 4
STEP_S = 0.05
STEP_SIGMAS = 8.0
CLIPPED = 3.0
_MAD = 1.4826


class ClockEstimate(NamedTuple):
    """What is known of a sensor's clock against ours; None: not yet.

    Attributes:
        offset_s: by how much its clock is ahead; below 0 it is behind, or all its messages come that late.
        drift_ppm, drift_sigma_ppm: how fast that changes, one sigma.
        steps: how often it jumped.
    """

    offset_s: float | None
    drift_ppm: float | None
    drift_sigma_ppm: float
    steps: int


class SensorClock:
    """The least delays of one sensor, in blocks of time.

    Args:
        block_s: length of a block; several of the sensor's batches should fall into each.
        look_s: how long the measurements of a batch may wait for it to be sent.
    """

    def __init__(self, block_s: float = BLOCK_S, look_s: float = 0.0) -> None:
        self._block_s = block_s
        self._step_s = max(STEP_S, look_s)
        self._number = -1
        self._lows: list[float] = []
        self._batches = self._heard = 0
        self._blocks: deque[tuple[float, float]] = deque(maxlen=BLOCKS)
        self._slope = self._scatter_s = 0.0
        self._odd: tuple[float, float] | None = None
        self.steps = 0

    def heard(self, arrived_s: float, delay_s: float) -> None:
        """A batch came.

        Args:
            arrived_s: when, by our clock, counted from anywhere.
            delay_s: that minus the time of its newest measurement.
        """
        number = int(arrived_s // self._block_s)
        if number != self._number:
            self._end_block()
            self._number = number
        self._batches += 1
        self._heard += 1
        self._lows = sorted([*self._lows, delay_s])[:LOWEST]

    def estimate(self) -> ClockEstimate:
        """What is known now."""
        drift_ppm, sigma_ppm = self._drift()
        return ClockEstimate(self._offset(), drift_ppm, sigma_ppm, self.steps)

    def _low(self) -> float:
        # One wild time stamp must not count for the whole block.
        return self._lows[min(len(self._lows) - 1, self._batches // ONE_OF)]

    def _offset(self) -> float | None:
        if self._heard < OFFSET_BATCHES:
            return None
        last = [low for _, low in self._blocks][-OFFSET_BLOCKS:]
        if self._odd is not None:
            last.append(self._odd[1])
        if self._lows and (self._batches >= OFFSET_BATCHES or not last):
            last.append(self._low())
        return -float(np.median(last[-OFFSET_BLOCKS:]))

    def _drift(self) -> tuple[float | None, float]:
        if len(self._blocks) < DRIFT_BLOCKS:
            return None, 0.0
        t_s, _ = self._arrays()
        sigma = max(self._scatter_s, LEAST_SCATTER_S) / float(np.sqrt(np.square(t_s - t_s.mean()).sum()))
        return -self._slope * 1e6, sigma * 1e6

    def _end_block(self) -> None:
        if not self._lows:
            return
        block = ((self._number + 0.5) * self._block_s, self._low())
        self._lows, self._batches = [], 0
        if not self._is_odd(block):
            self._blocks.append(block)
            self._odd = None
        elif self._odd is not None and abs(block[1] - self._odd[1]) < self._tolerance_s():
            # Two in a row agree on the new place: the clock was set.
            self._blocks.clear()
            self._blocks.extend((self._odd, block))
            self._odd = None
            self.steps += 1
        else:
            self._odd = block
            return
        if len(self._blocks) > 1:
            self._slope, self._scatter_s = _line(*self._arrays())

    def _is_odd(self, block: tuple[float, float]) -> bool:
        if len(self._blocks) < STEP_BLOCKS:
            return False
        t_s, low_s = self._arrays()
        expected_s = float(np.median(low_s + self._slope * (block[0] - t_s)))
        return abs(block[1] - expected_s) > self._tolerance_s()

    def _tolerance_s(self) -> float:
        return max(self._step_s, STEP_SIGMAS * self._scatter_s)

    def _arrays(self) -> tuple[FloatArray, FloatArray]:
        both = np.array(self._blocks, np.float64)
        return both[:, 0], both[:, 1]


def _line(t_s: FloatArray, low_s: FloatArray) -> tuple[float, float]:
    """Slope of the line through points (n,), and their scatter about it: median of all pairs' slopes (Theil, Sen)."""
    i, j = np.triu_indices(len(t_s), 1)
    slope = float(np.median((low_s[j] - low_s[i]) / (t_s[j] - t_s[i])))
    rest = low_s - slope * t_s
    rest = np.abs(rest - np.median(rest))
    usual_s = _MAD * float(np.median(rest))
    # Of few points the median tells too little; wild ones must not tell too much.
    return slope, max(usual_s, float(np.sqrt(np.square(np.minimum(rest, CLIPPED * usual_s)).mean())))
