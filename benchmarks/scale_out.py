"""Two or three units against one engine over everything: identities over borders, deaths, losses, delays.

python -m benchmarks.scale_out                          every case, seeds 2 and 3: some minutes
python -m benchmarks.scale_out --cases nominal,death --json out.json --plot out.png
python -m benchmarks.scale_out --list

The border is the line 20 km east of the first radar, through the middle of the peers' scenario. Crossers are targets
that are more than 2 km deep on both sides between 60 s and 5 s before the end; one is kept if it has the same track
then as it had at 60 s.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks import peer_scenario, trials, units, verdicts
from benchmarks.trials import Trial
from benchmarks.units import Cut, Death, HardBorder, Link, Run
from trackmesh.protocol.messages import TrackFrame
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.partition.areas import Place
from trackmesh.services.fusion.partition.engine import PartitionedEngine
from trackmesh.services.fusion.settings import EngineSettings

Figures = dict[str, float]
Shown = list[tuple[float, TrackFrame]]

BORDER_M, DEEP_M, FROM_S = 20e3, 2e3, 60.0
HALVES = (Place(np.array([0.0, 5e3])), Place(np.array([40e3, 5e3])))
CORNER = (Place(np.array([0.0, 25e3])), Place(np.array([40e3, 25e3])), Place(np.array([20e3, -15e3])))
"""Three cells that meet in one point in the middle, (20, 12.5) km."""

RECTANGLES = tuple(
    Place(corners.mean(axis=0), corners)
    for corners in (
        np.array([[east, -60e3], [east + 80e3, -60e3], [east + 80e3, 80e3], [east, 80e3]]) for east in (-60e3, 20e3)
    )
)

DEATH_S = 150.0


class Case(NamedTuple):
    """One hardship: a trial, and what happens to the units."""

    about: str
    make: Callable[[int, float, int], Trial]
    link: Link = Link(0.05)
    death: Death | None = None
    places: tuple[Place, ...] = HALVES
    width_m: float = 10_000.0
    times: int = 1
    kind: type[PartitionedEngine] = PartitionedEngine
    standby: bool = False
    targets: int = 200
    cut: Cut | None = None


def _nominal(seed: int, duration_s: float, n: int) -> Trial:
    return trials.trial(seed, duration_s, n)


def _biased(seed: int, duration_s: float, n: int) -> Trial:
    return trials.biased(_nominal(seed, duration_s, n), trials.EAST, 150.0, 0.4)


def _formation(seed: int, duration_s: float, n: int) -> Trial:
    return trials.trial(seed, duration_s, n, rearrange=trials.in_pairs(seed, 500.0))


def _rare(seed: int, duration_s: float, n: int) -> Trial:
    return trials.trial(seed, duration_s, n, radars={"p_detect": 0.7})


def _hard(seed: int, duration_s: float, n: int) -> Trial:
    return trials.trial(seed, duration_s, n, radars={"p_detect": 0.7, "clutter_per_scan": 200.0})


def death_of(case: Case, t_s: float) -> Case:
    """The case with its death at another time."""
    assert case.death is not None
    return case._replace(death=case.death._replace(t_s=t_s))


def _dead(heirs: str = "frames", noticed_s: float = 2.0, back_s: float | None = None) -> Death:
    return Death("unit-1", DEATH_S, noticed_s, back_s, heirs)


CASES: dict[str, Case] = {
    "hard border": Case("the control: own ids on each side, no exchange", _nominal, kind=HardBorder),
    "nominal": Case("two units, 5 % of the band messages lost", _nominal),
    "nominal 50": Case("the same with 50 targets", _nominal, targets=50),
    "bias": Case("one radar 150 m and 0.4 degrees wrong", _biased),
    "formation": Case("pairs 500 m apart", _formation),
    "Pd .7": Case("plots missing", _rare),
    "Pd .7, clutter 200, 50": Case("and ten times the clutter", _hard, targets=50),
    "band 3 km": Case("a narrower band", _nominal, width_m=3000.0),
    "band 5 km": Case("a narrower band", _nominal, width_m=5000.0),
    "band 15 km": Case("a wider band", _nominal, width_m=15_000.0),
    "20 % lost": Case("of the band messages", _nominal, link=Link(0.2)),
    "50 % lost": Case("of the band messages", _nominal, link=Link(0.5)),
    "4 s late": Case("band messages", _nominal, link=Link(0.05, 4.0)),
    "twice": Case("every batch delivered twice", _nominal, times=2),
    "corner": Case("three units that meet in the middle", _nominal, places=CORNER),
    "polygons": Case("two rectangles instead of Voronoi cells", _nominal, places=RECTANGLES),
    "cut 20 s": Case("no unit hears the other from 150 to 170 s", _nominal, cut=Cut(DEATH_S, DEATH_S + 20.0)),
    "polygons, death": Case("the heir takes over the polygon", _nominal, places=RECTANGLES, death=_dead()),
    "death, cold": Case("unit 1 killed at 150 s, its neighbour knows nothing of it", _nominal, death=_dead("cold")),
    "death, band": Case("its neighbour knows the band", _nominal, death=_dead("band")),
    "death": Case("its neighbour goes on from its last picture", _nominal, death=_dead()),
    "death, .1 s": Case("noticed after 0.1 s", _nominal, death=_dead(noticed_s=0.1)),
    "death, 6 s": Case("noticed after 6 s", _nominal, death=_dead(noticed_s=6.0)),
    "death, bias": Case("with one radar wrong", _biased, death=_dead()),
    "death, formation": Case("with pairs 500 m apart", _formation, death=_dead()),
    "death, standby": Case("a unit stands by", _nominal, death=_dead(), standby=True),
    "death, return": Case("and the unit is back 60 s later", _nominal, death=_dead(back_s=DEATH_S + 60.0)),
    "corner, death": Case("one of three that meet dies", _nominal, places=CORNER, death=_dead()),
}


def run_case(case: Case, seed: int, duration_s: float = 300.0, targets: int | None = None) -> Figures:
    """One run of a case; figures as in ``figures``, those of the single engine as ``single_...``."""
    trial = case.make(seed, duration_s, targets or case.targets)
    single = figures(trial, single_engine(trial))
    run = several_units(case, trial, seed)
    found = (
        figures(trial, run.shown)
        | _of_death(trial, run, case)
        | {f"single_{name}": value for name, value in single.items()}
    )
    late = int(0.15 * len(run.doubles))
    told = [len(one.track_id) for one in run.realm.told]
    return found | {
        "doubles": float(run.doubles[late:].mean()),
        "band_tracks": float(np.mean(told)),
        "switches_more": found["switches"] - single["switches"],
        "gospa_ratio": found["gospa_m"] / single["gospa_m"],
    }


def single_engine(trial: Trial) -> Shown:
    """The pictures of one engine over everything."""
    engine = FusionEngine(EngineSettings(), Unit())
    for sensor in trial.sensors:
        engine.sensor(sensor)
    return verdicts.drive(engine, trial)[0]


def several_units(case: Case, trial: Trial, seed: int) -> Run:
    """The merged pictures of the units."""
    realm = units.make_realm(
        trial, case.places, EngineSettings(), width_m=case.width_m, link=case.link, seed=seed, kind=case.kind,
        standby=case.standby,
    )  # fmt: skip
    return units.drive(realm, trial, case.death, case.times, case.cut)


def figures(trial: Trial, shown: Shown) -> Figures:
    """``verdicts.picture_figures``, crossers and the share of them that is kept, and duplicates.

    ``duplicates`` are tracks beyond the first within 500 m of a target that is nearest to them, a frame;
    ``wrong`` counts ids that stand twice in a merged picture.
    """
    found = verdicts.picture_figures(trial, shown)
    cross = crossers(trial)
    before, after = (verdicts._followers(trial, shown, t_s) for t_s in (FROM_S, trial.duration_s - 5.0))
    found["crossers"] = float(cross.sum())
    found["kept_pct"] = 100.0 * float(((before == after) & (before >= 0))[cross].mean()) if cross.any() else np.nan
    found["wrong"] = float(sum(len(f.track_id) - len(np.unique(f.track_id)) for _, f in shown))
    found["duplicates"] = float(np.mean([_duplicates(trial, t_s, f) for t_s, f in shown if t_s >= verdicts.WARMUP_S]))
    return found


def crossers(trial: Trial) -> npt.NDArray[np.bool_]:
    """Which targets (n,) fly over the border."""
    while_ = (trial.truth_t_s >= FROM_S) & (trial.truth_t_s <= trial.duration_s - 5.0)
    east = trial.truth[while_][:, :, 0] - BORDER_M
    return np.asarray((east.min(axis=0) < -DEEP_M) & (east.max(axis=0) > DEEP_M))


def _duplicates(trial: Trial, t_s: float, frame: TrackFrame) -> int:
    """Tracks beyond the first within 500 m of a target that is nearest to them."""
    from scipy.spatial import KDTree

    distance, nearest = KDTree(trial.state_at(t_s)[:, :2]).query(frame.state[:, :2])
    near = nearest[distance < 500.0]
    return len(near) - len(np.unique(near))


def _of_death(trial: Trial, run: Run, case: Case) -> Figures:
    """Of the targets that the dead unit showed: which share is shown some seconds later, and which keeps its id."""
    death = case.death
    if death is None:
        return {}
    before = verdicts._followers(trial, run.shown, death.t_s - 0.01)
    theirs = np.isin(before, run.realm.died_with)
    found = {"died_with": float(theirs.sum())}
    for later_s in (4, 8, 12, 16, 30, 60):
        if death.t_s + later_s > trial.duration_s:
            continue
        after = verdicts._followers(trial, run.shown, death.t_s + later_s)
        found[f"shown_{later_s}_pct"] = 100.0 * float((after >= 0)[theirs].mean())
        found[f"ids_{later_s}_pct"] = 100.0 * float((after == before)[theirs].mean())
    return found


# --- the command ---

_COLUMNS = ("crossers", "kept_pct", "switches", "single_switches", "gospa_ratio", "false", "duplicates", "doubles")


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--cases", metavar="A,B", help="names, separated by semicolons or commas; default: all")
    ask.add_argument("--seeds", default="2,3")
    ask.add_argument("--json", type=Path, metavar="FILE")
    ask.add_argument("--plot", type=Path, metavar="FILE.png")
    ask.add_argument("--list", action="store_true")
    given = ask.parse_args()
    if given.list:
        print("\n".join(f"{name:24} {case.about}" for name, case in CASES.items()))
        return
    if not peer_scenario.available():
        sys.exit("scale_out: the peers' scenario is not beside the repository.")
    names = _names(given.cases)
    seeds = [int(seed) for seed in given.seeds.split(",")]
    rows = []
    for name in names:
        for seed in seeds:
            found = run_case(CASES[name], seed)
            rows.append({"case": name, "seed": seed} | {key: _finite(value) for key, value in found.items()})
            print(_line(name, seed, found), flush=True)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    if given.plot:
        from benchmarks.scale_out_chart import draw

        draw(rows, given.plot)


def _names(text: str | None) -> list[str]:
    if not text:
        return list(CASES)
    names = [name.strip() for name in text.split(";" if ";" in text else ",")]
    unknown = [name for name in names if name not in CASES]
    if unknown:
        sys.exit(f"scale_out: there is no case {unknown[0]!r}; see --list.")
    return names


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _line(name: str, seed: int, found: Figures) -> str:
    parts = [f"{name:24} seed {seed}"] + [f"{key} {found[key]:.4g}" for key in _COLUMNS]
    parts += [f"{key} {found[key]:.3g}" for key in found if key.startswith(("shown_", "ids_"))]
    return "  ".join(parts)


if __name__ == "__main__":
    main()
