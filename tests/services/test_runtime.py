"""What every service shares, in one process on a bus in memory; real processes are at the end."""

from __future__ import annotations

import json
import logging
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.network.processes import Process, Processes, processes, wait_until

from trackmesh.protocol.client import Client, Watch
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import SensorHealth, ServiceStatus
from trackmesh.services.health import Counters, Latencies
from trackmesh.services.heartbeat import ill
from trackmesh.services.logs import configure_logging
from trackmesh.services.runtime import EXIT_DEADLINE, EXIT_FAILED, EXIT_OK, Health, ServiceRuntime, ServiceSettings


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def client(hub: MemoryHub) -> Client:
    return Client(MemoryBus(hub), "test")


__all__ = ["processes"]

Make = Callable[..., ServiceRuntime]


@pytest.fixture
def make(hub: MemoryHub) -> Make:
    def runtime(**settings: object) -> ServiceRuntime:
        given = ServiceSettings.load(overrides={"realm": "test", "stop_deadline_s": 2.0} | settings)
        return ServiceRuntime("fusion", given, bus=MemoryBus(hub))

    return runtime


def latest(watch: Watch[ServiceStatus], condition: Callable[[ServiceStatus], bool]) -> ServiceStatus:
    while (status := watch.receive(5.0)) is not None:
        if condition(status):
            return status
    pytest.fail("no such status came")


# --- alive and status


def test_a_service_is_alive_from_start_to_stop(make: Make, client: Client) -> None:
    with make(unit_id="west"):
        assert client.alive() == [("fusion", "west")]
    assert client.alive() == []


def test_a_late_watcher_gets_the_status_at_once(make: Make, client: Client) -> None:
    with make() as runtime:
        runtime.counters.count("plots", 5)
        runtime.counters.refuse("malformed")
        runtime.latencies.record(0.25)
        runtime.set_state("ready")
        status = client.watch_statuses().receive(0.5)
    assert status is not None
    assert (status.kind, status.unit_id, status.boot_id) == ("fusion", "main", runtime.boot_id)
    assert (status.state, status.counters, status.refused) == ("ready", {"plots": 5}, {"malformed": 1})
    assert status.latency_ms == {"p50": 250.0, "p90": 250.0, "p99": 250.0}


def test_the_status_comes_again_and_again(make: Make, client: Client) -> None:
    watch = client.watch_statuses()
    with make():
        assert latest(watch, lambda status: status.seq >= 2).uptime_s >= 1.0


def test_states_are_told_in_order_and_a_stopping_service_stays_so(make: Make, client: Client) -> None:
    watch = client.watch_statuses()
    with make() as runtime:
        runtime.set_state("compiling")
        runtime.set_state("ready")
        runtime.stop()
        runtime.set_state("ready")
    states = [status.state for status in iter(lambda: watch.receive(0.05), None)]
    assert list(dict.fromkeys(states)) == ["starting", "compiling", "ready", "stopping"]


def test_the_service_adds_its_health(make: Make, client: Client) -> None:
    north = SensorHealth(sensor_id="north", alive=True, plots=1, batches=1, gaps=0, duplicates=0, refused=0)
    with make() as runtime:
        runtime.health = lambda: Health({"tracks": 3.0, "unknown": float("nan")}, [north])
        runtime.set_state("ready")
        status = client.watch_statuses().receive(0.5)
    assert status is not None
    assert (status.figures, status.sensors) == ({"tracks": 3.0}, [north])


def test_a_health_that_cannot_be_told_does_not_end_the_status(make: Make, client: Client) -> None:
    def broken() -> Health:
        raise ZeroDivisionError

    with make() as runtime:
        runtime.health = broken
        runtime.set_state("ready")
        status = client.watch_statuses().receive(0.5)
    assert status is not None and status.counters["health_errors"] >= 1
    assert runtime.exit_code == EXIT_OK


def test_each_start_has_its_own_boot_id(make: Make) -> None:
    assert make().boot_id != make().boot_id


# --- threads and stop


def test_a_thread_that_reads_a_subscription_ends_with_it(make: Make) -> None:
    ended = threading.Event()
    with make() as runtime:
        subscription = runtime.closing(runtime.bus.subscribe(runtime.keys.plots("*")))

        def read() -> None:
            list(subscription)
            ended.set()

        runtime.spawn("reader", read)
    assert ended.is_set()


def test_the_stop_goes_in_order(make: Make) -> None:
    order: list[str] = []

    class Part:
        def close(self) -> None:
            order.append("closing")

    with make() as runtime:
        runtime.closing(Part())

        def work() -> None:
            runtime.stopping.wait()
            wait_until(lambda: order, "parts are closed before threads are joined")
            order.append("thread")

        runtime.spawn("worker", work)
        runtime.on_exit(lambda: order.append("exit of the first"))
        runtime.on_exit(lambda: order.append("exit of the last"))
    assert order == ["closing", "thread", "exit of the last", "exit of the first"]


def test_an_error_in_a_thread_stops_the_service(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    with make() as runtime:

        def fail() -> None:
            raise ZeroDivisionError("why")

        runtime.spawn("worker", fail)
        assert runtime.stopping.wait(5.0)
    assert runtime.exit_code == EXIT_FAILED
    assert "thread worker failed" in caplog.text and "ZeroDivisionError: why" in caplog.text


def test_a_part_that_cannot_be_closed_does_not_hold_up_the_others(make: Make) -> None:
    closed = threading.Event()

    class Broken:
        def close(self) -> None:
            raise OSError

    with make() as runtime:
        runtime.closing(Broken())
        runtime.on_exit(closed.set)
    assert closed.is_set()
    assert runtime.exit_code == EXIT_FAILED


def test_a_stop_has_a_deadline(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    release = threading.Event()

    def stuck() -> None:
        release.wait(20.0)

    runtime = make(stop_deadline_s=0.1).start()
    runtime.spawn("stuck", stuck)
    assert not runtime.close()
    assert "threads did not end in time: stuck" in caplog.text
    release.set()


def test_closing_without_having_started(make: Make) -> None:
    assert make().close()


# --- counting


def test_counters_count_from_many_threads() -> None:
    counters = Counters()

    def work() -> None:
        for _ in range(1000):
            counters.count("n")
            counters.refuse("r", 2)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    counters.count("seen", 0)
    assert (counters.counts(), counters.refused()) == ({"n": 4000, "seen": 0}, {"r": 8000})


def test_latencies_are_those_of_the_last_minute() -> None:
    now_s = 0.0
    latencies = Latencies(window_s=60.0, clock=lambda: now_s)
    assert latencies.percentiles_ms() == {}
    latencies.record(9.0)
    now_s = 61.0
    for ms in range(101):
        latencies.record(ms / 1000)
    assert latencies.percentiles_ms() == pytest.approx({"p50": 50.0, "p90": 90.0, "p99": 99.0})


# --- logs


@pytest.fixture
def root_logger() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.mark.usefixtures("root_logger")
def test_json_logs_are_one_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logging("info", "json", "fusion/main")
    logging.getLogger("trackmesh.x").info("hello %s", "there", extra={"sensor": "north"})
    logging.getLogger("trackmesh.x").debug("not shown")
    try:
        raise ValueError("two\nlines")
    except ValueError:
        logging.getLogger("trackmesh.x").exception("bad")
    first, second = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert (first["service"], first["level"], first["message"], first["sensor"]) == (
        "fusion/main",
        "info",
        "hello there",
        "north",
    )
    assert "ValueError: two\nlines" in second["exception"]


@pytest.mark.usefixtures("root_logger")
def test_human_logs_say_when_in_utc_and_who(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logging("info", "human", "fusion/main")
    record = logging.makeLogRecord({"levelno": 20, "levelname": "INFO", "msg": "hello", "created": 1.5, "msecs": 500})
    logging.getLogger().handle(record)
    assert capsys.readouterr().err == "1970-01-01T00:00:01.500Z INFO    fusion/main hello\n"


# --- as a process, with signals


SERVICE = """
import os, sys, threading
from trackmesh.protocol.memory_bus import MemoryBus
from trackmesh.services.runtime import ServiceRuntime, ServiceSettings

def start(runtime):
    what = sys.argv[1]
    if what == "stuck":
        runtime.spawn("stuck", lambda: threading.Event().wait())
    if what == "failing":
        runtime.spawn("failing", lambda: 1 / 0)
    if what == "broken":
        1 / 0
    if what == "compiling":
        runtime.set_state("compiling")
        os.write(1, b"ready\\n")
        while True:
            sum(range(10_000))
    runtime.set_state("ready")
    # One write, so that no line of another thread comes between the word and its end of line.
    os.write(1, b"ready\\n")

settings = ServiceSettings.load(overrides={"stop_deadline_s": 0.2, "log_format": "json", "connect_timeout_s": 60})
bus = None if sys.argv[1] == "waiting" else MemoryBus()
raise SystemExit(ServiceRuntime("fusion", settings, bus=bus).run(start))
"""


def service(processes: Processes, what: str) -> Process:
    return processes.start("-c", SERVICE, what)


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_is_a_normal_stop(processes: Processes, number: signal.Signals) -> None:
    process = service(processes, "good")
    process.wait_for("ready")
    assert process.stop(number) == EXIT_OK
    assert f"stopping: {number.name}" in process.output
    assert "Traceback" not in process.output


@pytest.mark.process
def test_a_signal_ends_a_service_that_still_compiles(processes: Processes) -> None:
    process = service(processes, "compiling")
    process.wait_for("ready")
    assert process.stop() == EXIT_OK
    assert "stopping: SIGTERM" in process.output


@pytest.mark.process
def test_a_stop_that_takes_too_long_is_cut_short(processes: Processes) -> None:
    process = service(processes, "stuck")
    process.wait_for("ready")
    assert process.stop() == EXIT_DEADLINE
    assert "threads did not end in time: stuck" in process.output


@pytest.mark.process
@pytest.mark.parametrize("what", ["failing", "broken"])
def test_a_failure_is_logged_and_ends_the_process(processes: Processes, what: str) -> None:
    process = service(processes, what)
    wait_until(lambda: not process.running, "the process ends")
    assert process.stop() == EXIT_FAILED
    assert "ZeroDivisionError" in process.output
    assert all(json.loads(line) for line in process.output.splitlines() if line != "ready")


@pytest.mark.process
def test_a_service_that_waits_for_its_router_can_be_stopped(
    processes: Processes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRACKMESH_CONNECT", "tcp/127.0.0.1:1")
    process = service(processes, "waiting")
    process.wait_for("no router")
    assert process.stop() == EXIT_OK


def test_a_heartbeat_for_probes(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "beat"
    with make(heartbeat_file=path) as runtime:
        assert ill(path) == ""
        assert ill(path, ready=True) == "The service is starting."
        runtime.set_state("ready")
        assert ill(path, ready=True) == ""
        before = path.read_text()
        wait_until(lambda: path.read_text() != before, "it beats again")
    assert ill(path, ready=True) == "The service is stopping."


def test_a_heartbeat_that_cannot_be_written_is_told_and_counted(
    make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with make(heartbeat_file=tmp_path / "none" / "beat") as runtime:
        assert runtime.counters.counts()["heartbeat_errors"] >= 1
    assert sum("no heartbeat" in record.message for record in caplog.records) == 1
