"""The Dockerfile: by a linter, and by what it copies and runs."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tests.docker.files import DOCKER, ROOT, unknown_settings

TEXT = (DOCKER / "Dockerfile").read_text()


def test_hadolint_finds_nothing() -> None:
    tool = Path(sys.executable).with_name("hadolint")
    found = str(tool) if tool.exists() else shutil.which("hadolint")
    if found is None:
        pytest.skip("hadolint is not installed")
    done = subprocess.run([found, DOCKER / "Dockerfile"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout


def test_what_is_copied_is_there_and_let_through() -> None:
    let_through = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {name for line in re.findall(r"^COPY (?!--from)(.+) \S+$", TEXT, re.M) for name in line.split()}
    assert copied == let_through
    assert all((ROOT / name).exists() for name in copied)


def test_it_does_not_run_as_root() -> None:
    assert re.findall(r"^USER (.+)$", TEXT, re.M) == ["10001:10001"]


def test_the_probe_and_the_settings_exist() -> None:
    probe = json.loads(re.findall(r"^HEALTHCHECK .*CMD (.+)$", TEXT, re.M)[0])
    assert importlib.util.find_spec(probe[-1]) is not None
    assert unknown_settings(re.findall(r"(TRACKMESH_\w+)=", TEXT)) == []


def test_the_base_is_a_python_that_we_support() -> None:
    found = re.search(r"^ARG BASE=docker.io/library/python:3\.(\d+)-slim", TEXT, re.M)
    assert found is not None
    assert int(found.group(1)) >= 11
