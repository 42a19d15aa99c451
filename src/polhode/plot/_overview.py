"""One figure of a whole scene: body axes and rates against time, observations, polhode."""

from typing import Any

import numpy as np

from polhode._trajectory import Trajectory
from polhode.plot._matplotlib import AXES, INK, new_figure, plain, styled
from polhode.plot._polhode import polhode
from polhode.plot._samples import Samples, as_samples
from polhode.plot._scale import Scale

_BAND = (5, 95)


@styled
def overview(
    what: Trajectory | Samples,
    *,
    observed: Samples | None = None,
    scale: Scale | None = None,
    axis_names: tuple[str, str, str] = ("x", "y", "z"),
    title: str = "",
) -> Any:
    """Figure of the first body, with the spread of the others and observations; returns it.

    Left: the three body axes as directions in space (components along space x, y, z) and the body
    rates, lines for body 0 and bands from the 5th to the 95th percentile of the others; dots are
    `observed` (`plot.samples` of one body; NaN where nothing was observed). Right: the polhode.
    """
    made = as_samples(what)
    names = tuple(plain(name, 30) for name in axis_names)
    scale = Scale.of(np.ptp(made.ts[0])) if scale is None else scale
    figure = new_figure(11.0, 7.6)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.75, 1.0))
    rows = [figure.add_subplot(grid[0, 0])]
    rows += [figure.add_subplot(grid[k, 0], sharex=rows[0]) for k in (1, 2, 3)]
    t = made.ts[0] / scale.seconds
    direction, band = made.matrices, made.count > 2
    seen = None if observed is None else observed.ts[0] / scale.seconds
    for k, ax in enumerate(rows[:3]):
        for i, color in enumerate(AXES):
            _curve(ax, t, direction[:, :, i, k], color, f"space {'xyz'[i]}", band)
            if observed is not None and observed.wxyz is not None:
                _dots(ax, seen, observed.matrices[0, :, i, k], color)
        ax.set_ylim(-1.1, 1.1)
        letter = "xyz"[k]
        name = "" if names[k] == letter else f" ({names[k]})"
        ax.set_title(f"Body {letter} axis{name}: direction in space")
    for k, color in enumerate(AXES):
        unit = scale.radians_per_second
        _curve(rows[3], t, made.omega_body[:, :, k] / unit, color, names[k], band)
        if observed is not None:
            _dots(rows[3], seen, observed.omega_body[0, :, k] / unit, color)
    rows[3].set_title("Body rates")
    rows[3].set_ylabel(f"[{scale.rate}]")
    rows[3].set_xlabel(f"time [{scale.time}]")
    for ax in rows:
        ax.margins(x=0.01)
        ax.label_outer()
    for ax in (rows[0], rows[3]):
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, borderpad=0,
                  handlelength=1.4, columnspacing=1.2)  # fmt: skip
    ax = figure.add_subplot(grid[:3, 1], projection="3d")
    polhode(made, ax=ax, axis_names=names)
    ax.set_title("Polhode on the inertia ellipsoid", loc="center")
    _key(figure.add_subplot(grid[3, 1]), observed is not None, made.count - 1)
    if title:
        figure.suptitle(plain(title), x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    return figure


def _curve(ax, t, values, color, label, band):
    if band:
        low, high = np.percentile(values[1:], _BAND, axis=0)
        ax.fill_between(t, low, high, color=color, alpha=0.22, linewidth=0, zorder=2)
    ax.plot(t, values[0], color=color, label=label, linewidth=1.3, zorder=3)


def _dots(ax, t, values, color):
    ax.plot(t, values, "o", color=color, markersize=4.2, markeredgecolor="white",
            markeredgewidth=0.6, zorder=4)  # fmt: skip


def _key(ax, observed, clones):
    """What lines, bands and dots mean."""
    from matplotlib.artist import Artist
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[tuple[Artist, str]] = [(Line2D([], [], color=INK, linewidth=1.3), "nominal body")]
    if clones > 1:
        entries.append((Patch(color=INK, alpha=0.22), f"5 % to 95 % of {clones:,} clones"))
    if observed:
        dot = Line2D([], [], color=INK, marker="o", linestyle="", markersize=4.2)
        entries.append((dot, "published values"))
    ax.set_axis_off()
    ax.legend(*zip(*entries, strict=True), loc="center")
