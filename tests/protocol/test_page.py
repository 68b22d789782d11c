"""docs/protocol.md against the code: every field with its type and bounds, every key, every reason."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from tests.network.processes import ROOT
from tests.protocol.test_fuzz import REASONS

from trackmesh.protocol.codec import MAX_BYTES
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import MESSAGES, Message
from trackmesh.protocol.messages.plots import COLUMN_BOUNDS, COLUMN_SETS

PAGE = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
NAMED = {r"^[a-z0-9][a-z0-9_-]{0,63}$": "id", r"^[A-Za-z0-9_-]{1,64}$": "boot id"}
POWERS = {2**63 - 1: "2^63-1", 2**53: "2^53"}


def kinds() -> dict[str, type[Message]]:
    """All messages, and those inside them, by name."""
    found: dict[str, type[Message]] = {}
    todo: list[Any] = list(MESSAGES.values())
    while todo:
        one = todo.pop()
        if isinstance(one, type) and issubclass(one, Message):
            if one.__name__ not in found:
                found[one.__name__] = one
                todo += [info.annotation for info in one.model_fields.values()]
        else:
            todo += getattr(one, "__args__", ())
    return found


def number(value: float) -> str:
    return POWERS.get(int(value)) or re.sub(r"e([+-])0?", lambda e: "e" + e[1].strip("+"), f"{value:.7g}")


def bounds(schema: dict[str, Any]) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    above = schema.get("exclusiveMinimum")
    if above is not None:
        return f" > {number(above)}" + (f", up to {number(high)}" if high is not None else "")
    if low is not None and high is not None:
        return f" {number(low)}" if low == high else f" {number(low)} to {number(high)}"
    return f" >= {number(low)}" if low is not None else f" <= {number(high)}" if high is not None else ""


def wording(schema: dict[str, Any]) -> str:
    """A type as the page words it: ``float 0 to 1``, ``<f8 (n, c)``, ``list of 3 floats``, ``id or null``."""
    if "anyOf" in schema:
        return " or ".join(wording(option) for option in schema["anyOf"])
    if "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[-1]
    if "dtype" in schema:
        item = schema
        while item.get("type") == "array":
            item = item["items"]
        shape = re.search(r"\(.*\)", schema["description"])
        return f"{schema['dtype']} {shape.group() if shape else ''}{bounds(item)}"
    if "enum" in schema or "const" in schema:
        return ", ".join(str(value) for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return listed(schema)
    if schema.get("type") == "object":
        inner = schema.get("additionalProperties")
        return f"map of {wording(inner)}" if isinstance(inner, dict) else "map"
    if schema.get("type") == "string":
        if "maxLength" in schema:
            return f"text of up to {schema['maxLength']} characters"
        return NAMED[schema["pattern"]] if "pattern" in schema else "text"
    names = {"integer": "int", "number": "float", "boolean": "bool", "null": "null"}
    return names[schema["type"]] + bounds(schema)


def listed(schema: dict[str, Any]) -> str:
    low, high = schema.get("minItems"), schema.get("maxItems")
    count = "" if high is None else f"{low} " if low == high else f"{low} to {high} " if low else f"up to {high} "
    return f"list of {count}{wording(schema['items'])}"


def expected(kind: type[Message]) -> dict[str, tuple[str, str]]:
    """Type and default of each field but the version, of which the page speaks once."""
    schema = kind.model_json_schema()
    along = {name: axes[0] for name, axes in kind._axes}
    found = {}
    for name, field in schema["properties"].items():
        words = wording(field)
        if "list" in words and name in along:
            words = words.replace(" or null", "") + f" ({along[name]})" + " or null" * (" or null" in words)
        needed = name in schema.get("required", [])
        found[name] = (words, "required" if needed else default_of(kind.model_fields[name].default))
    found.pop("schema_version", None)
    return found


def default_of(value: object) -> str:
    if isinstance(value, Message):
        return "all defaults"
    return value if isinstance(value, str) else json.dumps(value)


def sections() -> dict[str, str]:
    heads = [*re.finditer(r"^#+ (.+)$", PAGE, re.MULTILINE), None]
    found = {}
    for head, after in pairwise(heads):
        assert head is not None
        found[head.group(1).strip("`")] = PAGE[head.end() : after.start() if after else None]
    return found


def rows(section: str) -> Iterator[list[str]]:
    """Cells of the lines of the first table whose first cell is code."""
    for line in section.splitlines():
        if line.startswith("| `"):
            yield [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line.strip("|"))]


@pytest.mark.parametrize("name", sorted(kinds()))
def test_the_page_tells_every_field_as_it_is(name: str) -> None:
    told = {cells[0].strip("`"): (cells[1].strip("`"), cells[2].strip("`")) for cells in rows(sections()[name])}
    assert told == expected(kinds()[name])
    assert all(cells[3] for cells in rows(sections()[name])), "a field without a meaning"


def test_the_page_tells_every_column_and_its_bounds() -> None:
    told = {cells[0].strip("`"): cells[1].strip("`") for cells in rows(sections()["Columns"])}
    assert told == {name: f"{number(low)} to {number(high)}" for name, (low, high) in COLUMN_BOUNDS.items()}
    for columns in COLUMN_SETS:
        assert f"`{', '.join(columns)}`" in PAGE


def test_the_page_tells_every_key() -> None:
    keys = Keys("realm")
    families = {keys.service(s, "x") for s in ("tracks", "history", "emi")} | {
        keys.live("x", "x"),
        keys.status("x", "x"),
    }
    families |= {
        key("x") for key in (keys.plots, keys.ranges, keys.sensor, keys.tracks, keys.refined, keys.tags, keys.band,
                             keys.registration, keys.truth, keys.asking)
    }  # fmt: skip
    told = {re.sub(r"\{\w+\}", "x", cells[0].strip("`")) for cells in rows(sections()["Keys"])}
    assert {f"realm/@v1/{key}" for key in told} == families


def test_the_page_tells_every_reason_that_the_code_knows() -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    known = REASONS | set(re.findall(r'RefusedMessage\(\s*"(\w+)"', sources))
    told = {cells[0].strip("`") for cells in rows(sections()["Refusals"])}
    assert known - told == set()
    assert told - known <= {"busy", "internal"}


def test_the_page_names_the_limits() -> None:
    assert f"{MAX_BYTES // 2**20} MiB" in sections()["Limits"]
