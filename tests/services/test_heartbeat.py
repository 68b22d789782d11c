"""The heartbeat file, and the probe that containers run."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from trackmesh.services.heartbeat import STALE_S, VARIABLE, beat, ill, main


def test_who_beats_is_well(tmp_path: Path) -> None:
    beat(tmp_path / "beat", "compiling")
    assert ill(tmp_path / "beat") == ""
    assert ill(tmp_path / "beat", ready=True) == "The service is compiling."
    beat(tmp_path / "beat", "ready")
    assert ill(tmp_path / "beat", ready=True) == ""
    assert [path.name for path in tmp_path.iterdir()] == ["beat"]


@pytest.mark.parametrize("age_s", [STALE_S + 1.0, -100.0])
def test_who_has_stopped_or_is_of_before_the_boot_is_not(tmp_path: Path, age_s: float) -> None:
    path = tmp_path / "beat"
    path.write_text(json.dumps({"monotonic_s": time.monotonic() - age_s, "state": "ready"}))
    assert "heartbeat was" in ill(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"monotonic_s": null, "state": "ready"}'])
def test_what_is_no_heartbeat(tmp_path: Path, text: str) -> None:
    path = tmp_path / "beat"
    assert "No such file" in ill(path)
    path.write_text(text)
    assert ill(path) == f"{path} is no heartbeat file."


def test_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "beat"
    monkeypatch.setenv(VARIABLE, str(path))
    assert main([]) == 1
    beat(path, "ready")
    assert main(["--ready"]) == 0
    assert capsys.readouterr().out == "well\n"
    monkeypatch.delenv(VARIABLE)
    assert main([str(path)]) == 0
    with pytest.raises(SystemExit):
        main([])


def test_the_probe_loads_nothing_of_ours() -> None:
    """It runs every few seconds in every container."""
    heavy = "{'numpy', 'zenoh', 'pydantic'}"
    code = f"import sys, trackmesh.services.heartbeat; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
