"""The house itself: who may import whom, how large a file may be, what must not stand in the repository."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
KNOW_ZENOH = {f"protocol/zenoh_{part}.py" for part in ("bus", "config", "history")} | {"services/router.py"}


def _imports(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def test_the_contracts_between_rooms_are_kept() -> None:
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()", "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]


def test_zenoh_is_known_in_its_own_files_only() -> None:
    knowing = {
        str(path.relative_to(ROOT / "src" / "trackmesh"))
        for path in SOURCES
        if any(name.split(".")[0] == "zenoh" for name in _imports(path))
    }
    assert knowing == KNOW_ZENOH


def test_numerics_know_no_clock_no_log_no_messages() -> None:
    banned = {"time", "datetime", "logging", "pydantic", "socket", "threading", "zenoh"}
    for path in (ROOT / "src/trackmesh/services/estimation").glob("*.py"):
        assert not {name.split(".")[0] for name in _imports(path)} & banned, path


def test_the_fusion_engine_knows_no_clock_and_no_network() -> None:
    engines = ("engine", "layer", "life", "association", "membership", "sensors", "frames", "intake", "rates")
    partition = [f"partition/{part}" for part in ("areas", "band", "engine", "neighbours", "ownership", "pairing")]
    for name in (*engines, *partition):
        path = ROOT / f"src/trackmesh/services/fusion/{name}.py"
        imported = _imports(path)
        assert not {n.split(".")[0] for n in imported} & {"time", "logging", "threading", "zenoh"}, path
        assert not any("bus" in n or "client" in n for n in imported), path


def test_the_tag_engine_knows_no_clock_and_no_network() -> None:
    for path in (ROOT / "src/trackmesh/services/tags").glob("*.py"):
        if path.stem != "service":
            imported = _imports(path)
            assert not {n.split(".")[0] for n in imported} & {"time", "datetime", "logging", "threading"}, path
            assert not any("bus" in n or "client" in n for n in imported), path


def test_no_file_is_longer_than_two_rooms() -> None:
    long = {str(p.relative_to(ROOT)): n for p in SOURCES if (n := len(p.read_text().splitlines())) > 400}
    assert not long


def test_nothing_of_this_machine_is_in_the_repository() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    banned = re.compile(re.escape(f"{ROOT}/") + r"|--index-url|https?://[^ \"]*/(simple|packages)/")
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if path.suffix in {".py", ".md", ".toml", ".txt", ".lock", ".json", ".json5"} and path.exists():
            found = banned.search(path.read_text())
            assert found is None or path == Path(__file__).resolve(), f"{name}: {found and found.group()}"
