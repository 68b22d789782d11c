"""Plots of the sensors that a unit needs, each subscribed to by itself: what nobody needs is not sent."""

from __future__ import annotations

from trackmesh.protocol.bus import Sample, Subscription
from trackmesh.protocol.fair_buffer import FairBuffer
from trackmesh.services.runtime import ServiceRuntime


class SensorPlots:
    """One stream of many subscriptions; to be used like a subscription.

    Args:
        runtime: whose bus and threads are used.
        capacity: how many batches may wait.
    """

    def __init__(self, runtime: ServiceRuntime, capacity: int) -> None:
        self._runtime = runtime
        self._capacity = capacity
        self._merged = FairBuffer(capacity)
        self._open: dict[str, Subscription] = {}

    @property
    def dropped(self) -> int:
        """How many batches gave way because nobody took them in time."""
        return self._merged.dropped + sum(one.dropped for one in self._open.values())

    @property
    def sensors(self) -> frozenset[str]:
        """Those that are followed."""
        return frozenset(self._open)

    def follow(self, wanted: frozenset[str]) -> None:
        """Follow these sensors and no others."""
        for sensor_id in self.sensors - wanted:
            self._open.pop(sensor_id).close()
        for sensor_id in sorted(wanted - self.sensors):
            one = self._runtime.bus.subscribe(
                self._runtime.keys.plots(sensor_id), history=True, capacity=self._capacity
            )
            self._open[sensor_id] = one
            self._runtime.spawn(f"plots-{sensor_id}", lambda one=one: self._pass_on(one))  # type: ignore[misc]

    def receive(self, timeout_s: float | None = None) -> Sample | None:
        """The next batch of any of them, or None when the time is over."""
        return self._merged.receive(timeout_s)

    def close(self) -> None:
        """Follow none any more."""
        self._merged.close()
        for one in list(self._open.values()):
            one.close()

    def _pass_on(self, one: Subscription) -> None:
        for sample in one:
            self._merged.offer(sample)
