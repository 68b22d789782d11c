"""A TCP proxy between a client and a router: delay, jitter, half-open and severed links, without root.

It runs in a thread of the test. Bytes keep their order. What is held back while a direction is shut is sent on when it
opens, as TCP does after packets were dropped; the ends of connections wait like bytes, so that a link is half-open.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, Self

_CHUNK = 65_536
_HELD_MOST = 4096
_STEP_S = 0.005


class Direction:
    """One of the two ways through the proxy.

    Attributes:
        delay_s, jitter_s: every byte is delayed by the first and up to the second more.
        open: nothing passes while it is False, and nobody is told.
        passed: bytes sent on so far.
    """

    def __init__(self) -> None:
        self.delay_s = self.jitter_s = 0.0
        self.open = True
        self.passed = 0


class Proxy:
    """Listens at a free port of this host and passes on to a target.

    Args:
        target: host and port.
        seed: of the jitter.
    """

    def __init__(self, target: tuple[str, int], seed: int = 0) -> None:
        self.up, self.down = Direction(), Direction()
        self._target = target
        self._random = random.Random(seed)
        self._writers: set[asyncio.StreamWriter] = set()
        self._refusing = False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="proxy")
        self._thread.start()
        self._server = self._call(asyncio.start_server(self._accept, "127.0.0.1", 0))
        self.port = int(self._server.sockets[0].getsockname()[1])

    @property
    def endpoint(self) -> str:
        """Where to connect instead."""
        return f"tcp/127.0.0.1:{self.port}"

    def slow(self, delay_s: float, jitter_s: float = 0.0) -> None:
        """Delay both directions."""
        for way in (self.up, self.down):
            way.delay_s, way.jitter_s = delay_s, jitter_s

    def drop(self) -> None:
        """Let nothing pass in either direction, without a word."""
        self.up.open = self.down.open = False

    def sever(self) -> None:
        """Reset all connections, and new ones at once, until healed."""
        self._refusing = True
        self._loop.call_soon_threadsafe(self._abort)

    def heal(self) -> None:
        """Let all pass again."""
        self.up.open = self.down.open = True
        self._refusing = False

    def close(self) -> None:
        """End it, and all connections."""
        self._loop.call_soon_threadsafe(self._stop)
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _run(self) -> None:
        self._loop.run_forever()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(asyncio.sleep(0.01))
        self._loop.close()

    def _stop(self) -> None:
        self._server.close()
        self._abort()
        self._loop.stop()

    def _abort(self) -> None:
        for writer in list(self._writers):
            _reset(writer)

    def _call(self, work: Coroutine[Any, Any, asyncio.Server]) -> asyncio.Server:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(5.0)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._refusing:
            _reset(writer)
            return
        self._writers.add(writer)
        other: asyncio.StreamWriter | None = None
        try:
            far, other = await asyncio.open_connection(*self._target)
            self._writers.add(other)
            await asyncio.gather(self._pass_on(reader, other, self.up), self._pass_on(far, writer, self.down))
        except (OSError, asyncio.CancelledError):
            pass
        finally:
            for one in (writer, other):
                if one is not None:
                    self._writers.discard(one)
                    one.transport.abort()

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, way: Direction) -> None:
        """Read and write in two tasks: what is under way for long must not hold up what follows it."""
        held: deque[tuple[float, bytes]] = deque()
        changed = asyncio.Event()

        async def read() -> None:
            due_s = 0.0
            while True:
                data = b""
                with contextlib.suppress(OSError):
                    data = await reader.read(_CHUNK)
                due_s = max(due_s, time.monotonic() + way.delay_s + self._random.random() * way.jitter_s)
                held.append((due_s, data))
                changed.set()
                if not data:
                    return
                await _until(lambda: len(held) < _HELD_MOST)

        task = asyncio.ensure_future(read())
        try:
            while True:
                await changed.wait()
                due_s, data = held.popleft()
                if not held:
                    changed.clear()
                await asyncio.sleep(due_s - time.monotonic())
                await _until(lambda: way.open)
                if not data:
                    raise ConnectionResetError
                writer.write(data)
                await writer.drain()
                way.passed += len(data)
        finally:
            task.cancel()


def _reset(writer: asyncio.StreamWriter) -> None:
    # Without this the other side would be told of an orderly end.
    writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()


async def _until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(_STEP_S)
