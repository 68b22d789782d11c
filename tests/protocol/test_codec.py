"""Bytes from anywhere: a message, or one reason and one sentence."""

from __future__ import annotations

import json
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.protocol.strategies import VALID, plot_batches
from tests.protocol.test_messages import PLOTS, RADAR

from trackmesh.protocol import codec
from trackmesh.protocol.codec import Format, answer, decode, encode, encoding, end, failure, from_object, open_envelope
from trackmesh.protocol.errors import QueryFailed, RefusedMessage
from trackmesh.protocol.messages import (
    Envelope,
    PlotBatch,
    SensorInfo,
    ServiceStatus,
    TrackFrame,
    TrackQuery,
)
from trackmesh.protocol.messages.base import TopMessage

JSON = "application/json"


def refused(data: bytes, kind: type[TopMessage] = PlotBatch, encoding_str: str = "", **limits: int) -> RefusedMessage:
    """The refusal, which is one line."""
    with pytest.raises(RefusedMessage) as error:
        decode(data, kind, encoding_str, **limits)
    assert error.value.detail.isprintable() and len(error.value.detail) <= 300
    assert error.value.detail.endswith(".")
    assert str(error.value) == f"{error.value.detail} [{error.value.reason}]"
    return error.value


def packed(**change: Any) -> bytes:
    return bytes(msgpack.packb(PLOTS | change))


# --- encodings


@given(plot_batches())
def test_the_wire_is_msgpack_of_the_fields_in_any_order(batch: PlotBatch) -> None:
    fields = msgpack.unpackb(encode(batch))
    assert list(fields) == list(PlotBatch.model_fields)
    assert decode(msgpack.packb(dict(reversed(fields.items()))), PlotBatch) == batch


@pytest.mark.parametrize("fmt", ["msgpack", "json"])
def test_the_encoding_names_format_and_schema(fmt: Format) -> None:
    assert encoding(PlotBatch, fmt) == f"application/{fmt};trackmesh.PlotBatch.v1"


@pytest.mark.parametrize("given_", ["", "zenoh/bytes", "application/msgpack", "application/octet-stream"])
def test_an_encoding_that_says_nothing_is_msgpack_of_what_the_key_calls_for(given_: str) -> None:
    assert decode(packed(), PlotBatch, given_).seq == PLOTS["seq"]


@pytest.mark.parametrize("given_", ["application/json", "text/json", "application/json;trackmesh.PlotBatch.v1"])
def test_json_is_taken_where_it_is_said(given_: str) -> None:
    assert decode(json.dumps(PLOTS).encode(), PlotBatch, given_).seq == PLOTS["seq"]


@pytest.mark.parametrize("schema", ["trackmesh.TrackFrame.v1", "trackmesh.PlotBatch.v2", "PlotBatch", "x" * 100_000])
def test_another_schema_is_refused(schema: str) -> None:
    error = refused(packed(), PlotBatch, f"application/msgpack;{schema}")
    assert error.reason == "wrong_schema"
    assert ("unknown" in error.detail) == (schema != "trackmesh.TrackFrame.v1")


def test_json_taken_for_msgpack_is_malformed_and_the_other_way_round() -> None:
    assert refused(json.dumps(PLOTS).encode()).reason == "malformed"
    assert refused(packed(), PlotBatch, JSON).reason == "malformed"


# --- broken bytes


@settings(max_examples=30, deadline=None)
@given(plot_batches())
def test_every_truncation_is_malformed(batch: PlotBatch) -> None:
    data, text = encode(batch), encode(batch, "json")
    assert {refused(data[:n]).reason for n in range(len(data))} == {"malformed"}
    assert {refused(text[:n], PlotBatch, JSON).reason for n in range(len(text))} == {"malformed"}


@given(st.binary(min_size=1, max_size=20))
def test_what_follows_a_message_makes_it_malformed(tail: bytes) -> None:
    assert refused(packed() + tail).reason == "malformed"


@given(st.binary(max_size=200))
def test_random_bytes_are_refused(data: bytes) -> None:
    refused(data)
    refused(data, PlotBatch, JSON)


# --- bombs: refused, and at once


@pytest.mark.parametrize(
    ("data", "encoding_str", "reason"),
    [
        (b"\xdd\xff\xff\xff\xff", "", "malformed"),
        (b"\xdf\xff\xff\xff\xff", "", "malformed"),
        (b"\xdb\xff\xff\xff\xff", "", "malformed"),
        (b"\xc6\xff\xff\xff\xff", "", "malformed"),
        (b"\x91" * 100_000, "", "malformed"),
        (b"\x91" * 100_000 + b"\xc0", "", "malformed"),
        (b"\x81\xa1a" * 100_000 + b"\xc0", "", "malformed"),
        (b"\xc9\xff\xff\xff\xff\x01", "", "malformed"),
        (b"[" * 100_000, JSON, "malformed"),
        (b"[" * 100_000 + b"]" * 100_000, JSON, "malformed"),
        (b'{"a":' * 100_000 + b"1" + b"}" * 100_000, JSON, "malformed"),
        (b"9" * 100_000, JSON, "malformed"),
    ],
)
def test_huge_headers_and_deep_nesting_are_malformed(data: bytes, encoding_str: str, reason: str) -> None:
    assert refused(data, PlotBatch, encoding_str).reason == reason


@pytest.mark.parametrize("fmt", ["msgpack", "json"])
@pytest.mark.parametrize(
    "change",
    [
        {"labels": [1] * 400_000},
        {"columns": [1] * 400_000},
        {"values": [[]] * 400_000},
        {"values": ["x" * 1_000_000] + [""] * 400_000},
        {"t_ns": ["x" * 1_000_000] + [""] * 400_000},
        {"t_ns": [[[]]] * 100_000},
        {f"f{i}": 1 for i in range(100_000)},
        {"scan": {f"f{i}": 1 for i in range(100_000)}},
        {"values": {"dtype": "<f8", "shape": [2**31 - 1, 2**31 - 1], "data": ""}},
    ],
    ids=lambda change: f"{next(iter(change))}-{len(change)}",
)
def test_many_errors_are_not_looked_at_one_by_one(change: dict[str, Any], fmt: Format) -> None:
    # Four megabytes of wrong labels once took half a minute and 3 GB.
    fields = PLOTS | change
    data = msgpack.packb(fields) if fmt == "msgpack" else json.dumps(fields).encode()
    detail = refused(data, PlotBatch, f"application/{fmt}").detail
    with pytest.raises(ValidationError) as errors:
        PlotBatch.model_validate(fields, strict=True)
    assert errors.value.error_count() < 10 or "things are wrong" in detail


def test_a_message_over_its_limit_is_refused_unread() -> None:
    assert refused(b"\xc1" * 1000, PlotBatch, max_bytes=999).reason == "too_large"
    assert refused(b"\xc1" * 1000, PlotBatch, max_bytes=1000).reason == "malformed"
    assert refused(bytes(SensorInfo.most_bytes + 1), SensorInfo).reason == "too_large"
    for kind in VALID:
        assert kind.most_bytes <= codec.MAX_BYTES


# --- what msgpack has and we do not


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        (PLOTS | {1: 1}, "malformed"),
        (PLOTS | {None: 1}, "malformed"),
        (PLOTS | {b"more": 1}, "unknown_field"),
        (PLOTS | {"seq": msgpack.ExtType(5, b"x")}, "invalid"),
        (PLOTS | {"seq": msgpack.Timestamp(1)}, "invalid"),
        (PLOTS | {"labels": msgpack.ExtType(5, b"x")}, "invalid"),
        (PLOTS | {"t_ns": msgpack.ExtType(5, b"x" * 16)}, "wrong_type"),
        (PLOTS | {"sensor_id": b"north"}, "invalid"),
        (msgpack.ExtType(5, b"x"), "invalid"),
        ([1, 2], "invalid"),
        (None, "invalid"),
        ("text", "invalid"),
        (7, "invalid"),
    ],
)
def test_other_types_of_msgpack_are_refused(fields: Any, reason: str) -> None:
    assert refused(msgpack.packb(fields)).reason == reason


def test_bytes_that_are_no_text_are_malformed() -> None:
    data = packed().replace(b"north", b"n\xff\xferh")
    assert refused(data).reason == "malformed"


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_of_json_that_are_none_are_refused(number: str) -> None:
    text = json.dumps(RADAR).replace('"period_s": 4.0', f'"period_s": {number}')
    assert refused(text.encode(), SensorInfo, JSON).reason == "not_finite"
    text = json.dumps(PLOTS).replace("1000.0", number)
    assert refused(text.encode(), PlotBatch, JSON).reason == "not_finite"


def test_a_sentence_quotes_no_more_than_it_must() -> None:
    assert refused(packed(**{"x" * 100_000: 1})).reason == "unknown_field"
    assert refused(packed(**{"two\nlines\x1b[31m": 1})).reason == "unknown_field"
    text = json.dumps(RADAR | {"sigma": {"y" * 100_000: 1.0}}).encode()
    assert refused(text, SensorInfo, JSON).reason == "invalid"


@given(st.text())
def test_any_sentence_becomes_one_printable_line(text: str) -> None:
    detail = RefusedMessage("invalid", text).detail
    assert detail.isprintable() and detail.endswith(".") and len(detail) <= 300


# --- envelopes


@pytest.mark.parametrize("kind", list(VALID), ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("fmt", ["msgpack", "json"])
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_an_answer_opens_to_what_was_answered(kind: type[TopMessage], fmt: Format, data: st.DataObject) -> None:
    message = data.draw(VALID[kind])
    assert open_envelope(answer(message, fmt), encoding(Envelope, fmt), kind) == message


@pytest.mark.parametrize("fmt", ["msgpack", "json"])
def test_an_envelope_is_an_answer_an_error_or_the_end(fmt: Format) -> None:
    wrapped = encoding(Envelope, fmt)
    assert open_envelope(end(3, fmt), wrapped, TrackFrame) == 3
    with pytest.raises(QueryFailed) as failed:
        open_envelope(failure("busy", "Ask later.", fmt), wrapped, TrackFrame)
    assert (failed.value.code, failed.value.detail) == ("busy", "Ask later.")
    with pytest.raises(RefusedMessage) as other:
        open_envelope(answer(TrackQuery(), fmt), wrapped, TrackFrame)
    assert other.value.reason == "wrong_schema"


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"kind": "ok"}, "missing_field"),
        ({"kind": "ok", "schema_name": "trackmesh.TrackFrame.v1"}, "missing_field"),
        ({"kind": "error", "code": "busy"}, "missing_field"),
        ({"kind": "end"}, "missing_field"),
        ({"kind": "end", "count": -1}, "out_of_bounds"),
        ({"kind": "perhaps"}, "invalid"),
        ({"kind": "ok", "schema_name": "x", "payload": []}, "invalid"),
        ({"kind": "ok", "schema_name": "z" * 100_000, "payload": {}}, "wrong_schema"),
        ({"kind": "ok", "schema_name": "trackmesh.TrackFrame.v1", "payload": {}}, "missing_field"),
        ({}, "missing_field"),
    ],
)
def test_an_envelope_that_is_none_is_refused(fields: dict[str, Any], reason: str) -> None:
    for data, kind in ((msgpack.packb(fields), ""), (json.dumps(fields).encode(), JSON)):
        with pytest.raises(RefusedMessage) as error:
            open_envelope(data, kind, TrackFrame)
        assert error.value.reason == reason
        assert len(error.value.detail) <= 300


def test_an_unpacked_map_is_judged_as_strictly() -> None:
    assert from_object(PLOTS, PlotBatch).seq == PLOTS["seq"]
    with pytest.raises(RefusedMessage, match="invalid"):
        from_object(PLOTS | {"seq": True}, PlotBatch)


def test_encoding_keeps_what_a_number_is() -> None:
    status = ServiceStatus(
        kind="fusion", unit_id="main", boot_id="b", seq=0, t_ns=2**63 - 1, state="ready", uptime_s=1.0,
        figures={"tracks": 3.0},
    )  # fmt: skip
    fields = msgpack.unpackb(encode(status))
    assert (fields["t_ns"], type(fields["figures"]["tracks"])) == (2**63 - 1, float)
    assert np.isclose(json.loads(encode(status, "json"))["uptime_s"], 1.0)
