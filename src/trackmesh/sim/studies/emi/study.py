"""``trackmesh study emi``: the thesis's tables and claims beside ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.estimators import EstimatorName
from trackmesh.sim.studies.emi import charts, claims, efficiency
from trackmesh.sim.studies.emi.claims import AngleErrors, Case
from trackmesh.sim.studies.emi.diagnosis import Apart, Detection, DipoleBias, detection, dipole_bias, two_targets
from trackmesh.sim.studies.emi.efficiency import Efficiency
from trackmesh.sim.studies.emi.setting import ATTITUDES_DEG, world
from trackmesh.sim.studies.result import StudyResult, Table, study_row

RUNS = 60
PRINTED_DEG = ((1.2, 2.1), (0.5, 2.4), (1.6, 3.9), (0.6, 2.0), (1.0, 0.1), (0.26, 0.71), (0.61, 25.2))
"""Table 5-4: errors of pitch and roll."""
CLAIMED = {"5-17": (2.0, 4.0), "5-18": (3.0, 8.0)}
"""Position (cm) and polarizability (%) that the thesis claims to stay below."""
BAND = (0.88, 1.12)
SHOWN: tuple[EstimatorName, ...] = ("varpro", "ekf9", "kf-ekf-thesis")
INITIAL_SPHERE, INITIAL_ROD = "5-8, 5-10, 5-13", "5-9, 5-12, 5-14"


def run(plots: Path | None = None, runs: int = 0, progress: Callable[[float], None] | None = None) -> StudyResult:
    """All tables, and pictures into the folder ``plots``.

    Args:
        plots: folder of the pictures, made where missing; None for none.
        runs: draws of each case (the recursive filters get a quarter of them); 0 for ``RUNS``.
        progress: is told the share that is done.

    Raises:
        TrackmeshError: a picture cannot be drawn.
    """
    say = progress or (lambda _: None)
    runs = runs or RUNS
    here = world()
    cases = claims.measured(here, runs, lambda share: say(0.35 * share))
    angles = {name: claims.angle_errors(here, name, runs) for name in claims.FILTERS}
    say(0.45)
    measured = efficiency.measured(here, runs, lambda share: say(0.45 + 0.4 * share))
    bias, seen = dipole_bias(), detection(runs)
    say(0.93)
    apart = two_targets(max(4, runs // 5))
    result = StudyResult()
    result.rows += [*_angle_rows(angles["varpro"]), *_crlb_rows(measured), *_other_rows(cases, bias, seen, apart)]
    result.tables += [_angle_table(angles), _claim_table(cases), _crlb_table(measured), _coverage_table(measured)]
    result.tables += [_bias_table(bias), _seen_table(seen), _apart_table(apart)]
    result.notes += _notes(measured)
    if plots is not None:
        result.pictures += charts.draw_all(plots, here, cases, measured, bias)
    say(1.0)
    return result


def _angle_rows(ours: Sequence[AngleErrors]) -> Iterator[dict[str, object]]:
    for one, printed in zip(ours, PRINTED_DEG, strict=True):
        for i, column in enumerate(("theta", "phi")):
            yield study_row(
                "5-4", _attitude(one.attitude_deg), column,
                paper=printed[i], ours=float(one.mean_deg[i]), ours_std=float(one.std_deg[i]), runs=one.n,
            )  # fmt: skip


def _crlb_rows(measured: Sequence[Efficiency]) -> Iterator[dict[str, object]]:
    for one in measured:
        row = f"{one.target}, {one.snr_db:g} dB"
        spread = one.ratio / np.sqrt(6.0 * one.n)
        yield study_row("crlb", row, one.estimator, paper=None, ours=one.ratio, ours_std=float(spread), runs=one.n)


def _other_rows(
    cases: Sequence[Case], bias: Sequence[DipoleBias], seen: Detection, apart: Sequence[Apart]
) -> Iterator[dict[str, object]]:
    for case in cases:
        claimed = CLAIMED.get(case.figure, (None, None))
        row, n = f"{case.curve}, {case.at:g}", case.errors.n
        yield study_row(case.figure, row, f"{case.estimator} position", paper=claimed[0],
                        ours=case.errors.position_cm, runs=n)  # fmt: skip
        yield study_row(case.figure, row, f"{case.estimator} polarizability", paper=claimed[1],
                        ours=case.errors.tensor_percent, runs=n)  # fmt: skip
    for one in bias:
        yield study_row("dipole", f"{one.body}, {one.depth_m:g} m", "bias cm", paper=None, ours=one.bias_cm)
    for snr, share in seen.seen.items():
        yield study_row("detection", f"{snr:g} dB", "seen", paper=None, ours=share, runs=seen.runs)
    alarms = seen.false_alarms / seen.noise_scans
    yield study_row("detection", "noise", "false alarms", paper=None, ours=alarms, runs=seen.noise_scans)
    for two in apart:
        row = f"{two.apart_m:g} m, {two.snr_db:g} dB"
        yield study_row("two targets", row, "told", paper=None, ours=two.two_told, runs=two.runs)


def _angle_table(angles: Mapping[EstimatorName, list[AngleErrors]]) -> Table:
    body = []
    for i, (attitude, printed) in enumerate(zip(ATTITUDES_DEG, PRINTED_DEG, strict=True)):
        found = [angles[name][i] for name in SHOWN]
        pairs = [f"{a.mean_deg[0]:.2f}, {a.mean_deg[1]:.2f}" for a in found]
        body.append([_attitude(attitude), f"{printed[0]:g}, {printed[1]:g}", *pairs, f"{found[0].mean_deg[2]:.2f}"])
    header = ["pitch, roll", "thesis", *SHOWN, "varpro: axis"]
    return Table("Table 5-4: mean errors of pitch and roll, degrees, cylinder at 20 dB", header, body)


def _attitude(attitude: tuple[int, int]) -> str:
    return f"({attitude[0]}, {attitude[1]})"


class _Claim(NamedTuple):
    """A sentence of the thesis on errors (the ``value``-th of them) in a figure; on some of its points only."""

    what: str
    claimed: str
    figure: str
    value: int
    curve: str = ""
    least: float = 0.0


STARTS = (
    _Claim("horizontal start, sphere, >= 10 dB", "< 1 cm", INITIAL_SPHERE, 0, least=10.0),
    _Claim("horizontal start, cylinder", "< 10 cm", INITIAL_ROD, 0),
    _Claim("depth start, sphere, >= 20 dB", "6 cm", INITIAL_SPHERE, 1, least=20.0),
    _Claim("depth start, lying cylinder", "12 cm", INITIAL_ROD, 1, curve="roll 90"),
)
ACCURACY = (
    _Claim("position, sphere, 0 to 40 dB", "< 2 cm", "5-17", 2),
    _Claim("position, sphere, 20 dB and more", "< 2 cm", "5-17", 2, least=20.0),
    _Claim("polarizability, sphere, 20 dB and more", "< 4 %", "5-17", 3, least=20.0),
    _Claim("position, cylinder", "< 3 cm", "5-18", 2),
    _Claim("polarizability, cylinder", "< 8 %", "5-18", 3),
)


def _claim_table(cases: Sequence[Case]) -> Table:
    asked: list[tuple[_Claim, EstimatorName]] = [(claim, "initial") for claim in STARTS]
    asked += [(claim, name) for claim in ACCURACY for name in claims.FILTERS]
    body = []
    for claim, name in asked:
        points = [c for c in cases if c.figure == claim.figure and c.estimator == name]
        found = [c.errors[claim.value] for c in points if claim.curve in c.curve and c.at >= claim.least]
        body.append([claim.what, claim.claimed, name, f"{min(found):.2f} to {max(found):.2f}"])
    return Table("What the thesis claims (mean errors over SNR or attitude)", ["what", "thesis", "by", "found"], body)


def _crlb_table(measured: Sequence[Efficiency]) -> Table:
    body = []
    for target in dict.fromkeys(one.target for one in measured):
        for snr in dict.fromkeys(one.snr_db for one in measured):
            found = {o.estimator: o for o in measured if o.target == target and o.snr_db == snr}
            ratios = [f"{found[name].ratio:.2f}" for name in efficiency.ESTIMATED]
            body.append([target, f"{snr:g}", f"{found['varpro'].bound_cm:.3g}", *ratios])
    header = ["target", "SNR dB", "bound cm", *efficiency.ESTIMATED]
    return Table("RMSE / sqrt(CRLB) of the position", header, body)


def _coverage_table(measured: Sequence[Efficiency]) -> Table:
    body = []
    for target in dict.fromkeys(one.target for one in measured):
        found = [o for o in measured if o.target == target and o.coverage is not None]
        body.append([target, *(f"{o.coverage:.3f}" for o in found)])
    header = ["target", *(f"{snr:g} dB" for snr in claims.SNRS_DB)]
    return Table("How often the 95 % ellipsoid of position and tensor holds the truth", header, body)


def _bias_table(bias: Sequence[DipoleBias]) -> Table:
    body = []
    for b in bias:
        numbers = [f"{b.depth_m:g}", f"{b.bias_cm:.1f}", f"{b.tensor_percent:.0f}", f"{b.loop_cm:.1e}"]
        body.append([b.body, *numbers, "yes" if b.warned else "no"])
    header = ["target", "depth m", "too deep by cm", "tensor %", "with the loop cm", "warned"]
    return Table("A loop's scan without noise, inverted as if its coil were a point dipole", header, body)


def _seen_table(seen: Detection) -> Table:
    body = [["noise alone", f"{seen.false_alarms} of {seen.noise_scans}"]]
    body += [[f"sphere at 1 m, {snr:g} dB", f"{share:.0%}"] for snr, share in seen.seen.items()]
    return Table("A target is told", ["scan", "told"], body)


def _apart_table(apart: Sequence[Apart]) -> Table:
    body = [[f"{a.apart_m:g}", f"{a.snr_db:g}", f"{a.two_told:.0%}", f"{a.error_cm:.1f}"] for a in apart]
    header = ["apart m", "SNR dB", "two told", "worse error cm"]
    return Table("A sphere at 0.9 m and a cylinder at 0.8 m side by side, up to three targets allowed", header, body)


def _notes(measured: Sequence[Efficiency]) -> Iterator[str]:
    ours = [one for one in measured if one.estimator == "varpro"]
    ratios = [one.ratio for one in ours]
    held = [one.coverage for one in ours if one.coverage is not None and one.snr_db >= 10.0]
    outside = sum(not BAND[0] <= ratio <= BAND[1] for ratio in ratios)
    yield (
        f"varpro: RMSE / sqrt(CRLB) {min(ratios):.2f} to {max(ratios):.2f} over {len(ratios)} cases, {outside} of them "
        f"outside {BAND[0]} to {BAND[1]}; the ratio of {ours[0].n} draws is good to {1 / np.sqrt(6.0 * ours[0].n):.0%}"
    )
    yield f"coverage of its 95 % ellipsoids at 10 dB and more: {min(held):.2f} to {max(held):.2f}"
    yield "at pitch 90 degrees roll is not defined: the default answers null, the table shows what it would have been"
