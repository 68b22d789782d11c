"""A buffer of messages of several keys, in which one that floods cannot displace the others."""

from __future__ import annotations

from collections import deque

from trackmesh.protocol.buffer import Buffer
from trackmesh.protocol.bus import Sample


class FairBuffer(Buffer[Sample]):
    """Keys take turns where several wait; when full, a key that holds more than its share loses its oldest."""

    def __init__(self, capacity: int) -> None:
        super().__init__(capacity)
        self._queues: dict[str, deque[Sample]] = {}
        self._turns: deque[str] = deque()
        self._held = 0

    def __len__(self) -> int:
        return self._held

    def _append(self, item: Sample) -> None:
        queue = self._queues.get(item.key)
        if queue is None:
            queue = self._queues[item.key] = deque()
            self._turns.append(item.key)
        queue.append(item)
        self._held += 1

    def _take(self) -> Sample:
        key = self._turns.popleft()
        item = self._pop(key)
        if key in self._queues:
            self._turns.append(key)
        return item

    def _drop(self, item: Sample) -> None:
        own = len(self._queues.get(item.key, ()))
        # Who holds an equal share or more gives way himself; else there is one who holds more.
        key = item.key if own * len(self._queues) >= self._held else max(self._queues, key=self._holds)
        self._pop(key)
        if key not in self._queues:
            self._turns.remove(key)

    def _holds(self, key: str) -> int:
        return len(self._queues[key])

    def _pop(self, key: str) -> Sample:
        queue = self._queues[key]
        item = queue.popleft()
        self._held -= 1
        if not queue:
            # Else every key that was ever used would stay.
            del self._queues[key]
        return item
