"""Broken messages of every kind: a message comes out, or a refusal, and never anything else."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Iterator
from typing import Any

import msgpack
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.protocol.strategies import messages

from trackmesh.protocol.codec import Format, answer, decode, encode, encoding, open_envelope
from trackmesh.protocol.errors import QueryFailed, RefusedMessage
from trackmesh.protocol.files import from_line
from trackmesh.protocol.messages import MESSAGES, Envelope
from trackmesh.protocol.messages.base import TopMessage

REASONS = {
    "invalid", "invalid_id", "malformed", "missing_field", "not_finite", "out_of_bounds", "too_large", "unknown_field",
    "wrong_dtype", "wrong_length", "wrong_schema", "wrong_type", "wrong_version",
}  # fmt: skip
FORMATS: tuple[Format, ...] = ("msgpack", "json")

ODD: list[Any] = [
    None, True, False, 0, 1, -1, 2**31, 2**63, 2**64 - 1, -(2**63), 1.0, 0.5, -0.0, 1e308, float("nan"), float("inf"),
    "", "a", "north", "*", "\0", "é" * 70, b"", b"\0" * 8, b"\xff" * 24, [], [[]], [[], []], [None], [1], [1.5], ["a"],
    [[1.0, 2.0]], {}, {"a": 1}, {"dtype": "<f8", "shape": [0], "data": b""},
    {"dtype": "<i8", "shape": [1], "data": b"\0" * 8}, {"dtype": "<f8", "shape": [0, 2**30], "data": b""},
    {"dtype": "<f8", "shape": [1, 1, 1, 3], "data": b"\0\0\0\0\0\0\xf0\x7f" * 3},
    msgpack.ExtType(1, b"x"), msgpack.Timestamp(1, 2),
]  # fmt: skip


def judged(data: bytes, kind: type[TopMessage], fmt: Format) -> TopMessage | None:
    """The message, which then survives both ways; or None where it is refused well."""
    try:
        message = decode(data, kind, f"application/{fmt}")
    except RefusedMessage as error:
        assert error.reason in REASONS
        assert error.detail.isprintable() and len(error.detail) <= 300
        return None
    if kind is not Envelope:
        for again in FORMATS:
            assert decode(encode(message, again), kind, encoding(kind, again)) == message
    return message


def nodes(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) in a tree of maps and lists."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from nodes(tree[key])


def transplanted(tree: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """The tree with one to three of its nodes replaced, removed, doubled or renamed."""
    for _ in range(rng.randint(1, 3)):
        places = list(nodes(tree))
        if not places:
            return tree
        place, key = rng.choice(places)
        act = rng.randrange(5)
        if act == 0:
            del place[key]
        elif act == 1 and isinstance(place, dict):
            place[rng.choice(["", "seq", "values", "schema_version", "é"])] = place.pop(key)
        elif act == 2 and isinstance(place, list):
            place.insert(key, place[key])
        else:
            other, name = rng.choice(places)
            place[key] = (
                copy.deepcopy(rng.choice(ODD))
                if rng.random() < 0.7
                else json.loads(json.dumps(other[name], default=str))
            )
    return tree


def broken(data: bytes, rng: random.Random) -> bytes:
    """Bytes flipped, cut, doubled, or put in."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        i = rng.randrange(len(out) + 1)
        act = rng.randrange(5)
        if act == 0 and out:
            out[i % len(out)] ^= 1 << rng.randrange(8)
        elif act == 1:
            del out[i:]
        elif act == 2:
            out[i:i] = rng.randbytes(rng.randint(1, 4))
        elif act == 3:
            del out[i : i + rng.randint(1, 4)]
        else:
            out[i:i] = out[: rng.randint(0, 40)]
    return bytes(out)


seeds = st.integers(0, 2**32).map(random.Random)
no_limits = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example],
)


@no_limits
@given(messages, seeds)
def test_broken_bytes(message: TopMessage, rng: random.Random) -> None:
    for fmt in FORMATS:
        good = encode(message, fmt)
        for _ in range(10):
            judged(broken(good, rng), type(message), fmt)


@no_limits
@given(messages, seeds)
def test_transplanted_fields(message: TopMessage, rng: random.Random) -> None:
    for _ in range(10):
        judged(msgpack.packb(transplanted(message.model_dump(), rng)), type(message), "msgpack")
        tree = transplanted(json.loads(encode(message, "json")), rng)
        judged(json.dumps(tree, default=str).encode(), type(message), "json")


@no_limits
@given(messages, st.sampled_from(sorted(MESSAGES)))
def test_a_message_read_as_another(message: TopMessage, name: str) -> None:
    for fmt in FORMATS:
        judged(encode(message, fmt), MESSAGES[name], fmt)  # type: ignore[arg-type]


@no_limits
@given(messages, seeds)
def test_broken_envelopes(message: TopMessage, rng: random.Random) -> None:
    for fmt in FORMATS:
        good = answer(message, fmt)
        for _ in range(10):
            try:
                open_envelope(broken(good, rng), encoding(Envelope, fmt), type(message))
            except RefusedMessage as error:
                assert error.reason in REASONS
            except QueryFailed:
                pass


@no_limits
@given(messages, seeds)
def test_broken_lines(message: TopMessage, rng: random.Random) -> None:
    line = '{"type":"plots",' + message.model_dump_json()[1:]
    for _ in range(10):
        try:
            from_line(broken(line.encode(), rng).decode(errors="surrogateescape"))
        except RefusedMessage as error:
            assert error.reason in REASONS


@no_limits
@given(st.recursive(
    st.sampled_from(ODD),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["seq", "t_ns", "a"]), inner),
    max_leaves=8,
))  # fmt: skip
def test_any_tree(tree: Any) -> None:
    for kind in MESSAGES.values():
        judged(msgpack.packb(tree), kind, "msgpack")  # type: ignore[arg-type]
