"""Batches inverted here, without a network: as the service does it, on as many cores."""

from __future__ import annotations

from collections.abc import Iterator

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import EmiResult, EmiScanBatch
from trackmesh.services.emi.diagnosis.detection import LR_THRESHOLD
from trackmesh.services.emi.service.convert import Head, to_message, to_request
from trackmesh.services.emi.service.pool import Solver
from trackmesh.services.emi.service.work import Job, survey_key


def invert_locally(solver: Solver, batch: EmiScanBatch, lr_threshold: float = LR_THRESHOLD) -> Iterator[EmiResult]:
    """The results of a batch, each as it is done.

    Raises:
        TrackmeshError: the batch names its geometry and does not bring it.
        QueryFailed: a worker process could not do it.
    """
    if batch.geometry is None:
        raise TrackmeshError(f"The batch {batch.batch_id} brings no geometry, only its name {batch.geometry_id}.")
    request = to_request(batch, batch.geometry, lr_threshold)
    ident = batch.geometry.content_id()
    head = Head(batch.batch_id, batch.field_unit, None, ident)
    job = Job(survey_key(request, ident), request, head, None)
    for solved in solver.solve(job, lambda: False, float("inf")):
        assert solved.result is not None
        yield to_message(solved.result, head)
