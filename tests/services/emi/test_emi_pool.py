"""Real worker processes: shared out, killed, given up."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from tests.network.processes import wait_until

from trackmesh.protocol.codec import open_envelope
from trackmesh.protocol.errors import QueryFailed
from trackmesh.protocol.messages import EmiResult, EmiScanBatch
from trackmesh.services.emi.service.convert import Head, to_request
from trackmesh.services.emi.service.pool import OwnWork, WorkerPool
from trackmesh.services.emi.service.work import Job, Solved, pieces, survey_key
from trackmesh.sim.emi import random_targets, simulate, survey_geometry

GEOMETRY = survey_geometry((2.0, 2.0), 0.2)
FOREVER_S = float("inf")


@pytest.fixture(scope="module")
def pool() -> Iterator[WorkerPool]:
    pool = WorkerPool(2)
    assert pool.wait_ready(threading.Event())
    yield pool
    pool.close()


def job(n: int = 40, *, spoil: bool = False, as_bytes: bool = True, seed: int = 1) -> Job:
    batch: EmiScanBatch = simulate(GEOMETRY, random_targets(n, seed, spread_m=0.5), 30.0, seed).batch
    request = to_request(batch, GEOMETRY, 45.0)
    if spoil:
        # Not what a checked batch can hold: the worker's own defence.
        request = request._replace(sigma_t=np.ones(7))
    ident = GEOMETRY.content_id()
    return Job(survey_key(request, ident), request, Head("b", "nT", "main", ident), "msgpack" if as_bytes else None)


def never() -> bool:
    return False


def by_scan(solved: Iterator[Solved]) -> dict[int, Solved]:
    return {one.scan: one for one in solved}


def test_pieces_are_all_scans_and_enough_for_all_workers() -> None:
    cut = list(pieces(job(40), 2))
    assert [piece.first for piece in cut] == list(range(0, 40, 5))
    assert sum(len(piece.field_t) for piece in cut) == 40


def test_workers_give_the_bytes_that_the_service_itself_would(pool: WorkerPool) -> None:
    there, here = by_scan(pool.solve(job(), never, FOREVER_S)), by_scan(OwnWork().solve(job(), never, FOREVER_S))
    assert sorted(there) == list(range(40))
    assert there == here
    result = open_envelope(there[7].payload, "", EmiResult)
    assert isinstance(result, EmiResult) and result.index == 7 and result.status == there[7].status


def test_results_come_as_they_are_where_no_bytes_are_wanted(pool: WorkerPool) -> None:
    solved = by_scan(pool.solve(job(10, as_bytes=False), never, FOREVER_S))
    assert all(one.result is not None and one.result.scan_index == i for i, one in solved.items())


def test_requests_side_by_side_are_not_mixed_up(pool: WorkerPool) -> None:
    found: dict[int, dict[int, Solved]] = {}

    def ask(seed: int) -> None:
        found[seed] = by_scan(pool.solve(job(seed=seed), never, FOREVER_S))

    threads = [threading.Thread(target=ask, args=(seed,)) for seed in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert all(found[seed] == by_scan(OwnWork().solve(job(seed=seed), never, FOREVER_S)) for seed in (1, 2, 3))


def test_a_worker_that_is_killed_is_replaced_and_nothing_is_lost(pool: WorkerPool) -> None:
    before = set(pool.pids)
    answers = pool.solve(job(200), never, FOREVER_S)
    first = next(answers)
    os.kill(pool.pids[0], signal.SIGKILL)
    rest = by_scan(answers)
    assert sorted(rest.keys() | {first.scan}) == list(range(200))
    wait_until(lambda: len(set(pool.pids) - before) == 1, "another worker is started", 30.0)


def test_a_piece_that_cannot_be_solved_fails_its_request_alone(pool: WorkerPool) -> None:
    with pytest.raises(QueryFailed, match="log says why"):
        list(pool.solve(job(spoil=True), never, FOREVER_S))
    assert len(by_scan(pool.solve(job(), never, FOREVER_S))) == 40


def test_work_ends_when_nobody_wants_it_and_at_the_deadline(pool: WorkerPool) -> None:
    unwanted = threading.Event()
    answers = pool.solve(job(400), unwanted.is_set, FOREVER_S)
    next(answers)
    unwanted.set()
    assert len(list(answers)) < 390
    assert list(pool.solve(job(), never, time.monotonic())) == []
    assert len(by_scan(pool.solve(job(), never, FOREVER_S))) == 40


def test_a_closed_pool_leaves_no_process() -> None:
    pool = WorkerPool(1)
    assert pool.wait_ready(threading.Event())
    (pid,) = pool.pids
    pool.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
