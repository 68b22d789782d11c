"""The engine's time: seconds since a whole second shortly before the first data, which floats tell exactly enough."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Timeline:
    """Seconds of the engine and Unix nanoseconds of the wire.

    Attributes:
        epoch_ns: zero of the seconds; None before the first data.
        now_s: the newest time that data or ticks have told.
    """

    def __init__(self) -> None:
        self.epoch_ns: int | None = None
        self.now_s = 0.0

    @property
    def now_ns(self) -> int | None:
        """The newest time told; None before any."""
        return None if self.epoch_ns is None else self.to_ns(self.now_s)

    def advance(self, t_s: float) -> None:
        """Time does not go back."""
        self.now_s = max(self.now_s, t_s)

    def to_s(self, t_ns: int) -> float:
        """Seconds of a time; the first one ever asked for fixes the epoch."""
        if self.epoch_ns is None:
            self.epoch_ns = t_ns - t_ns % 1_000_000_000
        return (t_ns - self.epoch_ns) / 1e9

    def to_s_array(self, t_ns: IntArray) -> FloatArray:
        """Seconds of times (n,)."""
        self.to_s(int(t_ns.min()))
        return np.asarray((t_ns - (self.epoch_ns or 0)) / 1e9)

    def to_ns(self, t_s: float) -> int:
        """Unix nanoseconds; 0 before the first data."""
        return round(t_s * 1e9) + self.epoch_ns if self.epoch_ns is not None else 0

    def to_ns_array(self, t_s: FloatArray) -> IntArray:
        """Unix nanoseconds of times (n,)."""
        return np.rint(t_s * 1e9).astype(np.int64) + (self.epoch_ns or 0)
