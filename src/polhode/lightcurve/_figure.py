"""One figure of a fit: data over model, residuals, and the map of poles."""

import numpy as np

from polhode.lightcurve._solutions import LightCurveFit
from polhode.plot._samples import ACCENT, GREY, INK, Y, Z, new_figure, styled


@styled
def figure(fit: LightCurveFit, *, number: int = 0, title: str = ""):
    """Figure of a ``LightCurveFit``; solution ``number`` is drawn over the data. Returns it.

    Magnitudes without the offsets fitted; gaps longer than a tenth of the light curve are cut out.
    """
    if not 0 <= number < len(fit.solutions):
        raise ValueError(f"number must be 0 to {len(fit.solutions) - 1}, got {number}.")
    chosen, curve = fit.solutions[number], fit.curve
    page = new_figure(11.0, 7.5)
    rows = page.add_gridspec(3, 1, height_ratios=(1.5, 0.8, 1.6))
    top, middle = page.add_subplot(rows[0]), page.add_subplot(rows[1])
    below = rows[2].subgridspec(1, 2, width_ratios=(1.15, 1.0))
    t, unit = _clock(curve.t - curve.t[0])
    x = _without_gaps(t)
    offsets = chosen.offsets[: len(curve.columns()[0])] @ curve.columns()[0]
    rest = curve.magnitude - chosen.model
    used = chosen.weights > 0.5
    for ax, value, model in (
        (top, curve.magnitude - offsets, chosen.model - offsets),
        (middle, rest, np.zeros_like(rest)),
    ):
        ax.plot(x[used], value[used], ".", color=GREY, markersize=4, label="data")
        ax.plot(x[~used], value[~used], "x", color=ACCENT, markersize=4, label="data, outlying")
        for part in np.split(np.arange(t.size), np.flatnonzero(np.diff(t) > 0.02 * np.ptp(t)) + 1):
            ax.plot(
                x[part],
                model[part],
                color=Z,
                linewidth=1.2,
                label="model" if part[0] == 0 else None,
            )
        ax.invert_yaxis()
        ax.margins(x=0.01)
    top.legend(loc="upper right", ncols=3)
    top.set_ylabel("magnitude")
    top.set_title(
        f"Solution {number}: P_phi {chosen.P_phi:.5g} d, P_psi {chosen.P_psi:.5g} d,"
        f" {chosen.mode.name}, rms {chosen.rms:.3f} mag"
    )
    middle.set_ylabel("residual")
    cut = " (gaps cut out)" if x[-1] < t[-1] else ""
    middle.set_xlabel(f"time [{unit}]{cut}")
    _poles(page.add_subplot(below[0], projection="mollweide"), fit, number)
    _draw_table(page.add_subplot(below[1]), fit)
    if title:
        page.suptitle(title, x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    return page


def _clock(t):
    span = np.ptp(t)
    if span < 0.5:
        return t * 1440, "min"
    return (t * 24, "h") if span < 4 else (t, "d")


def _without_gaps(t):
    step = np.diff(t, prepend=t[0])
    longest = 0.1 * np.ptp(t)
    return np.cumsum(np.where(step > longest, 0.02 * np.ptp(t), step))


def _poles(ax, fit: LightCurveFit, number: int) -> None:
    for k, solution in enumerate(fit.solutions):
        longitude, latitude = np.radians(solution.pole)
        longitude = (longitude + np.pi) % (2 * np.pi) - np.pi
        color = ACCENT if k == number else Y if solution.mirror_of is not None else Z
        size = 20 + 100 * solution.probability**0.25
        ax.scatter(longitude, latitude, s=size, color=color, alpha=0.75, linewidths=0, zorder=3)
        ax.annotate(str(k), (longitude, latitude), xytext=(4, 4), textcoords="offset points")
    ax.set_title("Angular momentum, longitude from -180 to 180 deg (green: mirror images)")
    ax.set_xticklabels([])


def _draw_table(ax, fit: LightCurveFit) -> None:
    ax.axis("off")
    text = [" #   rms   P_phi     P_psi     mode  pole        mirror"]
    for k, s in enumerate(fit.solutions[:9]):
        mirror = "" if s.mirror_of is None else f"of {s.mirror_of}"
        text.append(
            f"{k:2d}  {s.rms:.3f} {s.P_phi:<9.5g} {s.P_psi:<9.5g} {s.mode.name:<5s}"
            f" {s.pole[0]:4.0f} {s.pole[1]:+4.0f}  {mirror}"
        )
    ax.text(0, 1, "\n".join(text), family="monospace", fontsize=8, va="top")
