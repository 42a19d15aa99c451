"""Error against run time of several methods."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from polhode._checks import ArrayLike
from polhode.plot._matplotlib import GREY, INK, new_figure, styled

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5195", "#5D4E37")
_MARKERS = "osD^vP*X"


@styled
def work_precision(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    ax: Any = None,
    time_label: str = "run time [s]",
    error_label: str = "error",
    highlight: str | None = None,
) -> Any:
    """Draw error (down is better) against run time (left is better) per method; returns the Axes.

    `curves`: name -> (errors, times), one entry per tolerance or step size. `highlight`: the name
    of the curve to draw bold. Entries that are not positive and finite are left out, and a curve
    left with nothing is named in the legend as failed.
    """
    if not curves:
        raise ValueError("work_precision needs at least one curve, got an empty mapping.")
    if ax is None:
        ax = new_figure(6.4, 4.6).add_subplot()
    for index, (name, (errors, times)) in enumerate(curves.items()):
        errors, times = (np.atleast_1d(np.asarray(x, float)) for x in (errors, times))
        if errors.shape != times.shape or errors.ndim != 1:
            raise ValueError(
                f"curve {name!r}: errors and times must be lists of one length, got shapes "
                f"{errors.shape} and {times.shape}."
            )
        good = np.isfinite(errors) & np.isfinite(times) & (errors > 0) & (times > 0)
        bold = name == highlight
        style = {
            "color": INK if bold else _COLORS[index % len(_COLORS)],
            "marker": _MARKERS[index % len(_MARKERS)],
            "linewidth": 2.4 if bold else 1.3,
            "markersize": 6 if bold else 4.5,
            "markeredgecolor": "white",
            "markeredgewidth": 0.6,
            "zorder": 5 if bold else 3,
        }
        label = name if good.any() else f"{name} (failed)"
        order = np.argsort(times[good])
        ax.plot(times[good][order], errors[good][order], label=label, **style)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.grid(which="minor", alpha=0.25)
    ax.set_xlabel(time_label)
    ax.set_ylabel(error_label)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    ax.annotate("better", xy=(0.02, 0.03), xytext=(0.13, 0.14), xycoords="axes fraction",
                color=GREY, fontsize=8, arrowprops={"arrowstyle": "->", "color": GREY})  # fmt: skip
    return ax
