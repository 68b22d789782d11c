"""Tags: microseconds a tag update of three ranges, and how many tags one core follows at one update a second.

python -m benchmarks.tags        the second case decodes the batches, runs the engine and encodes the frames
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.messages import RangeBatch, SensorInfo
from trackmesh.services.tags.engine import TagEngine, Unit
from trackmesh.services.tags.filtering import begin, filter_ranges
from trackmesh.services.tags.records import RANGE, Describe, make_filters, make_rules, make_work
from trackmesh.services.tags.settings import TagEngineSettings
from trackmesh.services.tags.warm_up import warm_up

REPEATS = 7
LEAST_S = 0.05
SIZES = (1, 100, 10_000)
FILTERS = {
    "service default": TagEngineSettings().description(),
    "ut": Describe(update="ut"),
    "ekf": Describe(update="ekf"),
    "ut, bias and scale": Describe(update="ut", bias_sd_m=1.0, scale_sd=0.05),
}
READERS = np.array([[x, y, 0.0] for x in range(0, 100, 20) for y in range(0, 100, 20)], float)

LIVE_TAGS = 10_000
LIVE_S = 12
RANGES_A_BATCH = 3_000
S = 1_000_000_000


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``: the median of some repeats."""
    for name, description in FILTERS.items():
        for n in SIZES:
            spent = update_us(description, n)
            case = f"update of 3 ranges, {name} N={n}"
            print(f"tags {case}: {np.median(spent):.2f} us (min {min(spent):.2f}, max {max(spent):.2f})")
            yield _row(case, float(np.median(spent)), "us/tag update")
    for name, settings in (("singer ut", TagEngineSettings(motion="singer")), ("default", TagEngineSettings())):
        share = load(settings)
        case = f"{LIVE_TAGS} tags at 1 Hz, 3 ranges each, {name}"
        print(f"tags {case}: {share:.3f} of a core, so {LIVE_TAGS / share:.0f} tags a core")
        yield _row(case, share, "CPU s/s")


def update_us(description: Describe, n: int) -> list[float]:
    """Microseconds for one tag: predict over 0.1 to 0.3 s and take three ranges; for n tags in one call."""
    rules = make_rules(description)
    filters, work = make_filters(rules, n), make_work(rules)
    rng = np.random.default_rng(1)
    places = rng.uniform(10.0, 70.0, (n, 2))
    for row in range(n):
        begin(rules[0], filters[row], 0.0, places[row, 0], places[row, 1], np.array([1.0, 0.0, 1.0]))
    batches = [_instant(rng, places, 0.1 * (k + 1)) for k in range(20)]
    filter_ranges(rules[0], filters, READERS, batches[0], work[0])
    spent = []
    for _ in range(REPEATS):
        times, seconds = 0, 0.0
        while seconds < LEAST_S:
            filters["t_s"] = 0.0
            started = time.perf_counter()
            for z in batches:
                filter_ranges(rules[0], filters, READERS, z, work[0])
            seconds += time.perf_counter() - started
            times += len(batches)
        spent.append(seconds / times / n * 1e6)
    return spent


def _instant(rng: np.random.Generator, places: npt.NDArray[np.float64], t_s: float) -> npt.NDArray[Any]:
    n = len(places)
    z = np.zeros(3 * n, RANGE)
    z["row"] = np.repeat(np.arange(n), 3)
    z["reader"] = rng.integers(0, len(READERS), 3 * n)
    at = places[z["row"]]
    z["range_m"] = np.hypot(*(at - READERS[z["reader"], :2]).T) + rng.normal(size=3 * n)
    z["t_s"], z["variance"] = t_s, 1.0
    return z


def load(settings: TagEngineSettings) -> float:
    """CPU seconds a second that very many tags cost: batches as bytes in, frames as bytes out."""
    warm_up(settings)
    engine = TagEngine(settings.model_copy(update={"frame_period_s": 1.0}), Unit())
    for k, (east, north, _) in enumerate(READERS.tolist()):
        engine.reader(_reader(k, east, north))
    payloads = list(_stream())
    first = len(payloads) // LIVE_S * 2
    started = 0.0
    for k, payload in enumerate(payloads):
        if k == first:
            # The first two seconds locate the tags; what counts is what goes on.
            started = time.process_time()
        frame = engine.ranges(decode(payload, RangeBatch))
        if frame is not None:
            encode(frame)
    share = (time.process_time() - started) / (LIVE_S - 2)
    located = engine.figures()["located"]
    if located < 0.99 * LIVE_TAGS:
        raise SystemExit(f"Only {located:.0f} tags were located.")
    return share


def _reader(k: int, east: float, north: float) -> SensorInfo:
    return SensorInfo(
        sensor_id=f"r{k}", kind="ranging", site_enu_m=[east, north, 0.0], period_s=1.0, p_detect=1.0, max_range_m=200.0,
        sigma={"range_m": 1.0},
    )  # fmt: skip


def _stream() -> Iterator[bytes]:
    """What a gateway sends: each tag is heard by three readers once a second, tags spread over the second."""
    rng = np.random.default_rng(2)
    names, readers = [f"tag-{k}" for k in range(LIVE_TAGS)], [f"r{k}" for k in range(len(READERS))]
    places, velocity = rng.uniform(0.0, 80.0, (LIVE_TAGS, 2)), rng.normal(size=(LIVE_TAGS, 2))
    a_batch, seq = RANGES_A_BATCH // 3, 0
    for second in range(LIVE_S):
        for first in range(0, LIVE_TAGS, a_batch):
            tags = np.arange(first, first + a_batch)
            tag = np.repeat(np.arange(a_batch), 3)
            reader = np.argsort(rng.random((a_batch, len(READERS))), axis=1)[:, :3].ravel()
            at = (places[tags] + second * 0.1 * velocity[tags])[tag]
            t_ns = second * S + first * S // LIVE_TAGS
            yield encode(
                RangeBatch(
                    network_id="hall", boot_id="b", seq=seq, t_ns=np.full(len(tag), 1_700_000_000 * S + t_ns),
                    tags=[names[k] for k in tags], readers=readers, tag=tag.astype(np.uint32),
                    reader=reader.astype(np.uint32),
                    range_m=np.abs(np.hypot(*(at - READERS[reader, :2]).T) + rng.normal(size=len(tag))),
                )
            )  # fmt: skip
            seq += 1


def _row(case: str, value: float, unit: str) -> dict[str, object]:
    return {
        "bench": "tags", "case": case, "value": value, "unit": unit, "peer": None, "peer_value": None, "ratio": None,
    }  # fmt: skip


if __name__ == "__main__":
    for _ in rows():
        pass
