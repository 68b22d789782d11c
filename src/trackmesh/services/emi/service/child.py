"""A worker process as the service sees it: started, asked, ended."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import deque
from multiprocessing.connection import Connection

from trackmesh.services.emi.service.work import Job, Piece, SurveyKey
from trackmesh.services.emi.service.worker import READY, SOLVE, TELL

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
STOP_S = 1.0
KEYS_TOLD = 4
"""Fewer than a worker keeps, so that what it was told it still has."""


class Child:
    """One worker process. It belongs to one thread; others may but ``kill`` it."""

    def __init__(self) -> None:
        # A new program, not a copy of this process: no fork that others' threads could have left in a bad state.
        environment = os.environ | dict.fromkeys(ONE_THREAD, "1")
        to_child, questions = os.pipe()
        answers, from_child = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "trackmesh.services.emi.service.worker"],
            stdin=to_child,
            stdout=from_child,
            env=environment,
            start_new_session=True,
        )
        os.close(to_child)
        os.close(from_child)
        self._questions, self._answers = Connection(questions, readable=False), Connection(answers, writable=False)
        self._told: deque[SurveyKey] = deque(maxlen=KEYS_TOLD)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def wait_ready(self) -> None:
        """Wait until it has its kernels.

        Raises:
            EOFError, OSError: it ended instead.
        """
        word, _ = self._answers.recv()
        if word != READY:
            raise EOFError

    def solve(self, job: Job, piece: Piece) -> tuple[str, object]:
        """The answer to a piece.

        Raises:
            EOFError, OSError: the process died.
        """
        if piece.key not in self._told:
            self._questions.send((TELL, (job.key, job.request.coils, job.request.options)))
            self._told.append(piece.key)
        self._questions.send((SOLVE, piece))
        word, content = self._answers.recv()
        return word, content

    def kill(self) -> None:
        """End it at once; whoever waits for an answer hears that it ended."""
        self._process.kill()

    def end(self) -> None:
        """See it ended, if need be by force."""
        self._questions.close()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._answers.close()
