"""A request cut into pieces, and what is done with each piece: by the service itself, or by a worker process."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.codec import Format, answer
from trackmesh.services.emi.diagnosis.results import ScanResult
from trackmesh.services.emi.engine import Survey, chunk_length, invert_over, survey
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import Coils
from trackmesh.services.emi.service.convert import Head, Request, to_message

SURVEYS_KEPT = 8
PIECES_A_WORKER = 4


class SurveyKey(NamedTuple):
    """What a survey is made of, by name: the geometry's content, the options, whether the noise is known."""

    geometry_id: str
    options: str
    sigma_known: bool


class Job(NamedTuple):
    """A request to be worked on.

    Attributes:
        key: of its survey.
        request: the arrays.
        head: what every answer repeats.
        fmt: of the answers; None: they are wanted as ``ScanResult``.
    """

    key: SurveyKey
    request: Request
    head: Head
    fmt: Format | None


class Piece(NamedTuple):
    """Some scans of a job, as a worker is sent them.

    Attributes:
        first: index of its first scan.
        key: of the survey; the worker has been told what it is made of.
        field_t, sigma_t: as in ``Request``.
        head, fmt: as in ``Job``.
    """

    first: int
    key: SurveyKey
    field_t: FloatArray
    sigma_t: FloatArray | float | None
    head: Head
    fmt: Format | None


class Solved(NamedTuple):
    """The answer to one scan: its index, its status for the counters, and its envelope, or else the result itself."""

    scan: int
    status: str
    payload: bytes
    result: ScanResult | None = None


class Surveys:
    """The last few geometries made ready, in the process that uses them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ready: OrderedDict[SurveyKey, Survey] = OrderedDict()

    def tell(self, key: SurveyKey, coils: Coils, options: Options) -> None:
        """Make one ready, unless it is."""
        with self._lock:
            if key not in self._ready:
                self._ready[key] = survey(coils, options, key.sigma_known)
            self._ready.move_to_end(key)
            while len(self._ready) > SURVEYS_KEPT:
                self._ready.popitem(last=False)

    def get(self, key: SurveyKey) -> Survey:
        """One that is still there.

        Raises:
            KeyError: it is not.
        """
        with self._lock:
            return self._ready[key]


def survey_key(request: Request, geometry_id: str) -> SurveyKey:
    """The name of what a request needs made ready."""
    return SurveyKey(geometry_id, repr(request.options), request.sigma_t is not None)


def pieces(job: Job, workers: int) -> Iterator[Piece]:
    """A job in pieces of a size that is efficient, and small enough that all workers have something to do."""
    field, sigma = job.request.field_t, job.request.sigma_t
    share = -(-len(field) // max(1, PIECES_A_WORKER * workers))
    size = max(1, min(chunk_length(field.shape[2]), share))
    for first in range(0, len(field), size):
        yield Piece(first, job.key, field[first : first + size], sigma, job.head, job.fmt)


def solve_piece(ready: Survey, piece: Piece) -> list[Solved]:
    """The answers to the scans of a piece."""
    solved = []
    for result in invert_over(ready, np.asarray(piece.field_t), piece.sigma_t):
        told = result._replace(scan_index=piece.first + result.scan_index)
        if piece.fmt is None:
            solved.append(Solved(told.scan_index, told.status, b"", told))
        else:
            solved.append(Solved(told.scan_index, told.status, answer(to_message(told, piece.head), piece.fmt)))
    return solved
