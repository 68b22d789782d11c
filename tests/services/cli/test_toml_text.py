"""TOML that is written is TOML that is read."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.cli.conftest import ROOT

from trackmesh.services.cli.toml_text import toml_text

# A file is UTF-8: half a surrogate pair cannot be in it.
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
PLAIN = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | TEXT
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3))


@given(st.dictionaries(TEXT, VALUES, max_size=5))
def test_a_document_is_read_as_it_was_written(document: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(document)) == document


def test_it_is_laid_out_as_people_do() -> None:
    document = {"unit_id": "west", "origin": {"latitude_deg": 48.0}, "connect": ["a", "b"], "engine": {"gate": 9.0}}
    text = 'unit_id = "west"\nconnect = ["a", "b"]\n\n[origin]\nlatitude_deg = 48.0\n\n[engine]\ngate = 9.0\n'
    assert toml_text(document) == text


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.toml")), ids=lambda path: path.name)
def test_the_examples_come_back(path: Path) -> None:
    document = tomllib.loads(path.read_text())
    assert tomllib.loads(toml_text(document)) == document


@pytest.mark.parametrize("value", [None, object(), [None]])
def test_what_toml_cannot_say_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match="no word"):
        toml_text({"a": value})
