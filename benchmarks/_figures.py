"""Figures of the benchmarks, drawn from their JSON files alone."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks._report import read

PEERS = (
    "polhode (default)",
    "polhode LiePoisson",
    "heyoka",
    "diffrax",
    "diffrax (Euler angles)",
    "SciPy closed form",
    "SciPy solve_ivp",
    "Numba",
    "MuJoCo",
)
MAIN = ("free", "separatrix", "lagrange", "heavy_top", "gradient", "dense")
"""Families in the figure of the README."""

ENGINE_COLOURS = {
    "MuJoCo Euler": "#CC79A7",
    "MuJoCo implicitfast": "#009E73",
    "MuJoCo RK4": "#0072B2",
    "Bullet": "#E69F00",
    "no gyroscopic term": "#888888",
}

DRAWN: dict[str, Callable] = {}
"""By name of the result."""


def _drawn(function: Callable) -> Callable:
    """Decorator: register a figure by the name of its result and draw it in the package's style."""

    @functools.wraps(function)
    def draw_report(report: dict, *options: Any) -> Any:
        import matplotlib.pyplot as plt

        from polhode.plot._samples import STYLE

        with plt.rc_context(STYLE):
            return function(plt, report, *options)

    DRAWN[function.__name__] = draw_report
    return draw_report


def _name(peer: str, program: str) -> str:
    if peer == "polhode":
        return PEERS[0] if program.startswith("default") else PEERS[1]
    return "diffrax (Euler angles)" if "Euler" in program else peer


def fronts(rows: list[dict]) -> dict[str, tuple[list, list]]:
    """Errors and times of the Pareto-optimal settings of each program, by name."""
    points: dict[str, list] = {}
    for row in rows:
        if row["attitude_median"] is not None:
            point = (row["ns_per_body"] * 1e-3, row["attitude_median"])
            points.setdefault(_name(row["peer"], row["program"]), []).append(point)
    found = {name: ([], []) for name in dict.fromkeys((*PEERS, *points))}
    for name, several in points.items():
        best = float("inf")
        for time, error in sorted(several):
            if error < best:
                best = error
                found[name][0].append(error)
                found[name][1].append(time)
    return found


@_drawn
def work_precision(plt, report: dict, families: tuple[str, ...] = ()):
    """One panel per family: median attitude error of 1,000 bodies against time per body."""
    from polhode import plot

    tables = [t for t in report["numbers"]["tables"] if t["bodies"] == 1000]
    tables = [t for t in tables if t["dtype"] == "float64"]
    tables = [t for t in tables if not families or t["family"] in families]
    if not tables:
        raise ValueError("the result holds no table of 1,000 bodies in float64")
    columns = min(3 if len(tables) <= 6 else 5, len(tables))
    rows = -(-len(tables) // columns)
    figure = plt.figure(figsize=(3.3 * columns + 1.9, 2.6 * rows + 0.3), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).flat)
    drawn = {}
    for ax, table in zip(axes, tables):
        plot.work_precision(
            fronts(table["rows"]), ax=ax, highlight=PEERS[0], error_label="", time_label=""
        )
        for line in ax.lines:
            if len(line.get_xdata()):
                drawn[line.get_label()] = line
            if len(line.get_xdata()) == 1:  # a closed form: its single point applies to every error
                line.set_markersize(10)
        ax.get_legend().remove()
        ax.set_title(table["title"])
        ax.set_ylim(3e-16, 5)
        ax.minorticks_off()
        ax.label_outer()
        for text in ax.texts:
            text.remove()
    for ax in axes[len(tables) :]:
        ax.set_axis_off()
    figure.supxlabel("time per body [µs]", fontsize=9.5)
    figure.supylabel("attitude error at the end [rad], median body", fontsize=9.5)
    figure.legend(list(drawn.values()), list(drawn), loc="outside right upper")
    return figure


@_drawn
def scaling(plt, report: dict):
    """Time and memory per body against the number of bodies, the horizon and saved times."""
    labels = {"bodies": "bodies", "horizon": "horizon [s]", "saves": "saved times"}
    figure = plt.figure(figsize=(10.5, 5.0), layout="constrained")
    axes = figure.subplots(2, 3, sharex="col", sharey="row")
    for column, (sweep, label) in enumerate(labels.items()):
        for name, points in report["numbers"][sweep].items():
            x = [point[sweep] for point in points]
            axes[0, column].plot(x, [p["ns_per_body"] * 1e-3 for p in points], "o-", label=name)
            memory = [p["memory_MB"] for p in points]
            axes[1, column].plot(x, memory, "o-", label=name)
        axes[1, column].set_xlabel(label)
        for ax in axes[:, column]:
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.label_outer()
    axes[0, 0].set_ylabel("time per body [µs]")
    axes[1, 0].set_ylabel("memory of the program [MB]")
    axes[0, 2].legend(loc="upper left")
    return figure


@_drawn
def gradients(plt, report: dict):
    """Time of value and gradient relative to that of the value, and error of the gradient."""
    rows = report["numbers"]["rows"]
    figure = plt.figure(figsize=(10.5, 0.3 * len(rows) + 0.9), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    kinds = {"polhode": "#222222", "diffrax": "#CC79A7", "heyoka": "#009E73"}
    for k, row in enumerate(rows):
        style = {"color": kinds[row["peer"]], "height": 0.6}
        left.barh(k, row["ns_gradient"] * 1e-3, **style)
        left.text(row["ns_gradient"] * 1.15e-3, k, f"{row['ratio']:.2g} x", va="center", size=8)
        right.barh(k, row["error_median"], **style)
    by = [row["program"].partition(", by ")[2] for row in rows]
    names = [
        f"{row['title']}{', by ' + what if what else ''}: {row['peer']}, {row['setting']}"
        for row, what in zip(rows, by)
    ]
    left.set_yticks(range(len(rows)), names)
    left.invert_yaxis()
    left.set_xscale("log")
    left.margins(x=0.12)
    left.set_xlabel("both, per body [µs]; over the value alone")
    right.set_xscale("log")
    right.set_xlim(1e-16, 1)
    right.set_xlabel("relative error, median")
    for ax in (left, right):
        ax.grid(visible=False, axis="y")
    return figure


@_drawn
def identification(plt, report: dict):
    """Errors over the bound and coverage of the intervals, with bars of two standard errors; times
    compared with SciPy.
    """
    numbers = report["numbers"]
    rows = [*numbers["designs"], numbers["designs_pooled"]]
    names = [
        f"{row['turns']} turns, {100 * row['noise_over_rate']:g} %" if "turns" in row else "all"
        for row in rows
    ]
    figure = plt.figure(figsize=(10.5, 3.2), layout="constrained")
    error, cover, speed = figure.subplots(1, 3)
    for ax, name, target, label in (
        (error, "error_over_bound", (0.9, 1.1), "error / Cramér-Rao bound"),
        (cover, "interval_cover", (0.93, 0.97), "cover of 95 % intervals"),
    ):
        values = [row.get(name, row.get(f"{name}_95")) for row in rows]
        spread = [2 * row[f"{name}_std"] for row in rows]
        ax.axvspan(*target, color="#009E73", alpha=0.15, linewidth=0)
        ax.errorbar(values, range(len(rows)), xerr=spread, fmt="o", color="#222222")
        ax.set_yticks(range(len(rows)), names if ax is error else [""] * len(rows))
        ax.invert_yaxis()
        ax.set_xlabel(label)
        ax.grid(visible=False, axis="y")
    cases = numbers["speed"]["cases"]
    for kind, colour in (("ours", "#222222"), ("scipy", "#CC79A7")):
        times = [1e3 * case[f"{kind}_s"] for case in cases]
        off = [case[f"error_{kind}"] for case in cases]
        name = {"ours": "polhode", "scipy": "SciPy"}[kind]
        speed.plot(times, off, "o", color=colour, label=name, alpha=0.8)
    speed.set_xscale("log")
    speed.set_yscale("log")
    speed.set_xlabel("time of one fit [ms]")
    speed.set_ylabel("error of the tensor")
    speed.legend()
    return figure


@_drawn
def throw_design(plt, report: dict):
    """Standard deviation of the tensor after a throw, by direction of the spin and by the speed
    programme of the wheel.
    """
    figure = plt.figure(figsize=(10.0, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    x = {
        "turn_deg": "spin about the wheel's axis, turned by [deg]",
        "length_s": "wheel is on for [s]",
    }
    y = {"tilt_deg": "tilted by [deg]", "begin_s": "switched on after [s]"}
    for ax, across, up, values in zip(axes, x, y, ("spread_of_spins", "spread_of_programs")):
        numbers = report["numbers"]
        table = [[100 * value for value in row] for row in numbers[values]]
        drawn = ax.contourf(numbers[across], numbers[up], table, levels=12, cmap="viridis_r")
        figure.colorbar(drawn, ax=ax, label="spread of the tensor [%]")
        ax.set_xlabel(x[across])
        ax.set_ylabel(y[up])
        ax.grid(visible=False)
    return figure


@_drawn
def engines(plt, report: dict):
    """Attitude error and change of the energy of physics engines against revolutions."""
    figure = plt.figure(figsize=(9.0, 3.1), layout="constrained")
    left, right = figure.subplots(1, 2)
    for row in report["numbers"]["rows"]:
        if row["body"] != "t_handle":
            continue
        for ax, name in ((left, "attitude"), (right, "energy")):
            values = [None if x is None else abs(x) for x in row[name]]
            points = [(t, x) for t, x in zip(row["turns"], values) if x]
            if points and max(x for _, x in points) > 1e-14:
                (line,) = ax.loglog(*zip(*points), label=row["engine"])
                line.set_color(ENGINE_COLOURS.get(row["engine"], "#888888"))
    left.set_ylabel("attitude error [rad]")
    right.set_ylabel("relative change of the energy")
    right.set_ylim(1e-13, 1e2)
    for ax in (left, right):
        ax.set_xlabel("revolutions")
    left.legend()
    return figure


def save(figure, path: Path) -> Path:
    """Write a figure atomically, without metadata that change from run to run."""
    import matplotlib.pyplot as plt

    from polhode._atomic import atomic_write

    path.parent.mkdir(parents=True, exist_ok=True)
    quiet = {"svg.hashsalt": "polhode", "svg.fonttype": "path"}
    with plt.rc_context(quiet), atomic_write(path) as partial:
        figure.savefig(partial, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)
    return path


def draw(paths: list[Path], folder: Path, suffix: str = ".svg") -> list[Path]:
    """Draw the figures of the results at ``paths`` into ``folder``; returns the files."""
    made = []
    for path in paths:
        report = read(path)
        if report["name"] in DRAWN:
            made.append(save(DRAWN[report["name"]](report), folder / f"{report['name']}{suffix}"))
    return made
