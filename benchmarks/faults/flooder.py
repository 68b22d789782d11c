"""A sensor out of its mind: valid batches at any rate, or messages that are none, at its own key.

python -m benchmarks.faults.flooder ENDPOINT NAME RATE_HZ SECONDS plots|garbage
"""

from __future__ import annotations

import random
import sys
import time
from typing import Any

import msgpack
import numpy as np

from trackmesh.protocol.bus import Publisher
from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import PlotBatch, ScanPart, SensorInfo
from trackmesh.protocol.sensor import Presence
from trackmesh.protocol.zenoh_bus import ZenohBus

SECTORS = 8
PLOTS = 5
ODD: list[Any] = [
    None, True, -1, 0, 1.5, 2**63, -(2**63), float("nan"), float("inf"), "", "x" * 300, b"", bytes(999), [], {},
    {"dtype": "<f8", "shape": [2**31, 2], "data": b""}, {"dtype": "O", "shape": [1], "data": b"1"}, [[]] * 50,
]  # fmt: skip


def batch(name: str, seq: int, rng: np.random.Generator) -> PlotBatch:
    """A sector with plots anywhere, of now."""
    now_ns = time.time_ns()
    values = np.stack([rng.uniform(1e3, 6e4, PLOTS), rng.uniform(0.0, 2.0 * np.pi, PLOTS)], axis=1)
    part = ScanPart(index=seq // SECTORS, sector=seq % SECTORS, sectors=SECTORS)
    return PlotBatch(
        sensor_id=name, boot_id="flood", seq=seq, t_ns=np.full(PLOTS, now_ns), columns=["range_m", "azimuth_rad"],
        values=values, scan=part,
    )  # fmt: skip


def broken(data: bytes, rng: random.Random) -> bytes:
    """A message that was spoilt: in its bytes (flipped, cut, put in, doubled), or in one of its fields."""
    if rng.random() < 0.6:
        return _with_odd_field(data, rng)
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        i, act = rng.randrange(len(out) + 1), rng.randrange(4)
        if act == 0 and out:
            out[i % len(out)] ^= 1 << rng.randrange(8)
        elif act == 1:
            del out[i:]
        elif act == 2:
            out[i:i] = rng.randbytes(rng.randint(1, 4))
        else:
            out[i:i] = out[: rng.randint(0, 40)]
    return bytes(out)


def _with_odd_field(data: bytes, rng: random.Random) -> bytes:
    fields: dict[str, Any] = msgpack.unpackb(data)
    place, name = fields, rng.choice(list(fields))
    if isinstance(fields[name], dict) and rng.random() < 0.7:
        place = fields[name]
        name = rng.choice(list(place))
    act = rng.randrange(4)
    if act == 0:
        del place[name]
    elif act == 1:
        place[rng.choice(["seq", "more", "", "values"])] = place.pop(name)
    else:
        place[name] = rng.choice(ODD)
    return bytes(msgpack.packb(fields))


def flood(publisher: Publisher, name: str, rate_hz: float, seconds: float, garbage: bool) -> int:
    """Publish on and on; how many messages."""
    rng, odd = np.random.default_rng(1), random.Random(1)
    began_s = time.monotonic()
    sent = 0
    while (now_s := time.monotonic() - began_s) < seconds:
        while sent < now_s * rate_hz:
            one = batch(name, sent, rng)
            publisher.put(broken(encode(one), odd) if garbage else encode(one), encoding(PlotBatch))
            sent += 1
        time.sleep(0.001)
    return sent


def main() -> None:
    endpoint, name, rate_hz, seconds, what = sys.argv[1:6]
    info = SensorInfo(
        sensor_id=name, kind="radar", site_enu_m=[0.0, 0.0, 0.0], period_s=1.0, p_detect=0.9, max_range_m=1e5,
        sigma={"range_m": 30.0, "azimuth_rad": 1e-3},
    )  # fmt: skip
    with ZenohBus.open([endpoint], timeout_s=60.0) as bus:
        presence = Presence(bus, Keys(), info)
        sent = flood(bus.publisher(Keys().plots(name)), name, float(rate_hz), float(seconds), what == "garbage")
        presence.close()
    print(f"sent {sent}", flush=True)


if __name__ == "__main__":
    main()
