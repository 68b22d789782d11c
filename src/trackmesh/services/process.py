"""How a process of trackmesh ends: exit codes, and signals as a call in an ordinary thread."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_DEADLINE = 0, 1, 2, 3
"""Exit codes; the last is that of a stop that took longer than its deadline."""


@contextmanager
def on_signal(action: Callable[[str], None]) -> Iterator[None]:
    """Within the block, call ``action`` with the name of each SIGTERM and SIGINT, in a thread of its own.

    For the main thread only. An ordinary handler is not enough: it runs when the main thread next wakes, and a signal
    that the kernel delivers to another thread (the network library has several) does not wake it. So the number goes
    through a pipe, which is written in whichever thread the signal arrives.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def relay() -> None:
        while number := os.read(reading, 1)[0]:
            action(signal.Signals(number).name)

    thread = threading.Thread(target=relay, name="signals", daemon=True)
    thread.start()
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    previous = {number: signal.signal(number, _noted) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
        signal.set_wakeup_fd(before)
        os.write(writing, b"\0")
        thread.join()
        os.close(reading)
        os.close(writing)


def _noted(_number: int, _frame: object) -> None:
    """Only keeps the default away; the pipe does the work."""
