"""A command of trackmesh as a child of another: it ends when its parent does, however that came about.

The parent holds the other end of our standard input and never writes to it; with the parent it is closed. So
``python -m trackmesh.services.cli.child fusion --connect ...`` never outlives who started it.
"""

from __future__ import annotations

import os
import signal
import threading


def end_with_parent(stdin: int = 0) -> None:
    """From a thread, ask this process to stop once ``stdin`` is closed."""

    def wait() -> None:
        while os.read(stdin, 64):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, name="parent", daemon=True).start()


def main() -> None:
    """Be the command that the arguments say."""
    # Before what takes long: the parent may be gone by then.
    end_with_parent()
    from trackmesh.services.cli.main import app

    app(prog_name="trackmesh")


if __name__ == "__main__":
    main()
