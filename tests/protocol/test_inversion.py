"""A batch shared out to several services, some of which fail."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.network.processes import wait_until
from tests.protocol.builders import emi_result, scans

from trackmesh.protocol.bus import Query
from trackmesh.protocol.client import Client, Incomplete
from trackmesh.protocol.codec import answer, decode, encoding, end, failure
from trackmesh.protocol.errors import QueryFailed, Unavailable
from trackmesh.protocol.inversion import PORTION_NUMBERS, portion, portions
from trackmesh.protocol.memory_bus import MemoryBus
from trackmesh.protocol.messages import EmiScanBatch, Envelope

Reply = tuple[bytes, str]
Answering = Callable[[EmiScanBatch], Iterator[bytes]]
WRAPPED = encoding(Envelope)


@pytest.fixture
def bus() -> MemoryBus:
    return MemoryBus()


@pytest.fixture
def client(bus: MemoryBus) -> Client:
    return Client(bus)


def serve(bus: MemoryBus, unit: str, answering: Answering) -> list[EmiScanBatch]:
    """A service that is alive; the questions it was asked."""
    keys, asked = Client(bus).keys, []
    bus.declare_alive(keys.live("emi", unit))

    def handler(query: Query) -> Iterator[Reply]:
        batch = decode(query.payload, EmiScanBatch, query.encoding)
        asked.append(batch)
        for payload in answering(batch):
            yield payload, WRAPPED

    bus.serve(keys.service("emi", unit), handler)
    return asked


def well(batch: EmiScanBatch) -> Iterator[bytes]:
    for i in range(len(batch.field)):
        yield answer(emi_result(i).model_copy(update={"geometry_id": named(batch)}))
    yield end(len(batch.field))


def named(batch: EmiScanBatch) -> str | None:
    return batch.geometry.content_id() if batch.geometry else batch.geometry_id


def dying_after(n: int) -> Answering:
    def answering(batch: EmiScanBatch) -> Iterator[bytes]:
        for i in range(min(n, len(batch.field))):
            yield answer(emi_result(i))

    return answering


@given(st.integers(1, 300), st.integers(1, 5))
def test_portions_are_all_scans_once(n: int, services: int) -> None:
    batch = scans(n)
    cut = list(portions(batch, services))
    assert [i for part in cut for i in part] == list(range(n))
    assert services == 1 or len(cut) >= min(n, services)
    assert all(len(part) * batch.field[0].size <= PORTION_NUMBERS for part in cut)
    assert len(portion(batch, cut[0]).field) == len(cut[0])


def test_all_services_have_a_share(bus: MemoryBus, client: Client) -> None:
    begun = {unit: threading.Event() for unit in "ab"}

    def together(unit: str) -> Answering:
        def answering(batch: EmiScanBatch) -> Iterator[bytes]:
            # No portion is answered before both have been asked for one.
            begun[unit].set()
            assert all(event.wait(30.0) for event in begun.values())
            yield from well(batch)

        return answering

    asked = {unit: serve(bus, unit, together(unit)) for unit in "ab"}
    inversion = client.invert(scans(64))
    assert sorted(r.index for r in inversion) == list(range(64))
    assert inversion.done == inversion.total == 64
    assert set(inversion.by_unit) == {"a", "b"}
    assert sum(len(batch.field) for batches in asked.values() for batch in batches) == 64


@pytest.mark.parametrize("n", [0, 1, 3])
def test_what_a_service_leaves_undone_is_done_by_another(bus: MemoryBus, client: Client, n: int) -> None:
    serve(bus, "a", dying_after(n))
    serve(bus, "b", well)
    inversion = client.invert(scans(40))
    assert sorted(r.index for r in inversion) == list(range(40))
    assert inversion.by_unit["b"] >= 40 - 2 * n


def test_a_service_that_fails_last_is_helped_by_one_that_was_done(bus: MemoryBus, client: Client) -> None:
    others_done = threading.Event()

    def slow(batch: EmiScanBatch) -> Iterator[bytes]:
        others_done.wait(10.0)
        yield answer(emi_result(0))

    serve(bus, "a", slow)
    serve(bus, "b", well)
    inversion = client.invert(scans(8))
    got = []
    for result in inversion:
        got.append(result.index)
        if len(got) == 4:
            others_done.set()
    assert sorted(got) == list(range(8))


def test_when_all_have_failed_it_is_told_how_far_they_came(bus: MemoryBus, client: Client) -> None:
    serve(bus, "a", dying_after(1))
    serve(bus, "b", dying_after(1))
    got = []
    with pytest.raises(Incomplete) as broken:
        for result in client.invert(scans(80)):
            got.append(result.index)
    assert broken.value.received == len(got) == len(set(got)) < 80


@pytest.mark.parametrize(("code", "helped"), [("busy", True), ("stopping", True), ("too_large", False)])
def test_a_refusal_is_raised_but_not_the_word_of_one_that_is_busy(
    bus: MemoryBus, client: Client, code: str, helped: bool
) -> None:
    def refusing(_batch: EmiScanBatch) -> Iterator[bytes]:
        yield failure(code, "No.")
        yield end(0)

    serve(bus, "a", refusing)
    serve(bus, "b", well)
    if helped:
        assert len(list(client.invert(scans(20)))) == 20
    else:
        with pytest.raises(QueryFailed, match="No"):
            list(client.invert(scans(20)))


def test_an_answer_to_another_question_is_refused(bus: MemoryBus, client: Client) -> None:
    def twice(_batch: EmiScanBatch) -> Iterator[bytes]:
        yield answer(emi_result(0))
        yield answer(emi_result(0))

    serve(bus, "a", twice)
    with pytest.raises(Exception, match="what was not asked"):
        list(client.invert(scans(3)))


def test_a_geometry_is_sent_once_and_then_named(bus: MemoryBus, client: Client) -> None:
    asked = serve(bus, "a", well)
    for _ in range(3):
        assert len(list(client.invert(scans(2)))) == 2
    assert [batch.geometry is None for batch in asked] == [False, True, True]
    assert {batch.geometry_id for batch in asked[1:]} == {named(asked[0])}


def test_a_service_that_has_forgotten_is_sent_the_geometry_again(bus: MemoryBus, client: Client) -> None:
    def forgetful(batch: EmiScanBatch) -> Iterator[bytes]:
        if batch.geometry is None:
            yield failure("unknown_geometry", "Send it.")
            yield end(0)
        else:
            yield from well(batch)

    asked = serve(bus, "a", forgetful)
    for _ in range(2):
        assert len(list(client.invert(scans(2)))) == 2
    assert [batch.geometry is None for batch in asked] == [False, True, False]


def test_who_cancels_is_no_longer_waiting(bus: MemoryBus, client: Client) -> None:
    release = threading.Event()

    def slowly(batch: EmiScanBatch) -> Iterator[bytes]:
        yield answer(emi_result(0))
        release.wait(10.0)

    serve(bus, "a", slowly)
    expression = client.keys.asking("*")
    with client.invert(scans(5)) as inversion:
        assert next(inversion).index == 0
        assert len(bus.alive(expression)) == 1
    assert bus.alive(expression) == []
    assert list(inversion) == []
    release.set()


def test_an_inversion_that_is_forgotten_is_over(bus: MemoryBus, client: Client) -> None:
    release = threading.Event()

    def slowly(_batch: EmiScanBatch) -> Iterator[bytes]:
        yield answer(emi_result(0))
        release.wait(10.0)

    serve(bus, "a", slowly)
    assert next(iter(client.invert(scans(5)))).index == 0
    gc.collect()
    wait_until(lambda: not bus.alive(client.keys.asking("*")), "nobody waits")
    release.set()


def test_a_finished_inversion_leaves_nothing_behind(bus: MemoryBus, client: Client) -> None:
    serve(bus, "a", well)
    inversion = client.invert(scans(3))
    assert len(list(inversion)) == 3
    assert bus.alive(client.keys.asking("*")) == []
    wait_until(lambda: not [t for t in threading.enumerate() if t.name.startswith("invert-")], "the threads end")


def test_one_may_wait_for_a_while_only(bus: MemoryBus, client: Client) -> None:
    release = threading.Event()

    def slowly(batch: EmiScanBatch) -> Iterator[bytes]:
        release.wait(10.0)
        yield from well(batch)

    serve(bus, "a", slowly)
    inversion = client.invert(scans(2))
    assert inversion.receive(0.05) is None
    release.set()
    assert {r.index for r in inversion} == {0, 1}
    assert inversion.receive(0.05) is None


def test_nobody_there_is_told(client: Client) -> None:
    with pytest.raises(Unavailable, match="No emi service is alive"):
        list(client.invert(scans(2), timeout_s=0.2))
