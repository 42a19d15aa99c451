"""``polhode lightcurve FILE``: reading and fitting, and output of tables, JSON and a figure."""

import json
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from polhode._closed_forms import Mode
from polhode._extras import imported
from polhode.lightcurve._brightness import (
    HG,
    HG1G2,
    AbstractPhase,
    LinearPhase,
    SeeligerPhase,
)
from polhode.lightcurve._data import LightCurve
from polhode.lightcurve._files import read_light_curve
from polhode.lightcurve._fit import fit_light_curve
from polhode.lightcurve._frequencies import (
    Pairs,
    check_max_frequency,
    fourier_lattices,
    fourier_pairs,
    meaning,
    reaches_beyond_pairs,
)
from polhode.lightcurve._solutions import COVARIANCE_OF, LightCurveFit, Solution

# Units of the numbers in the JSON file; those not listed are dimensionless.
_UNITS = {
    "P_phi": "day",
    "P_psi": "day",
    "P_phi_std": "day",
    "P_psi_std": "day",
    "lines": "day",
    "P_phi_short_axis": "day",
    "periods": "day",
    "max_frequency": "1/day",
    "rms": "mag",
    "offsets": "mag",
    "offset_sigma": "mag",
    "floor": "mag",
    "pole": "deg",
    "pole_std": "deg",
    "omega_body": "rad/day",
    "epoch": "day",
    "covariance": "products of the units of covariance_of; moments and momentum have none",
}

# Phase functions by their names on the command line.
PHASES: dict[str, AbstractPhase] = {
    "seeliger": SeeligerPhase(),
    "linear": LinearPhase(),
    "hg": HG(),
    "hg1g2": HG1G2(),
}


def table(fit: LightCurveFit) -> str:
    """Null hypotheses with their evidence, the bodies, one per line, the verdict and notes."""
    return "\n".join([model_table(fit), "", solution_table(fit), "", *conclusions(fit)])


def conclusions(fit: LightCurveFit) -> list[str]:
    """Lines with the verdict, its reasons, and notes on what the light curve cannot determine."""
    lines = [f"verdict: {fit.verdict.name} (PAR {fit.par:+d})"]
    lines += [f"because: {reason}" for reason in fit.reasons]
    return [*lines, *(f"note: {note}" for note in fit.notes)]


def model_table(fit: LightCurveFit) -> str:
    """Models of the light curve, null hypotheses first; ln Z is relative to noise alone."""
    unit, per = _unit([p for model in fit.models for p in model.periods])
    lines = [f"  ln Z      parameters  rms [mag]  rms/error  model: periods [{unit}]"]
    for model in fit.models:
        periods = ", ".join(f"{p * per:.6g}" for p in model.periods)
        lines.append(
            f"  {model.log_evidence - fit.models[0].log_evidence:+8.1f}  {model.parameters:10.1f}"
            f"  {model.rms:9.4f}  {model.misfit:9.2f}  {model.name}"
            + (f": {periods}" if periods else "")
        )
    return "\n".join(lines)


def solution_table(fit: LightCurveFit) -> str:
    """The tumbling bodies, one per line, and the main spectral lines of the best."""
    best = fit.best
    unit, per = _unit([best.P_phi, best.P_psi])
    lines = [
        f"  #  rms [mag]  odds     P_phi [{unit}]          P_psi [{unit}]          P_phi short axis"
        "  mode        moments              pole (lon, lat) [deg]"
    ]
    for k, s in enumerate(fit.solutions):
        moments = " : ".join(f"{m:.3f}" for m in s.moments)
        mirror = "" if s.mirror_of is None else f"  mirror of {s.mirror_of}"
        lines.append(
            f"{k:3d}  {s.rms:.4f}    {s.probability:7.1e}"
            f"  {s.P_phi * per:9.5g} +- {s.P_phi_std * per:7.2g}"
            f"  {s.P_psi * per:9.5g} +- {s.P_psi_std * per:7.2g}"
            f"  {s.P_phi_short_axis * per:16.5g}"
            f"  {s.mode.name:<10s}  {moments}  {s.pole[0]:6.1f} {s.pole[1]:+6.1f}"
            f" +- {s.pole_std:.1f}{mirror}"
        )
    main = ", ".join(f"{name}: {period * per:.5g} {unit}" for name, period in best.lines())
    return "\n".join([*lines, f"main lines of the best: {main}"])


def _unit(periods) -> tuple[str, float]:
    """A unit that suits the periods [day]: its name, and how many of it make a day."""
    typical = float(np.exp(np.mean(np.log(periods)))) if len(periods) else 1.0
    if typical > 2:
        return "d", 1.0
    return ("h", 24.0) if typical > 1 / 24 else ("min", 1440.0)


def frequency_table(pairs: Pairs, count: int = 6, *, lines: bool = False) -> str:
    """Candidate pairs of frequencies and their interpretations.

    ``lines``: the pairs are spectral lines, sums of the frequencies that are not identified.
    """
    if lines:
        text = ["  explained  line 1 [1/d]  line 2 [1/d]"]
        for a, b, part in list(zip(pairs.f_phi, pairs.f_psi, pairs.explained))[:count]:
            text.append(f"  {part:8.1%}  {a:12.5g}  {b:12.5g}")
        return "\n".join(text)
    text = ["  explained  f_phi [1/d]  f_psi [1/d]  meaning"]
    for a, b, part in list(zip(pairs.f_phi, pairs.f_psi, pairs.explained))[:count]:
        text.append(f"  {part:8.1%}  {a:11.5g}  {b:11.5g}  {meaning(a, b)}")
    return "\n".join(text)


def run(
    path: str | PathLike[str],
    *,
    vectors: str | PathLike[str] | None = None,
    output: str | PathLike[str] | None = None,
    trials: int = 40_000,
    max_frequency: float | None = None,
    floor: float = 0.03,
    seed: int = 0,
    searches: int = 3,
    binned: float | None = None,
    phase: str | None = None,
    calibrated: bool = False,
    reduced: bool = False,
    start: str | PathLike[str] | None = None,
    say: Callable = print,
) -> LightCurveFit | None:
    """Read and fit a light curve, print the table, and write the figure and a JSON file.

    ``output``: path of the files without suffix (default: that of ``path``, in the current folder).
    ``searches``, ``trials``, ``max_frequency``, ``floor``, ``seed``: of `fit_light_curve`;
    ``calibrated``, ``reduced``: of `read_light_curve`; ``binned``: width [day] of normal points;
    ``phase``: ``"seeliger"``, ``"linear"``, ``"hg"`` or ``"hg1g2"``; ``start``: the JSON file of an
    earlier fit, whose solutions are tried first.
    Without directions to Sun and observer only the frequencies are listed, and None is returned.
    Raises the errors of `read_light_curve`, and ValueError for a floor of 0 without errors.
    """
    path = Path(path)
    name = Path(path.stem if output is None else output)
    picture, document = (name.with_name(name.name + suffix) for suffix in (".png", ".json"))
    curve = read(path, vectors, floor, binned=binned, calibrated=calibrated, reduced=reduced)
    return fit_file(
        curve,
        path.name,
        picture,
        document,
        trials=trials,
        max_frequency=max_frequency,
        floor=floor,
        seed=seed,
        searches=searches,
        phase=phase,
        start=None if start is None else read_solutions(start),
        say=say,
        reading={
            "vectors": None if vectors is None else Path(vectors).name,
            "binned": binned,
            "calibrated": calibrated,
            "reduced": reduced,
            "start": None if start is None else Path(start).name,
        },
    )


def read(
    path: str | PathLike[str],
    vectors: str | PathLike[str] | None,
    floor: float,
    *,
    binned: float | None = None,
    calibrated: bool = False,
    reduced: bool = False,
) -> LightCurve:
    """The light curve of a file; ValueError for points without error if ``floor`` is 0."""
    curve = read_light_curve(path, vectors, calibrated=calibrated, reduced=reduced)
    if not floor > 0 and curve.sun is not None and not np.all(curve.sigma > 0):
        raise ValueError(
            f"{path}: a floor of {floor:g} needs a positive error of every point (sigma), which the"
            " file does not give."
        )
    return curve if binned is None else curve.binned(binned)


def fit_file(
    curve: LightCurve,
    title: str,
    picture: Path,
    document: Path,
    *,
    say=print,
    max_frequency: float | None = None,
    trials: int,
    floor: float,
    seed: int,
    searches: int = 3,
    phase: str | None = None,
    start: Sequence[Solution] | None = None,
    progress: Callable[[str], None] | None = None,
    reading: dict[str, Any] | None = None,
) -> LightCurveFit | None:
    """Fit, print the table with ``say``, and write the figure and the JSON file; see `run`.

    ``reading``: the options with which the light curve was read, for the JSON file.
    """
    curve.require_points()
    say(f"{title}: {curve.t.size} points, {len(curve.names)} groups, {np.ptp(curve.t):.4g} d")
    if curve.sun is None:
        check_max_frequency(curve.t, max_frequency)
        columns = curve.columns(np.inf)[0]
        options = {"columns": columns, "max_frequency": max_frequency}
        lines = reaches_beyond_pairs(curve.t, max_frequency)
        if not lines:
            pairs = fourier_pairs(curve.t, curve.magnitude, **options)
            lines = pairs.is_cut
        if lines:  # beyond the two-dimensional grid: pairs of lines reach higher frequencies
            pairs = fourier_lattices(curve.t, curve.magnitude, **options)
        say(frequency_table(pairs, lines=lines))
        missing = "without vectors to Sun and observer no body can be fitted."
        for note in (*curve.notes, *pairs.warnings(), missing):
            say(f"note: {note}")
        return None
    # raises ImportError before the search instead of after it
    imported("the figure of a light curve", "matplotlib", extra="plot")
    settings = {
        "trials": trials,
        "max_frequency": max_frequency,
        "floor": floor,
        "seed": seed,
        "searches": searches,
    }
    if phase is not None and phase not in PHASES:
        raise ValueError(f"phase must be one of {', '.join(PHASES)}, got {phase!r}.")
    fit = fit_light_curve(
        curve,
        **settings,
        phase=None if phase is None else PHASES[phase],
        start=start,
        progress=progress,
    )
    phase_name = next(name for name, each in PHASES.items() if type(each) is type(fit.phase))
    settings |= {"phase": phase_name} | (reading or {})
    say(frequency_table(fit.pairs, lines=True))
    say(table(fit))
    _write(fit, title, picture, document, settings, say)
    return fit


def read_solutions(path: str | PathLike[str]) -> tuple[Solution, ...]:
    """Solutions of an earlier fit from its JSON file, as ``start`` of another fit.

    Raises FileNotFoundError, and ValueError for a file that `run` did not write.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        rows = document["solutions"]
        out = []
        for row in rows:
            fields = {name: row.get(name) for name in Solution._fields}
            needed = ("moments", "axes", "wxyz", "omega_body", "coefficients")
            arrays = {name: row[name] for name in needed} | {
                name: value for name, value in fields.items() if isinstance(value, list)
            }
            fields |= {name: np.asarray(value, float) for name, value in arrays.items()}
            fields |= {"mode": Mode[row["mode"]], "epoch": float(row["epoch"])}
            out.append(Solution(**fields))
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        what = "it is not JSON in UTF-8"
        if not isinstance(error, UnicodeDecodeError | json.JSONDecodeError):
            what = "it lacks the solutions of one, or parts of them"
        raise ValueError(f"{path} is not a result of polhode lightcurve: {what}.") from error
    if not out:
        raise ValueError(f"{path} holds no solutions.")
    return tuple(out)


def _write(
    fit: LightCurveFit, name: str, picture: Path, document: Path, settings: dict, say
) -> None:
    import jax
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    from polhode import __version__
    from polhode._atomic import atomic_write

    page = figure(fit, title=name)
    with atomic_write(picture) as temporary:
        page.savefig(temporary, dpi=160, metadata={"Software": f"polhode {__version__}"})
    plt.close(page)

    def plain(value):
        return value.tolist() if isinstance(value, np.ndarray) else value

    rows = []
    for solution in fit.solutions:
        fields = {
            k: plain(v) for k, v in solution._asdict().items() if k not in ("model", "weights")
        }
        derived = {"P_phi_short_axis": solution.P_phi_short_axis, "lines": dict(solution.lines())}
        rows.append(fields | {"mode": solution.mode.name} | derived)
    contents = {
        "file": name,
        "polhode": __version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "units": _UNITS,
        "settings": settings,
        "verdict": fit.verdict.name,
        "reasons": fit.reasons,
        "par": fit.par,
        "misfit": fit.misfit,
        "agreement": fit.agreement,
        "scale": fit.scale,
        "alike": fit.alike,
        "offset_sigma": fit.offset_sigma,
        "max_frequency": fit.pairs.max_frequency,
        "covariance_of": COVARIANCE_OF,
        "models": [model._asdict() for model in fit.models],
        "solutions": rows,
        "notes": fit.notes,
    }
    with atomic_write(document) as temporary:
        temporary.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")
    say(f"wrote {picture} and {document}")


# The figure. `polhode.plot` is imported in the functions, because it needs matplotlib.


def figure(fit: LightCurveFit, *, number: int = 0, title: str = "") -> Any:
    """Returns a figure of a ``LightCurveFit``, with solution ``number`` drawn over the data.

    The fitted offsets are subtracted; gaps longer than a tenth of the light curve are cut out.
    """
    from polhode.plot._samples import styled

    return styled(_figure)(fit, number, title)


def _figure(fit: LightCurveFit, number: int, title: str) -> Any:
    from polhode.plot._samples import ACCENT, GREY, INK, Z, new_figure

    if not 0 <= number < len(fit.solutions):
        raise ValueError(f"number must be 0 to {len(fit.solutions) - 1}, got {number}.")
    solution, curve = fit.solutions[number], fit.curve
    page = new_figure(11.0, 7.5)
    rows = page.add_gridspec(3, 1, height_ratios=(1.5, 0.8, 1.6))
    top, middle = page.add_subplot(rows[0]), page.add_subplot(rows[1])
    below = rows[2].subgridspec(1, 2, width_ratios=(1.15, 1.0))
    t, unit = _clock(curve.t - curve.t[0])
    x = _without_gaps(t)
    columns = curve.columns(fit.offset_sigma)[0]
    offsets = solution.offsets[: len(columns)] @ columns
    rest = curve.magnitude - solution.model
    inlier = solution.weights > 0.5
    for ax, value, model in (
        (top, curve.magnitude - offsets, solution.model - offsets),
        (middle, rest, np.zeros_like(rest)),
    ):
        ax.plot(x[inlier], value[inlier], ".", color=GREY, markersize=4, label="data")
        ax.plot(x[~inlier], value[~inlier], "x", color=ACCENT, markersize=4, label="data, outlying")
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
        f"Solution {number}: P_phi {solution.P_phi:.5g} d, P_psi {solution.P_psi:.5g} d,"
        f" {solution.mode.name}, rms {solution.rms:.3f} mag"
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
    from polhode.plot._samples import ACCENT, Y, Z

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
