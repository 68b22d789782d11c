"""A worker process of the EMI service: pieces of requests in by standard input, answers out by standard output.

``python -m trackmesh.services.emi.service.worker``. It is started afresh, never forked; it knows no network, and ends
when its input is closed, so it never outlives the service, however that ended.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from multiprocessing.connection import Connection

TELL, SOLVE = "tell", "solve"
READY, SOLVED, FAILED = "ready", "solved", "failed"


def main() -> None:
    """Work until the input ends."""
    # Ctrl-C is for the service, which ends us by closing our input.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = Connection(os.dup(1), readable=False)
    # Whatever prints must not get in between.
    os.dup2(2, 1)
    from trackmesh.services.emi.service.warm_up import warm_up

    warm_up()
    try:
        answers.send((READY, None))
        _work(Connection(0, writable=False), answers)
    except (EOFError, OSError):
        pass


def _work(questions: Connection, answers: Connection) -> None:
    from trackmesh.services.emi.service.work import Surveys, solve_piece

    surveys = Surveys()
    answer: tuple[str, object]
    while True:
        word, content = questions.recv()
        if word == TELL:
            surveys.tell(*content)
            continue
        try:
            answer = (SOLVED, solve_piece(surveys.get(content.key), content))
        except (MemoryError, ArithmeticError, LookupError, TypeError, ValueError):
            answer = (FAILED, traceback.format_exc())
        answers.send(answer)


if __name__ == "__main__":
    main()
    sys.exit(0)
