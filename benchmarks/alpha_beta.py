"""The alpha-beta filter: nanoseconds a track update (one plot, two coordinates) for one track and for very many.

python -m benchmarks.alpha_beta        beside FilterPy's filter with constant gains, one object a track
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import filterpy
import numpy as np
from filterpy.gh import GHFilter

from trackmesh.services.estimation import alpha_beta

SIZES = (1, 100, 1_000, 10_000, 100_000)
REPEATS = 7
LEAST_S = 0.05
"""Each repeat lasts at least this long."""


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``: the median of some repeats."""
    peer_ns = float(np.median(_nanoseconds(_peer(), 100)))
    print(f"alpha-beta FilterPy {filterpy.__version__}: {peer_ns:.0f} ns a track update")
    for n in SIZES:
        for name, call in _calls(n).items():
            spent = _nanoseconds(call, n)
            case = f"{name} N={n}"
            print(f"alpha-beta {case}: {np.median(spent):.1f} ns (min {min(spent):.1f}, max {max(spent):.1f})")
            yield _row(case, float(np.median(spent)), peer_ns if name != "bank estimate" else None)


def _calls(n: int) -> dict[str, Callable[[], object]]:
    """What a service would call for n tracks of different ages and intervals; gains are made anew each time."""
    rng = np.random.default_rng(1)
    x, z, row = rng.normal(size=(n, 4)), rng.normal(size=(n, 2)), np.arange(n)
    dt_s, k, k_end = rng.uniform(1.0, 1.5, n), rng.integers(1, 50, n), np.full(n, 7)
    bank = alpha_beta.make_bank(n)

    def held() -> object:
        return alpha_beta.step(x, z, dt_s, k, *alpha_beta.decreasing_gains(np.minimum(k, k_end)))

    def combined() -> object:
        index = alpha_beta.manoeuvring_index(dt_s, 2.0, 10.0)
        return alpha_beta.step(x, z, dt_s, k, *alpha_beta.combined_gains(k, index))

    def fed() -> None:
        alpha_beta.feed_bank(bank, row, z, dt_s)

    def estimated() -> object:
        return alpha_beta.bank_estimate(bank, row, dt_s)

    return {"k_end": held, "combined": combined, "bank": fed, "bank estimate": estimated}


def _peer() -> Callable[[], None]:
    plots = np.random.default_rng(1).normal(size=(100, 2))
    filters = [GHFilter(np.zeros(2), np.zeros(2), 1.0, 0.5, 0.2) for _ in plots]

    def call() -> None:
        for one, plot in zip(filters, plots, strict=True):
            one.update(plot)

    return call


def _nanoseconds(call: Callable[[], object], n: int) -> list[float]:
    """Nanoseconds a track of each repeat."""
    for _ in range(3):
        call()
    started = time.perf_counter()
    call()
    times = max(1, int(LEAST_S / max(time.perf_counter() - started, 1e-7)))
    spent = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        for _ in range(times):
            call()
        spent.append((time.perf_counter() - started) / times / n * 1e9)
    return spent


def _row(case: str, value: float, peer_value: float | None) -> dict[str, object]:
    known = peer_value is not None
    return {
        "bench": "alpha-beta", "case": case, "value": value, "unit": "ns/track update",
        "peer": f"FilterPy {filterpy.__version__} GHFilter" if known else None,
        "peer_value": peer_value, "ratio": value / peer_value if peer_value is not None else None,
    }  # fmt: skip


if __name__ == "__main__":
    for _ in rows():
        pass
