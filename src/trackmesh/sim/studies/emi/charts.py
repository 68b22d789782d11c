"""The figures of the thesis anew, and what it has not: efficiency, the price of a dipole, a fit with its ellipse."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.emi.estimators import Enough, EstimatorName, Task
from trackmesh.services.emi.estimators.thesis import filtered_state
from trackmesh.sim.drawing import INK, MUTED
from trackmesh.sim.emi import Buried
from trackmesh.sim.emi_drawing import FIELD_MAP, MapOf, draw_map, ellipse
from trackmesh.sim.studies.charts import dress, figure_title, log_ticks, new_figure, save, title
from trackmesh.sim.studies.emi.claims import Case
from trackmesh.sim.studies.emi.diagnosis import DipoleBias
from trackmesh.sim.studies.emi.efficiency import Efficiency
from trackmesh.sim.studies.emi.setting import (
    SNR_DB,
    World,
    clean_t,
    draws,
    estimates,
    noise_t,
    results,
    rod,
    sphere,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = {"varpro": "#1769aa", "ekf9": "#2a9d6f", "kf-ekf-thesis": "#d1495b", "initial": "#e08a1e"}
ROLLS = {"roll 0": "#1769aa", "roll 45": "#d1495b", "roll 90": "#2a9d6f"}
OTHERS: tuple[EstimatorName, ...] = ("initial", "kf-ekf-thesis", "ekf9")
CLAIM = "#c3c9d1"
SIGNED_MAP = "RdBu_r"
COMPONENTS = ("Bx", "By", "Bz", "|B|")


class Panel(NamedTuple):
    """One chart: its title, its axes' names, the figures and what of their errors it shows, the thesis's claim."""

    title: str
    x: str
    y: str
    figure: str
    value: int
    claim: float | None


INITIAL = (
    Panel("initial: horizontal, sphere", "SNR, dB", "cm", "5-8, 5-10, 5-13", 0, 1.0),
    Panel("initial: depth, sphere", "SNR, dB", "cm", "5-8, 5-10, 5-13", 1, 6.0),
    Panel("initial: depth, sphere", "depth, m", "cm", "5-11", 1, 5.0),
    Panel("initial: horizontal, cylinder", "pitch, deg", "cm", "5-9, 5-12, 5-14", 0, 10.0),
    Panel("initial: depth, cylinder", "pitch, deg", "cm", "5-9, 5-12, 5-14", 1, 12.0),
    Panel("initial: tensor, cylinder", "pitch, deg", "%", "5-9, 5-12, 5-14", 3, None),
)
FILTERED = (
    Panel("sphere: position", "SNR, dB", "cm", "5-17", 2, 2.0),
    Panel("sphere: polarizability", "SNR, dB", "%", "5-17", 3, 4.0),
    Panel("cylinder, roll 45: position", "pitch, deg", "cm", "5-18", 2, 3.0),
    Panel("cylinder, roll 45: polarizability", "pitch, deg", "%", "5-18", 3, 8.0),
)


def draw_all(
    folder: Path, here: World, cases: Sequence[Case], efficiency: Sequence[Efficiency], bias: Sequence[DipoleBias]
) -> list[Path]:
    """Every picture, into ``folder``; the files."""
    return [
        *(draw_maps(folder, here, name, body) for name, body in MAPS.items()),
        draw_fit(folder, here),
        draw_initial(folder, cases),
        draw_filtered(folder, cases),
        draw_convergence(folder, here),
        draw_efficiency(folder, efficiency),
        draw_bias(folder, bias),
    ]


MAPS = {"sphere": sphere(), "cylinder-standing": rod(0.0, 0.0), "cylinder-lying": rod(90.0, 0.0)}


def draw_maps(folder: Path, here: World, name: str, body: Buried) -> Path:
    """Figures 5-2 to 5-4: the components of the field and its size."""
    field, place = 1e9 * clean_t(here.geometry, body)[0], here.geometry.positions_m
    figure = new_figure((10.0, 9.0))
    shown = [*field.T, np.linalg.norm(field, axis=1)]
    for axes, values, label in zip(figure.subplots(2, 2).ravel(), shown, COMPONENTS, strict=True):
        dress(axes)
        # Levels that leave out zero: where the field vanishes it has no sign to show.
        levels = np.linspace(-1.0, 1.0, 26) * np.abs(values).max() if values.min() < 0.0 else 24
        colours = SIGNED_MAP if values.min() < 0.0 else FIELD_MAP
        filled = axes.tricontourf(place[:, 0], place[:, 1], values, levels=levels, cmap=colours)
        bar = figure.colorbar(filled, ax=axes, shrink=0.8, pad=0.02)
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=8, colors=MUTED)
        axes.set_title(f"{label}, nT", loc="left", color=INK)
        axes.set_aspect("equal")
    figure_title(figure, f"Secondary field of the {name.replace('-', ', ')} at 1 m")
    return save(figure, folder / f"emi-map-{name}.png")


def draw_fit(folder: Path, here: World) -> Path:
    """Figure 5-7 and more: what each estimator makes of one scan of a tilted cylinder, with the default's ellipse."""
    body = rod(45.0, 45.0)
    field = clean_t(here.geometry, body)
    sigma = noise_t(field, SNR_DB)
    fields = draws(field, sigma, 1, seed=7)
    figure = new_figure((12.0, 6.0))
    whole, close = figure.subplots(1, 2)
    seen = MapOf(here.geometry.positions_m[:, :2], 1e9 * np.linalg.norm(fields[0, 0], axis=1))
    draw_map(whole, seen, "|B|, nT")
    dress(close)
    (target,) = results(here, fields, sigma)[0].targets
    for axes in (whole, close):
        axes.plot(*body.position_m[0, :2], "x", color=INK, ms=10, mew=2, label="truth", zorder=6)
        for name in OTHERS:
            place = estimates(name, here, fields, sigma).position_m[0]
            axes.plot(*place[:2], "o", color=COLORS[name], ms=7, label=name, zorder=5)
        axes.plot(*target.position_m[:2], "+", color=COLORS["varpro"], ms=12, mew=2, label="varpro", zorder=6)
    close.plot(*ellipse(target.position_m[:2].tolist(), target.covariance[:2, :2], 1), color=COLORS["varpro"], lw=1.6)
    close.set_aspect("equal", adjustable="datalim")
    close.legend(frameon=False, fontsize=9)
    close.set_title("the middle of it: 95 % ellipse of varpro", loc="left", color=INK)
    close.set_xlabel("x, m", color=MUTED)
    figure_title(figure, "A cylinder at 1 m, pitch and roll 45 degrees, 20 dB")
    return save(figure, folder / "emi-fit.png")


def draw_initial(folder: Path, cases: Sequence[Case]) -> Path:
    """Figures 5-8 to 5-14: the initial estimate."""
    figure = new_figure((13.0, 8.0))
    for axes, panel in zip(figure.subplots(2, 3).ravel(), INITIAL, strict=True):
        points = [case for case in cases if case.figure == panel.figure and case.estimator == "initial"]
        for curve in dict.fromkeys(case.curve for case in points):
            _curve(axes, [c for c in points if c.curve == curve], panel.value, curve, ROLLS.get(curve, INK))
        _panel(axes, panel)
    figure_title(figure, "The initial estimate of the thesis (figures 5-8 to 5-14); grey: what it claims")
    return save(figure, folder / "emi-initial.png")


def draw_filtered(folder: Path, cases: Sequence[Case]) -> Path:
    """Figures 5-17 and 5-18: the accuracy that is reached."""
    figure = new_figure((13.0, 8.0))
    for axes, panel in zip(figure.subplots(2, 2).ravel(), FILTERED, strict=True):
        points = [c for c in cases if c.figure == panel.figure and c.curve in ("sphere", "roll 45")]
        for name in dict.fromkeys(case.estimator for case in points):
            _curve(axes, [c for c in points if c.estimator == name], panel.value, name, COLORS[name])
        _panel(axes, panel)
        axes.set_yscale("log")
        log_ticks(axes.yaxis, (0.1, 0.3, 1, 3, 10, 30))
    figure_title(figure, "Accuracy (figures 5-17 and 5-18); grey: what the thesis claims of its KF-EKF")
    return save(figure, folder / "emi-accuracy.png")


def _curve(axes: Axes, points: Sequence[Case], value: int, label: str, color: str) -> None:
    axes.plot([c.at for c in points], [c.errors[value] for c in points], "o-", color=color, ms=4, lw=1.6, label=label)


def _panel(axes: Axes, panel: Panel) -> None:
    dress(axes)
    if panel.claim is not None:
        axes.axhline(panel.claim, color=CLAIM, lw=6, zorder=1)
    axes.set_title(panel.title, loc="left", color=INK, fontsize=11)
    axes.set_xlabel(panel.x, color=MUTED)
    axes.set_ylabel(panel.y, color=MUTED)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=9)


def draw_convergence(folder: Path, here: World) -> Path:
    """Figures 5-15 and 5-16: the filters' error as samples come in."""
    figure = new_figure((12.0, 5.0))
    n_w = len(here.geometry.positions_m)
    upto = np.unique(np.round(np.linspace(0, n_w, 21)).astype(int))[1:]
    for axes, (name, body) in zip(
        figure.subplots(1, 2), (("sphere", sphere()), ("cylinder 45/45", rod(45.0, 45.0))), strict=True
    ):
        field = clean_t(here.geometry, body)
        sigma = noise_t(field, SNR_DB)
        fields = draws(field, sigma, 2, seed=5)
        off = [_error_after(here, fields, sigma, body, int(k)) for k in upto]
        axes.plot(upto, off, color=COLORS["kf-ekf-thesis"], lw=1.8)
        dress(axes)
        title(axes, name)
        axes.set_ylim(0.0, None)
        axes.set_xlabel("samples", color=MUTED)
        axes.set_ylabel("position error, cm", color=MUTED)
    figure_title(figure, "The thesis's KF-EKF as samples come in (figures 5-15 and 5-16)")
    return save(figure, folder / "emi-convergence.png")


def _error_after(here: World, fields: FloatArray, sigma: float, body: Buried, k: int) -> float:
    ready, off = here.ready, []
    for y in fields:
        weight = np.full(y.shape, 1.0 / sigma)
        task = Task(ready.sensor, y, weight, ready.setting.grounds[0], Enough(0.0, 0.0, 0.0, 0.0))
        off.append(100.0 * float(np.linalg.norm(filtered_state(task, k)[0] - body.position_m[0])))
    return float(np.mean(off))


def draw_efficiency(folder: Path, measured: Sequence[Efficiency]) -> Path:
    """Root mean square error by the bound, of every estimator."""
    figure = new_figure((10.0, 6.0))
    axes = figure.subplots()
    dress(axes)
    axes.axhspan(0.88, 1.12, color=CLAIM, alpha=0.5, zorder=0)
    for name in dict.fromkeys(one.estimator for one in measured):
        for target in dict.fromkeys(one.target for one in measured):
            points = [one for one in measured if one.estimator == name and one.target == target]
            label = name if target == measured[0].target else None
            axes.plot([p.snr_db for p in points], [p.ratio for p in points], "o-", color=COLORS[name], ms=3, lw=1.0,
                      alpha=0.8, label=label)  # fmt: skip
    axes.set_yscale("log")
    log_ticks(axes.yaxis, (1, 10, 100, 1000))
    axes.set_xlabel("SNR, dB", color=MUTED)
    axes.set_ylabel("RMSE / sqrt(CRLB) of the position", color=MUTED)
    axes.legend(frameon=False)
    title(axes, "How near estimators come to the Cramer-Rao bound")
    return save(figure, folder / "emi-efficiency.png")


def draw_bias(folder: Path, bias: Sequence[DipoleBias]) -> Path:
    """How much too deep a target of a loop lies for a dipole."""
    figure = new_figure((8.0, 5.0))
    axes = figure.subplots()
    dress(axes)
    for body, color in zip(dict.fromkeys(one.body for one in bias), COLORS.values(), strict=False):
        points = [one for one in bias if one.body == body]
        axes.plot([p.depth_m for p in points], [p.bias_cm for p in points], "o-", color=color, label=body)
    axes.set_xlabel("depth, m", color=MUTED)
    axes.set_ylabel("too deep by, cm", color=MUTED)
    axes.legend(frameon=False)
    title(axes, "A loop of 0.5 m radius inverted as a point dipole")
    return save(figure, folder / "emi-dipole-bias.png")
