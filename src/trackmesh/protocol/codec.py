"""Messages to bytes and back, in msgpack (the wire) and JSON (files, and on request).

The Zenoh encoding names format and schema: ``application/msgpack;trackmesh.PlotBatch.v1``. Everything that can be
wrong with bytes from outside ends in ``RefusedMessage``, whose reason names a counter.
"""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import msgpack
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from trackmesh.protocol.errors import QueryFailed, RefusedMessage
from trackmesh.protocol.messages import MESSAGES, Envelope
from trackmesh.protocol.messages.base import Message, TopMessage

Format = Literal["msgpack", "json"]
M = TypeVar("M", bound=TopMessage)
R = TypeVar("R", bound=Message)

MAX_BYTES = 64 * 2**20
"""No message is larger; many kinds (``TopMessage.most_bytes``) and services set lower limits."""

_ERRORS_READ = 1000
_SILENT: dict[type, str] = {msgpack.StackError: "nested too deeply"}

_OURS = {
    "wrong_type",
    "wrong_dtype",
    "wrong_length",
    "not_finite",
    "out_of_bounds",
    "too_large",
    "invalid",
    "missing_field",
}
_PYDANTIC = {
    "extra_forbidden": "unknown_field",
    "missing": "missing_field",
    "string_pattern_mismatch": "invalid_id",
    "finite_number": "not_finite",
    "greater_than": "out_of_bounds",
    "greater_than_equal": "out_of_bounds",
    "less_than": "out_of_bounds",
    "less_than_equal": "out_of_bounds",
    "too_long": "wrong_length",
    "too_short": "wrong_length",
    "string_too_long": "wrong_length",
    "string_unicode": "malformed",
    "invalid_key": "unknown_field",
    "json_invalid": "malformed",
}


def encoding(message: type[TopMessage] | TopMessage, fmt: Format = "msgpack") -> str:
    """The encoding string of a message: ``application/msgpack;trackmesh.PlotBatch.v1``."""
    return f"application/{fmt};{message.schema_id()}"


def encode(message: TopMessage, fmt: Format = "msgpack") -> bytes:
    """Bytes of a message."""
    if fmt == "json":
        return message.model_dump_json().encode()
    return bytes(msgpack.packb(message.model_dump()))


def decode(data: bytes, kind: type[M], encoding_str: str = "", max_bytes: int = MAX_BYTES) -> M:
    """The message in ``data``, which must be of ``kind``.

    Args:
        data: the payload.
        kind: the message class that the key calls for.
        encoding_str: the encoding it came with. A plain or empty one is taken as msgpack of ``kind``; one that names
            another schema is refused.
        max_bytes: the largest payload accepted, if that is less than the kind's own limit.

    Raises:
        RefusedMessage: whatever is wrong with it.
    """
    most = min(max_bytes, kind.most_bytes)
    if len(data) > most:
        raise RefusedMessage("too_large", f"The message has {len(data)} bytes, at most {most} are accepted.")
    fmt = _format_for(kind, encoding_str)
    try:
        if fmt == "json":
            return kind.model_validate_json(data, strict=True)
        return kind.model_validate(_unpack(data), strict=True)
    except ValidationError as error:
        raise refusal(kind.__name__, error) from None


def from_object(payload: object, kind: type[R]) -> R:
    """The message in an already unpacked map (of either format).

    Raises:
        RefusedMessage: whatever is wrong with it.
    """
    try:
        return kind.model_validate(payload, strict=True)
    except ValidationError as error:
        raise refusal(kind.__name__, error) from None


def refusal(name: str, error: ValidationError) -> RefusedMessage:
    """One reason and one sentence for the first thing that is wrong."""
    if (count := error.error_count()) > _ERRORS_READ:
        # To look at each of a million errors takes seconds.
        return RefusedMessage("invalid", f"{name}: {count} things are wrong with it.")
    first = error.errors(include_url=False, include_input=False, include_context=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    return RefusedMessage(_reason(first), f"{name}{'.' + where if where else ''}: {first['msg']}")


def answer(message: TopMessage, fmt: Format = "msgpack") -> bytes:
    """An ``ok`` envelope around a message."""
    payload = message.model_dump(mode="json" if fmt == "json" else "python")
    return encode(Envelope(kind="ok", schema_name=message.schema_id(), payload=payload), fmt)


def failure(code: str, detail: str, fmt: Format = "msgpack") -> bytes:
    """An ``error`` envelope."""
    return encode(Envelope(kind="error", code=code, detail=detail), fmt)


def end(count: int, fmt: Format = "msgpack") -> bytes:
    """The ``end`` envelope after ``count`` answers."""
    return encode(Envelope(kind="end", count=count), fmt)


def open_envelope(data: bytes, encoding_str: str, kind: type[M]) -> M | int:
    """What an envelope holds: the message of an ``ok``, the count of an ``end``.

    Raises:
        QueryFailed: it is an ``error``.
        RefusedMessage: it is no envelope, or holds no ``kind``.
    """
    envelope = decode(data, Envelope, encoding_str)
    if envelope.kind == "error":
        raise QueryFailed(envelope.code or "", envelope.detail or "")
    if envelope.kind == "end":
        return envelope.count or 0
    if envelope.schema_name != kind.schema_id():
        raise RefusedMessage("wrong_schema", f"Expected {kind.schema_id()}, got {envelope.schema_name!r:.80}.")
    return from_object(envelope.payload, kind)


def _format_for(kind: type[TopMessage], encoding_str: str) -> Format:
    mime, _, schema = encoding_str.partition(";")
    if schema and schema != kind.schema_id():
        known = "" if schema in MESSAGES else "unknown "
        raise RefusedMessage("wrong_schema", f"Expected {kind.schema_id()}, got {known}schema {schema!r:.80}.")
    return "json" if mime in ("application/json", "text/json") else "msgpack"


def _unpack(data: bytes) -> Any:
    try:
        return msgpack.unpackb(data)
    except (ValueError, msgpack.UnpackException) as error:
        why = str(error)[:120] or _SILENT.get(type(error), "against its format")
        raise RefusedMessage("malformed", f"The bytes are no msgpack: {why}.") from None


def _reason(error: ErrorDetails) -> str:
    kind = error["type"]
    if error["loc"] == ("schema_version",):
        return "wrong_version"
    if kind in _OURS:
        return kind
    return _PYDANTIC.get(kind, "invalid")
