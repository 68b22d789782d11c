"""Small participants, each a process of its own: ``python -m tests.network.peers ROLE ENDPOINTS KEY [N]``.

``publish`` counts at up to 400 Hz, keeping N messages, and prints how far it is; ``tick`` does so at 50 Hz and is
alive, ``pour`` with 32 kB each; ``token`` is only alive; ``listen`` subscribes in all ways and serves; ``forget`` does
so and ends without closing anything; ``count`` answers a query with N numbers, and dies after half of them if told to.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator

from trackmesh.protocol.bus import Query
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.process import on_signal


def publish(
    bus: ZenohBus, key: str, history: int, stop: threading.Event, every_s: float = 0.0025, size: int = 0
) -> None:
    publisher = bus.publisher(key, history=history)
    number = 0
    while not stop.wait(every_s):
        publisher.put(str(number).encode().ljust(size), "text/plain")
        print(f"at {number}", flush=True)
        number += 1


def tick(bus: ZenohBus, key: str, history: int, stop: threading.Event) -> None:
    bus.declare_alive(f"{key}/alive")
    publish(bus, key, history, stop, 0.02)


def pour(bus: ZenohBus, key: str, history: int, stop: threading.Event) -> None:
    bus.declare_alive(f"{key}/alive")
    publish(bus, key, history, stop, 0.02, 32_000)


def token(bus: ZenohBus, key: str, _n: int, stop: threading.Event) -> None:
    bus.declare_alive(key)
    stop.wait()


def listen(bus: ZenohBus, key: str, _n: int, stop: threading.Event) -> None:
    plain, kept, watcher = bus.subscribe(key), bus.subscribe(key, history=True), bus.watch_alive(key)
    bus.serve(key, lambda _query: [(b"", "")])
    threads = [threading.Thread(target=list, args=(s,)) for s in (plain, kept, watcher)]
    for thread in threads:
        thread.start()
    print("listening", flush=True)
    stop.wait()
    for subscription in (plain, kept, watcher):
        subscription.close()
    for thread in threads:
        thread.join()


def count(bus: ZenohBus, key: str, n: int, stop: threading.Event) -> None:
    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        for i in range(n):
            yield str(i).encode(), "text/plain"
            if query.payload == b"die" and i == n // 2:
                time.sleep(0.2)
                os._exit(9)

    bus.serve(key, handler)
    stop.wait()


ROLES = {"publish": publish, "tick": tick, "pour": pour, "token": token, "listen": listen, "count": count}


def forget(endpoints: str, key: str, error: bool) -> None:
    bus = ZenohBus.open(endpoints.split(","))
    bus.subscribe(key)
    bus.subscribe(key, history=True)
    bus.serve(key, lambda _query: [(b"", "")])
    if error:
        raise ZeroDivisionError


def main(role: str, endpoints: str, key: str, n: int) -> None:
    if role == "forget":
        forget(endpoints, key, bool(n))
        return
    stop = threading.Event()
    with on_signal(lambda _name: stop.set()), ZenohBus.open(endpoints.split(",")) as bus:
        print("ready", flush=True)
        {"publish": publish, "tick": tick, "pour": pour, "token": token, "listen": listen, "count": count}[role](
            bus, key, n, stop
        )
    print("left", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]) if len(sys.argv) > 4 else 0)
