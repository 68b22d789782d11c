"""All benchmarks, or those named: rows to ``benchmarks/latest.json``, spread and machine to the terminal.

python -m benchmarks.run [NAME ...]

Those not named keep the rows they have.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
LATEST = HERE / "latest.json"
FIELDS = ["bench", "case", "value", "unit", "peer", "peer_value", "ratio"]

Row = dict[str, Any]
Bench = Callable[[], Iterable[Row]]


def benches() -> dict[str, Bench]:
    """Every benchmark by its name; a new one is a new entry."""
    # A script's own directory is on the path, not that of the package it lies in.
    sys.path.insert(0, str(HERE.parent))
    from benchmarks import alpha_beta, association, emi, fusion, fusion_cost, imm, live, recordings, tags, wire

    return {
        "wire": wire.rows,
        "fusion": fusion.rows,
        "fusion-cost": fusion_cost.rows,
        "live": live.rows,
        "recordings": recordings.rows,
        "association": association.rows,
        "emi": emi.rows,
        "tags": tags.rows,
        "alpha-beta": alpha_beta.rows,
        "imm": imm.rows,
    }


def machine() -> str:
    """What the numbers were measured on."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("numpy", "pydantic", "msgpack")]
    return f"{_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, {', '.join(versions)}"


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def measure(bench: Bench) -> list[Row]:
    """The rows of a benchmark, of the agreed fields."""
    found = []
    for row in bench():
        if list(row) != FIELDS:
            raise SystemExit(f"A row must have the fields {FIELDS}, not {list(row)}.")
        found.append(row)
    return found


def main(names: list[str]) -> int:
    """Run and write; the exit code."""
    known = benches()
    if unknown := set(names) - set(known):
        print(f"Unknown benchmark {', '.join(sorted(unknown))}; there are {', '.join(known)}.", file=sys.stderr)
        return 2
    print(machine())
    wanted = names or list(known)
    kept = json.loads(LATEST.read_text(encoding="utf-8")) if names and LATEST.exists() else []
    rows = [row for row in kept if row["bench"] not in wanted]
    for name in wanted:
        rows += measure(known[name])
    LATEST.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(f"{len(rows)} rows in {LATEST}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
