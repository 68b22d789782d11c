from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from trackmesh.protocol.bus import Query
from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.errors import QueryFailed
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import EmiScanBatch, Envelope
from trackmesh.services.emi.service import EmiService, start
from trackmesh.services.emi.settings import EmiSettings
from trackmesh.services.runtime import ServiceRuntime
from trackmesh.sim.emi import random_targets, simulate, survey_geometry

Run = Callable[..., ServiceRuntime]


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def run(hub: MemoryHub) -> Iterator[Run]:
    running: list[ServiceRuntime] = []

    def go(**options: object) -> ServiceRuntime:
        settings = EmiSettings(**options)  # type: ignore[arg-type]
        runtime = ServiceRuntime("emi", settings, bus=MemoryBus(hub)).start()
        running.append(runtime)
        start(runtime, settings)
        return runtime

    yield go
    for runtime in running:
        runtime.close()


@pytest.fixture
def ask(hub: MemoryHub) -> Client:
    return Client(MemoryBus(hub))


@pytest.fixture(scope="module")
def batch() -> EmiScanBatch:
    geometry = survey_geometry((4.0, 4.0), 0.2)
    return simulate(geometry, random_targets(4, 3), 30.0, 3, batch_id="survey").batch


def test_each_scan_gets_its_answer(run: Run, ask: Client, batch: EmiScanBatch) -> None:
    runtime = run()
    results = list(ask.invert(batch))
    assert [(r.batch_id, r.index, r.status) for r in results] == [("survey", i, "ok") for i in range(4)]
    truth = random_targets(4, 3).position_m
    for result in results:
        np.testing.assert_allclose(result.targets[0].position_m, truth[result.index], atol=0.05)
        assert result.targets[0].covariance.shape == (9, 9)
    assert runtime.counters.counts() == {"requests": 1, "scans": 4, "scans_ok": 4}


def test_a_broken_scan_in_a_batch_is_answered_as_such(run: Run, ask: Client, batch: EmiScanBatch) -> None:
    run()
    field = batch.field.copy()
    field[1] = np.nan
    broken = batch.model_copy(update={"field": field})
    results = list(ask.invert(broken))
    assert [r.status for r in results] == ["ok", "invalid", "ok", "ok"]
    whole = list(ask.invert(batch))
    assert [results[i] for i in (0, 2, 3)] == [whole[i] for i in (0, 2, 3)]


@pytest.mark.parametrize("limit", [{"max_samples": 100}, {"max_numbers": 1000}, {"max_request_bytes": 2000}])
def test_too_large_a_request_is_refused(run: Run, ask: Client, batch: EmiScanBatch, limit: dict[str, int]) -> None:
    runtime = run(**limit)
    with pytest.raises(QueryFailed, match=r"at most \d+ are accepted") as caught:
        list(ask.invert(batch))
    assert caught.value.code == "too_large"
    assert runtime.counters.refused() == {"too_large": 1}


def test_a_request_that_takes_too_long_is_given_up(run: Run, ask: Client, batch: EmiScanBatch) -> None:
    runtime = run(request_deadline_s=1e-9)
    with pytest.raises(QueryFailed, match="given up"):
        list(ask.invert(batch))
    assert runtime.counters.refused() == {"deadline": 1}


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80", encode(Envelope(kind="end", count=0))])
def test_rubbish_is_refused_with_a_sentence(run: Run, payload: bytes) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings())
    replies = [decode(p, Envelope, e) for p, e in service.handle(Query("key", {}, payload, ""))]
    assert [r.kind for r in replies] == ["error", "end"]
    assert replies[0].detail
    assert sum(runtime.counters.refused().values()) == 1


def test_json_is_answered_in_json(run: Run, batch: EmiScanBatch) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings())
    one = batch.model_copy(update={"field": batch.field[:1]})
    query = Query("key", {"fmt": "json"}, encode(one, "json"), encoding(one, "json"))
    first, last = service.handle(query)
    assert first[1].startswith("application/json")
    assert b'"status":"ok"' in first[0]
    assert decode(last[0], Envelope, last[1]).count == 1


def test_a_stopping_service_ends_its_answer(run: Run, batch: EmiScanBatch) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings())
    answer = service.handle(Query("key", {}, encode(batch), encoding(batch)))
    next(answer)
    runtime.stopping.set()
    assert [decode(p, Envelope, e).kind for p, e in answer] == ["error", "end"]
