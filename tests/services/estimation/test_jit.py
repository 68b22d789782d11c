from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from tests.services.estimation.makers import NAMED, TVIMM_LAGGED, fed_walk, plain_python

from trackmesh.services.estimation import imm, jit


def test_kernels_are_compiled_here_and_plain_python_on_request() -> None:
    assert hasattr(imm.filter_plot, "py_func") or os.environ.get("NUMBA_DISABLE_JIT") == "1"
    assert plain_python("hasattr(tracks.feed, 'py_func')", "tests.services.estimation.makers") is False


def test_compiled_and_plain_give_the_same_numbers() -> None:
    """To 1e-10 relative: compiled code may contract and reorder sums."""
    walks = "{n: fed_walk(m).tolist() for n, m in (NAMED | {'lags': TVIMM_LAGGED}).items()}"
    plain = plain_python(walks, "tests.services.estimation.makers")
    for name, models in (NAMED | {"lags": TVIMM_LAGGED}).items():
        np.testing.assert_allclose(fed_walk(models), plain[name], rtol=1e-10, atol=1e-10, err_msg=name)


def copied(target: Path) -> ModuleType:
    """The module ``jit`` from a copy of the services."""
    services = Path(jit.__file__).resolve().parent.parent
    shutil.copytree(services, target, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    spec = importlib.util.spec_from_file_location("copied_jit", target / "estimation" / "jit.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_cache_is_another_after_any_change_of_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))  # or the copy would point numba elsewhere
    module = copied(tmp_path)
    first = {room: module.cache_folder(room) for room in ("estimation", "fusion", "emi")}
    assert first == {room: jit.cache_folder.__wrapped__(room) for room in first}
    with (tmp_path / "estimation" / "imm.py").open("a") as source:
        source.write("# changed\n")
    module.cache_folder.cache_clear()
    second = {room: module.cache_folder(room) for room in first}
    assert {folder.parent for folder in second.values()} == {first["fusion"].parent}
    assert [room for room in first if first[room] != second[room]] == ["estimation", "fusion"]


def test_the_cache_is_where_the_user_keeps_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRACKMESH_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert jit.cache_folder.__wrapped__("emi").parent == tmp_path / "trackmesh" / "numba"
    monkeypatch.setenv("TRACKMESH_CACHE", str(tmp_path / "ours"))
    assert jit.cache_folder.__wrapped__("emi").parent == tmp_path / "ours" / "numba"


def test_where_nothing_can_be_written_the_cache_is_of_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TRACKMESH_CACHE", str(tmp_path / "file"))
    folders = jit.cache_folder.__wrapped__("emi"), jit.cache_folder.__wrapped__("emi")
    assert folders[0] != folders[1]
    assert all(folder.is_dir() for folder in folders)
    for folder in folders:
        folder.rmdir()
