"""One contract, held by the bus in memory and by the bus over Zenoh alike."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.network.processes import RouterProcess, free_port, wait_until

from trackmesh.protocol.bus import AliveEvent, AliveSubscription, Bus, Publisher, Query, Subscription
from trackmesh.protocol.codec import open_envelope
from trackmesh.protocol.errors import BusError, QueryFailed
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus

_realms = itertools.count()


class Network:
    """Makes participants of one network, and keys that no other test uses."""

    def __init__(self, make: Callable[[], Bus]) -> None:
        self._make = make
        self._made: list[Bus] = []
        self._realm = f"test{next(_realms)}"

    def bus(self) -> Bus:
        self._made.append(self._make())
        return self._made[-1]

    def key(self, *chunks: str) -> str:
        return "/".join((self._realm, "@v1", *chunks))

    def close(self) -> None:
        for bus in self._made:
            bus.close()


@pytest.fixture(params=["memory", pytest.param("zenoh", marks=pytest.mark.process)])
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    if request.param == "memory":
        hub = MemoryHub()
        made = Network(lambda: MemoryBus(hub))
    else:
        router: RouterProcess = request.getfixturevalue("router")
        made = Network(lambda: ZenohBus.open([router.endpoint]))
    yield made
    made.close()


def join(publisher: Publisher, subscription: Subscription) -> None:
    """Put until the subscription hears it: a new subscription is not known everywhere at once."""

    def heard() -> bool:
        publisher.put(b"join", "")
        return subscription.receive(0.02) is not None

    wait_until(heard, "the subscription hears the publisher")
    publisher.put(b"joined", "")
    while (sample := subscription.receive(5.0)) is not None and sample.payload != b"joined":
        pass


def payloads(subscription: Subscription, n: int) -> list[bytes]:
    samples = [subscription.receive(5.0) for _ in range(n)]
    return [sample.payload for sample in samples if sample is not None]


def events(watcher: AliveSubscription, n: int) -> list[AliveEvent | None]:
    return [watcher.receive(5.0) for _ in range(n)]


def count_to(n: int) -> Callable[[Query], Iterator[tuple[bytes, str]]]:
    return lambda _query: ((str(i).encode(), "text/plain") for i in range(n))


def served(bus: Bus, expression: str) -> None:
    """Wait until queries reach a server."""
    wait_until(lambda: list(bus.query(expression, b"ping", timeout_s=1.0)), "a server answers")


# --- publish and subscribe


def test_messages_arrive_whole_and_in_order(network: Network) -> None:
    publisher = network.bus().publisher(network.key("plots", "a"))
    subscription = network.bus().subscribe(network.key("plots", "*"))
    join(publisher, subscription)
    samples = []
    for i in range(100):
        # One by one: plots are dropped, not waited for, where a busy network cannot take them at once.
        publisher.put(bytes([i, 0, 255]), "application/msgpack;trackmesh.PlotBatch.v1")
        samples.append(subscription.receive(5.0))
    assert [s.payload for s in samples if s] == [bytes([i, 0, 255]) for i in range(100)]
    assert {(s.key, s.encoding) for s in samples if s} == {
        (network.key("plots", "a"), "application/msgpack;trackmesh.PlotBatch.v1")
    }


def test_a_subscription_hears_its_expression_only(network: Network) -> None:
    bus = network.bus()
    mine, other = bus.publisher(network.key("plots", "a")), bus.publisher(network.key("tracks", "a"))
    subscription = network.bus().subscribe(network.key("plots", "*"))
    join(mine, subscription)
    other.put(b"other", "")
    mine.put(b"mine", "")
    assert payloads(subscription, 1) == [b"mine"]


def test_wildcards_do_not_cross_the_version(network: Network) -> None:
    publisher = network.bus().publisher(network.key("plots", "a"))
    bus = network.bus()
    everything = bus.subscribe(network.key("plots", "a").split("/")[0] + "/**")
    join(publisher, bus.subscribe(network.key("**")))
    assert everything.receive(0.05) is None


def test_a_participant_hears_itself(network: Network) -> None:
    bus = network.bus()
    join(bus.publisher(network.key("plots", "a")), bus.subscribe(network.key("plots", "a")))


def test_receive_gives_up_after_its_time(network: Network) -> None:
    assert network.bus().subscribe(network.key("plots", "*")).receive(0.01) is None


def test_a_slow_reader_loses_the_oldest_and_counts_them(network: Network) -> None:
    publisher = network.bus().publisher(network.key("plots", "a"))
    subscription = network.bus().subscribe(network.key("plots", "*"), capacity=8)
    join(publisher, subscription)
    for i in range(50):
        publisher.put(str(i).encode(), "")
    wait_until(lambda: subscription.dropped == 42, "all have arrived")
    assert payloads(subscription, 8) == [str(i).encode() for i in range(42, 50)]


def test_a_key_that_floods_displaces_no_other_where_that_is_asked_for(network: Network) -> None:
    loud, quiet = (network.bus().publisher(network.key("plots", name)) for name in ("loud", "quiet"))
    subscription = network.bus().subscribe(network.key("plots", "*"), capacity=8, fair=True)
    join(loud, subscription)
    join(quiet, subscription)
    for i in range(50):
        loud.put(str(i).encode(), "")
    wait_until(lambda: subscription.dropped == 42, "the flood has come")
    for i in range(3):
        quiet.put(str(i).encode(), "")
    wait_until(lambda: subscription.dropped == 45, "the others have come")
    got = [subscription.receive(1.0) for _ in range(8)]
    assert [s.payload for s in got if s and s.key.endswith("quiet")] == [b"0", b"1", b"2"]
    assert [s.payload for s in got if s and s.key.endswith("loud")] == [b"45", b"46", b"47", b"48", b"49"]
    assert got[1] is not None and got[1].key.endswith("quiet")


def test_closing_a_subscription_ends_its_iteration(network: Network) -> None:
    subscription = network.bus().subscribe(network.key("plots", "*"))
    ended = threading.Event()

    def read() -> None:
        for _ in subscription:
            pass
        ended.set()

    thread = threading.Thread(target=read)
    thread.start()
    subscription.close()
    subscription.close()
    thread.join(5.0)
    assert ended.is_set()


def test_a_closed_publisher_publishes_nothing_and_raises_nothing(network: Network) -> None:
    bus = network.bus()
    closed, open_ = bus.publisher(network.key("plots", "a")), bus.publisher(network.key("plots", "a"))
    subscription = network.bus().subscribe(network.key("plots", "*"))
    join(open_, subscription)
    closed.close()
    closed.close()
    closed.put(b"never", "")
    open_.put(b"after", "")
    assert payloads(subscription, 1) == [b"after"]


# --- history


def test_a_late_joiner_gets_what_was_kept_then_what_follows(network: Network) -> None:
    publisher = network.bus().publisher(network.key("sensors", "a"), history=3)
    for i in range(5):
        publisher.put(str(i).encode(), "text/plain")
    late = network.bus().subscribe(network.key("sensors", "*"), history=True)
    assert payloads(late, 3) == [b"2", b"3", b"4"]
    publisher.put(b"5", "text/plain")
    assert payloads(late, 1) == [b"5"]
    assert late.receive(0.05) is None


def test_without_history_nothing_old_comes(network: Network) -> None:
    publisher = network.bus().publisher(network.key("sensors", "a"), history=3)
    join(publisher, network.bus().subscribe(network.key("sensors", "*")))
    plain = network.bus().subscribe(network.key("sensors", "*"))
    assert plain.receive(0.1) is None
    join(publisher, plain)


def test_history_is_of_each_publisher(network: Network) -> None:
    bus = network.bus()
    for name in ("a", "b"):
        publisher = bus.publisher(network.key("sensors", name), history=1)
        publisher.put(b"old", "")
        publisher.put(name.encode(), "")
    late = network.bus().subscribe(network.key("sensors", "*"), history=True)
    assert sorted(payloads(late, 2)) == [b"a", b"b"]


def test_a_publisher_that_comes_later_is_heard_from_its_first_message(network: Network) -> None:
    early = network.bus().subscribe(network.key("sensors", "*"), history=True)
    publisher = network.bus().publisher(network.key("sensors", "a"), history=5)
    for i in range(5):
        publisher.put(str(i).encode(), "")
    assert payloads(early, 5) == [str(i).encode() for i in range(5)]


def test_history_goes_with_its_publisher(network: Network) -> None:
    publisher = network.bus().publisher(network.key("sensors", "a"), history=3)
    publisher.put(b"kept", "")
    publisher.close()
    late = network.bus().subscribe(network.key("sensors", "*"), history=True)
    assert late.receive(0.2) is None


# --- queries


def test_answers_come_in_order_each_as_it_is_ready(network: Network) -> None:
    go_on = threading.Event()

    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        yield b"first", "text/plain"
        if query.payload == b"slowly":
            go_on.wait(5.0)
        yield b"second", "text/plain"

    network.bus().serve(network.key("svc", "emi", "a"), handler)
    asker = network.bus()
    served(asker, network.key("svc", "emi", "*"))
    answers = asker.query(network.key("svc", "emi", "*"), b"slowly", timeout_s=5.0)
    assert next(answers).payload == b"first"
    go_on.set()
    assert [answer.payload for answer in answers] == [b"second"]


def test_many_answers_of_one_key_all_arrive(network: Network) -> None:
    network.bus().serve(network.key("svc", "emi", "a"), count_to(500))
    asker = network.bus()
    served(asker, network.key("svc", "emi", "a"))
    # Were it to end by its time only, the test would run into its own limit.
    answers = list(asker.query(network.key("svc", "emi", "a"), timeout_s=1000.0))
    assert [int(answer.payload) for answer in answers] == list(range(500))
    assert {(a.key, a.encoding) for a in answers} == {(network.key("svc", "emi", "a"), "text/plain")}


def test_the_server_sees_the_whole_question(network: Network) -> None:
    seen: list[Query] = []

    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        seen.append(query)
        yield b"", ""

    network.bus().serve(network.key("svc", "tracks", "a"), handler)
    asker = network.bus()
    served(asker, network.key("svc", "tracks", "a"))
    seen.clear()
    list(asker.query(network.key("svc", "tracks", "*"), b"what", "text/x", parameters="fmt=json;x=1"))
    assert seen == [Query(network.key("svc", "tracks", "a"), {"fmt": "json", "x": "1"}, b"what", "text/x")]


def test_all_servers_answer(network: Network) -> None:
    for name in ("a", "b", "c"):
        network.bus().serve(network.key("svc", "emi", name), count_to(20))
    asker = network.bus()
    for name in ("a", "b", "c"):
        served(asker, network.key("svc", "emi", name))
    answers = list(asker.query(network.key("svc", "emi", "*")))
    for name in ("a", "b", "c"):
        mine = [int(a.payload) for a in answers if a.key == network.key("svc", "emi", name)]
        assert mine == list(range(20))


def test_nobody_answers(network: Network) -> None:
    assert list(network.bus().query(network.key("svc", "emi", "nobody"), timeout_s=5.0)) == []


def test_a_query_ends_at_its_time_with_what_has_come(network: Network) -> None:
    release = threading.Event()

    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        yield b"one", ""
        if query.payload != b"ping":
            release.wait(20.0)

    network.bus().serve(network.key("svc", "emi", "a"), handler)
    asker = network.bus()
    served(asker, network.key("svc", "emi", "a"))
    assert [a.payload for a in asker.query(network.key("svc", "emi", "a"), timeout_s=0.3)] == [b"one"]
    release.set()


def test_the_time_of_a_query_is_that_of_all_its_answers(network: Network) -> None:
    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        yield b"", ""
        for _ in range(500 if query.payload != b"ping" else 0):
            time.sleep(0.02)
            yield b"", ""

    network.bus().serve(network.key("svc", "emi", "a"), handler)
    asker = network.bus()
    served(asker, network.key("svc", "emi", "a"))
    assert len(list(asker.query(network.key("svc", "emi", "a"), timeout_s=0.3))) < 100


def test_questions_are_answered_side_by_side(network: Network) -> None:
    together = threading.Barrier(3)

    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        if query.payload != b"ping":
            together.wait(5.0)
        yield b"done", ""

    network.bus().serve(network.key("svc", "emi", "a"), handler, workers=3)
    asker = network.bus()
    served(asker, network.key("svc", "emi", "a"))
    questions = [asker.query(network.key("svc", "emi", "a"), timeout_s=10.0) for _ in range(3)]
    assert [[a.payload for a in answers] for answers in questions] == [[b"done"]] * 3


def test_a_handler_that_fails_gives_an_error_envelope(network: Network, caplog: pytest.LogCaptureFixture) -> None:
    def handler(_query: Query) -> Iterator[tuple[bytes, str]]:
        yield b"one", ""
        raise ZeroDivisionError("secret")

    network.bus().serve(network.key("svc", "emi", "a"), handler)
    asker = network.bus()
    served(asker, network.key("svc", "emi", "a"))
    for parameters in ("", "fmt=json"):
        _, last = list(asker.query(network.key("svc", "emi", "a"), parameters=parameters))
        with pytest.raises(QueryFailed) as failed:
            open_envelope(last.payload, last.encoding, TrackFrame)
        assert failed.value.code == "internal"
        assert "secret" not in str(failed.value)
        assert ("json" in last.encoding) == (parameters != "")
    assert "ZeroDivisionError" in caplog.text


def test_a_server_with_too_much_to_do_says_so(network: Network) -> None:
    release = threading.Event()

    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        if query.payload != b"ping":
            release.wait(20.0)
        yield b"done", ""

    network.bus().serve(network.key("svc", "emi", "a"), handler, workers=1)
    asker = network.bus()
    served(asker, network.key("svc", "emi", "a"))
    questions = [asker.query(network.key("svc", "emi", "a"), timeout_s=10.0) for _ in range(100)]
    last = next(questions[-1])
    with pytest.raises(QueryFailed) as failed:
        open_envelope(last.payload, last.encoding, TrackFrame)
    assert failed.value.code == "busy"
    release.set()
    assert [a.payload for a in questions[0]] == [b"done"]


def test_a_server_that_closes_answers_no_more(network: Network) -> None:
    bus, asker = network.bus(), network.bus()
    server = bus.serve(network.key("svc", "emi", "a"), count_to(1))
    served(asker, network.key("svc", "emi", "a"))
    server.close()
    server.close()
    wait_until(lambda: not list(asker.query(network.key("svc", "emi", "a"))), "no answers any more")


# --- liveliness


def test_tokens_come_and_go(network: Network) -> None:
    bus, watcher = network.bus(), network.bus().watch_alive(network.key("live", "**"))
    token = bus.declare_alive(network.key("live", "fusion", "a"))
    assert events(watcher, 1) == [AliveEvent(network.key("live", "fusion", "a"), True)]
    token.close()
    token.close()
    assert events(watcher, 1) == [AliveEvent(network.key("live", "fusion", "a"), False)]


def test_who_watches_later_sees_those_already_there(network: Network) -> None:
    bus = network.bus()
    keys = [network.key("live", "sensor", name) for name in ("a", "b")]
    for key in keys:
        bus.declare_alive(key)
    asker = network.bus()
    wait_until(lambda: asker.alive(network.key("live", "sensor", "*")) == keys, "both are alive")
    late = asker.watch_alive(network.key("live", "*", "*"))
    seen = events(late, 2)
    assert {event.key for event in seen if event and event.alive} == set(keys)


def test_all_tokens_of_a_participant_go_with_it(network: Network) -> None:
    leaving = network.bus()
    leaving.declare_alive(network.key("live", "fusion", "a"))
    watcher = network.bus().watch_alive(network.key("live", "**"))
    assert events(watcher, 1) == [AliveEvent(network.key("live", "fusion", "a"), True)]
    leaving.close()
    assert events(watcher, 1) == [AliveEvent(network.key("live", "fusion", "a"), False)]


def test_a_token_held_twice_is_alive_until_both_are_gone(network: Network) -> None:
    key = network.key("live", "fusion", "a")
    first, second = network.bus().declare_alive(key), network.bus().declare_alive(key)
    watcher = network.bus().watch_alive(key)
    assert events(watcher, 1) == [AliveEvent(key, True)]
    first.close()
    assert watcher.receive(0.1) is None
    second.close()
    assert events(watcher, 1) == [AliveEvent(key, False)]


# --- closing


def test_closing_twice_is_closing_once_and_then_nothing_can_be_declared(network: Network) -> None:
    bus = network.bus()
    publisher = bus.publisher(network.key("plots", "a"), history=2)
    bus.serve(network.key("svc", "emi", "a"), count_to(1))
    bus.declare_alive(network.key("live", "emi", "a"))
    subscription = bus.subscribe(network.key("plots", "*"), history=True)
    watcher = bus.watch_alive(network.key("live", "**"))
    bus.close()
    bus.close()
    publisher.put(b"late", "")
    list(subscription)
    list(watcher)
    for declare in (bus.publisher, bus.subscribe, bus.declare_alive, bus.watch_alive, bus.alive):
        with pytest.raises(BusError):
            declare(network.key("plots", "a"))
    with pytest.raises(BusError):
        bus.query(network.key("svc", "emi", "a"))


def test_closing_does_not_wait_for_a_handler_at_work(network: Network) -> None:
    release = threading.Event()

    def handler(query: Query) -> Iterator[tuple[bytes, str]]:
        yield b"one", ""
        if query.payload != b"ping":
            release.wait(20.0)
            yield b"two", ""

    server, asker = network.bus(), network.bus()
    server.serve(network.key("svc", "emi", "a"), handler)
    served(asker, network.key("svc", "emi", "a"))
    answers = asker.query(network.key("svc", "emi", "a"), timeout_s=10.0)
    next(answers)
    server.close()
    release.set()
    assert list(answers) == []


# --- opening, over Zenoh only


def test_no_router_is_one_clear_sentence() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(BusError, match=f"No router answers at {endpoint}; start one with `trackmesh router`"):
        ZenohBus.open([endpoint], timeout_s=0.1)


def test_waiting_for_a_router_can_be_stopped() -> None:
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    with pytest.raises(BusError):
        ZenohBus.open([f"tcp/127.0.0.1:{free_port()}"], timeout_s=60.0, stop=stop)
    assert stop.is_set()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [("{ mode: 'client', foo: 1 }", "unknown field `foo`"), ("{ mode ", "are wrong"), (None, "no such file")],
)
def test_a_wrong_settings_file_is_one_clear_sentence(tmp_path: Path, text: str | None, sentence: str) -> None:
    path = tmp_path / "zenoh.json5"
    if text is not None:
        path.write_text(text)
    with pytest.raises(BusError, match=sentence):
        ZenohBus.open([], config_path=path, timeout_s=0.1)


def test_a_wrong_endpoint_is_one_clear_sentence() -> None:
    with pytest.raises(BusError, match="connect/endpoints"):
        ZenohBus.open(["nowhere"], timeout_s=0.1)


@pytest.mark.process
def test_a_dead_router_first_in_the_list_does_not_matter(router: RouterProcess) -> None:
    with ZenohBus.open([f"tcp/127.0.0.1:{free_port()}", router.endpoint], timeout_s=5.0) as bus:
        assert bus.alive("none/@v1/**") == []
