"""A file that a healthy process rewrites every second, and the probe that looks at it.

Containers are probed every few seconds for as long as they live. So the probe,
``python -m trackmesh.services.heartbeat``, loads nothing but the standard library and asks nobody over the network.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

STALE_S = 10.0
VARIABLE = "TRACKMESH_HEARTBEAT_FILE"


def beat(path: Path, state: str) -> None:
    """Write that the process lives, and its state; whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    # The monotonic clock is one for all processes of a machine, and nobody sets it.
    text = json.dumps({"monotonic_s": time.monotonic(), "state": state})
    fresh = path.with_name(f"{path.name}.{os.getpid()}")
    fresh.write_text(text, encoding="utf-8")
    fresh.replace(path)


def ill(path: Path, *, ready: bool = False, stale_s: float = STALE_S) -> str:
    """Why a process is not well, in a sentence; empty if it is.

    Args:
        path: its heartbeat file.
        ready: it must also be ready, not only alive.
        stale_s: how old the last beat may be.
    """
    try:
        last = json.loads(path.read_text(encoding="utf-8"))
        age_s, state = time.monotonic() - float(last["monotonic_s"]), str(last["state"])
    except OSError as error:
        return f"{path}: {error.strerror}."
    except (ValueError, TypeError, KeyError):
        return f"{path} is no heartbeat file."
    # One of before the machine was started may lie in the future.
    if not 0.0 <= age_s <= stale_s:
        return f"The last heartbeat was {abs(age_s):.0f} s ago."
    if ready and state != "ready":
        return f"The service is {state}."
    return ""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the probe: exit code 0 if well, 1 if not."""
    parser = argparse.ArgumentParser(description="Whether a process of trackmesh is well.")
    parser.add_argument("file", type=Path, nargs="?", default=os.environ.get(VARIABLE), help=f"default: {VARIABLE}")
    parser.add_argument("--ready", action="store_true", help="ready for work, not only alive")
    parser.add_argument("--stale", type=float, default=STALE_S, metavar="S", help=f"default: {STALE_S:g}")
    given = parser.parse_args(arguments)
    if given.file is None:
        parser.error(f"no file given, and {VARIABLE} is not set")
    reason = ill(given.file, ready=given.ready, stale_s=given.stale)
    print(reason or "well", file=sys.stderr if reason else sys.stdout)
    return int(bool(reason))


if __name__ == "__main__":
    raise SystemExit(main())
