"""The results page, benchmarks/README.md, from the JSON in benchmarks/results only.

Each result is a section, whose title and text stand in ``SECTIONS``.
Most are shown by their own keys.
"""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks._report import RESULTS, ROOT, read

OURS = "polhode"
PEERS = ("heyoka", "diffrax", "SciPy closed form", "SciPy solve_ivp", "Numba", "MuJoCo")
LEVELS = (1e-3, 1e-6, 1e-9, 1e-12)
INTRODUCTION = """\
# Benchmarks

Written by `python -m benchmarks page` from the JSON in `benchmarks/results`; do not edit. Every
number here stands in one of those files, with the command that made it.

```sh
make bench                          # quick tables and figures into out/benchmarks
python -m benchmarks                # the same in full: hours on one core
python -m benchmarks.NAME           # one benchmark; --quick, --output FILE, --help
python -m benchmarks.truth --check  # compute the truth again with more digits and compare
```

Peers come from the dependency group `bench` (`pip install --group bench`); one that is not
installed is named as missing. The same bodies go to every program, drawn from a seed; programs
take turns, so that a machine whose speed changes shifts them all. Times are medians, without
compilation; errors are angles in radians against Taylor series of 40 digits
(`benchmarks/truth.py`), which use nothing of the package.

Every result names its commit: that of the measured code, with `-dirty` where it was changed; or for
older results, the commit that brought the file into the repository ("committed with"). Other pages
quote results between markers (`benchmarks/_quotes.py`); the same command writes them, and a test
compares them.
"""


# Numbers and tables


def number(value: float | None, unit: float = 1.0) -> str:
    """Three digits, or a dash."""
    if value is None:
        return "–"
    value = value / unit
    if value == 0:
        return "0"
    if 1e-2 <= abs(value) < 1e7:
        digits = f"{value:.3g}"
        return f"{float(digits):,.0f}" if abs(value) >= 100 else digits
    return f"{value:.1e}"


def cell(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(cell, value))
    if isinstance(value, float):
        return number(value)
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "–" if value is None else str(value)


def markdown(header: list[str], lines: Iterable[list[str]]) -> list[str]:
    """A table; columns after the first are right-aligned."""
    out = ["| " + " | ".join(header) + " |", "|---" + "|---:" * (len(header) - 1) + "|"]
    return [*out, *("| " + " | ".join(line) + " |" for line in lines), ""]


Column = str | tuple[str, float] | Callable[[dict], Any]
"""A key of the row; a key and the unit of the column; or a function of the row."""


def table(rows: Iterable[dict], columns: Mapping[str, Column]) -> list[str]:
    """A table of rows by the columns' titles."""

    def show(row: dict, column: Column) -> str:
        if callable(column):
            return cell(column(row))
        if isinstance(column, str):
            return cell(row.get(column))
        return number(row.get(column[0]), column[1])

    lines = [[show(row, column) for column in columns.values()] for row in rows]
    return markdown(list(columns), lines)


def source(report: dict) -> str:
    """The date and the commit of a result, or of a part of one (its ``origin``)."""
    date = report.get("date", "")
    if head := report.get("commit"):
        name, _, changed = head.partition("-")
        return f"{date}, commit `{name[:7]}`{' with uncommitted changes' if changed else ''}"
    if head := report.get("committed_with"):
        return f"{date}, committed with `{head[:7]}`"
    return f"{date}, commit unknown"


def command(report: dict) -> str:
    """The command of a result, its date and its commit."""
    return f"`{report['command']}`, {source(report)}"


def machine(report: dict) -> str:
    """One line on where and how a result was made."""
    about = report["machine"]
    versions = {k: v for k, v in report["versions"].items() if v and k != "equinox"}
    flags = f", `XLA_FLAGS={report['flags']}`" if report["flags"] else ""
    threads = report.get("threads")
    model = f" ({about['model']})" if about.get("model") else ""
    device = about.get("device", "cpu")
    model += "" if device == "cpu" else f" and one {device}"
    return (
        f"`{report['command']}` on {about['processor']}{model}, {about['system']},"
        f" {about.get('memory_GB', '?')} GB, {threads} core{'s' if threads != 1 else ''} of a"
        f" shared virtual machine{flags}; "
        + ", ".join(f"{name} {version}" for name, version in versions.items())
        + f"; {source(report)}."
    )


# Error against run time


def curves(rows: Iterable[dict]) -> dict[tuple[str, str], list[dict]]:
    """(peer, program) -> its rows, in their order."""
    groups: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        groups.setdefault((row["peer"], row["program"]), []).append(row)
    return groups


def is_default(row: dict) -> bool:
    """Whether a row is what the planner chooses."""
    return row["peer"] == OURS and row["program"].startswith("default")


def default_rows(table_: dict) -> list[dict]:
    """The rows of the planner's choice; it changes its method with the tolerance: one curve."""
    return [row for row in table_["rows"] if is_default(row)]


def time_at(rows: list[dict], level: float, error: str = "attitude_median") -> float | None:
    """Time [ns per body] of one program to reach an error; None where it never does.

    Interpolated between neighbouring settings on logarithmic scales, never extrapolated: where all
    settings are better than requested, the cheapest one counts.
    """
    points = [
        (max(row[error], 1e-17), row["ns_per_body"])
        for row in rows
        if row[error] is not None and not row["failed"]
    ]
    times = [time for value, time in points if value <= level]
    if not times:
        return None
    best = min(times)
    for left, right in itertools.pairwise(points):
        (high, cheap), (low, dear) = sorted((left, right), key=lambda p: -p[0])
        if low <= level < high and cheap < dear:
            share = math.log(level / high) / math.log(low / high)
            best = min(best, cheap * (dear / cheap) ** share)
    return best


def best(table_: dict, peer: str, level: float, error: str = "attitude_median") -> float | None:
    """Time of the best program of a peer at a level."""
    programs = curves(row for row in table_["rows"] if row["peer"] == peer)
    times = [time_at(group, level, error) for group in programs.values()]
    return min((time for time in times if time is not None), default=None)


def standing(table_: dict, error: str = "attitude_median") -> list[dict]:
    """Per level: our default's time, the best peer, its time, and peer over ours.

    ``ratio`` above 1: the default is faster than every peer; None where one of the two never
    reaches the level.
    """
    rows = default_rows(table_)
    others = curves(row for row in table_["rows"] if row["peer"] != OURS)
    levels = []
    for level in LEVELS:
        times = {key: time_at(group, level, error) for key, group in others.items()}
        times = {key: time for key, time in times.items() if time is not None}
        first = min(times, key=times.__getitem__, default=(None, None))
        ours, theirs = time_at(rows, level, error), times.get(first)
        ratio = theirs / ours if theirs and ours else None
        levels.append(
            {"level": level, "ours": ours, "peer": first[0], "program": first[1]}
            | {"peer_time": theirs, "ratio": ratio}
        )
    return levels


def heading(table_: dict) -> str:
    kind = "" if table_["dtype"] == "float64" else f", {table_['dtype']}"
    return f"{table_['title']}, N = {table_['bodies']:,}{kind}"


def merged() -> dict | None:
    """The work-precision results, one file or one per family, as one."""
    reports = [read(path) for path in sorted(RESULTS.glob("work_precision*.json"))]
    if not reports:
        return None
    runs = {(r["date"], str(sorted(r["machine"].items())), r.get("commit")) for r in reports}
    if len(runs) > 1:
        raise ValueError("work_precision*.json are of several commits, machines or days: run again")
    from benchmarks.problems import PROBLEMS

    order = list(PROBLEMS)
    tables = [t for report in reports for t in report["numbers"]["tables"]]
    tables.sort(key=lambda t: (order.index(t["family"]), t["dtype"], t["bodies"]))
    missing = {k: v for report in reports for k, v in report["numbers"]["missing"].items()}
    numbers = {"tables": tables, "missing": missing}
    return reports[0] | {"reports": reports, "numbers": numbers}


def _ratio(at: dict) -> str:
    if at["ratio"] is not None:
        times = f"{number(at['ratio'])} x"
        return f"{times if at['ratio'] >= 1 else f'**{times}**'} {at['peer']}"
    if at["ours"] is not None:
        return "only polhode"
    return f"**only {at['peer']}**" if at["peer"] else "none"


def _standings(tables: list[dict], error: str) -> list[str]:
    """Per table and level: how many times as long the best peer takes, and which it is."""
    lines = [[heading(t), *map(_ratio, standing(t, error))] for t in tables]
    return markdown(["", *(f"{level:.0e} rad" for level in LEVELS)], lines)


def _peer_times(table_: dict) -> list[str]:
    """Time of every peer at every level."""
    lines = []
    groups = {"polhode (default)": default_rows(table_)}
    for row in table_["rows"]:
        if row["peer"] != OURS:
            groups.setdefault(row["peer"], []).append(row)
    for name, rows in groups.items():
        if not rows:
            continue
        programs = [rows] if name.startswith(OURS) else curves(rows).values()
        times = [[time_at(program, level) for program in programs] for level in LEVELS]
        times = [min((t for t in each if t is not None), default=None) for each in times]
        reached = min(row["attitude_median"] for row in rows)
        lines.append([name, *(number(time, 1e3) for time in times), f"{reached:.0e}"])
    levels = (f"{level:.0e}" for level in LEVELS)
    return markdown(["µs per body to reach", *levels, "best reached"], lines)


def _default_errors(tables: list[dict]) -> list[str]:
    """What the default reaches where it integrates, beside its tolerance."""
    rows = [
        row | {"table": heading(t), "method": row["program"].removeprefix("default: ")}
        for t in tables
        for row in default_rows(t)
        if row["setting"] != "exact"
    ]
    columns: dict[str, Column] = {"": "table", "method": "method", "rtol": "setting"}
    columns |= {
        "median error [rad]": "attitude_median",
        "worst error [rad]": "attitude_worst",
        "time [µs/body]": ("ns_per_body", 1e3),
    }
    return table(rows, columns) if rows else []


def faster_peers(tables: list[dict]) -> list[str]:
    """Where a peer is faster than the default, in words."""
    lines = []
    for table_ in tables:
        for error, body in (("attitude_median", "median"), ("attitude_worst", "worst")):
            for at in standing(table_, error):
                place = f"{at['level']:.0e} rad ({body} body)"
                if at["ratio"] is not None and at["ratio"] < 1:
                    lines.append(
                        f"- {heading(table_)}: {at['peer']} ({at['program']}) reaches {place} in"
                        f" {number(at['peer_time'], 1e3)} µs per body, polhode's default in"
                        f" {number(at['ours'], 1e3)} µs."
                    )
                elif at["ours"] is None and at["peer"] is not None:
                    lines.append(
                        f"- {heading(table_)}: polhode's default does not reach {place} at the"
                        f" settings run; {at['peer']} does."
                    )
    return lines or ["- In no table of the last full run, at the levels above."]


def _compile_times(tables: list[dict]) -> str:
    """Range of compile times per peer."""
    spans: dict[str, list[float]] = {}
    for row in itertools.chain.from_iterable(table_["rows"] for table_ in tables):
        if row["compile_s"] is not None:
            spans.setdefault(row["peer"], []).append(row["compile_s"])
    words = [f"{name} {min(x):.2f} to {max(x):.1f} s" for name, x in spans.items()]
    return (
        f"- Compilation, per program: {'; '.join(words)} (least: compiled before in the same run);"
        " SciPy and MuJoCo compile nothing."
    )


def details(summary: str, lines: list[str]) -> list[str]:
    return [f"<details><summary>{summary}</summary>", "", *lines, "</details>", ""]


def work_precision(report: dict) -> list[str]:
    tables = report["numbers"]["tables"]
    every_peer = [line for t in tables for line in (f"**{heading(t)}**", "", *_peer_times(t))]
    return [
        "## Error against run time",
        "",
        *(f"- {machine(each)}" for each in report["reports"]),
        *(f"- Missing: {name} ({why})." for name, why in report["numbers"]["missing"].items()),
        "",
        "![error against time per body](results/work_precision_all.svg)",
        "",
        "How many times as long as polhode's default the best peer takes until the median body's"
        " attitude error is below a level, and which peer that is. Interpolated between settings on"
        " logarithmic scales, never extrapolated; an exact method has one setting. In bold: the"
        " peer is faster, or the default does not get there at the settings run.",
        "",
        *_standings(tables, "attitude_median"),
        *details("The same for the worst body", _standings(tables, "attitude_worst")),
        *details("What the default reaches where it integrates", _default_errors(tables)),
        *details("Every peer", every_peer),
        "## Where others are better",
        "",
        *faster_peers(tables),
        _compile_times(tables),
        "- MuJoCo simulates contacts and articulated bodies, heyoka any system of ODEs with event"
        " detection and 128-bit or longer arithmetic, diffrax any equation in JAX; polhode does"
        " rotating rigid bodies only.",
        "",
    ]


# Sections of the other results


class Section(NamedTuple):
    """``about`` is formatted with the numbers. ``more`` renders the numbers; None: by their keys,
    those in ``keys`` only if it is not None.
    """

    title: str
    about: str = ""
    keys: tuple[str, ...] | None = None
    figure: str = ""
    more: Callable[[dict], list[str]] | None = None

    def lines(self, report: dict) -> list[str]:
        numbers = report["numbers"]
        lines = [f"## {self.title}", "", machine(report), ""]
        if self.about:
            lines += [self.about.format_map(numbers), ""]
        if self.figure:
            lines += [f"![{self.figure}](results/{report['name']}.svg)", ""]
        if self.more is not None:
            return lines + self.more(report)
        keys = numbers.keys() if self.keys is None else self.keys
        return lines + by_keys("", {key: numbers[key] for key in keys})


def by_keys(title: str, value: Any) -> list[str]:
    """Numbers under their own keys: rows of alike entries as tables, others as lists."""
    head = [f"**{title}**", ""] if title else []
    entries = list(value.values()) if isinstance(value, dict) else []
    if len(entries) > 1 and all(isinstance(entry, dict) for entry in entries):
        counts = Counter(k for entry in entries for k, v in entry.items() if _is_shown(v))
        if 2 * max(counts.values(), default=0) >= len(entries):  # entries that are alike
            value = [{"": name} | entry for name, entry in value.items()]
    if isinstance(value, list):
        if not (value and isinstance(value[0], dict)):
            return [f"- {title}: {cell(value)}", ""] if value and _is_shown(value) else []
        keys = dict.fromkeys(k for row in value for k, v in row.items() if _is_shown(v))
        return head + table(value, {key.replace("_", " "): key for key in keys})
    if not isinstance(value, dict):
        return [f"- {title}: {cell(value)}", ""]
    plain = {k: v for k, v in value.items() if not isinstance(v, dict | list)}
    lines = [f"- {k.replace('_', ' ')}: {cell(v)}" for k, v in plain.items()]
    lines = [*head, *lines, ""] if lines else []
    for key in value:
        if key not in plain and key != "origin":
            names = [title, "" if key == "rows" else key.replace("_", " ")]
            lines += by_keys(", ".join(filter(None, names)), value[key])
    return lines


def _is_shown(value: Any) -> bool:
    """Whether a value fits into a cell: a few numbers, or one."""
    if isinstance(value, list):
        return len(value) <= 8 and all(isinstance(x, int | float) for x in value)
    return not isinstance(value, dict)


def cold_tasks_table(report: dict) -> list[str]:
    """Tasks from a cold process; in bold where the other library is sooner or smaller."""
    from benchmarks.cold_tasks import TASKS

    def pair(key: str) -> Callable[[dict], str]:
        def show(row: dict) -> str:
            ours, theirs = row["polhode"], row["peer"] or {}
            other = number(theirs.get(key))
            if key in theirs and theirs[key] < ours[key]:
                other = f"**{other}**"
            return f"{number(ours.get(key))} / {other}"

        return show

    def errors(row: dict) -> str:
        both = (row["polhode"], row["peer"] or {})
        return " / ".join(f"{x['error']:.0e}" if "error" in x else "–" for x in both)

    return table(
        report["numbers"]["rows"],
        {
            "polhode / other": lambda r: (
                r["task"] + (f", {TASKS[r['task']][2]}" if r["peer"] else "")
            ),
            "first answer [s]": pair("first"),
            "second call [s]": pair("second"),
            "first answer with stored programs [s]": lambda r: r["polhode"].get("cached"),
            "memory [MB]": pair("memory"),
            "error": errors,
        },
    )


def controller_times(numbers: dict, dtype: str = "float64") -> list[str]:
    """Milliseconds of processor time to an error, polhode beside both solvers of diffrax."""
    from benchmarks.controllers import LEVELS as levels, level_times

    groups: dict[str, list[dict]] = {}
    for row in numbers["rows"]:
        if row["dtype"] == dtype:
            name = f"{row['activation']}, {row['bodies']:,} bodies"
            groups.setdefault(name, []).append(row)

    def show(rows: list[dict], level: float) -> str:
        ours, *others = level_times(rows, level).values()
        least = min((x for x in others if x is not None), default=None)
        is_behind = least is not None and (ours is None or least < ours)
        texts = [number(ours, 1e-3)]
        texts += [
            f"**{number(x, 1e-3)}**" if is_behind and x == least else number(x, 1e-3)
            for x in others
        ]
        return " / ".join(texts)

    lines = [[name, *(show(rows, level) for level in levels)] for name, rows in groups.items()]
    return markdown(["error below", *(f"{level:.0e} [ms]" for level in levels)], lines)


def controller_kinds(numbers: dict) -> list[str]:
    """Cost of value and gradient, error and memory by kind of controller."""
    columns: dict[str, Column] = {
        "controller": "kind",
        "parameters": "parameters",
        "value [ms]": ("value_s", 1e-3),
        "value and gradient [ms]": ("gradient_s", 1e-3),
        "ratio": "ratio",
        "error of the gradient": lambda r: f"{r['error']:.0e}",
        "compile [s]": "compile_s",
        "memory [MB]": "memory_MB",
    }
    return table(numbers["kinds"], columns)


def _controllers(report: dict) -> list[str]:
    numbers = report["numbers"]
    checks = "; ".join(
        f"{x['activation']} {x['along']:.0e} and {x['across']:.0e}" for x in numbers["checks"]
    )
    columns: dict[str, Column] = {
        "": lambda r: f"{r['activation']}, {r['bodies']:,} bodies, {r['dtype']}",
        "program": "program",
        "tolerance": "tolerance",
        "time [ms]": ("seconds", 1e-3),
        "error": "error",
        "compile [s]": "compile_s",
        "memory [MB]": "memory_MB",
    }
    return [
        "The reference differs from central differences of SciPy's DOP853, along the gradient and"
        f" along a random direction, by ({checks}) of its norm.",
        "",
        *controller_times(numbers),
        "The same in float32, errors included:",
        "",
        *controller_times(numbers, "float32"),
        "By kind of controller, 32 bodies, `rtol=1e-6`:",
        "",
        *controller_kinds(numbers),
        *details("Every tolerance", table(numbers["rows"], columns)),
    ]


def _engines(report: dict) -> list[str]:
    from benchmarks.engines import at_turns

    def after(turns: int) -> Callable[[dict], str]:
        def show(row: dict) -> str:
            angle, energy = at_turns(row, turns)
            return "–" if angle is None else f"{angle:.1e} / {energy:+.1e}"

        return show

    columns: dict[str, Column] = {
        "attitude error [rad] / change of the energy after": lambda r: f"{r['body']}: {r['engine']}"
    }
    columns |= {f"{turns:,} revolutions": after(turns) for turns in (1, 10, 100, 1000)}
    step = 1e3 * report["numbers"]["step"]
    return [
        f"Steps of {step:g} ms.",
        "",
        *table(report["numbers"]["rows"], columns | {"µs a step": "us_per_step"}),
    ]


def throws_table(rows: list[dict]) -> list[str]:
    """Simulated throws of each size of body."""

    def three(key: str) -> Callable[[dict], str]:
        return lambda row: " ".join(f"{value:.2f}" for value in row[key])

    columns: dict[str, Column] = {
        "size": lambda r: f"{r['size']:g}",
        "throws": "throws",
        "stated, %": three("std_percent"),
        "mean error over its deviation": three("mean_error_over_std"),
        "rms error over the bound": three("rms_error_over_bound"),
        "95 % hold": lambda r: f"{r['covered_percent_all']:.1f} %",
    }
    if "joint_rms_error_over_std" in rows[0]:
        joint = "40 throws together: rms error over the one stated"
        columns[joint] = three("joint_rms_error_over_std")
    return table(rows, columns)


def _rotation_stress(report: dict) -> list[str]:
    """One row for each conversion, and one for the worst of all Euler sequences."""
    groups: dict[str, dict[str, list]] = {}
    for row in report["numbers"]["rows"]:
        name = row["conversion"]
        if "Euler" in name.split() and "wxyz" in name.split():
            to_wxyz = name.startswith("Euler")
            name = "Euler (any sequence) → wxyz" if to_wxyz else "wxyz → Euler (any sequence)"
        values = groups.setdefault(name.replace("->", "→"), {})
        for column in ("value", "first", "second"):
            values.setdefault(f"{row['dtype']}: {column}", []).append(row[column])
    columns = [
        f"{dtype}: {c}" for dtype in ("float64", "float32") for c in ("value", "first", "second")
    ]
    lines = []
    for name, values in groups.items():
        worst = ["∞" if None in values[c] else f"{max(values[c]):.2f}" for c in columns]
        lines.append([name, *worst])
    titles = [
        c.replace("first", "first derivative").replace("second", "second derivative")
        for c in columns
    ]
    return markdown(["worst [eps]", *titles], lines)


def _torqued(report: dict) -> list[str]:
    """A table for each dtype: scenes and horizons against tolerances."""
    lines = []
    rows = report["numbers"]["rows"]
    for dtype in dict.fromkeys(row["dtype"] for row in rows):
        mine = [row for row in rows if row["dtype"] == dtype]
        levels = sorted({row["rtol"] for row in mine}, reverse=True)
        groups: dict[tuple, list[dict]] = {}
        for row in mine:
            groups.setdefault((row["scene"], row["horizon"]), []).append(row)
        body = []
        for (scene, horizon), group in groups.items():
            cells = [f"{scene}, t = {horizon:g} [{max(row['tame'] for row in group)}]"]
            for level in levels:
                both = [row for row in group if row["rtol"] == level]
                median, worst = (
                    number(max((row[key] or 0.0 for row in both), default=None))
                    for key in ("over_median", "over_worst")
                )
                flags = sum(row["flagged"] for row in both)
                cells.append(f"{median} / {worst}" + (f" ({flags} flagged)" if flags else ""))
            body.append(cells)
        lines += markdown([dtype, *(f"rtol {level:.0e}" for level in levels)], body)
    return lines


def _light_curves(report: dict) -> list[str]:
    numbers = report["numbers"]
    lines = by_keys("", {key: numbers.get(key, []) for key in ("speed", "summary", "eggs")})
    if real := numbers.get("real"):
        for run in real["toutatis"]:
            lines += by_keys(f"Toutatis 1992, seed {run['seed']}", run["solutions"][:4])
    return lines


def _scene_cost(report: dict) -> list[str]:
    """Cost of whole scenes, of single parts, and of reading a body."""
    numbers = report["numbers"]
    origin = numbers.get("origin", {}).get("rows", report)
    columns: dict[str, Column] = {
        "part": "part",
        "bodies": "bodies",
        "steps": "steps",
        "first call [s]": "first_call_s",
        "later call [ms]": "later_call_ms",
        "over the first row": "ratio",
    }
    files: dict[str, Column] = {
        "file": "file",
        "first read [s]": "first_read_s",
        "later read [ms]": "later_read_ms",
    }
    return [
        "Operations and bytes as the compiler counts them (the body of a loop once): what a scene"
        " does not need is not in its program. Times compare the rows of this table alone: the"
        " programs return whole trajectories, and the top, of moments (1, 2, 3) and with a centre"
        " of mass given as a vector, takes more steps and more work in each than the top of the"
        " other tables, of moments (1, 1.5, 2) and with a centre of mass on its third axis"
        f" ({command(origin)}, on {origin['machine']['processor']}; {numbers['bodies']:,} bodies).",
        "",
        *by_keys("", numbers["rows"]),
        "What a part costs: a satellite, and 50 of them, for an hour under the gravity gradient"
        " (first rows) and with one part more; 61 samples, `rtol=1e-6`. Processor time of one core:"
        " the first call contains tracing, compilation and run. Methods differ in the work of a"
        " step: torques on up to four bodies and scenes with switches take explicit steps of order"
        " 8 or 5, the others extrapolation.",
        "",
        *table(numbers["parts"], columns),
        "Reading the mass properties of one body: the first read by each reader, and a later one:",
        "",
        *table(numbers["files"], files),
    ]


SECTIONS = {
    "cold_tasks": Section(
        "Tasks from a cold process",
        "Seconds from the start of a process to the first answer, imports and compilation included;"
        " the second call in the same process; the first answer of a later process that finds"
        " compiled programs in JAX's persistent cache; the largest resident size. polhode / the"
        " other library; in bold where the other is sooner or smaller. The script of each task is"
        " in `benchmarks/cold_tasks.py`.",
        more=cold_tasks_table,
    ),
    "imports": Section(
        "Imports",
        "Least seconds of a new process over {runs} alternated runs, beside the libraries that"
        " polhode builds on.",
    ),
    "plain_calls": Section(
        "Plain calls",
        "`ph.simulate` as typed, with its checks and both times, beside the compiled program for"
        " the last state alone, at the default `rtol`, with the errors reached. Error against run"
        " time, above, interpolates to an error instead, and takes the time of one body from three."
        " Then free bodies by saved times, ns per body, and how far the most expensive lies above a"
        " straight line between its neighbours.",
    ),
    "first_calls": Section(
        "First calls",
        "Seconds of processor time of the first call and the first gradient of a new process"
        " without a cache of programs, one body; the stages are those of one program under"
        " `jax.jit`.",
    ),
    "gradients": Section(
        "Gradients",
        "Of a linear function of the final state by the moments of each body, or by what is named,"
        " to t = {horizon:g}; errors relative, against 40-digit solutions.",
    ),
    "controllers": Section(
        "Gradients through controllers",
        "The mean cost of bodies under a network of 1,411 parameters, differentiated by all of"
        " them; horizon {horizon:g} s. Errors are norms over that of the gradient, against polhode"
        " at `rtol=1e-11`. Least processor time of one core, of the tolerances that reach an error:"
        " polhode / diffrax Tsit5 / diffrax Dopri8; in bold where diffrax is faster or polhode does"
        " not get there.",
        more=_controllers,
    ),
    "fuzz": Section(
        "Every part against an independent integrator",
        "Random scenes of every part, alone and in pairs, moments, rates, gains and times over six"
        " decades, against SciPy's DOP853 restarted at every switch. Errors of attitudes and of"
        " derivatives (slopes) over `rtol`.",
        keys=("values", "slopes", "parts"),
    ),
    "conservation": Section(
        "Energy and angular momentum over many revolutions",
        "One body by `ph.simulate` with its defaults (but for `max_steps`): relative change of the"
        " energy, and of the components of the angular momentum that the scene conserves, the"
        " largest up to each number of revolutions. Integrated motions accumulate the error that"
        " `rtol` allows.",
    ),
    "scene_cost": Section(
        "Cost of each kind of scene",
        more=_scene_cost,
    ),
    "accelerator": Section(
        "Accelerators",
        "Free bodies, tops and satellites on a GPU or TPU, with the shares of its memory bandwidth"
        " and arithmetic peak (those that two small programs reach), beside diffrax: `python -m"
        ' benchmarks.accelerator`, or with `--quick` in a minute or two. The result is "not run"'
        " where JAX finds no accelerator. Where `equal error` is false, no tolerance of diffrax"
        " reaches the error of polhode in that precision.",
    ),
    "scaling": Section(
        "Scaling",
        figure="time and memory against bodies, horizon and saved times",
    ),
    "identification": Section("Identification", figure="errors over the bound, cover, times"),
    "throws": Section(
        "Throws with a flywheel",
        "Real recordings (TU Delft, arXiv:2503.13137; not part of the project); every throw alone,"
        " the instrument known from all, or those of a configuration together. Errors where the"
        " reference is known, means over throws.",
        keys=("every_throw_alone", "throws_of_a_configuration_together"),
    ),
    "throws_synthetic": Section(
        "Simulated throws",
        "Bodies of 1 to 30 times the inertia of the TU Delft device, each throw alone, with the"
        " noise that 40 of every 120 show; three principal moments.",
    ),
    "throw_design": Section(
        "Information of a throw by its design",
        "Geometric mean of the standard deviations of the tensor after one throw, from the"
        " log-determinant of `benchmarks.throws.throw_information`: by direction of a spin of 18"
        " rad/s, and by the program of the wheel.",
        keys=(),
        figure="information of a throw by spin and by program",
    ),
    "satellites": Section(
        "Satellites with a wheel",
        "Mean relative error of the tensor from 60 s of rates at 10 Hz with noise of 1e-4 rad/s;"
        " satellites and the wheel's program are assumed (`benchmarks/satellites.py`).",
    ),
    "light_curves": Section(
        "Light curves",
        "Synthetic tumblers: how the fit from the light alone ends (see the top of"
        " `benchmarks/light_curves.py`), and bodies that are no ellipsoids (`eggs`).",
        more=_light_curves,
    ),
    "light_curves_unseen": Section(
        "Light curves of other bodies",
        "{curves} light curves of convex polyhedra, whose shapes, motions and light do not come"
        " from the package (see the top of `benchmarks/light_curves_unseen.py`), fitted with the"
        " default settings; periods in hours.",
        keys=(
            "commits",
            "tumblers",
            "others",
            "period_errors_over_stated",
            "processor_seconds",
            "not_right",
        ),
    ),
    "racquet": Section(
        "Tosses of a racquet",
        "Real recordings of a phone's gyroscope (University of British Columbia,"
        " doi:10.14288/1.0448943; not part of the project). The trials of a round together; the"
        " seven of the first, fast spins about all axes, are not the free motion of one body, and"
        " those of the fourth are mostly fast, where the air matters. Standard deviations are those"
        " of white residuals, which these are not (the model lacks the air).",
    ),
    "stress": Section(
        "Stress suite of the exact free motion",
        "Errors against 50 digits in units of eps x max(1, angle turned): of the attitude in"
        " radians, of the rates relative to their size, of derivatives relative to the larger of"
        " the exact one and the natural size. Fast needles lose digits of the gradient in"
        " proportion to the ratio of their moments.",
        keys=("worst",),
        figure="errors of every body by family",
    ),
    "free_body": Section("The exact free motion"),
    "rotation_stress": Section(
        "Conversions of rotations",
        "Worst errors against 120 digits over random samples and samples at and near the identity,"
        " half turns, the ends of the angle ranges and every threshold, in units of eps: values"
        " relative to the rotation's angle where it is small, derivatives (forward and reverse)"
        " relative to the largest of the sample; of the Euler sequences the worst.",
        more=_rotation_stress,
    ),
    "torqued": Section(
        "Tolerance and error where something acts",
        "`method=None`, 24 bodies that share nothing (needles, discs, near-spheres; 1/32 to 8"
        " rad/s) in one batch, four of them alone too. Error over the larger of `rtol` and 4 eps"
        " angle^1.5, median and worst of the bodies whose attitude at the end depends on the start"
        " less than ten times as strongly as that of free rotation (how many, in brackets, of 24;"
        " no method can keep the others), worst of both ways of moving them. Truth: 80-bit Taylor"
        " series by heyoka.",
        more=_torqued,
    ),
    "engines": Section(
        "Physics engines beside the exact motion",
        "Free bodies of `polhode reference` at about 10 rad/s, without damping; a dash: the motion"
        " has diverged.",
        figure="attitude error and energy of physics engines",
        more=_engines,
    ),
}
"""By name of the benchmark, in the order of the page; others have their name only."""


# The pages


def names_on(text: str) -> list[str]:
    """The results that a page was written from."""
    return text.partition("<!-- results: ")[2].partition(" -->")[0].split()


def page(names: list[str] | None = None) -> str:
    """The text of benchmarks/README.md from the named results; None: from all."""
    names = [path.stem for path in sorted(RESULTS.glob("*.json"))] if names is None else names
    lines = [f"<!-- results: {' '.join(names)} -->", INTRODUCTION]
    if report := merged():
        lines += work_precision(report)
    names = [name for name in names if not name.startswith("work_precision")]
    for name in (*SECTIONS, *(name for name in names if name not in SECTIONS)):
        if name in names:
            report = read(name)
            lines += SECTIONS.get(name, Section(name.replace("_", " ").capitalize())).lines(report)
    return "\n".join(lines).rstrip() + "\n"


def readme_block() -> str:
    """The generated part of the README: a figure, two tables, the commands."""
    report = merged()
    if report is None:
        return ""
    lines = []
    for each in report["numbers"]["tables"]:
        rows = default_rows(each)
        is_integrated = any(row["setting"] != "exact" for row in rows)
        sizes = (1, 1000) if is_integrated else (1000,)
        if each["dtype"] != "float64" or each["bodies"] not in sizes:
            continue
        about = ", integrated" * is_integrated + ", one body" * (each["bodies"] == 1)
        cells = [each["title"] + about, number(time_at(rows, 1e-9), 1e3)]
        lines.append(cells + [number(best(each, peer, 1e-9), 1e3) for peer in PEERS])
    return "\n".join(
        [
            "![error against run time per body](benchmarks/results/work_precision.svg)",
            "",
            "Microseconds per body, on one core, for a median attitude error of 1e-9 rad at t = 100"
            " (1e5 in the last row), 1,000 bodies where none are named, float64, compiling apart; a"
            " dash: never reached, or not offered; rows that are not marked as integrated are"
            " closed forms in polhode:",
            "",
            *markdown(["", "polhode", *PEERS], lines),
            f"Made by `python -m benchmarks.work_precision` ({_runs(report)});"
            " quick tables by `make bench`; all results, other precisions and sizes, and where"
            " others are better: [benchmarks](benchmarks/README.md).",
            "",
            *_plain_calls_block(),
        ]
    )


def _runs(report: dict) -> str:
    """The sources of the merged results, each with its families."""
    groups: dict[str, list[str]] = {}
    for each in report["reports"]:
        families = dict.fromkeys(table_["family"] for table_ in each["numbers"]["tables"])
        groups.setdefault(source(each), []).extend(families)
    return "; ".join(f"{made}: {', '.join(families)}" for made, families in groups.items())


def _plain_calls_block() -> list[str]:
    """The cost of a user's calls, in a few rows."""
    if not (RESULTS / "plain_calls.json").exists():
        return []
    rows = [
        row
        for row in read("plain_calls")["numbers"]["rows"]
        if row["bodies"] == 1000 or (row["family"] == "heavy_top" and row["bodies"] == 1)
    ]
    columns: dict[str, Column] = {
        "": lambda r: f"{r['title']}, {r['bodies']:,} {'body' if r['bodies'] == 1 else 'bodies'}",
        "program": ("ns_bare", 1e3),
        "call": ("ns_plain", 1e3),
        "each of 100 saved times": ("ns_sample", 1e3),
        "median error": lambda r: f"{r['attitude_median']:.0e}",
    }
    return [
        "Cost of an ordinary call, `ph.simulate(scene, state, [0, 100])`, beside that of its"
        " compiled program for the last state, at the default `rtol`, microseconds per body"
        f" ({command(read('plain_calls'))}):",
        "",
        *table(rows, columns),
    ]


def write() -> list[Path]:
    """Write benchmarks/README.md and the quoted results in all pages; the files."""
    from benchmarks import _quotes

    target = ROOT / "benchmarks" / "README.md"
    target.write_text(page(), encoding="utf-8")
    written = [target]
    for path in _quotes.pages():
        text = path.read_text(encoding="utf-8")
        if _quotes.MARK.search(text):
            path.write_text(_quotes.fill(text), encoding="utf-8")
            written.append(path)
    return written
