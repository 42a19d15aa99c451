"""Figures of fits, and of the error against the run time of several methods."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from polhode._checks import ArrayLike
from polhode.fit._numerics import compiled
from polhode.fit._options import calibrate
from polhode.plot._samples import ACCENT, AXES, GREY, INK, matrices, new_figure, plain, styled

# quantiles of chi-square with two degrees of freedom
_LEVELS = {"68 %": 2.2957, "95 %": 5.9915}
# one program, since its thirty operations take five times as long to compile one by one
_calibrate = compiled(lambda *_: True)(calibrate)
# maximum number of characters of a name, and of rows of a table, in the figure
_LONGEST, _ROWS = 18, 10


@styled
def fit(result: Any, recording: Any, *, body: int = 0, title: str = "") -> Any:
    """Returns a figure of a ``fit.Fit`` and its ``fit.Recording``.

    Left: rates of the first recording (dots) and of the fitted motion (lines, interrupted
    where a reading is at the limit of the gyroscope), and the residuals in units of their noise.
    Right, for an inertia: the confidence region of the two smaller ratios (or moments), and the
    limit of physical bodies; for a scene: the correlations of the fitted numbers. Below, a table of
    the results. ``body``: index in a batch. Raises ValueError for a recording without rates, or
    whose leading axes or number of samples differ from those of the fit.
    """
    if recording.omega is None:
        raise ValueError("the figure of a fit needs a recording of rates, got attitudes alone.")
    data = _single(result, recording, body)
    figure = new_figure(11.0, 7.0)
    sides = figure.add_gridspec(1, 2, width_ratios=(1.7, 1.0))
    left, right = sides[0].subgridspec(4, 1), sides[1].subgridspec(2, 1, height_ratios=(1.2, 1.0))
    rows = [figure.add_subplot(left[0])]
    rows += [figure.add_subplot(left[k], sharex=rows[0]) for k in (1, 2, 3)]
    dense = data["times"].size > 300
    for k, color in enumerate(AXES):
        ax = rows[k]
        ax.plot(
            data["times"],
            data["omega"][:, k],
            ".",
            color=GREY,
            label="data",
            markersize=2 if dense else 5,
        )
        ax.plot(data["times"], data["model"][:, k], color=color, label="model")
        ax.set_title(f"Rate about {'xyz'[k]}")
        ax.set_ylabel("[rad/s]")
        rows[3].plot(data["times"], data["residual"][:, k], ".", color=color, markersize=3)
    rows[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, borderpad=0)
    for size in (-2, 0, 2):
        rows[3].axhline(size * data["chi"], color=GREY, linewidth=0.8, zorder=1)
    rows[3].set_title("Residuals over noise, lines at twice their spread")
    rows[3].set_xlabel("time [s]")
    for ax in rows:
        ax.margins(x=0.01)
        ax.label_outer()
    if "correlation" in data:
        _correlations(figure, figure.add_subplot(right[0]), data)
        _scene_table(figure.add_subplot(right[1]), data)
    else:
        _region(figure.add_subplot(right[0]), data)
        _table(figure.add_subplot(right[1]), data)
    if title:
        figure.suptitle(plain(title), x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    return figure


def _single(result, recording, body) -> dict[str, Any]:
    """The numbers of one body and its first recording, as NumPy arrays."""
    lead = np.asarray(result.diagnostics).ndim
    if not 0 <= body < max(np.asarray(result.diagnostics).size, 1):
        raise ValueError(f"body must be one of the fit's, got {body}.")

    if lead and recording.batch_shape != np.shape(result.diagnostics):
        raise ValueError(
            "recording must be that of the fit, with the leading axes"
            f" {np.shape(result.diagnostics)}, got {recording.batch_shape}."
        )

    def pick(value, tail, place=body):
        value = np.asarray(value)
        return value.reshape(-1, *value.shape[value.ndim - tail :])[place]

    place = body if lead else 0
    recording = _calibrate(recording, result.model.gyroscope)
    omega, noise = (pick(x, 2, place) for x in (recording.omega, recording.omega_noise))
    present, times = (pick(x, 1, place) for x in (recording.present, recording.times))
    present = present > 0
    residual, count = pick(result.residuals["omega"], 3)[0], times.size
    # shorter recordings of a fit are filled up with gaps, whose residuals are zero
    if count > len(residual) or np.any(residual[count:]):
        raise ValueError(
            f"recording must be the first of those that were fitted, got one of {count} samples."
        )
    residual = residual[:count]
    # these residuals are those before the robust loss, so that this is the fitted motion
    model = omega - residual * noise
    if recording.saturated is not None:  # a bound that holds does not tell where the model is
        limits = pick(recording.saturated, 2, place)
        model = np.where((limits != 0) & (residual == 0), np.nan, model)
    hole = np.where(present, 1.0, np.nan)[:, None]
    shared = {
        "times": times,
        "omega": omega * hole,
        "model": model * hole,
        "residual": residual * hole,
        "rms": float(pick(result.rms, 0)),
        "chi": float(pick(result.noise, 0)),
        "white": float(pick(result.whiteness, 0)),
        "findings": result.findings(body),
    }
    if not hasattr(result, "moments"):  # a fit of a scene
        return shared | _of_scene(result, body)
    moments, axes = pick(result.moments, 1), pick(result.axes, 1)
    value, spread = result.principal_values
    return shared | {
        "value": pick(value, 1),
        "spread": pick(spread, 1),
        "axes_std": pick(result.axes_std, 1),
        "covariance": _of_values(
            moments, axes, pick(result.covariance, 2), result.scale_known, result.model.entries
        ),
        "scale_known": result.scale_known,
    }


# Places of the entries of a symmetric tensor, in the order of ``Fit.covariance``.
_ENTRIES = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))


def _of_scene(result, body: int) -> dict[str, Any]:
    """Names, values, standard deviations and correlations of the fitted numbers of a scene."""
    names, values, spreads = [], [], []
    lead = np.ndim(result.diagnostics)
    parts = result.value_names, result.values, result.std, result._entry_counts
    for name, value, std, entries in zip(*parts, strict=True):
        value, std = (np.asarray(x).reshape(-1, *np.shape(x)[lead:])[body] for x in (value, std))
        for place in np.ndindex(value.shape) if entries is None else _ENTRIES[:entries]:
            names.append(name + "".join(f"[{k}]" for k in place))
            values.append(value[place])
            spreads.append(std[place])
    sensors = [result.parameters.bias, result.parameters.mounting, result.parameters.lever]
    first_entry = sum(int(np.prod(np.shape(x)[lead:])) for x in sensors if x is not None)
    covariance = np.asarray(result.covariance)
    covariance = covariance.reshape(-1, *covariance.shape[-2:])[body]
    value_slice = slice(first_entry, first_entry + len(names))
    covariance = covariance[value_slice, value_slice]
    size = np.sqrt(np.maximum(np.diagonal(covariance), 0))
    size = np.where(size > 0, size, 1)
    return {
        "names": names,
        "value": np.array(values),
        "spread": np.array(spreads),
        "correlation": covariance / size / size[:, None],
    }


def _correlations(figure, ax, data):
    """Matrix of the correlations of the fitted numbers."""
    names = [name if len(name) <= _LONGEST else "..." + name[-_LONGEST:] for name in data["names"]]
    picture = ax.imshow(data["correlation"], vmin=-1, vmax=1, cmap="RdBu_r")
    ax.set_title("Correlations of the fitted numbers")
    ax.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    ax.set_yticks(range(len(names)), names, fontsize=7)
    ax.grid(visible=False)
    figure.colorbar(picture, ax=ax, shrink=0.8)


def _scene_table(ax, data):
    """The numbers of a scene, and the findings."""
    ax.set_axis_off()
    rows = list(zip(data["names"], data["value"], data["spread"], strict=True))
    lines = [f"{name[-_LONGEST:]:<20}{_rounded(value, std)}" for name, value, std in rows[:_ROWS]]
    if len(rows) > _ROWS:
        lines.append(f"... and {len(rows) - _ROWS} more")
    lines += [
        "",
        f"residual rms   {data['rms']:.3g} rad/s",
        f"over the noise {data['chi']:.3g}",
        f"whiteness      p = {data['white']:.2g}",
        "findings       " + (", ".join(data["findings"]) or "none"),
    ]
    _write_lines(ax, lines)


def _of_values(moments, axes, covariance, scale_known, count) -> np.ndarray:
    """Covariance (2, 2) of the two smaller moments or ratios."""
    turn = matrices(axes)
    slope = np.array(
        [
            [a * a, b * b, c * c, 2 * b * c, 2 * c * a, 2 * a * b]
            for a, b, c in (turn[:, k] for k in range(3))
        ]
    )
    slope = slope[:, :count]  # without products for ``MomentsOnly``
    if not scale_known:
        slope = (slope - (moments / moments[2])[:, None] * slope[2]) / moments[2]
    return (slope @ covariance[:count, :count] @ slope.T)[:2, :2]


def _region(ax, data):
    """Confidence ellipses of the two smaller values and, for ratios, the unphysical region."""
    value, covariance = data["value"][:2], data["covariance"]
    ax.set_title("What the data allow")
    kind = "moment [kg m²]" if data["scale_known"] else "ratio to the largest moment"
    ax.set_xlabel(f"smallest {kind}")
    ax.set_ylabel(f"middle {kind}" if data["scale_known"] else "middle ratio")
    ax.plot(*value, "+", color=INK, markersize=9)
    if not np.isfinite(data["spread"][:2]).all():
        ax.text(0.5, 0.1, "not determined", transform=ax.transAxes, ha="center", color=ACCENT)
        return
    sizes, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(sizes, 0))
    circle = np.linspace(0, 2 * np.pi, 181)
    unit = np.stack([np.cos(circle), np.sin(circle)])
    for name, level in _LEVELS.items():
        x, y = value[:, None] + np.sqrt(level) * (root @ unit)
        ax.fill(x, y, facecolor=ACCENT, alpha=0.22, linewidth=0, label=name)
    ax.autoscale_view()
    if not data["scale_known"]:
        limits = ax.get_xlim(), ax.get_ylim()
        line = np.linspace(0, 1, 201)
        is_visible = limits[0][0] + limits[1][0] < 1
        ax.fill_between(
            line,
            0,
            1 - line,
            color=GREY,
            alpha=0.35,
            linewidth=0,
            label="no body" if is_visible else None,
        )
        ax.set_xlim(*limits[0])
        ax.set_ylim(*limits[1])
    ax.legend(loc="best")
    ax.ticklabel_format(useOffset=False)
    ax.locator_params(axis="x", nbins=4)


def _table(ax, data):
    """The results for an inertia, and the findings."""
    ax.set_axis_off()
    head = "moments [kg m²]" if data["scale_known"] else "ratios"
    lines = [f"{'principal ' + head:<28}axis known to"]
    for value, spread, turn in zip(data["value"], data["spread"], data["axes_std"], strict=True):
        rounded = _rounded(value, spread)
        angle = f"{np.degrees(turn):.2g}°" if np.isfinite(turn) else "-"
        lines.append(f"{rounded:<28}{angle}")
    lines += [
        "",
        f"residual rms   {data['rms']:.3g} rad/s",
        f"over the noise {data['chi']:.3g}",
        f"whiteness      p = {data['white']:.2g}",
        "scale          " + ("known" if data["scale_known"] else "not shown by free motion"),
        "findings       " + (", ".join(data["findings"]) or "none"),
    ]
    _write_lines(ax, lines)


def _write_lines(ax, lines: list[str]) -> None:
    ax.text(
        0.0,
        0.95,
        "\n".join(lines),
        family="monospace",
        fontsize=8.5,
        va="top",
        linespacing=1.5,
        transform=ax.transAxes,
        color=INK,
    )


def _rounded(value, spread) -> str:
    """A value and its standard deviation, to two digits of the latter."""
    if not spread > 0:
        return f"{value:.6g}"
    if not np.isfinite(spread):
        return f"{value:.6g} (not determined)"
    power = int(np.floor(np.log10(abs(value)))) if value else 0
    if abs(power) > 3:
        return f"({_rounded(value / 10.0**power, spread / 10.0**power)}) 1e{power}"
    digits = max(0, 1 - int(np.floor(np.log10(spread))))
    return f"{value:.{digits}f} ± {spread:.{digits}f}"


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
    of the curve to draw bold. Entries that are not positive and finite are left out; a curve
    without any other is marked as failed in the legend.
    """
    if not isinstance(curves, Mapping):
        raise TypeError(
            f"curves must be a mapping of names to (errors, times), got {type(curves).__name__}."
        )
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
    ax.annotate(
        "better",
        xy=(0.02, 0.03),
        xytext=(0.13, 0.14),
        xycoords="axes fraction",
        color=GREY,
        fontsize=8,
        arrowprops={"arrowstyle": "->", "color": GREY},
    )
    return ax
