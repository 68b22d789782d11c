"""What the fusion engine costs as the number of targets grows: by scans and by 32 sectors, on the two-radar scenario.

python -m benchmarks.fusion_cost                                     the table, a minute or two
python -m benchmarks.fusion_cost --plot docs/fusion-cost.png         and the figure
python -m benchmarks.fusion_cost --targets 50,3000 --seconds 40      other cases

Processor time of one process is measured, tracks from a cold start included; the figure shows the second half.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import peer_scenario
from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.warm_up import warm_up

TARGETS = (10, 20, 50, 100, 200, 500, 1000, 2000, 3000, 5000)
MODES = {"scans": 1, "32 sectors": 32}
SEED = 2


class Cost(NamedTuple):
    """Processor time of one case.

    Attributes:
        spent_s: (b,) of each batch; ``plots`` (b,) how many it had; ``at_s`` (b,) when it came.
        tracks: confirmed at the end.
    """

    targets: int
    mode: str
    spent_s: FloatArray
    plots: IntArray
    at_s: FloatArray
    tracks: int

    @property
    def steady(self) -> slice:
        """The second half of the time, when nearly all tracks are there."""
        return slice(int(np.searchsorted(self.at_s, 0.5 * self.at_s[-1])), None)

    @property
    def plots_per_s(self) -> float:
        """Plots a CPU second, over all."""
        return float(self.plots.sum() / self.spent_s.sum())

    @property
    def plot_us(self) -> float:
        """Microseconds a plot, in the second half."""
        return float(self.spent_s[self.steady].sum() / self.plots[self.steady].sum() * 1e6)

    @property
    def share(self) -> float:
        """Share of one core that the sensors keep busy, in the second half."""
        part = self.steady
        return float(self.spent_s[part].sum() / (self.at_s[-1] - self.at_s[part][0]))

    @property
    def worst_share(self) -> float:
        """The same in the busiest second of all."""
        seconds = (self.at_s - self.at_s[0]).astype(np.int64)
        return float(np.bincount(seconds, self.spent_s).max())

    @property
    def batch_ms(self) -> tuple[float, float]:
        """Milliseconds a batch, median and 99th percentile, in the second half."""
        median, high = np.percentile(self.spent_s[self.steady], [50, 99]) * 1e3
        return float(median), float(high)


def measure(targets: int, mode: str, duration_s: float, settings: EngineSettings) -> Cost:
    """Track one case; the time of making frames counts."""
    case = peer_scenario.make(SEED, targets, MODES[mode], duration_s)
    engine = FusionEngine(settings, Unit())
    for sensor in case.sensors:
        engine.sensor(sensor)
    spent_s = np.zeros(len(case.batches))
    for k, batch in enumerate(case.batches):
        started_s = time.process_time()
        engine.plots(batch)
        spent_s[k] = time.process_time() - started_s
    plots = np.array([len(batch.t_ns) for batch in case.batches])
    at_s = np.array([scan.time_s for scan in case.scenario.scans])
    return Cost(targets, mode, spent_s, plots, at_s, int(engine.figures()["tracks"]))


def duration_s(targets: int) -> float:
    """Fewer targets are watched for longer, so that there is something to measure."""
    return float(np.clip(20_000.0 / targets, 40.0, 120.0))


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``: microseconds a plot, and the share of one core of 3000 targets."""
    if not peer_scenario.available():
        print("fusion-cost: the peer study is not beside the repository, left out")
        return
    for cost in costs(TARGETS, None):
        print(_line(cost), flush=True)
        yield _row(f"{cost.targets} targets, {cost.mode}", cost.plot_us, "us/plot")
        if cost.targets == 3000:
            yield _row(f"3000 targets, {cost.mode}, share of one core", 100.0 * cost.share, "%")


def costs(targets: tuple[int, ...], seconds: float | None) -> Iterator[Cost]:
    """Every case, after one that compiles and warms up."""
    settings = EngineSettings()
    warm_up(settings)
    for mode in MODES:
        measure(10, mode, 30.0, settings)
    for mode in MODES:
        for n in targets:
            yield measure(n, mode, seconds or duration_s(n), settings)


def draw(found: list[Cost], path: Path) -> None:
    """Microseconds a plot, and the share of one core, against the number of targets."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import FuncFormatter, NullFormatter

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.6), layout="constrained")
    for mode, colour in zip(MODES, ("#1f5fa8", "#c2571a"), strict=True):
        ours = [cost for cost in found if cost.mode == mode]
        if not ours:
            continue
        n = [cost.targets for cost in ours]
        left.loglog(n, [cost.plot_us for cost in ours], "o-", color=colour, label=f"by {mode}")
        right.loglog(n, [100.0 * cost.share for cost in ours], "o-", color=colour, label=f"by {mode}")
        middle = min(ours, key=lambda cost: abs(cost.targets - 1000))
        ends = np.array([min(n), max(n)], float)
        left.loglog(ends, np.full(2, middle.plot_us), ":", color=colour, lw=1)
        right.loglog(ends, 100.0 * middle.share * ends / middle.targets, ":", color=colour, lw=1)
    left.plot([], [], "k:", lw=1, label="linear growth, through 1000 targets")
    right.axhline(100.0, color="black", lw=1)
    right.annotate("one core, real time", (min(c.targets for c in found), 100.0), (0, -12), textcoords="offset points")
    left.set(ylabel="CPU time per plot, µs", title="What a plot costs")
    right.set(ylabel="share of one core, %", title="What two radars (4 s and 5 s) cost")
    for axes in (left, right):
        axes.set_xlabel("targets")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(plain)
            axis.set_minor_formatter(NullFormatter())
        axes.grid(visible=True, which="both", color="0.9")
    left.set_ylim(10.0, 1000.0)
    left.legend(loc="upper right")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _line(cost: Cost) -> str:
    median, high = cost.batch_ms
    return (
        f"{cost.targets:5d} targets, {cost.mode:10}: {cost.plots_per_s:7.0f} plots/CPU s, "
        f"{cost.plot_us:6.1f} us a plot, "
        f"batch p50 {median:6.2f} p99 {high:6.2f} ms, {100 * cost.share:6.2f} % of a core "
        f"(busiest second {100 * cost.worst_share:.1f} %), {cost.tracks} tracks"
    )


def _row(case: str, value: float, unit: str) -> dict[str, object]:
    return {
        "bench": "fusion-cost", "case": case, "value": value, "unit": unit,
        "peer": None, "peer_value": None, "ratio": None,
    }  # fmt: skip


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--targets", default=",".join(map(str, TARGETS)), metavar="N,N")
    ask.add_argument("--seconds", type=float, help="of the scenario; default: 40 to 120, fewer for more targets")
    ask.add_argument("--plot", type=Path, metavar="FILE", help="picture to write")
    given = ask.parse_args()
    if not peer_scenario.available():
        sys.exit("fusion_cost: the peers' scenario is not beside the repository.")
    found = []
    for cost in costs(tuple(map(int, given.targets.split(","))), given.seconds):
        found.append(cost)
        print(_line(cost), flush=True)
    if given.plot:
        draw(found, given.plot)


if __name__ == "__main__":
    main()
