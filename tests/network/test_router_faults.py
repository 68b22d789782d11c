"""What a killed, frozen or restarted process costs the others."""

from __future__ import annotations

import itertools
import signal
from collections.abc import Iterator

import pytest
from tests.network.processes import Process, Processes, RouterProcess, wait_until

from trackmesh.protocol.bus import AliveEvent, Subscription
from trackmesh.protocol.zenoh_bus import ZenohBus

PLOTS = "faults/@v1/plots/a"
LIVE = "faults/@v1/live/sensor/a"
KEPT = 4000


@pytest.fixture
def own_router(processes: Processes) -> RouterProcess:
    return processes.router()


@pytest.fixture
def bus(own_router: RouterProcess) -> Iterator[ZenohBus]:
    with ZenohBus.open([own_router.endpoint], timeout_s=10.0) as opened:
        yield opened


def peer(processes: Processes, role: str, endpoints: str, key: str, n: int = 0) -> Process:
    process = processes.start("-m", "tests.network.peers", role, endpoints, key, str(n))
    process.wait_for("ready")
    return process


def published(publisher: Process) -> int:
    """The last number that was published, -1 before the first."""
    whole_lines = publisher.output.split("\n")[:-1]
    numbers = [line for line in whole_lines if line.startswith("at ")]
    return int(numbers[-1].removeprefix("at ")) if numbers else -1


def publish_on(publisher: Process, n: int) -> int:
    """Wait until ``n`` more are published; the last number."""
    goal = published(publisher) + n
    wait_until(lambda: published(publisher) >= goal, f"number {goal} is published")
    return published(publisher)


def numbers_up_to(subscription: Subscription, last: int) -> list[int]:
    """All numbers received until ``last`` has come."""
    numbers: list[int] = []
    while not numbers or numbers[-1] < last:
        sample = subscription.receive(10.0)
        assert sample is not None, f"nothing after {numbers[-1:]}, waiting for {last}"
        numbers.append(int(sample.payload))
    return numbers


def gaps(numbers: list[int]) -> list[tuple[int, int]]:
    return [(a, b) for a, b in itertools.pairwise(numbers) if b != a + 1]


def test_a_killed_router_loses_nothing_of_what_is_kept(
    processes: Processes, own_router: RouterProcess, bus: ZenohBus
) -> None:
    subscription = bus.subscribe(PLOTS, history=True, capacity=100_000)
    publisher = peer(processes, "publish", own_router.endpoint, PLOTS, KEPT)
    publish_on(publisher, 50)
    for _ in range(2):
        own_router.process.kill()
        publish_on(publisher, 100)
        own_router.restart()
        publish_on(publisher, 50)
    numbers = numbers_up_to(subscription, publish_on(publisher, 10))
    assert numbers[0] == 0
    assert gaps(numbers) == []


def test_without_history_the_outage_is_lost(processes: Processes, own_router: RouterProcess, bus: ZenohBus) -> None:
    # The other side of the test above: the outage is real.
    subscription = bus.subscribe(PLOTS, capacity=100_000)
    publisher = peer(processes, "publish", own_router.endpoint, PLOTS)
    publish_on(publisher, 20)
    own_router.process.kill()
    publish_on(publisher, 100)
    own_router.restart()
    numbers = numbers_up_to(subscription, publish_on(publisher, 300))
    ((before, after),) = gaps(numbers)
    assert after - before > 50


def test_an_outage_longer_than_the_cache_loses_only_the_surplus(
    processes: Processes, own_router: RouterProcess, bus: ZenohBus
) -> None:
    subscription = bus.subscribe(PLOTS, history=True, capacity=100_000)
    publisher = peer(processes, "publish", own_router.endpoint, PLOTS, 20)
    publish_on(publisher, 20)
    own_router.process.kill()
    publish_on(publisher, 200)
    own_router.restart()
    numbers = numbers_up_to(subscription, publish_on(publisher, 500))
    assert len(gaps(numbers)) <= 1
    assert numbers == sorted(set(numbers))


def test_who_joins_before_publishers_are_back_gets_what_was_kept(
    processes: Processes, own_router: RouterProcess
) -> None:
    # A restarted router has its first clients long before the old ones try again.
    publisher = peer(processes, "publish", own_router.endpoint, PLOTS, KEPT)
    publish_on(publisher, 50)
    own_router.restart()
    with ZenohBus.open([own_router.endpoint], timeout_s=10.0) as late:
        subscription = late.subscribe(PLOTS, history=True, capacity=100_000)
        numbers = numbers_up_to(subscription, publish_on(publisher, 500))
    assert numbers[0] == 0
    assert gaps(numbers) == []


def test_a_last_message_lost_in_an_outage_arrives_without_another(own_router: RouterProcess, bus: ZenohBus) -> None:
    with ZenohBus.open([own_router.endpoint], timeout_s=10.0) as sensor:
        subscription = bus.subscribe(PLOTS, history=True)
        publisher = sensor.publisher(PLOTS, history=2)
        publisher.put(b"before", "")
        assert subscription.receive(5.0)
        own_router.process.kill()
        publisher.put(b"during", "")
        own_router.restart()
        sample = subscription.receive(10.0)
        assert sample is not None and sample.payload == b"during"


def test_who_has_heard_only_what_was_before_gets_what_an_outage_withheld(
    own_router: RouterProcess, bus: ZenohBus
) -> None:
    with ZenohBus.open([own_router.endpoint], timeout_s=10.0) as sensor:
        publisher = sensor.publisher(PLOTS, history=2)
        publisher.put(b"before", "")
        subscription = bus.subscribe(PLOTS, history=True)
        assert subscription.receive(5.0)
        own_router.process.kill()
        publisher.put(b"during", "")
        own_router.restart()
        sample = subscription.receive(10.0)
        assert sample is not None and sample.payload == b"during"


def test_a_frozen_router_loses_nothing_of_what_is_kept(
    processes: Processes, own_router: RouterProcess, bus: ZenohBus
) -> None:
    subscription = bus.subscribe(PLOTS, history=True, capacity=100_000)
    publisher = peer(processes, "publish", own_router.endpoint, PLOTS, KEPT)
    publish_on(publisher, 50)
    own_router.process.send(signal.SIGSTOP)
    publish_on(publisher, 1100)
    own_router.process.send(signal.SIGCONT)
    numbers = numbers_up_to(subscription, publish_on(publisher, 100))
    assert numbers[0] == 0
    assert gaps(numbers) == []


def test_a_second_router_takes_over(processes: Processes, own_router: RouterProcess) -> None:
    second = processes.router()
    endpoints = f"{own_router.endpoint},{second.endpoint}"
    with ZenohBus.open(endpoints.split(","), timeout_s=10.0) as bus:
        subscription = bus.subscribe(PLOTS, history=True, capacity=100_000)
        publisher = peer(processes, "publish", endpoints, PLOTS, KEPT)
        publish_on(publisher, 50)
        own_router.process.kill()
        numbers = numbers_up_to(subscription, publish_on(publisher, 100))
    assert numbers[0] == 0
    assert gaps(numbers) == []


def test_a_frozen_process_is_not_alive_and_comes_back(
    processes: Processes, own_router: RouterProcess, bus: ZenohBus
) -> None:
    watcher = bus.watch_alive(LIVE)
    process = peer(processes, "token", own_router.endpoint, LIVE)
    assert watcher.receive(5.0) == AliveEvent(LIVE, True)
    process.send(signal.SIGSTOP)
    # The lease is 2 s; the rest is room for a busy machine.
    assert watcher.receive(6.0) == AliveEvent(LIVE, False)
    process.send(signal.SIGCONT)
    assert watcher.receive(10.0) == AliveEvent(LIVE, True)
    process.kill()
    assert watcher.receive(5.0) == AliveEvent(LIVE, False)


def test_tokens_come_back_with_the_router(processes: Processes, own_router: RouterProcess, bus: ZenohBus) -> None:
    watcher = bus.watch_alive(LIVE)
    peer(processes, "token", own_router.endpoint, LIVE)
    assert watcher.receive(5.0) == AliveEvent(LIVE, True)
    own_router.process.kill()
    assert watcher.receive(5.0) == AliveEvent(LIVE, False)
    own_router.restart()
    assert watcher.receive(10.0) == AliveEvent(LIVE, True)
    # Just after a link is back, what is asked through it may find nothing for some ten milliseconds.
    wait_until(lambda: bus.alive(LIVE) == [LIVE], "the token can be asked for again")


def test_a_server_that_dies_half_way_ends_the_query_at_once(
    processes: Processes, own_router: RouterProcess, bus: ZenohBus
) -> None:
    peer(processes, "count", own_router.endpoint, PLOTS, 10)
    wait_until(lambda: len(list(bus.query(PLOTS))) == 10, "the server answers")
    # Were it to wait for the time given, this test would run into its limit.
    answers = [int(sample.payload) for sample in bus.query(PLOTS, b"die", timeout_s=1000.0)]
    assert answers == list(range(6))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_process_that_listens_leaves_when_told(
    processes: Processes, own_router: RouterProcess, number: signal.Signals
) -> None:
    process = peer(processes, "listen", own_router.endpoint, PLOTS)
    process.wait_for("listening")
    assert process.stop(number) == 0
    assert "left" in process.output


def test_a_process_that_listens_leaves_without_its_router(processes: Processes, own_router: RouterProcess) -> None:
    process = peer(processes, "listen", own_router.endpoint, PLOTS)
    process.wait_for("listening")
    own_router.process.kill()
    assert process.stop() == 0
    assert "left" in process.output


@pytest.mark.parametrize("error", [0, 1])
def test_a_process_that_forgets_to_close_ends_all_the_same(
    processes: Processes, own_router: RouterProcess, error: int
) -> None:
    process = processes.start("-m", "tests.network.peers", "forget", own_router.endpoint, PLOTS, str(error))
    wait_until(lambda: not process.running, "the process ends")
    assert process.stop() == error


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_router_leaves_when_told(own_router: RouterProcess, bus: ZenohBus, number: signal.Signals) -> None:
    bus.subscribe(PLOTS)
    assert own_router.process.stop(number) == 0
    assert "stopped" in own_router.process.output


def test_two_routers_at_one_endpoint_is_one_clear_sentence(processes: Processes, own_router: RouterProcess) -> None:
    second = processes.start("-m", "trackmesh.services.router", "--listen", own_router.endpoint)
    second.wait_for("cannot listen at")
    wait_until(lambda: not second.running, "the second router has ended")
    assert "Traceback" not in second.output
