from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from tests.network.processes import wait_until

from trackmesh.protocol.bus import Query
from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.errors import QueryFailed, RefusedMessage
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import EmiScanBatch, Envelope
from trackmesh.services.emi.service.geometries import Geometries
from trackmesh.services.emi.service.handler import EmiService
from trackmesh.services.emi.service.main import start
from trackmesh.services.emi.service.pool import OwnWork
from trackmesh.services.emi.service.settings import EmiSettings
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
        settings = EmiSettings(**({"processes": 0} | options))  # type: ignore[arg-type]
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


def test_one_bad_scan_of_many_leaves_the_others_bit_for_bit(run: Run, ask: Client) -> None:
    run()
    many = simulate(survey_geometry((2.0, 2.0), 0.2), random_targets(64, 3, spread_m=0.5), 30.0, 3).batch
    field = many.field.copy()
    field[17] = np.nan
    whole = {r.index: r for r in ask.invert(many)}
    broken = {r.index: r for r in ask.invert(many.model_copy(update={"field": field}))}
    assert broken.pop(17).status == "invalid"
    assert all(encode(result) == encode(whole[i]) for i, result in broken.items())
    assert len(broken) == 63


@pytest.mark.parametrize("limit", [{"max_numbers": 1000}, {"max_request_bytes": 2000}])
def test_too_large_a_request_is_refused(run: Run, ask: Client, batch: EmiScanBatch, limit: dict[str, int]) -> None:
    runtime = run(**limit)
    with pytest.raises(QueryFailed, match=r"at most \d+ are accepted") as caught:
        list(ask.invert(batch))
    assert caught.value.code == "too_large"
    assert runtime.counters.refused() == {"too_large": 1}


def test_too_large_a_scan_is_answered_as_such(run: Run, ask: Client, batch: EmiScanBatch) -> None:
    runtime = run(max_samples=100)
    results = list(ask.invert(batch))
    assert [(r.index, r.status, r.reasons, r.targets) for r in results] == [
        (i, "too_large", ["more_than_100_samples"], []) for i in range(4)
    ]
    assert runtime.counters.counts()["scans_too_large"] == 4


def test_scans_not_done_at_the_deadline_are_told(run: Run, ask: Client, batch: EmiScanBatch) -> None:
    run(request_deadline_s=1e-9)
    results = list(ask.invert(batch))
    assert [(r.status, r.reasons) for r in results] == [("too_large", ["deadline"])] * 4


def test_a_geometry_may_be_named_once_it_is_known(run: Run, batch: EmiScanBatch) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings(), OwnWork())
    assert batch.geometry is not None
    ident = batch.geometry.content_id()
    named = batch.model_copy(update={"geometry": None, "geometry_id": ident})

    def answered(question: EmiScanBatch) -> list[Envelope]:
        query = Query("key", {}, encode(question), encoding(question))
        return [decode(p, Envelope, e) for p, e in service.handle(query)]

    assert answered(named)[0].code == "unknown_geometry"
    whole = answered(batch)
    assert answered(named) == whole
    payload = whole[0].payload
    assert payload is not None and (payload["geometry_id"], payload["unit_id"]) == (ident, "main")
    assert answered(batch.model_copy(update={"geometry_id": "other"}))[0].code == "invalid"
    short = named.model_copy(update={"field": batch.field[:, :, :-1]})
    assert answered(short)[0].code == "wrong_length"


def test_forgotten_geometries_are_those_not_used(batch: EmiScanBatch) -> None:
    known = Geometries(2)
    batches = []
    for k in range(3):
        geometry = survey_geometry((4.0, 4.0), 0.2, height_m=0.1 * k)
        batches.append(batch.model_copy(update={"geometry": geometry}))
    idents = [known.resolve(one)[0] for one in (*batches[:2], batches[0], batches[2])]
    named = [batch.model_copy(update={"geometry": None, "geometry_id": ident}) for ident in idents]
    assert known.resolve(named[0])[1] == batches[0].geometry
    with pytest.raises(RefusedMessage, match="not known here"):
        known.resolve(named[1])


def test_what_nobody_waits_for_is_given_up(run: Run, hub: MemoryHub, batch: EmiScanBatch) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings(), OwnWork())
    many = batch.model_copy(update={"field": np.repeat(batch.field, 30, axis=0)})
    answer = service.handle(Query("key", {"asking": "me"}, encode(many), encoding(many)))
    next(answer)
    assert service.askers.left("me") == 1
    kinds = [decode(p, Envelope, e) for p, e in answer]
    assert [(e.kind, e.code) for e in kinds[-2:]] == [("error", "cancelled"), ("end", None)]
    assert len(kinds) < 100
    assert service.askers.left("me") == 0


def test_a_client_that_cancels_ends_the_work(run: Run, ask: Client, batch: EmiScanBatch) -> None:
    runtime = run()
    many = batch.model_copy(update={"field": np.repeat(batch.field, 200, axis=0)})
    with ask.invert(many) as inversion:
        next(inversion)
    wait_until(lambda: runtime.counters.refused().get("cancelled"), "the work is given up")
    assert runtime.counters.counts()["scans"] < 800


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80", encode(Envelope(kind="end", count=0))])
def test_rubbish_is_refused_with_a_sentence(run: Run, payload: bytes) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings(), OwnWork())
    replies = [decode(p, Envelope, e) for p, e in service.handle(Query("key", {}, payload, ""))]
    assert [r.kind for r in replies] == ["error", "end"]
    assert replies[0].detail
    assert sum(runtime.counters.refused().values()) == 1


def test_json_is_answered_in_json(run: Run, batch: EmiScanBatch) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings(), OwnWork())
    one = batch.model_copy(update={"field": batch.field[:1]})
    query = Query("key", {"fmt": "json"}, encode(one, "json"), encoding(one, "json"))
    first, last = service.handle(query)
    assert first[1].startswith("application/json")
    assert b'"status":"ok"' in first[0]
    assert decode(last[0], Envelope, last[1]).count == 1


def test_a_stopping_service_ends_its_answer(run: Run, batch: EmiScanBatch) -> None:
    runtime = run()
    service = EmiService(runtime, EmiSettings(), OwnWork())
    answer = service.handle(Query("key", {}, encode(batch), encoding(batch)))
    next(answer)
    runtime.stopping.set()
    assert [decode(p, Envelope, e).kind for p, e in answer] == ["error", "end"]
