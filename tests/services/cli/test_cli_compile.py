"""``trackmesh compile`` asks every service that has numerics."""

from __future__ import annotations

import pytest
from tests.services.cli.conftest import Run


def test_every_service_compiles(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    rooms = {"fusion": "fusion.warm_up", "tags": "tags.warm_up", "emi": "emi.service.warm_up"}
    for name, module in rooms.items():
        path = f"trackmesh.services.{module}.warm_up"
        monkeypatch.setattr(path, lambda *_, name=name, **__: asked.append(name))
    done = run("compile")
    assert done.exit_code == 0, done.output
    assert asked == ["fusion", "tags", "emi"]
    assert [line.split(":")[0] for line in done.stderr.splitlines()] == asked
