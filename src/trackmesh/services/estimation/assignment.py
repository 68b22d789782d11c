"""Sparse one-to-one assignment: the set of pairs with the greatest total score, each row and column used once.

Pairs fall into connected components; each is solved exactly by shortest augmenting paths (Jonker and Volgenant 1987, in
the form for rectangular problems), or greedily where a component is so large that the exact solution would
take seconds.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

GREEDY_ABOVE_CELLS = 40_000


@kernel
def assign(row: IntArray, column: IntArray, score: FloatArray, n_rows: int, n_columns: int) -> IntArray:
    """The best one-to-one assignment of a sparse score table; pairs that are not listed score nothing.

    Args:
        row, column: (k,) indices of the listed pairs, each pair at most once.
        score: (k,) positive scores.
        n_rows, n_columns: sizes of the table.

    Returns:
        (n_columns,) row assigned to each column, or -1.
    """
    result = np.full(n_columns, -1, np.int64)
    k = len(row)
    if k == 0:
        return result
    component = components(row, column, n_rows, n_columns)
    order = np.argsort(component, kind="mergesort")
    local_row, local_column = np.full(n_rows, -1, np.int64), np.full(n_columns, -1, np.int64)
    start = 0
    while start < k:
        stop = start + 1
        while stop < k and component[order[stop]] == component[order[start]]:
            stop += 1
        edges = order[start:stop]
        if stop - start == 1:
            result[column[edges[0]]] = row[edges[0]]
        else:
            _solve_component(row, column, score, edges, local_row, local_column, result)
        start = stop
    return result


@kernel
def components(row: IntArray, column: IntArray, n_rows: int, n_columns: int) -> IntArray:
    """Number of the connected component of each pair (k,): pairs that share a row or a column are of one."""
    k = len(row)
    parent = np.arange(n_rows + n_columns)
    for e in range(k):
        a, b = _root(parent, row[e]), _root(parent, n_rows + column[e])
        if a != b:
            parent[max(a, b)] = min(a, b)
    component = np.empty(k, np.int64)
    for e in range(k):
        component[e] = _root(parent, row[e])
    return component


@kernel
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def _solve_component(
    row: IntArray,
    column: IntArray,
    score: FloatArray,
    edges: IntArray,
    local_row: IntArray,
    local_column: IntArray,
    result: IntArray,
) -> None:
    k = len(edges)
    rows, columns = np.empty(k, np.int64), np.empty(k, np.int64)
    nr = nc = 0
    for e in edges:
        if local_row[row[e]] < 0:
            local_row[row[e]] = nr
            rows[nr] = row[e]
            nr += 1
        if local_column[column[e]] < 0:
            local_column[column[e]] = nc
            columns[nc] = column[e]
            nc += 1
    if nr * nc > GREEDY_ABOVE_CELLS:
        _greedy(row, column, score, edges, result)
    else:
        # The shorter side is augmented, so that every augmenting path exists.
        turned = nr > nc
        table = np.zeros((nc, nr)) if turned else np.zeros((nr, nc))
        for e in edges:
            a, b = local_row[row[e]], local_column[column[e]]
            if turned:
                table[b, a] = -score[e]
            else:
                table[a, b] = -score[e]
        chosen = cheapest(table)
        for a in range(len(chosen)):
            b = chosen[a]
            if table[a, b] < 0.0:
                if turned:
                    result[columns[a]] = rows[b]
                else:
                    result[columns[b]] = rows[a]
    for e in edges:
        local_row[row[e]] = -1
        local_column[column[e]] = -1


@kernel
def _greedy(row: IntArray, column: IntArray, score: FloatArray, edges: IntArray, result: IntArray) -> None:
    used = np.zeros(row.max() + 1, np.bool_)
    for e in edges[np.argsort(-score[edges], kind="mergesort")]:
        if not used[row[e]] and result[column[e]] < 0:
            used[row[e]] = True
            result[column[e]] = row[e]


@kernel
def cheapest(cost: FloatArray) -> IntArray:
    """Column of each row in the cheapest full assignment of ``cost`` (n, m), n <= m, by shortest augmenting paths."""
    n, m = cost.shape
    u, v = np.zeros(n + 1), np.zeros(m + 1)
    row_of, way = np.zeros(m + 1, np.int64), np.zeros(m + 1, np.int64)
    for i in range(1, n + 1):
        row_of[0] = i
        j0 = 0
        best = np.full(m + 1, np.inf)
        done = np.zeros(m + 1, np.bool_)
        while True:
            done[j0] = True
            i0 = row_of[j0]
            delta, j1 = np.inf, 0
            for j in range(1, m + 1):
                if not done[j]:
                    reduced = cost[i0 - 1, j - 1] - u[i0] - v[j]
                    if reduced < best[j]:
                        best[j] = reduced
                        way[j] = j0
                    if best[j] < delta:
                        delta, j1 = best[j], j
            for j in range(m + 1):
                if done[j]:
                    u[row_of[j]] += delta
                    v[j] -= delta
                else:
                    best[j] -= delta
            j0 = j1
            if row_of[j0] == 0:
                break
        while j0 != 0:
            j1 = way[j0]
            row_of[j0] = row_of[j1]
            j0 = j1
    chosen = np.full(n, -1, np.int64)
    for j in range(1, m + 1):
        if row_of[j] > 0:
            chosen[row_of[j] - 1] = j - 1
    return chosen
