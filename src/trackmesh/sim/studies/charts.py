"""What the charts of all studies share: a figure on paper, quiet axes, few ticks, a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.sim.drawing import GRID, INK, MUTED, PAPER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


def new_figure(size_in: tuple[float, float]) -> Figure:
    """An empty figure of this width and height in inches.

    Raises:
        TrackmeshError: matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise TrackmeshError("Drawing needs matplotlib; install it with: pip install 'trackmesh[studies]'.") from None
    return Figure(figsize=size_in, layout="constrained", facecolor=PAPER)


def save(figure: Figure, out: Path) -> Path:
    """Write the picture, making its folder where missing, and return ``out``.

    Raises:
        TrackmeshError: the picture cannot be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=150, bbox_inches="tight", pad_inches=0.25)
    except OSError as error:
        raise TrackmeshError(f"Cannot write {out}: {error.strerror or error}.") from None
    except ValueError as error:
        raise TrackmeshError(f"Cannot draw into {out}: {error}.") from None
    return out


def dress(axes: Axes) -> None:
    """A quiet grid behind the data, quiet ticks and spines."""
    axes.grid(color=GRID, lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, labelsize=9)
    for spine in axes.spines.values():
        spine.set_color(GRID)


def log_ticks(axis: Axis, values: tuple[float, ...]) -> None:
    """Few labelled ticks on a logarithmic axis."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axis.set_major_locator(FixedLocator(values))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))


def title(axes: Axes, text: str) -> None:
    """The title of a chart that stands alone."""
    axes.set_title(text, loc="left", fontsize=14, fontweight="bold", color=INK, pad=12)


def figure_title(figure: Figure, text: str) -> None:
    """The title over several charts."""
    figure.suptitle(text, x=0.01, ha="left", fontsize=14, fontweight="bold", color=INK)
