"""A bounded buffer between who brings items and who takes them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Buffer(Generic[T]):
    """A bounded, closable buffer that drops the oldest; ``dropped`` counts what it lost.

    ``offer`` never waits for a receiver.
    """

    def __init__(self, capacity: int) -> None:
        self.dropped = 0
        self._items: deque[T] = deque()
        self._capacity = capacity
        self._on_close: Callable[[], None] | None = None
        self._closed = False
        self._changed = threading.Condition()

    def offer(self, item: T) -> None:
        """Append an item; the oldest gives way when full."""
        with self._changed:
            if self._closed:
                return
            if len(self) >= self._capacity:
                self._drop(item)
                self.dropped += 1
            self._append(item)
            self._changed.notify()

    def receive(self, timeout_s: float | None = None) -> T | None:
        """The oldest item, or None after ``timeout_s`` or when closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: len(self) or self._closed, timeout_s)
            return self._take() if len(self) else None

    def on_close(self, action: Callable[[], None]) -> None:
        """Have ``action`` called at the first ``close``."""
        self._on_close = action

    def close(self) -> None:
        """No more items; those inside can still be received, and waiting receivers wake."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            action, self._on_close = self._on_close, None
        if action is not None:
            action()

    def __len__(self) -> int:
        return len(self._items)

    def __bool__(self) -> bool:
        return True

    def _append(self, item: T) -> None:
        self._items.append(item)

    def _take(self) -> T:
        return self._items.popleft()

    def _drop(self, item: T) -> None:
        """Make room for an item."""
        self._items.popleft()

    def __iter__(self) -> Iterator[T]:
        while (item := self.receive()) is not None:
            yield item
