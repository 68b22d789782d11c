"""Settings as the text of a TOML file; the standard library only reads such files."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(document: Mapping[str, Any]) -> str:
    """A document of strings, numbers, booleans, lists and tables as TOML, so that ``tomllib.loads`` gives it again.

    Raises:
        TypeError: TOML has no word for a value.
    """
    return "\n\n".join(block for block in _blocks(document, "") if block) + "\n"


def _blocks(table: Mapping[str, Any], path: str) -> list[str]:
    """The lines of a table that are its own, then the tables within it."""
    inner = {name: value for name, value in table.items() if isinstance(value, Mapping)}
    own = [f"{_key(name)} = {_value(value)}" for name, value in table.items() if name not in inner]
    heading = [f"[{path}]"] if path and (own or not inner) else []
    blocks = ["\n".join(heading + own)]
    for name, value in inner.items():
        blocks += _blocks(value, f"{path}.{_key(name)}" if path else _key(name))
    return blocks


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else _string(name)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_key(name)} = {_value(part)}' for name, part in value.items())}}}"
    raise TypeError(f"TOML has no word for a {type(value).__name__}.")


def _string(text: str) -> str:
    # JSON's escapes are TOML's too, but for this one character, which JSON leaves as it is.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
