"""A client that was written from docs/protocol.md alone, against real processes: nothing here imports our code.

It knows Zenoh, msgpack, JSON and the layout of arrays; it publishes plots, hears frames, asks for tracks, and has scans
inverted.
"""

from __future__ import annotations

import json
import math
import os
import queue
import re
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt
import pytest
import zenoh
from tests.network.processes import ROOT, Process, Processes, RouterProcess, wait_until

Fields = dict[str, Any]
Numbers = npt.NDArray[np.float64]

REALM = "rawtest/@v1"
PAGE = ROOT / "docs" / "protocol.md"
LOOKS = 15
LEAST_WAIT_NS = 150_000_000

STARTS = np.array([[8e3, 12e3], [-9e3, 6e3], [3e3, -14e3]])
SPEEDS = np.array([[120.0, 30.0], [0.0, -150.0], [-90.0, 90.0]])


class RawClient:
    """A Zenoh session and the wire protocol, by hand."""

    def __init__(self, endpoint: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        self.boot_id = os.urandom(8).hex()
        self.seq = 0
        self.frames: queue.SimpleQueue[Fields] = queue.SimpleQueue()
        self._subscriber = self.session.declare_subscriber(f"{REALM}/tracks/*", self._hear)

    def put(self, key: str, name: str, fields: Fields) -> None:
        self.session.put(
            f"{REALM}/{key}",
            msgpack.packb(fields),
            encoding=f"application/msgpack;trackmesh.{name}.v1",
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )

    def plots(self, t_ns: int, range_m: Numbers, azimuth_rad: Numbers) -> None:
        self.seq += 1
        fields = {
            "sensor_id": "mast",
            "boot_id": self.boot_id,
            "seq": self.seq,
            "columns": ["range_m", "azimuth_rad"],
            "t_ns": array(np.full(len(range_m), t_ns)),
            "values": array(np.stack([range_m, azimuth_rad], axis=1)),
        }
        self.put("plots/mast", "PlotBatch", fields)

    def ask(self, selector: str, name: str, fields: Fields, timeout_s: float = 10.0) -> Iterator[Fields]:
        """Envelopes as they come."""
        for reply in self.session.get(
            f"{REALM}/{selector}",
            payload=msgpack.packb(fields),
            encoding=f"application/msgpack;trackmesh.{name}.v1",
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        ):
            assert reply.ok is not None, "the time is over"
            encoding, data = str(reply.ok.encoding), reply.ok.payload.to_bytes()
            if "fmt=json" in selector:
                assert encoding == "application/json;trackmesh.Envelope.v1"
                yield json.loads(data)
            else:
                assert encoding == "application/msgpack;trackmesh.Envelope.v1"
                yield msgpack.unpackb(data)

    def answers(self, selector: str, name: str, fields: Fields) -> list[Fields]:
        """The payloads of a whole answer, which is of the schema that the page names for this question."""
        envelopes = list(self.ask(selector, name, fields))
        schema = {"TrackQuery": "trackmesh.TrackFrame.v1", "EmiScanBatch": "trackmesh.EmiResult.v1"}[name]
        assert {envelope["schema_name"] for envelope in envelopes[:-1]} == {schema}
        assert [envelope["kind"] for envelope in envelopes] == ["ok"] * (len(envelopes) - 1) + ["end"], envelopes
        assert envelopes[-1]["count"] == len(envelopes) - 1
        return [envelope["payload"] for envelope in envelopes[:-1]]

    def alive(self) -> set[str]:
        replies = self.session.liveliness().get(f"{REALM}/live/*/*", timeout=2.0)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def close(self) -> None:
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self.session.close()  # type: ignore[no-untyped-call]

    def _hear(self, sample: zenoh.Sample) -> None:
        assert str(sample.encoding) == "application/msgpack;trackmesh.TrackFrame.v1"
        self.frames.put(msgpack.unpackb(sample.payload.to_bytes()))


def array(values: npt.NDArray[Any]) -> Fields:
    dtype = {"f": "<f8", "i": "<i8"}[values.dtype.kind]
    return {"dtype": dtype, "shape": list(values.shape), "data": values.astype(dtype).tobytes()}


def numbers(field: Fields) -> npt.NDArray[Any]:
    return np.frombuffer(field["data"], field["dtype"]).reshape(field["shape"])


def polar(places: Numbers) -> tuple[Numbers, Numbers]:
    """Range, and azimuth clockwise from north."""
    return np.hypot(places[:, 0], places[:, 1]), np.arctan2(places[:, 0], places[:, 1])


def service(processes: Processes, router: RouterProcess, kind: str) -> Process:
    where = ["--connect", router.endpoint, "--realm", "rawtest", "--unit-id", "one"]
    return processes.start("-m", "trackmesh.services.cli.main", kind, *where)


@pytest.fixture
def client(router: RouterProcess) -> Iterator[RawClient]:
    made = RawClient(router.endpoint)
    yield made
    made.close()


def test_plots_become_tracks_that_can_be_heard_and_asked_for(
    client: RawClient, processes: Processes, router: RouterProcess
) -> None:
    service(processes, router, "fusion")
    wait_until(lambda: f"{REALM}/live/fusion/one" in client.alive(), "the fusion service is alive", 60.0)
    wait_until(lambda: any(True for _ in client.ask("svc/tracks/one", "TrackQuery", {})), "it answers", 60.0)
    client.put(
        "sensors/mast",
        "SensorInfo",
        {
            "sensor_id": "mast",
            "kind": "radar",
            "site_enu_m": [0.0, 0.0, 0.0],
            "period_s": 2.0,
            "p_detect": 0.9,
            "max_range_m": 50e3,
            "sigma": {"range_m": 10.0, "azimuth_rad": 1e-3},
        },
    )
    begin_ns = time.time_ns()
    last = publish_looks(client, begin_ns)
    truth = STARTS + SPEEDS * (last["t_ns"] - begin_ns) / 1e9
    assert (last["unit_id"], last["schema_version"]) == ("one", 1)
    assert np.linalg.norm(states_near(last, truth)[:, :2] - truth, axis=1).max() < 100.0
    assert numbers(last["covariance"]).shape == (3, 21)
    assert np.allclose(numbers(last["model_probability"]).sum(axis=1), 1.0)

    box = [truth[0, 0] - 500.0, truth[0, 1] - 500.0, truth[0, 0] + 500.0, truth[0, 1] + 500.0]
    later_ns = last["t_ns"] + 1_000_000_000
    (one,) = client.answers("svc/tracks/*", "TrackQuery", {"bbox_enu_m": box})
    (later,) = client.answers("svc/tracks/one", "TrackQuery", {"at_t_ns": later_ns})
    (as_json,) = client.answers("svc/tracks/*?fmt=json", "TrackQuery", {"at_t_ns": later_ns})
    (found,) = numbers(one["track_id"]).tolist()
    row = numbers(last["track_id"]).tolist().index(found)
    assert np.linalg.norm(numbers(last["state"])[row, :2] - truth[0]) < 100.0
    # To predict is to move with the velocity; both answers tell the same.
    assert abs(later["t_ns"] - later_ns) < 1000
    ids = numbers(later["track_id"]).tolist()
    assert as_json["track_id"] == ids
    assert np.allclose(as_json["state"], numbers(later["state"]))
    moved = numbers(later["state"])[ids.index(found)]
    assert np.linalg.norm(moved[:2] - truth[0] - SPEEDS[0]) < 200.0

    (refused, end) = client.ask("svc/tracks/one", "TrackQuery", {"bbox_enu_m": [1.0, 2.0]})
    assert (refused["kind"], refused["code"], end["count"]) == ("error", "wrong_length", 0)
    assert list(client.ask("svc/tracks/nobody", "TrackQuery", {})) == []


def publish_looks(client: RawClient, begin_ns: int) -> Fields:
    """Send looks until all tracks are in a frame, each after a frame that follows the one before; that frame."""
    rng = np.random.default_rng(1)
    frame: Fields = {"t_ns": 0, "track_id": {"shape": [0]}}
    for _ in range(3 * LOOKS):
        t_ns = time.time_ns()
        range_m, azimuth_rad = polar(STARTS + SPEEDS * (t_ns - begin_ns) / 1e9)
        client.plots(t_ns, range_m + rng.normal(0, 10, 3), azimuth_rad + rng.normal(0, 1e-3, 3))
        deadline = time.monotonic() + 20.0
        while frame["t_ns"] < t_ns or time.time_ns() < t_ns + LEAST_WAIT_NS:
            assert time.monotonic() < deadline, "no frame follows the plots"
            try:
                frame = client.frames.get(timeout=0.05)
            except queue.Empty:
                continue
        if client.seq >= LOOKS and frame["track_id"]["shape"] == [3]:
            return frame
    pytest.fail(f"after {client.seq} looks there are {frame['track_id']['shape']} tracks")


def states_near(frame: Fields, places: Numbers) -> Numbers:
    """The states in the order of the places that they are nearest to."""
    states = numbers(frame["state"])
    distance = np.linalg.norm(states[:, None, :2] - places[None], axis=2)
    order = distance.argmin(axis=0)
    assert sorted(order.tolist()) == list(range(len(places)))
    return np.asarray(states[order])


# --- induction


def dipole_field(moment: Numbers, away: Numbers) -> Numbers:
    """H (A/m) of point dipoles at a distance: (3 d (d.m) / d^2 - m) / (4 pi d^3)."""
    d = np.linalg.norm(away, axis=-1, keepdims=True)
    along = (away * moment).sum(axis=-1, keepdims=True)
    return np.asarray((3.0 * away * along / d**2 - moment) / (4.0 * math.pi * d**3))


def scan_of(positions: Numbers, target: Numbers, tensor: Numbers, moment_am2: float) -> Numbers:
    """Secondary field (nT) at a sensor whose vertical dipole stands at each position."""
    primary = dipole_field(np.array([0.0, 0.0, moment_am2]), target - positions)
    return np.asarray(4e-7 * math.pi * 1e9 * dipole_field(primary @ tensor, positions - target))


def test_a_scan_is_inverted_and_streamed(client: RawClient, processes: Processes, router: RouterProcess) -> None:
    service(processes, router, "emi")
    wait_until(lambda: client.alive() & {f"{REALM}/live/emi/one"}, "the EMI service is alive", 60.0)
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9))
    positions = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.1)], axis=1)
    targets = np.array([[0.2, -0.1, -0.5], [-0.3, 0.3, -0.7]])
    tensor = np.diag([0.02, 0.02, 0.05])
    radius_m, turns, current_a = 0.25, 10.0, 5.0
    moment = turns * current_a * math.pi * radius_m**2
    noise = 0.01 * np.random.default_rng(2).normal(size=(2, 1, 81, 3))
    field = np.stack([scan_of(positions, target, tensor, moment)[None] for target in targets]) + noise
    question = {
        "batch_id": "two-scans",
        "geometry": {
            "positions_m": array(positions),
            "transmitter": {"model": "dipole", "radius_m": radius_m, "turns": turns, "current_a": current_a},
        },
        "field": array(field),
        "field_unit": "nT",
        "sigma": 0.01,
    }
    wait_until(lambda: any(True for _ in client.ask("svc/emi/one", "EmiScanBatch", {})), "it answers", 60.0)
    results = client.answers("svc/emi/*", "EmiScanBatch", question)
    # As each was done, by two processes.
    results = sorted(results, key=lambda result: result["index"])
    assert [(result["index"], result["status"]) for result in results] == [(0, "ok"), (1, "ok")]
    for result, target in zip(results, targets, strict=True):
        (found,) = result["targets"]
        assert np.linalg.norm(np.array(found["position_m"]) - target) < 0.01
        assert np.allclose(found["principal_m3"], [0.02, 0.02, 0.05], rtol=0.05)
        assert found["shape"] == "axisymmetric"
        assert abs(found["axis"][2]) > 0.99
    (refused, end) = client.ask("svc/emi/one?fmt=json", "EmiScanBatch", question | {"field_unit": "gauss"})
    assert (refused["kind"], refused["code"], end) == (
        "error", "invalid", end | {"kind": "end", "count": 0},
    )  # fmt: skip


# --- the page's own example


def test_the_example_of_the_page_runs(client: RawClient, processes: Processes, router: RouterProcess) -> None:
    found = re.search(r"^## A client from scratch.*?^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert found is not None
    heard: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    subscriber = client.session.declare_subscriber("trackmesh/@v1/plots/mast", heard.put)
    code = found.group(1).replace("tcp/127.0.0.1:7447", router.endpoint)

    def ran() -> bool:
        # The subscription is not known everywhere at once: another try is another client.
        process = processes.start("-c", code)
        wait_until(lambda: not process.running, "the example ends")
        assert process.stop() == 0, process.output
        return not heard.empty()

    wait_until(ran, "the plots of the example are heard")
    fields = msgpack.unpackb(heard.get().payload.to_bytes())
    assert numbers(fields["values"]).tolist() == [[10e3, 0.5], [12e3, 1.5]]
    subscriber.undeclare()  # type: ignore[no-untyped-call]
